//! Tests of LAS: what is written comes back, real files agree with another reader, headers that lie
//! are refused.

use std::io::Cursor;

use fnsf::flow::Point;
use fnsf::formats::{DenseFormat, FormatError, declared_rows, read_cloud, read_timed_cloud};

use crate::dense_file::dense_file as file;
use crate::real_data::real;
use crate::samples::points;

#[test]
fn what_is_written_comes_back_to_the_millimetre() {
    let points = points(500);
    let bytes = file(DenseFormat::Las, &points);
    let read = read_cloud(&bytes, Some("x.las")).expect("a cloud").points;
    assert_eq!(read.len(), points.len());
    for (read, written) in read.iter().flatten().zip(points.iter().flatten()) {
        assert!((read - written).abs() <= 0.52e-3, "{read} {written}");
    }
    assert_eq!(declared_rows(&bytes, None).expect("a header"), 500);
    let compressed = read_cloud(&file(DenseFormat::Laz, &points), None);
    let refused = compressed.expect_err("LAZ").to_string();
    assert!(refused.contains("compressed (LAZ)"), "{refused}");
}

#[test]
fn real_files_agree_with_another_reader() {
    for name in ["simple.las", "simple1_4.las", "extrabytes.las"] {
        let Some(bytes) = real(&format!("fixtures/{name}")) else {
            return;
        };
        let mut reader = las::Reader::new(Cursor::new(bytes.clone())).expect("a file");
        let theirs = reader.read_all().expect("points");
        let ours = read_timed_cloud(&bytes, Some(name)).expect(name);
        let found = theirs.x().zip(theirs.y()).zip(theirs.z());
        let found: Vec<Point> = found
            .map(|((x, y), z)| [x, y, z].map(|v| v as f32))
            .collect();
        assert_eq!(ours.cloud.points, found, "{name}");
        assert!(theirs.gps_time().is_some(), "{name}");
        // Minutes of a flight are no sweep.
        assert!(ours.times.is_none(), "{name}");
    }
}

/// A small file with some bytes of its header replaced.
fn lying(at: usize, value: &[u8]) -> FormatError {
    let mut bytes = file(DenseFormat::Las, &points(20));
    bytes[at..at + value.len()].copy_from_slice(value);
    read_cloud(&bytes, None).expect_err("a lie")
}

#[test]
fn headers_that_lie_are_refused_before_memory_is_taken() {
    for (at, value, said) in [
        (25, &[5][..], "version 1.5"),
        (24, &[2], "version 2."),
        (104, &[11], "point format 11"),
        (104, &[7], "points of format 7 have 36 bytes"),
        (105, &0_u16.to_le_bytes(), "have 26 bytes, its have 0"),
        (
            96,
            &u32::MAX.to_le_bytes(),
            "its points begin at byte 4294967295",
        ),
        (96, &0_u32.to_le_bytes(), "its points begin at byte 0"),
        (247, &u64::MAX.to_le_bytes(), "points are declared"),
        (247, &21_u64.to_le_bytes(), "21"),
        (131, &f64::NAN.to_le_bytes(), "a scale of its header is NaN"),
        (
            155,
            &f64::INFINITY.to_le_bytes(),
            "an offset of its header is inf",
        ),
        (155, &1e9_f64.to_le_bytes(), "out of range"),
    ] {
        let error = lying(at, value).to_string();
        assert!(error.contains(said), "{at}: {error}");
    }
}
