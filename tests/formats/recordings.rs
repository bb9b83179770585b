//! Tests of recordings of robots.
//!
//! The Python packages `mcap` and `mcap-ros2-support` wrote the files. Each has clouds of 40 points on one topic,
//! 0.1 s apart. Point 5 of every cloud is NaN. The files of ROS 2 have a second topic with texts.

use std::ops::ControlFlow;

use fnsf::formats::{FormatError, RecordedSweep, read_cloud, read_recording};

const ROS1_LZ4: &[u8] = include_bytes!("recordings/ros1_lz4.mcap");
const ROS2_ZSTD: &[u8] = include_bytes!("recordings/ros2_zstd.mcap");
const ROS2_PLAIN: &[u8] = include_bytes!("recordings/ros2_none.mcap");
const ALL: [(&[u8], &str, usize); 3] = [
    (ROS1_LZ4, "/velodyne", 2),
    (ROS2_ZSTD, "/lidar/top", 3),
    (ROS2_PLAIN, "/lidar/top", 3),
];

/// The stamp of the first sweep, nanoseconds.
const BEGAN_NS: u64 = 1_700_000_000_000_000_000;

type Sweeps = Vec<(String, Result<RecordedSweep, FormatError>)>;

fn sweeps(bytes: &[u8]) -> (Sweeps, Result<(), FormatError>) {
    let mut sweeps = Vec::new();
    let read = read_recording(bytes, |message| {
        sweeps.push((message.topic.to_owned(), message.sweep()));
        ControlFlow::Continue(())
    });
    (sweeps, read)
}

#[test]
fn clouds_of_ros_1_and_2_in_every_compression_are_read_with_their_times() {
    for (bytes, topic, count) in ALL {
        let (sweeps, read) = sweeps(bytes);
        read.expect("a whole recording");
        assert_eq!(sweeps.len(), count);
        for (index, (of, sweep)) in sweeps.into_iter().enumerate() {
            assert_eq!(of, topic);
            let sweep = sweep.expect("a sweep");
            assert_eq!(sweep.stamp_ns, BEGAN_NS + index as u64 * 100_000_000);
            assert_eq!((sweep.points.len(), sweep.dropped), (39, 1));
            let times = sweep.times.expect("times");
            for (row, (point, offset)) in sweep.points.iter().zip(&times.offsets_s).enumerate() {
                // Point 5 has no return.
                let place = if row < 5 { row } else { row + 1 };
                let [x, y, z] = [0.25 * place as f32, (place % 7) as f32 - 3.0, 0.5];
                assert_eq!(*point, [x + index as f32, y, z * index as f32]);
                assert!((offset - 0.0025 * place as f32).abs() < 1e-6, "{offset}");
            }
        }
    }
}

#[test]
fn a_recording_that_was_cut_off_gives_what_it_has_and_says_so() {
    for (bytes, _, count) in ALL {
        let mut most = 0;
        for length in 0..bytes.len() {
            let (sweeps, read) = sweeps(&bytes[..length]);
            assert!(sweeps.len() >= most, "{length}");
            most = sweeps.len();
            if let Err(error) = read {
                let words = error.to_string();
                assert!(
                    words.contains("middle of a record") || length < 8,
                    "{words}"
                );
            } else {
                assert_eq!(most, count);
            }
        }
    }
}

#[test]
fn a_changed_byte_is_read_or_refused_and_never_gives_a_point_that_is_not_finite() {
    for (bytes, ..) in ALL {
        for place in 0..bytes.len() {
            for change in [0x01, 0x80, 0xff] {
                let mut changed = bytes.to_vec();
                changed[place] ^= change;
                let (sweeps, _read) = sweeps(&changed);
                let points = sweeps.into_iter().filter_map(|(_, sweep)| sweep.ok());
                for point in points.flat_map(|sweep| sweep.points) {
                    assert!(point.iter().all(|value| value.is_finite()), "{place}");
                }
            }
        }
    }
}

/// A recording with one record.
fn recording(code: u8, content: &[u8]) -> Vec<u8> {
    let mut bytes = b"\x89MCAP0\r\n".to_vec();
    bytes.push(code);
    bytes.extend((content.len() as u64).to_le_bytes());
    bytes.extend(content);
    bytes
}

/// A chunk that declares this size.
fn chunk(size: u64, compression: &str, records: &[u8]) -> Vec<u8> {
    let mut chunk = vec![0; 16];
    chunk.extend(size.to_le_bytes());
    chunk.extend([0; 4]);
    chunk.extend((compression.len() as u32).to_le_bytes());
    chunk.extend(compression.as_bytes());
    chunk.extend((records.len() as u64).to_le_bytes());
    chunk.extend(records);
    chunk
}

#[test]
fn lies_about_sizes_are_refused_before_memory_is_taken() {
    let endless = {
        let mut bytes = recording(0x06, &[]);
        bytes[9..17].copy_from_slice(&u64::MAX.to_le_bytes());
        bytes
    };
    let many_zeros = lz4_flex::frame::FrameEncoder::new(Vec::new());
    let many_zeros = {
        use std::io::Write;
        let mut encoder = many_zeros;
        encoder.write_all(&vec![0; 100 << 20]).expect("memory");
        encoder.finish().expect("a frame")
    };
    for (bytes, said) in [
        (endless, "too large"),
        (
            recording(0x06, &chunk(u64::MAX, "lz4", &[0; 30])),
            "unfold to",
        ),
        (
            recording(0x06, &chunk(100 << 20, "lz4", &many_zeros)),
            "unfold to",
        ),
        (
            recording(0x06, &chunk(1 << 20, "lz4", &many_zeros)),
            "declares",
        ),
        (
            recording(0x06, &chunk(4, "bz2", &[0; 4])),
            "compressed by bz2",
        ),
        (recording(0x06, &chunk(4, "zstd", &[0; 4])), "damaged"),
        (recording(0x05, &[0; 22]), "not declared"),
    ] {
        let (sweeps, read) = sweeps(&bytes);
        let words = read.expect_err(said).to_string();
        assert!(sweeps.is_empty() && words.contains(said), "{words}");
    }
}

#[test]
fn chunks_that_are_small_one_by_one_and_names_without_end_are_refused() {
    let zeros = |size: usize| {
        use std::io::Write;
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(&vec![0; size]).expect("memory");
        encoder.finish().expect("a frame")
    };
    // Each unfolds to less than 32 MiB, and both to more. Nine zeros are a record of no kind that is read.
    let size = 9 * 2_300_000;
    let mut bytes = recording(0x06, &chunk(size as u64, "lz4", &zeros(size)));
    let again = bytes[8..].to_vec();
    bytes.extend(again);
    let (_, read) = sweeps(&bytes);
    let words = read.expect_err("a bomb").to_string();
    assert!(words.contains("unfold to 41400000"), "{words}");

    let long = "a".repeat(1 << 20);
    let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
    let schema = [&1_u16.to_le_bytes()[..], &text(&long)].concat();
    let channel = [&[1, 0, 1, 0][..], &text(&long), &text("cdr")].concat();
    for (code, body) in [(0x03, schema), (0x04, channel)] {
        let (_, read) = sweeps(&recording(code, &body));
        let words = read.expect_err("a long name").to_string();
        assert!(words.contains("a name of 1048576 bytes"), "{words}");
    }
}

#[test]
fn a_recording_is_no_cloud_and_the_error_says_what_to_do() {
    let refused = read_cloud(ROS2_ZSTD, Some("drive.mcap")).expect_err("a recording");
    assert!(refused.to_string().contains("fnsf unpack"), "{refused}");
}
