//! Tests of dense clouds: written in every format, read back as clouds and row by row.

use std::io::Cursor;
use std::path::Path;

use fnsf::flow::DenseCloud;
use fnsf::formats::{
    DENSE_FORMATS, DenseFormat, FormatError, read_cloud, read_intensity, write_dense,
};
use fnsf::picture::DenseColors;

use crate::samples::{pattern, points};

/// Rounding error of LAS: half of its step of one millimetre, plus the float32 error at 60 m.
const LAS_STEP_M: f64 = 0.0005 + 5e-6;

fn dense(count: usize) -> DenseCloud {
    DenseCloud {
        points: points(count),
        sweep: (0..count as u32).map(|row| row % 7).collect(),
        age: (0..count).map(|row| 3.0 - (row % 7) as f32).collect(),
        dynamic: pattern(count, 3),
        converged: pattern(count, 5).into_iter().map(|flag| !flag).collect(),
    }
}

fn file(format: DenseFormat, cloud: &DenseCloud) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_dense(format, cloud, None, &mut bytes).unwrap();
    bytes
}

#[test]
fn a_dense_cloud_reads_back_as_a_cloud() {
    let dense = dense(1000);
    for format in [DenseFormat::Npz, DenseFormat::Ply, DenseFormat::Pcd] {
        let cloud = read_cloud(&file(format, &dense), None).unwrap();
        assert_eq!(cloud.points, dense.points, "{format:?}");
        let empty = file(format, &DenseCloud::default());
        assert_eq!(read_cloud(&empty, None).unwrap().points.len(), 0);
    }
}

/// A row of ply and of pcd has 12 bytes of coordinates, 4 of the sweep index, 4 of the age, one byte per
/// mask, and the color: in ply red, green, blue, in pcd blue, green, red and 0.
#[test]
fn ply_and_pcd_rows_hold_sweep_age_masks_and_color() {
    let dense = dense(50);
    let colors = DenseColors::of(&dense);
    for (format, stride) in [(DenseFormat::Ply, 25), (DenseFormat::Pcd, 26)] {
        let bytes = file(format, &dense);
        let (header, rows) = bytes.split_at(bytes.len() - 50 * stride);
        for (row, bytes) in rows.chunks_exact(stride).enumerate() {
            assert_eq!(bytes[12..16], dense.sweep[row].to_le_bytes());
            assert_eq!(bytes[16..20], dense.age[row].to_le_bytes());
            let masks = [dense.dynamic[row], dense.converged[row]].map(u8::from);
            assert_eq!(bytes[20..22], masks);
            let [red, green, blue] = colors.color(row);
            match format {
                DenseFormat::Ply => assert_eq!(bytes[22..], [red, green, blue]),
                _ => assert_eq!(bytes[22..], [blue, green, red, 0]),
            }
        }
        let header = String::from_utf8_lossy(header).into_owned();
        for words in match format {
            DenseFormat::Ply => ["property uint sweep\nproperty float age\n", "uchar red\n"],
            _ => [
                "FIELDS x y z sweep age dynamic converged rgb\n",
                "SIZE 4 4 4 4 4 1 1 4\n",
            ],
        } {
            assert!(header.contains(words), "{header}");
        }
    }
}

#[test]
fn npz_arrays_have_the_types_that_they_are_documented_with() {
    let bytes = file(DenseFormat::Npz, &dense(9));
    let mut archive = zip::ZipArchive::new(Cursor::new(bytes)).unwrap();
    for (name, descr, shape) in [
        ("points", "<f4", "(9, 3)"),
        ("sweep", "<u4", "(9,)"),
        ("age", "<f4", "(9,)"),
        ("dynamic", "|b1", "(9,)"),
        ("converged", "|b1", "(9,)"),
    ] {
        let mut array = Vec::new();
        let mut member = archive.by_name(&format!("{name}.npy")).unwrap();
        std::io::copy(&mut member, &mut array).unwrap();
        let header = String::from_utf8_lossy(&array[10..74]).into_owned();
        assert!(header.contains(descr) && header.contains(shape), "{header}");
    }
}

#[test]
fn intensities_are_in_every_format() {
    let dense = dense(300);
    let intensity: Vec<f32> = (0..300).map(|row| (row % 256) as f32).collect();
    let written = |format, intensity: &[f32]| {
        let mut bytes = Vec::new();
        let written = write_dense(format, &dense, Some(intensity), &mut bytes);
        written.map(|()| bytes)
    };
    for (format, _, ending) in DENSE_FORMATS {
        let bytes = written(format, &intensity).unwrap();
        if format == DenseFormat::Laz {
            let mut reader = las::Reader::new(Cursor::new(bytes)).unwrap();
            let read = reader.read_all().unwrap();
            let read: Vec<f32> = read
                .points()
                .map(|p| f32::from(p.unwrap().intensity))
                .collect();
            assert_eq!(read[255], 65_535.0);
            continue;
        }
        let scale = if format == DenseFormat::Las {
            257.0
        } else {
            1.0
        };
        let expected: Vec<f32> = intensity.iter().map(|value| value * scale).collect();
        let read = read_intensity(&bytes, None).unwrap().expect("intensities");
        assert!(read == expected, "{ending}");
        assert!(read_cloud(&bytes, None).unwrap().points.len() == 300);
        // Without intensities there is no column of them. LAS always has one.
        let none = read_intensity(&file(format, &dense), None).unwrap();
        assert_eq!(none.is_some(), format == DenseFormat::Las, "{ending}");
    }
    let error = written(DenseFormat::Ply, &intensity[1..]).unwrap_err();
    assert!(matches!(error, FormatError::RowCount { .. }), "{error}");
    let unknown = [&intensity[1..], &[f32::NAN]].concat();
    let error = written(DenseFormat::Ply, &unknown).unwrap_err();
    assert!(error.to_string().contains("intensity"), "{error}");
}

#[test]
fn las_and_laz_come_back_through_another_reader() {
    let dense = dense(2000);
    let colors = DenseColors::of(&dense);
    for format in [DenseFormat::Laz, DenseFormat::Las] {
        let mut reader = las::Reader::new(Cursor::new(file(format, &dense))).unwrap();
        assert_eq!(reader.header().number_of_points(), 2000);
        let extra = &reader.header().vlrs()[0];
        assert_eq!(
            (extra.record_id, &extra.data[..8]),
            (4, &b"\0\0\x09\0age\0"[..])
        );
        let read = reader.read_all().unwrap();
        for (row, point) in read.points().enumerate() {
            let point = point.unwrap();
            let found = [point.x, point.y, point.z];
            for (found, written) in found.into_iter().zip(dense.points[row]) {
                assert!((found - f64::from(written)).abs() <= LAS_STEP_M, "{row}");
            }
            assert_eq!(u32::from(point.point_source_id), dense.sweep[row]);
            assert_eq!(point.extra_bytes, dense.age[row].to_le_bytes());
            assert_eq!(point.user_data == 1, dense.dynamic[row]);
            assert_eq!(point.is_withheld, !dense.converged[row]);
            let color = point.color.expect("a color");
            let found = [color.red, color.green, color.blue].map(|value| value / 257);
            assert_eq!(found, colors.color(row).map(u16::from));
        }
    }
    let laz = file(DenseFormat::Laz, &dense);
    assert_eq!(laz, file(DenseFormat::Laz, &dense), "the same bytes again");
    assert!(laz.len() < file(DenseFormat::Las, &dense).len());
    file(DenseFormat::Laz, &DenseCloud::default());
}

#[test]
fn a_sweep_past_sixteen_bits_is_refused_in_las_alone() {
    let mut dense = dense(3);
    dense.sweep[1] = 65_536;
    let error = write_dense(DenseFormat::Laz, &dense, None, &mut Vec::new()).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("row 1 has sweep 65536; write npz"), "{text}");
    file(DenseFormat::Npz, &dense);
}

#[test]
fn a_dense_cloud_that_no_reader_would_take_is_refused() {
    for (format, ..) in DENSE_FORMATS {
        let mut short = dense(4);
        short.converged.pop();
        let error = write_dense(format, &short, None, &mut Vec::new()).unwrap_err();
        assert!(matches!(error, FormatError::RowCount { .. }), "{error}");
        let mut lost = dense(4);
        lost.points[2][1] = f32::NAN;
        let error = write_dense(format, &lost, None, &mut Vec::new()).unwrap_err();
        assert!(
            matches!(error, FormatError::NotFinite { row: 2, .. }),
            "{error}"
        );
        let mut ageless = dense(4);
        ageless.age[3] = f32::INFINITY;
        assert!(write_dense(format, &ageless, None, &mut Vec::new()).is_err());
    }
}

#[test]
fn dense_formats_are_named_by_ending() {
    for (format, _, ending) in DENSE_FORMATS {
        let name = format!("out/dense.{}", ending.to_uppercase());
        assert_eq!(DenseFormat::from_path(Path::new(&name)).unwrap(), format);
        assert!(DenseFormat::KNOWN.contains(&format!(".{ending}")));
    }
    let error = DenseFormat::from_path(Path::new("dense.e57")).unwrap_err();
    assert!(
        error.to_string().contains("end it in one of .npz"),
        "{error}"
    );
}
