//! Tests that written files are read back, and that common variants of each format are read.

use fnsf::flow::Point;
use fnsf::formats::{
    CloudFormat, FileKind, FlowFormat, FormatError, is_pair, read_av2_labels, read_cloud,
    read_flow, read_pair, read_timed_cloud, recognize, write_cloud, write_timed_pcd,
};

use crate::samples::{
    CLOUD_FORMATS, FLOW_FORMATS, cloud_file, feather, floats, flow_file, lzf_literals, npy, npz,
    objects, pair, pair_file, points,
};

/// Tolerance of a rotation that is converted to a quaternion and back in float64.
const SAME_EGO: f64 = 1e-12;

#[test]
fn a_cloud_comes_back_from_every_format() {
    let points = points(1000);
    for (format, ending) in CLOUD_FORMATS {
        let bytes = cloud_file(format, &points);
        let cloud = read_cloud(&bytes, Some(&format!("sweep.{ending}"))).unwrap();
        assert_eq!(cloud.points, points, "{ending}");
        assert_eq!(cloud.no_return, 0);
    }
}

#[test]
fn the_times_of_points_are_read_from_ply_pcd_and_feather() {
    let points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]];
    let mut pcd = Vec::new();
    write_timed_pcd(&points, &[0.0, 0.05, 0.1], &mut pcd).unwrap();
    let ply = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
        property uint t\nproperty float z\nend_header\n1 2 0 3\n4 5 50000000 6\n7 8 100000000 9\n";
    let column = |values: [f32; 3]| values.map(Some).to_vec();
    let axes = [0, 1, 2].map(|axis| column(points.map(|point| point[axis])));
    let [x, y, z] = axes;
    let times = column([-100.0, -50.0, 0.0]);
    let feather = feather(&[("x", x), ("y", y), ("z", z), ("time", times)]);
    for (bytes, first) in [(&pcd, 0.0), (&ply.to_vec(), 0.0), (&feather, -0.1)] {
        let read = read_timed_cloud(bytes, None).unwrap();
        assert_eq!(read.cloud.points, points);
        let times = read.times.expect("times");
        assert!((times.duration_s - 0.1).abs() < 1e-6);
        for (time, expected) in times.offsets_s.iter().zip([0.0, 0.05, 0.1]) {
            assert!((time - first - expected).abs() < 1e-6, "{time}");
        }
    }
    let untimed = read_timed_cloud(&cloud_file(CloudFormat::Npy, &points), None).unwrap();
    assert_eq!((untimed.times, untimed.refused_times), (None, None));
}

#[test]
fn rows_without_return_need_no_time() {
    let pcd =
        b"VERSION .7\nFIELDS x y z timestamp\nSIZE 4 4 4 8\nTYPE F F F F\nWIDTH 3\nHEIGHT 1\n\
        POINTS 3\nDATA ascii\n1 2 3 1600000000.0\nnan nan nan nan\n4 5 6 1600000000.1\n";
    let read = read_timed_cloud(pcd, None).unwrap();
    assert_eq!(read.cloud.no_return, 1);
    let times = read.times.expect("times");
    assert_eq!(times.offsets_s[1], 0.0);
    assert!((times.offsets_s[2] - 0.1).abs() < 1e-6);
    assert!((times.sweep_s.expect("a clock") - 1.6e9).abs() < 1e-6);
}

#[test]
fn an_empty_cloud_comes_back_where_the_format_can_say_so() {
    for (format, ending) in CLOUD_FORMATS {
        if format != CloudFormat::KittiBin {
            let bytes = cloud_file(format, &[]);
            assert_eq!(
                read_cloud(&bytes, None).unwrap().points.len(),
                0,
                "{ending}"
            );
        }
    }
}

#[test]
fn a_pair_comes_back_with_all_that_is_known() {
    let pair = pair(100);
    let bytes = pair_file(&pair);
    assert!(is_pair(&bytes));
    let mut read = read_pair(&bytes).unwrap();
    let ego = read.ego.take().unwrap();
    let difference = ego.to_homogeneous() - pair.ego.unwrap().to_homogeneous();
    assert!(difference.abs().max() < SAME_EGO);
    assert_eq!(read, fnsf::formats::Pair { ego: None, ..pair });
}

#[test]
fn a_pair_of_two_clouds_alone_is_enough() {
    let pair = fnsf::formats::Pair {
        source: points(5),
        target: points(7),
        ..Default::default()
    };
    assert_eq!(read_pair(&pair_file(&pair)).unwrap(), pair);
}

#[test]
fn the_same_pair_gives_the_same_bytes() {
    assert_eq!(pair_file(&pair(50)), pair_file(&pair(50)));
}

#[test]
fn a_flow_comes_back_from_every_format() {
    let pair = pair(500);
    let truth = pair.truth.clone().unwrap();
    for format in FLOW_FORMATS {
        let read = read_flow(&flow_file(format, &pair), None).unwrap();
        assert_eq!(read.flow, truth.flow, "{format:?}");
        if format == FlowFormat::Npy {
            assert_eq!((read.valid, read.dynamic), (None, None));
            assert_eq!(
                (read.cluster, read.confidence, read.moving),
                (None, None, None)
            );
        } else {
            let objects = objects(500);
            let whole = matches!(format, FlowFormat::Npz | FlowFormat::Json);
            assert_eq!(
                read.clusters,
                whole.then_some(objects.clusters),
                "{format:?}"
            );
            assert_eq!(read.ego.is_some(), whole, "{format:?}");
            if let Some(ego) = read.ego {
                let apart = ego.to_homogeneous() - pair.ego.unwrap().to_homogeneous();
                assert!(apart.amax() < 1e-12, "{format:?}");
            }
            assert_eq!(read.cluster, Some(objects.cluster), "{format:?}");
            assert_eq!(read.confidence, Some(objects.confidence), "{format:?}");
            assert_eq!(read.moving, Some(objects.moving), "{format:?}");
            assert_eq!(read.valid.as_ref(), Some(&truth.valid), "{format:?}");
            assert_eq!(read.dynamic, truth.dynamic, "{format:?}");
        }
    }
}

#[test]
fn json_and_npz_hold_the_clusters_themselves() {
    let pair = pair(50);
    let json: serde_json::Value =
        serde_json::from_slice(&flow_file(FlowFormat::Json, &pair)).unwrap();
    assert_eq!(
        json["clusters"][0],
        serde_json::json!({
            "points": 16, "dynamic": true, "center": [1.0, 2.0, 3.0], "size": [4.0, 2.0, 1.5],
            "yaw": 0.5, "velocity": [0.5, -0.25, 0.0], "yaw_rate": 0.125, "confidence": 0.75,
            "moving": 0.25,
        })
    );
    assert_eq!(json["clusters"].as_array().map(Vec::len), Some(2));

    let bytes = flow_file(FlowFormat::Npz, &pair);
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
    let mut array = |name: &str| {
        let mut bytes = Vec::new();
        let mut member = archive.by_name(&format!("{name}.npy")).unwrap();
        std::io::Read::read_to_end(&mut member, &mut bytes).unwrap();
        bytes
    };
    let centers = array("clusters_center");
    assert!(String::from_utf8_lossy(&centers).contains("'shape': (2, 3)"));
    assert!(centers.ends_with(&floats(&[1.0, 2.0, 3.0, 1.0, 2.0, 3.0])));
    assert!(array("clusters_velocity").ends_with(&floats(&[0.5, -0.25, 0.0, 0.0, 0.0, 0.0])));
    assert!(array("clusters_points").ends_with(&[16, 0, 0, 0, 16, 0, 0, 0]));
    assert!(array("clusters_dynamic").ends_with(&[1, 0]));
    assert!(array("clusters_yaw_rate").ends_with(&floats(&[0.125; 2])));
    assert!(array("clusters_confidence").ends_with(&floats(&[0.75; 2])));
    assert!(array("clusters_moving").ends_with(&floats(&[0.25; 2])));
}

#[test]
fn senseless_clusters_and_probabilities_are_refused_by_name() {
    let read = |key: &str| {
        let text = format!(r#"{{"flow":[[0,0,0]],{key}}}"#);
        read_flow(text.as_bytes(), None).unwrap_err().to_string()
    };
    assert!(read(r#""confidence":[1.5]"#).contains("confidence is 1.5"));
    assert!(read(r#""moving":[-0.5]"#).contains("moving is -0.5"));
    assert!(read(r#""cluster":[0,1]"#).contains("cluster"));
    let flow = npy("'<f4'", false, "(1, 3)", &floats(&[0.0; 3]));
    let half = npy("'<f4'", false, "(1,)", &floats(&[0.5]));
    let file = npz(&[("flow", &flow), ("cluster", &half)]);
    let error = read_flow(&file, None).unwrap_err().to_string();
    assert!(error.contains("cluster is 0.5"), "{error}");
}

#[test]
fn ply_and_pcd_flow_read_as_clouds_too() {
    let pair = pair(50);
    for format in [FlowFormat::Ply, FlowFormat::Pcd] {
        let cloud = read_cloud(&flow_file(format, &pair), None).unwrap();
        assert_eq!(cloud.points, pair.source);
    }
}

#[test]
fn a_feather_flow_reads_with_arrows_own_reader() {
    let bytes = flow_file(FlowFormat::Feather, &pair(50));
    let reader = arrow_ipc::reader::FileReader::try_new(std::io::Cursor::new(bytes), None).unwrap();
    let names: Vec<String> = reader
        .schema()
        .fields()
        .iter()
        .map(|field| field.name().clone())
        .collect();
    assert_eq!(
        names,
        [
            "flow_tx_m",
            "flow_ty_m",
            "flow_tz_m",
            "is_valid",
            "is_dynamic",
            "cluster",
            "confidence",
            "moving"
        ]
    );
    assert_eq!(
        reader.map(|batch| batch.unwrap().num_rows()).sum::<usize>(),
        50
    );
}

#[test]
fn flow_formats_are_named_by_ending() {
    let named = |name: &str| FlowFormat::from_path(std::path::Path::new(name));
    assert_eq!(named("out/flow.NPZ").unwrap(), FlowFormat::Npz);
    assert_eq!(named("flow.feather").unwrap(), FlowFormat::Feather);
    let error = named("flow.las").unwrap_err().to_string();
    assert!(
        error.contains("flow.las") && error.contains(".npz, .npy"),
        "{error}"
    );
    assert!(named("flow").is_err());
}

/// The same 2 x 3 points in the float types, byte orders and memory orders that numpy saves.
#[test]
fn npy_is_read_in_every_float_type_and_order() {
    let expected: Vec<Point> = vec![[1.0, 2.0, 3.0], [-4.0, 5.5, 6.0]];
    let rows = [1.0, 2.0, 3.0, -4.0, 5.5, 6.0_f64];
    let columns = [1.0, -4.0, 2.0, 5.5, 3.0, 6.0_f64];
    let halves = |big: bool, values: &[f64]| -> Vec<u8> {
        let bytes = |value: &f64| {
            let half = half::f16::from_f64(*value);
            if big {
                half.to_be_bytes()
            } else {
                half.to_le_bytes()
            }
        };
        values.iter().flat_map(bytes).collect()
    };
    let big = |values: &[f64]| -> Vec<u8> { values.iter().flat_map(|v| v.to_be_bytes()).collect() };
    let little =
        |values: &[f64]| -> Vec<u8> { values.iter().flat_map(|v| v.to_le_bytes()).collect() };
    let cases = [
        npy("'<f8'", false, "(2, 3)", &little(&rows)),
        npy("'>f8'", false, "(2, 3)", &big(&rows)),
        npy("'<f8'", true, "(2, 3)", &little(&columns)),
        npy("'>f2'", true, "(2, 3)", &halves(true, &columns)),
        npy("'<f2'", false, "(2, 3)", &halves(false, &rows)),
        npy("'<f4'", false, "(2, 3)", &floats(&rows.map(|v| v as f32))),
        npy(
            "'<f4'",
            false,
            "(2, 4)",
            &floats(&[1.0, 2.0, 3.0, 9.0, -4.0, 5.5, 6.0, 9.0]),
        ),
    ];
    for bytes in cases {
        assert_eq!(read_cloud(&bytes, None).unwrap().points, expected);
    }
}

#[test]
fn an_npz_has_one_cloud_if_one_array_can_be_it() {
    let cloud = npy("'<f4'", false, "(1, 3)", &floats(&[1.0, 2.0, 3.0]));
    let mask = npy("'|b1'", false, "(1,)", &[1]);
    let alone = npz(&[("whatever", &cloud), ("mask", &mask)]);
    assert_eq!(read_cloud(&alone, None).unwrap().points, [[1.0, 2.0, 3.0]]);
    let named = npz(&[("points", &cloud), ("normals", &cloud)]);
    assert_eq!(read_cloud(&named, None).unwrap().points.len(), 1);
    let two = read_cloud(&npz(&[("a", &cloud), ("b", &cloud)]), None).unwrap_err();
    assert!(
        matches!(two, FormatError::Ambiguous(_)) && two.to_string().contains("a, b"),
        "{two}"
    );
    let none = read_cloud(&npz(&[("mask", &mask)]), None).unwrap_err();
    assert!(none.to_string().contains("mask [1]"), "{none}");
    let pair = read_cloud(&pair_file(&pair(3)), None).unwrap_err();
    assert!(pair.to_string().contains("is a pair"), "{pair}");
}

#[test]
fn ascii_ply_with_lists_and_other_elements_is_read() {
    let text = "ply\r\nformat ascii 1.0\r\ncomment by hand\r\nelement camera 1\r\nproperty float f\r\n\
        property list uchar int ids\r\nelement vertex 2\r\nproperty list uchar int near\r\n\
        property double z\r\nproperty float x\r\nproperty uchar red\r\nproperty float y\r\n\
        element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n\
        3.5 2 7 8\r\n2 1 1 3.0 1.0 255 2.0\r\n0 6 4 0 5e0\r\n3 0 1 0\r\n";
    let cloud = read_cloud(text.as_bytes(), None).unwrap();
    assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
}

#[test]
fn big_endian_ply_with_lists_and_other_elements_is_read() {
    let mut bytes = b"ply\nformat binary_big_endian 1.0\nelement camera 2\nproperty ushort id\n\
        element vertex 2\nproperty list uchar short near\nproperty double x\nproperty float y\n\
        property float z\nend_header\n"
        .to_vec();
    bytes.extend([0, 1, 0, 2]);
    for (near, [x, y, z]) in [(2_u8, [1.0, 2.0, 3.0_f32]), (0, [4.0, 5.0, 6.0])] {
        bytes.push(near);
        bytes.extend(vec![9; usize::from(near) * 2]);
        bytes.extend(f64::from(x).to_be_bytes());
        bytes.extend([y, z].iter().flat_map(|value| value.to_be_bytes()));
    }
    let cloud = read_cloud(&bytes, None).unwrap();
    assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
}

fn pcd_header(data: &str) -> Vec<u8> {
    format!(
        "# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS intensity x y z ring\n\
         SIZE 1 4 4 8 2\nTYPE U F F F U\nCOUNT 2 1 1 1 1\nWIDTH 2\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA {data}\n"
    )
    .into_bytes()
}

#[test]
fn pcd_is_read_in_ascii_binary_and_compressed() {
    let expected: Vec<Point> = vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]];
    let mut ascii = pcd_header("ascii");
    ascii.extend(b"7 7 1 2 3 0\n8 8 4.0 5e0 6 1\n");
    assert_eq!(read_cloud(&ascii, None).unwrap().points, expected);

    let mut binary = pcd_header("binary");
    for [x, y, z] in &expected {
        binary.extend([7, 7]);
        binary.extend(floats(&[*x, *y]));
        binary.extend(f64::from(*z).to_le_bytes());
        binary.extend([0, 1]);
    }
    assert_eq!(read_cloud(&binary, None).unwrap().points, expected);

    let mut columns = vec![7, 7, 8, 8];
    columns.extend(floats(&[1.0, 4.0, 2.0, 5.0]));
    columns.extend([3.0_f64, 6.0].iter().flat_map(|value| value.to_le_bytes()));
    columns.extend([0, 1, 0, 2]);
    let packed = lzf_literals(&columns);
    let mut compressed = pcd_header("binary_compressed");
    compressed.extend(u32::try_from(packed.len()).unwrap().to_le_bytes());
    compressed.extend(u32::try_from(columns.len()).unwrap().to_le_bytes());
    compressed.extend(packed);
    assert_eq!(read_cloud(&compressed, None).unwrap().points, expected);
}

#[test]
fn pcd_rows_without_return_keep_their_place() {
    let points = [[1.0, 2.0, 3.0], [f32::NAN; 3], [4.0, 5.0, 6.0]];
    let cloud = read_cloud(&cloud_file(CloudFormat::Pcd, &points), None).unwrap();
    assert_eq!((cloud.points.len(), cloud.no_return), (3, 1));
    assert!(cloud.points[1][0].is_nan());
    assert_eq!(cloud.points[2], points[2]);
    for (format, ending) in CLOUD_FORMATS {
        if format != CloudFormat::Pcd {
            let error = write_cloud(format, &points, &mut Vec::new()).unwrap_err();
            assert!(
                matches!(error, FormatError::NotFinite { row: 1, .. }),
                "{ending}: {error}"
            );
        }
    }
}

#[test]
fn raw_floats_are_told_apart_by_name_and_then_by_what_fits() {
    let kitti = floats(&[1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.25]);
    assert_eq!(recognize(&kitti, None).unwrap(), FileKind::KittiBin);
    let nuscenes = floats(&[1.0, 2.0, 3.0, 40.0, 7.0, 4.0, 5.0, 6.0, 20.0, 31.0]);
    assert_eq!(
        recognize(&nuscenes, Some("a.bin")).unwrap(),
        FileKind::NuscenesBin
    );
    let cloud = read_cloud(&nuscenes, Some("sweep.pcd.bin")).unwrap();
    assert_eq!(cloud.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);

    let both = floats(&[0.0; 20]);
    let error = recognize(&both, Some("a.bin")).unwrap_err();
    assert!(matches!(error, FormatError::Ambiguous(_)), "{error}");
    assert!(error.to_string().contains("*.pcd.bin"), "{error}");
    assert_eq!(
        recognize(&both, Some("a.kitti.bin")).unwrap(),
        FileKind::KittiBin
    );
    assert_eq!(
        recognize(&both, Some("A.PCD.BIN")).unwrap(),
        FileKind::NuscenesBin
    );

    let error = recognize(&floats(&[1.0, 2.0, 3.0, 99.0]), None).unwrap_err();
    assert!(matches!(error, FormatError::Unrecognized(_)), "{error}");
}

#[test]
fn av2_labels_make_foreground_of_every_class_but_none() {
    let column = |values: &[f32]| values.iter().map(|value| Some(*value)).collect::<Vec<_>>();
    let bytes = feather(&[
        ("flow_tx_m", column(&[1.0, 2.0])),
        ("flow_ty_m", column(&[0.0, 0.0])),
        ("flow_tz_m", column(&[0.0, 0.0])),
        ("classes", column(&[0.0, 19.0])),
        ("dynamic", column(&[0.0, 1.0])),
        ("is_ground_0", column(&[1.0, 0.0])),
    ]);
    let labels = read_av2_labels(&bytes).unwrap();
    assert_eq!(labels.truth.flow, [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
    assert_eq!(labels.truth.valid, [true, true]);
    assert_eq!(labels.truth.foreground, Some(vec![false, true]));
    assert_eq!(labels.truth.dynamic, Some(vec![false, true]));
    assert_eq!(labels.ground, [true, false]);
}
