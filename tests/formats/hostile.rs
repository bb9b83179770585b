//! Files that lie, break off or are built to cost: refused by name, cheaply, without a panic.

use fnsf::formats::{FormatError, read_cloud, read_flow, read_pair};

use crate::samples::{feather, floats, npy, npz};

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
    let structured = refusal(&npy("[('x', '<f4')]", false, "(2,)", &[0; 64]));
    assert!(
        structured.to_string().contains("structured"),
        "{structured}"
    );
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
    assert!(named(b"\x89HDF\r\n\x1a\n").contains("HDF5"));
    assert!(named(b"LASF....").contains("LAS"));
    assert!(named(b"\x1f\x8b\x08").contains("gzip"));
    assert!(named(b"\x80\x04\x95").contains("pickle"));
    let error = read_cloud(b"hello", Some("a.ply")).unwrap_err().to_string();
    assert!(error.contains(".ply"), "{error}");
    assert!(read_flow(b"{\"flow\": [[1, 2]]}", None).is_err());
}
