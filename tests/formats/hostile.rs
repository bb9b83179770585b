//! Tests of invalid, truncated and oversized files: refused by name, cheaply and without a panic.

use fnsf::flow::Point;
use fnsf::formats::{
    DenseFormat, FormatError, is_pair, read_av2_labels, read_cloud, read_flow, read_intensity,
    read_pair, read_timed_cloud, write_timed_pcd,
};
use proptest::prelude::*;

use crate::dense_file::dense_file as las_file;
use crate::samples::{
    CLOUD_FORMATS, FLOW_FORMATS, cloud_file, feather, floats, flow_file, lzf_literals, npy, npz,
    pair, pair_file, points,
};

fn refusal(bytes: &[u8]) -> FormatError {
    read_cloud(bytes, None).unwrap_err()
}

#[test]
fn object_arrays_are_refused_by_name() {
    let error = refusal(&npy("'|O'", false, "(2, 3)", &[0; 64]));
    assert!(matches!(error, FormatError::Unsupported { .. }));
    assert!(
        error
            .to_string()
            .contains("object arrays hold pickled Python and are refused")
    );
    let pickled = npy("'|O'", false, "(2,)", &[0; 64]);
    let error = refusal(&npz(&[("pcs", &pickled)]));
    assert!(error.to_string().contains("pickled Python"), "{error}");
    let structured = refusal(&npy("[('x', '<f4')]", false, "(2,)", &[0; 64]));
    assert!(
        structured.to_string().contains("structured"),
        "{structured}"
    );
}

#[test]
fn a_transposed_cloud_is_refused_with_what_to_do() {
    for (shape, floats) in [("(3, 65)", 195), ("(4, 1000)", 4000)] {
        for fortran in [false, true] {
            let refused = refusal(&npy("'<f4'", fortran, shape, &vec![0; floats * 4]));
            assert!(refused.to_string().contains("transposed"), "{refused}");
        }
    }
    // Few points with some features each are no transposed cloud.
    let few = npy("'<f4'", false, "(3, 64)", &[0; 3 * 64 * 4]);
    assert_eq!(read_cloud(&few, None).expect("a cloud").points.len(), 3);
}

#[test]
fn values_that_are_no_place_are_refused_by_row_and_column() {
    let at = |value: f32| {
        npy(
            "'<f4'",
            false,
            "(2, 3)",
            &floats(&[1.0, 2.0, 3.0, 4.0, value, 6.0]),
        )
    };
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let error = refusal(&at(value));
        let FormatError::NotFinite { row: 1, column, .. } = &error else {
            panic!("{error}");
        };
        assert_eq!(column, "y");
    }
    let error = refusal(&at(2e6));
    assert!(
        matches!(error, FormatError::OutOfRange { row: 1, .. }),
        "{error}"
    );
    assert!(
        error.to_string().contains("2000000 m is out of range"),
        "{error}"
    );
}

#[test]
fn a_column_with_a_time_that_is_not_finite_is_left_out_and_named() {
    let points = points(3);
    let mut bytes = Vec::new();
    write_timed_pcd(&points, &[0.0, f32::NAN, 0.1], &mut bytes).unwrap();
    let read = read_timed_cloud(&bytes, None).unwrap();
    assert_eq!((read.cloud.points, read.times), (points, None));
    assert!((read.clock.unwrap().duration_s - 0.1).abs() < 1e-6);
    let refused = read.refused_times.unwrap();
    assert!(
        refused.contains("column time is NaN or infinite in row 1"),
        "{refused}"
    );
}

#[test]
fn a_half_nan_pcd_row_is_refused() {
    let header =
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nPOINTS 1\nDATA ascii\n";
    let nan = read_cloud(format!("{header}nan nan nan\n").as_bytes(), None).unwrap();
    assert_eq!(nan.no_return, 1);
    let half = refusal(format!("{header}1 nan nan\n").as_bytes());
    assert!(
        matches!(half, FormatError::NotFinite { row: 0, .. }),
        "{half}"
    );
    let infinite = refusal(format!("{header}inf inf inf\n").as_bytes());
    assert!(
        matches!(infinite, FormatError::NotFinite { row: 0, .. }),
        "{infinite}"
    );
}

#[test]
fn missing_values_in_a_feather_column_are_refused() {
    let column = |first| vec![first, Some(2.0)];
    let bytes = feather(&[
        ("x", column(None)),
        ("y", column(Some(1.0))),
        ("z", column(Some(1.0))),
    ]);
    let error = refusal(&bytes);
    assert!(
        error.to_string().contains("column x has 1 missing values"),
        "{error}"
    );
}

#[test]
fn feather_columns_beside_the_coordinates_are_left_alone() {
    use std::sync::Arc;

    use arrow_array::{ArrayRef, Float32Array, NullArray, RecordBatch, StringArray};
    let axis = |value: f32| -> ArrayRef { Arc::new(Float32Array::from(vec![value, value + 1.0])) };
    let batch = RecordBatch::try_from_iter([
        ("x", axis(0.0)),
        ("nothing", Arc::new(NullArray::new(2)) as ArrayRef),
        ("y", axis(10.0)),
        (
            "note",
            Arc::new(StringArray::from(vec!["a", "b"])) as ArrayRef,
        ),
        ("z", axis(20.0)),
    ]);
    let batch = batch.expect("columns of one length");
    let mut bytes = Vec::new();
    let writer = arrow_ipc::writer::FileWriter::try_new(&mut bytes, &batch.schema());
    let mut writer = writer.expect("a writer");
    writer.write(&batch).expect("written");
    writer.finish().expect("finished");
    drop(writer);
    let cloud = read_cloud(&bytes, Some("cloud.feather")).expect("a cloud");
    assert_eq!(cloud.points, [[0.0, 10.0, 20.0], [1.0, 11.0, 21.0]]);
}

#[test]
fn a_pair_whose_parts_disagree_is_refused() {
    let cloud = |rows: usize| {
        npy(
            "'<f4'",
            false,
            &format!("({rows}, 3)"),
            &floats(&vec![1.0; rows * 3]),
        )
    };
    let (two, three) = (cloud(2), cloud(3));
    let error = read_pair(&npz(&[("pc1", &two), ("pc2", &two), ("flow", &three)])).unwrap_err();
    let expected = "flow has 3 rows where 2 are needed";
    assert_eq!(error.to_string(), expected);

    let identity = |scale: f64| -> Vec<f64> {
        (0..16)
            .map(|i| {
                if i % 5 == 0 {
                    if i == 15 { 1.0 } else { scale }
                } else {
                    0.0
                }
            })
            .collect()
    };
    let bytes = |values: Vec<f64>| -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    };
    let scaled = npy("'<f8'", false, "(4, 4)", &bytes(identity(1.1)));
    let error = read_pair(&npz(&[("pc1", &two), ("pc2", &two), ("ego_SE3", &scaled)])).unwrap_err();
    assert!(
        error.to_string().contains("not a rigid transform"),
        "{error}"
    );
    let rigid = npy("'<f8'", false, "(4, 4)", &bytes(identity(1.0)));
    assert!(read_pair(&npz(&[("pc1", &two), ("pc2", &two), ("ego_SE3", &rigid)])).is_ok());
}

#[test]
fn strangers_are_named() {
    let named = |bytes: &[u8]| refusal(bytes).to_string();
    assert!(named(b"").contains("empty"));
    assert!(named(b"sweeps/a.pcd").contains("write @ before the name"));
    assert!(named(b"LASF....").contains("las"));
    assert!(named(b"\x1f\x8b\x08").contains("gzip"));
    assert!(named(b"\x80\x04\x95").contains("pickle"));
    let error = read_cloud(b"hello", Some("a.ply")).unwrap_err().to_string();
    assert!(error.contains(".ply"), "{error}");
    assert!(read_flow(b"{\"flow\": [[1, 2]]}", None).is_err());
}

/// A small valid file of every kind, with its name.
fn every_valid_file() -> Vec<(String, Vec<u8>)> {
    let points = points(20);
    let pair = pair(20);
    let mut files: Vec<(String, Vec<u8>)> = CLOUD_FORMATS
        .into_iter()
        .map(|(format, ending)| (format!("cloud.{ending}"), cloud_file(format, &points)))
        .collect();
    for format in FLOW_FORMATS {
        files.push((format!("flow of {format:?}"), flow_file(format, &pair)));
    }
    files.push(("pair".to_owned(), pair_file(&pair)));
    files.push(("ascii ply".to_owned(), ascii_ply()));
    files.push(("ascii pcd".to_owned(), ascii_pcd()));
    files.push(("compressed pcd".to_owned(), compressed_pcd(&points)));
    files.push(("timed pcd".to_owned(), timed_pcd(&points)));
    files.push(("las".to_owned(), las_file(DenseFormat::Las, &points)));
    files
}

fn timed_pcd(points: &[Point]) -> Vec<u8> {
    let times: Vec<f32> = (0..points.len()).map(|row| row as f32 * 0.005).collect();
    let mut bytes = Vec::new();
    write_timed_pcd(points, &times, &mut bytes).unwrap();
    bytes
}

fn ascii_ply() -> Vec<u8> {
    b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
      property float z\nproperty list uchar int near\nend_header\n1 2 3 1 4\n4 5 6 0\n"
        .to_vec()
}

fn ascii_pcd() -> Vec<u8> {
    b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n\
      DATA ascii\n1 2 3\n4 5 6\n"
        .to_vec()
}

fn compressed_pcd(points: &[Point]) -> Vec<u8> {
    let column = |axis: usize| points.iter().map(move |point| point[axis]);
    let columns: Vec<f32> = (0..3).flat_map(column).collect();
    let columns = floats(&columns);
    let packed = lzf_literals(&columns);
    let mut bytes = format!(
        "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\n\
         DATA binary_compressed\n",
        points.len()
    )
    .into_bytes();
    bytes.extend((packed.len() as u32).to_le_bytes());
    bytes.extend((columns.len() as u32).to_le_bytes());
    bytes.extend(packed);
    bytes
}

/// Calls every reader. Returns whether any of them accepts the file.
fn read_all(bytes: &[u8], name: Option<&str>) -> bool {
    let cloud = read_cloud(bytes, name).is_ok();
    let timed = read_timed_cloud(bytes, name).is_ok();
    assert!(cloud || !timed, "times make no file a cloud");
    if let (Ok(cloud), Ok(Some(found))) = (read_cloud(bytes, name), read_intensity(bytes, name)) {
        let is_npz = bytes.starts_with(b"PK");
        assert!(
            is_npz || found.len() == cloud.points.len(),
            "intensities of all points"
        );
    }
    let flow = read_flow(bytes, name).is_ok();
    let pair = read_pair(bytes).is_ok() && is_pair(bytes);
    let labels = read_av2_labels(bytes).is_ok();
    cloud || flow || pair || labels
}

#[test]
fn every_valid_file_is_taken_whole() {
    for (name, bytes) in every_valid_file() {
        assert!(read_all(&bytes, None), "{name}");
    }
}

/// Raw floats cut between rows are valid shorter files. Text cut inside its last number or before
/// its last line feed may be valid. Every other cut must be detected.
#[test]
fn every_truncated_file_is_refused() {
    for (name, bytes) in every_valid_file() {
        if name.contains("bin") {
            continue;
        }
        let spare = if name.contains("ascii") || name.contains("Json") {
            2
        } else {
            0
        };
        for len in 0..bytes.len() - spare {
            assert!(
                !read_all(&bytes[..len], Some("a.dat")),
                "{name} cut at {len}"
            );
        }
    }
}

#[test]
fn no_single_changed_byte_panics_a_reader() {
    for (_, bytes) in every_valid_file() {
        let mut changed = bytes.clone();
        for index in 0..bytes.len() {
            for value in [
                0,
                1,
                0x7f,
                0x80,
                0xff,
                bytes[index] ^ 1,
                bytes[index].wrapping_add(1),
            ] {
                changed[index] = value;
                read_all(&changed, None);
            }
            changed[index] = bytes[index];
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn no_torn_and_spliced_file_panics_a_reader(
        file in 0_usize..15,
        cut in any::<prop::sample::Index>(),
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
        tail in prop::collection::vec(any::<u8>(), 0..32),
    ) {
        let files = every_valid_file();
        let mut bytes = files[file % files.len()].1.clone();
        for (index, value) in edits {
            let index = index.index(bytes.len());
            bytes[index] = value;
        }
        bytes.truncate(cut.index(bytes.len()) + 1);
        bytes.extend(tail);
        read_all(&bytes, None);
    }

    #[test]
    fn no_random_bytes_panic_a_reader(
        start in prop::sample::select(vec![
            &b""[..], b"\x93NUMPY\x01\x00", b"PK\x03\x04", b"ply\n", b"ARROW1\0\0", b"# .PCD", b"{\"",
        ]),
        rest in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        read_all(&[start, &rest].concat(), None);
    }
}
