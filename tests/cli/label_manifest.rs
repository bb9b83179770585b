//! Tests of manifests as Parquet: every type of column that common writers use, and damaged files.

use std::sync::Arc;

use arrow_array::builder::{Float64Builder, ListBuilder};
use arrow_array::{
    ArrayRef, Int32Array, Int64Array, LargeStringArray, RecordBatch, StringArray, StringViewArray,
};
use bytes::Bytes;
use fnsf::label::{ManifestError, read_manifest};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::file::properties::WriterProperties;

const SWEEPS: [&str; 3] = ["a/0.pcd", "s3://lake/1.pcd", "a/2.pcd"];

fn file(columns: Vec<(&str, ArrayRef)>, compression: Compression) -> Bytes {
    let properties = WriterProperties::builder().set_compression(compression);
    written(columns, properties.build())
}

fn written(columns: Vec<(&str, ArrayRef)>, properties: WriterProperties) -> Bytes {
    let batch = RecordBatch::try_from_iter(columns).expect("columns");
    let mut out = Vec::new();
    let mut writer =
        ArrowWriter::try_new(&mut out, batch.schema(), Some(properties)).expect("a writer");
    writer.write(&batch).expect("written");
    writer.close().expect("closed");
    Bytes::from(out)
}

fn poses() -> ArrayRef {
    let mut list = ListBuilder::new(Float64Builder::new());
    for row in 0..3 {
        let pose = [
            1.0,
            0.0,
            0.0,
            f64::from(row),
            0.0,
            1.0,
            0.0,
            0.0,
            0.0,
            0.0,
            1.0,
            0.0,
        ];
        list.values().append_slice(&pose);
        list.append(true);
    }
    Arc::new(list.finish())
}

fn sweeps(compression: Compression) -> Bytes {
    file(
        vec![
            (
                "drive",
                Arc::new(LargeStringArray::from(vec!["d"; 3])) as ArrayRef,
            ),
            ("sweep", Arc::new(StringArray::from(SWEEPS.to_vec()))),
            (
                "timestamp_ns",
                Arc::new(Int64Array::from(vec![
                    100_000_000,
                    200_000_000,
                    300_000_000,
                ])),
            ),
            ("pose", poses()),
            ("weather", Arc::new(Int32Array::from(vec![1, 2, 3]))),
        ],
        compression,
    )
}

#[test]
fn sweeps_are_read_from_every_common_compression() {
    let zstd = Compression::ZSTD(ZstdLevel::default());
    for compression in [
        Compression::UNCOMPRESSED,
        Compression::SNAPPY,
        zstd,
        Compression::LZ4_RAW,
    ] {
        let drives = read_manifest(sweeps(compression), Some("/data")).expect("drives");
        assert_eq!(drives.len(), 1);
        let found: Vec<&str> = drives[0]
            .sweeps
            .iter()
            .map(|sweep| sweep.uri.as_str())
            .collect();
        assert_eq!(found, ["/data/a/0.pcd", "s3://lake/1.pcd", "/data/a/2.pcd"]);
        let last = &drives[0].sweeps[2];
        assert_eq!(last.pose.map(|pose| pose.translation.x), Some(2.0));
        assert!((last.time_s.expect("a time") - 0.3).abs() < 1e-9);
    }
}

#[test]
fn pairs_are_read_and_other_types_are_named() {
    let text = |values: [&str; 2]| Arc::new(StringViewArray::from(values.to_vec())) as ArrayRef;
    let columns = vec![
        ("source", text(["/a", "/b"])),
        ("target", text(["/b", "/c"])),
    ];
    let drives = read_manifest(file(columns, Compression::SNAPPY), None).expect("drives");
    assert_eq!(
        drives.iter().map(|drive| drive.key(0)).collect::<Vec<_>>(),
        ["a", "b"]
    );
    let numbers: ArrayRef = Arc::new(Int32Array::from(vec![1]));
    let wrong = read_manifest(file(vec![("sweep", numbers)], Compression::SNAPPY), None);
    let wrong = wrong.expect_err("numbers are no sweeps").to_string();
    assert!(wrong.contains("sweep has type Int32"), "{wrong}");
}

#[test]
fn a_pose_with_a_missing_number_is_refused() {
    let mut list = ListBuilder::new(Float64Builder::new());
    for number in 0..12 {
        list.values().append_option((number != 5).then_some(1.0));
    }
    list.append(true);
    let pose: ArrayRef = Arc::new(list.finish());
    let sweep: ArrayRef = Arc::new(StringArray::from(vec!["0.pcd"]));
    let columns = vec![("sweep", sweep), ("pose", pose)];
    let refused = read_manifest(file(columns, Compression::SNAPPY), None);
    let said = refused.expect_err("11 numbers").to_string();
    assert!(
        said.contains("row 1: a number of pose is missing"),
        "{said}"
    );
}

#[test]
fn damaged_tables_are_refused() {
    let whole = sweeps(Compression::SNAPPY);
    for length in (4..whole.len()).step_by(7) {
        let cut = read_manifest(whole.slice(..length), None);
        assert!(matches!(cut, Err(ManifestError::Unreadable(_))), "{length}");
    }
    // A changed byte may change a value or a name: what counts is that nothing ends the program.
    let mut state = 1_u64;
    for _ in 0..2000 {
        let mut bytes = whole.to_vec();
        for _ in 0..3 {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            let at = (state >> 33) as usize % bytes.len();
            bytes[at] ^= (state >> 25) as u8 | 1;
        }
        let _either = read_manifest(Bytes::from(bytes), None);
    }
}

#[test]
fn a_dictionary_that_claims_more_values_than_it_has_bytes_is_refused() {
    let mut bytes = sweeps(Compression::UNCOMPRESSED).to_vec();
    // The first page is the dictionary of drives: one value of five bytes.
    let header = [0x15, 4, 0x15, 10, 0x15, 10, 0x4c, 0x15, 2];
    assert_eq!(bytes[4..13], header);
    bytes[12] = 126;
    let error = read_manifest(Bytes::from(bytes), None).expect_err("63 values");
    assert!(error.to_string().contains("claims 63 values"), "{error}");
}

/// Replaces the number of rows of all row groups and columns in the footer, but not that of the file.
fn with_rows_of_groups(file: &[u8], from: [u8; 3], to: &[u8]) -> Bytes {
    let (body, end) = file.split_at(file.len() - 8);
    let length = u32::from_le_bytes([end[0], end[1], end[2], end[3]]) as usize;
    let (pages, footer) = body.split_at(body.len() - length);
    let mut places = footer.windows(3).enumerate();
    let mut places = places
        .by_ref()
        .filter(|(_, window)| *window == from)
        .map(|(place, _)| place);
    let of_file = places.next().expect("the rows of the file") + from.len();
    let mut changed = footer[..of_file].to_vec();
    let mut rest = &footer[of_file..];
    while let Some(place) = rest.windows(3).position(|window| window == from) {
        changed.extend(&rest[..place]);
        changed.extend(to);
        rest = &rest[place + from.len()..];
    }
    changed.extend(rest);
    let length = (changed.len() as u32).to_le_bytes();
    Bytes::from([pages, &changed, &length, b"PAR1"].concat())
}

#[test]
fn row_groups_that_claim_more_rows_than_the_file_are_refused() {
    let column = Arc::new(StringArray::from(vec!["a"; 100])) as ArrayRef;
    let file = file(vec![("other", column)], Compression::UNCOMPRESSED);
    // A number of 64 bits as a field of Thrift's compact protocol: 100, and 40 million.
    let (hundred, many) = ([0x16, 0xc8, 0x01], [0x16, 0x80, 0xd0, 0xa5, 0x26]);
    assert!(with_rows_of_groups(&file, hundred, &hundred) == file);
    let lies = with_rows_of_groups(&file, hundred, &many);
    let error = read_manifest(lies, None)
        .expect_err("more rows")
        .to_string();
    assert!(error.contains("more than the 100 rows"), "{error}");
}

#[test]
fn columns_stored_as_differences_are_refused_by_the_name_of_their_encoding() {
    let text: ArrayRef = Arc::new(StringArray::from(SWEEPS.to_vec()));
    let properties = WriterProperties::builder()
        .set_dictionary_enabled(false)
        .set_encoding(Encoding::DELTA_BYTE_ARRAY);
    let bytes = written(vec![("sweep", text)], properties.build());
    let error = read_manifest(bytes, None).expect_err("differences");
    assert!(error.to_string().contains("DELTA_BYTE_ARRAY"), "{error}");
}
