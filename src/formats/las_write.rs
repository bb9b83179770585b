//! Writes LAS and LAZ, the formats of surveying.
//!
//! Version 1.4, point format 2, which has colors, with the age as an extra dimension.

use std::io::{Cursor, Write};

use las::point::Format;
use las::{Builder, Color, Point, Transform, Vector, Version, Vlr, Writer};

use super::error::{FileKind, FormatError};
use crate::flow::DenseCloud;
use crate::picture::DenseColors;

const KIND: FileKind = FileKind::Las;

/// Resolution of a coordinate, metres. With 32 bits the range is 2,147 km from the frame's origin.
const SCALE_M: f64 = 0.001;

/// Bit of the user data that marks a dynamic point.
const DYNAMIC: u8 = 1;

/// Bytes of a float32 extra dimension.
const AGE_BYTES: u16 = 4;

/// Writes M points, compressed or not. The same cloud gives the same bytes.
///
/// # Errors
/// `Unsupported` for sweep indices over 65,535, `Encode` and `Write` where writing fails.
pub(super) fn write(
    cloud: &DenseCloud,
    intensity: Option<&[f32]>,
    compressed: bool,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let encode = |error| KIND.encode(error);
    let mut builder = Builder::from(Version::new(1, 4));
    let step = Transform {
        scale: SCALE_M,
        offset: 0.0,
    };
    builder.transforms = Vector {
        x: step,
        y: step,
        z: step,
    };
    builder.point_format = Format {
        has_color: true,
        extra_bytes: AGE_BYTES,
        is_compressed: compressed,
        ..Format::default()
    };
    builder.system_identifier = "EXTRACTION".to_owned();
    builder.generating_software = "fnsf".to_owned();
    builder.vlrs.push(age_record());
    let header = builder.into_header().map_err(encode)?;
    let mut writer = Writer::new(Cursor::new(Vec::new()), header).map_err(encode)?;
    let colors = DenseColors::of(cloud);
    let scale = intensity.map_or(1.0, scale_to_16_bits);
    for (row, point) in cloud.points.iter().enumerate() {
        let [x, y, z] = point.map(f64::from);
        let sweep = cloud.sweep[row];
        let point_source_id = u16::try_from(sweep).map_err(|_| {
            KIND.unsupported(format!(
                "it numbers {} sweeps at most, row {row} has sweep {sweep}; write npz, ply or pcd",
                u32::from(u16::MAX) + 1
            ))
        })?;
        let point = Point {
            x,
            y,
            z,
            return_number: 1,
            number_of_returns: 1,
            user_data: if cloud.dynamic[row] { DYNAMIC } else { 0 },
            // The withheld flag is LAS's mark for a point that should not be used.
            is_withheld: !cloud.converged[row],
            point_source_id,
            intensity: intensity.map_or(0, |values| (values[row] * scale).round() as u16),
            color: Some(wide(colors.color(row))),
            extra_bytes: cloud.age[row].to_le_bytes().to_vec(),
            ..Point::default()
        };
        writer.write_point(point).map_err(encode)?;
    }
    out.write_all(writer.into_inner().map_err(encode)?.get_ref())?;
    Ok(())
}

/// The factor from the range of the intensities to 0 to 65,535. The range is 0 to 1 or 0 to 255 where no
/// value is larger, else that of LAS itself.
fn scale_to_16_bits(intensity: &[f32]) -> f32 {
    let largest = intensity.iter().copied().fold(0.0, f32::max);
    match largest {
        ..=1.0 => 65_535.0,
        ..=255.0 => 257.0,
        _ => 1.0,
    }
}

/// A color in 16 bits a channel.
fn wide([red, green, blue]: [u8; 3]) -> Color {
    let [red, green, blue] = [red, green, blue].map(|value| u16::from(value) * 257);
    Color { red, green, blue }
}

/// The variable-length record that names and types the extra bytes of every point.
fn age_record() -> Vlr {
    const EXTRA_BYTES_RECORD: u16 = 4;
    const DESCRIPTOR_BYTES: usize = 192;
    const FLOAT: u8 = 9;
    const TYPE_AT: usize = 2;
    const NAME_AT: usize = 4;
    const DESCRIPTION_AT: usize = 160;
    const NAME: &[u8] = b"age";
    const DESCRIPTION: &[u8] = b"sweeps since it was measured";
    let mut data = vec![0; DESCRIPTOR_BYTES];
    data[TYPE_AT] = FLOAT;
    data[NAME_AT..][..NAME.len()].copy_from_slice(NAME);
    data[DESCRIPTION_AT..][..DESCRIPTION.len()].copy_from_slice(DESCRIPTION);
    Vlr {
        user_id: "LASF_Spec".to_owned(),
        record_id: EXTRA_BYTES_RECORD,
        description: "extra dimensions".to_owned(),
        data,
    }
}
