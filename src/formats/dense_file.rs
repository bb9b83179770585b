//! Dense cloud files, written only: one row per point, with its sweep, age and flags.

use std::io::Write;

use super::error::{FileKind, FormatError, shorten};
use super::limits::{check_finite, check_points, check_value};
use super::npz::{Npz, NpzWriter};
use super::pair::check_count;
use super::sniff::ending;
use super::{las_write, npy, pcd, ply};
use crate::flow::DenseCloud;
use crate::picture::DenseColors;

/// The formats in which a dense cloud of M points is written. Positions are in metres, ages in
/// sweeps. All except LAZ can be read back as clouds. Ply, pcd, LAZ and LAS have the colors of
/// [`DenseColors`]. Where the sweeps have intensities, every format has them as well: as `intensity`
/// float32, in LAZ and LAS in 16 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DenseFormat {
    /// `points` M x 3 float32; M each: `sweep` uint32, `age` float32, `dynamic` bool, `converged`
    /// bool.
    Npz,
    /// Binary little endian: x y z float32, `sweep` uint32, `age` float32, `dynamic` and
    /// `converged` uint8; `red`, `green`, `blue` uint8.
    Ply,
    /// Binary, with the same fields as PLY; the color is packed into `rgb`.
    Pcd,
    /// LAS 1.4, compressed, with a resolution of 1 mm. The sweep is the point source id, the age
    /// the extra dimension `age` (float32). Bit 0 of the user data marks dynamic points. The
    /// withheld flag marks points that did not converge.
    Laz,
    /// As LAZ, not compressed.
    Las,
}

/// Every format with its media type and its file ending without dot; the first is the default.
pub const DENSE_FORMATS: [(DenseFormat, &str, &str); 5] = [
    (DenseFormat::Npz, "application/x-npz", "npz"),
    (DenseFormat::Ply, "application/x-ply", "ply"),
    (DenseFormat::Pcd, "application/x-pcd", "pcd"),
    (DenseFormat::Laz, "application/vnd.laszip", "laz"),
    (DenseFormat::Las, "application/vnd.las", "las"),
];

/// Whether `bytes` are an npz with a dense cloud rather than one sweep or a pair.
pub fn is_dense(bytes: &[u8]) -> bool {
    Npz::open(bytes).is_ok_and(|npz| {
        ["points", "sweep", "age", "dynamic"]
            .iter()
            .all(|name| npz.has(name))
    })
}

impl DenseFormat {
    /// The endings that [`DenseFormat::from_path`] accepts, as text for messages.
    pub const KNOWN: &'static str = ".npz, .ply, .pcd, .laz, .las";

    fn entry(self) -> &'static (Self, &'static str, &'static str) {
        let found = DENSE_FORMATS.iter().find(|(format, ..)| *format == self);
        found.unwrap_or(&DENSE_FORMATS[0])
    }

    /// The format's media type.
    pub fn media_type(self) -> &'static str {
        self.entry().1
    }

    /// The format's file ending, without dot.
    pub fn ending(self) -> &'static str {
        self.entry().2
    }

    /// The format of a file name's ending, in upper or lower case.
    ///
    /// # Errors
    /// `UnknownExtension` for any other name; it lists the known endings.
    pub fn from_path(path: &std::path::Path) -> Result<Self, FormatError> {
        let name = path
            .file_name()
            .map(|name| name.to_string_lossy())
            .unwrap_or_default();
        let wanted = ending(&name);
        DENSE_FORMATS
            .iter()
            .find(|(_, _, known)| *known == wanted)
            .map(|(format, ..)| *format)
            .ok_or_else(|| FormatError::UnknownExtension {
                name: shorten(&name),
                known: Self::KNOWN,
            })
    }

    fn kind(self) -> FileKind {
        match self {
            Self::Npz => FileKind::Npz,
            Self::Ply => FileKind::Ply,
            Self::Pcd => FileKind::Pcd,
            Self::Laz | Self::Las => FileKind::Las,
        }
    }
}

/// Writes a dense cloud of M points. `intensity` has M values, none where they are not known.
///
/// LAZ and LAS have intensities of 0 to 65,535. Ones of at most 1, and others of at most 255, are
/// scaled to that range.
///
/// # Errors
/// - `RowCount` where the cloud's lists differ in length.
/// - `NotFinite` for a coordinate, age or intensity that is NaN or infinite.
/// - `OutOfRange` for a coordinate over 1e6 m or an age over 1e6 sweeps in magnitude.
/// - `Unsupported` for a sweep index over 65,535 in LAS and LAZ.
/// - `Write` where writing to `out` fails, `Encode` where encoding fails.
pub fn write_dense(
    format: DenseFormat,
    cloud: &DenseCloud,
    intensity: Option<&[f32]>,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let count = cloud.points.len();
    check_count("sweep", cloud.sweep.len(), count)?;
    check_count("age", cloud.age.len(), count)?;
    check_count("dynamic", cloud.dynamic.len(), count)?;
    check_count("converged", cloud.converged.len(), count)?;
    let kind = format.kind();
    check_points(kind, "points", &cloud.points)?;
    for (row, &age) in cloud.age.iter().enumerate() {
        check_value(kind, row, "age", f64::from(age))?;
    }
    if let Some(values) = intensity {
        check_count("intensity", values.len(), count)?;
        for (row, &value) in values.iter().enumerate() {
            check_finite(kind, row, "intensity", f64::from(value))?;
        }
    }
    match format {
        DenseFormat::Npz => write_npz(cloud, intensity, out),
        DenseFormat::Ply => write_ply(cloud, intensity, out),
        DenseFormat::Pcd => write_pcd(cloud, intensity, out),
        DenseFormat::Laz => las_write::write(cloud, intensity, true, out),
        DenseFormat::Las => las_write::write(cloud, intensity, false, out),
    }
}

fn write_npz(
    cloud: &DenseCloud,
    intensity: Option<&[f32]>,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let mut npz = NpzWriter::new();
    npz.points("points", &cloud.points)?;
    npz.array("sweep", |out| npy::write_counts(out, &cloud.sweep))?;
    npz.values("age", &cloud.age)?;
    npz.mask("dynamic", &cloud.dynamic)?;
    npz.mask("converged", &cloud.converged)?;
    if let Some(intensity) = intensity {
        npz.values("intensity", intensity)?;
    }
    out.write_all(&npz.finish()?)?;
    Ok(())
}

fn write_ply(
    cloud: &DenseCloud,
    intensity: Option<&[f32]>,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let mut properties = vec![
        ("float", "x"),
        ("float", "y"),
        ("float", "z"),
        ("uint", "sweep"),
        ("float", "age"),
        ("uchar", "dynamic"),
        ("uchar", "converged"),
        ("uchar", "red"),
        ("uchar", "green"),
        ("uchar", "blue"),
    ];
    properties.extend(intensity.map(|_| ("float", "intensity")));
    let comment = "age is in sweeps, positive where a point was measured before";
    ply::write_header(out, cloud.points.len(), &[comment], &properties)?;
    write_rows(cloud, intensity, out, |[red, green, blue], row| {
        row.extend([red, green, blue]);
    })
}

fn write_pcd(
    cloud: &DenseCloud,
    intensity: Option<&[f32]>,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let mut fields = vec![
        ("x", 4, 'F'),
        ("y", 4, 'F'),
        ("z", 4, 'F'),
        ("sweep", 4, 'U'),
        ("age", 4, 'F'),
        ("dynamic", 1, 'U'),
        ("converged", 1, 'U'),
        ("rgb", 4, 'F'),
    ];
    fields.extend(intensity.map(|_| ("intensity", 4, 'F')));
    pcd::write_header(out, cloud.points.len(), &fields)?;
    write_rows(cloud, intensity, out, |color, row| {
        row.extend(pcd::rgb(color));
    })
}

/// Writes rows of point, sweep, age, flags, color and intensity, little endian.
fn write_rows(
    cloud: &DenseCloud,
    intensity: Option<&[f32]>,
    out: &mut dyn Write,
    push_color: impl Fn([u8; 3], &mut Vec<u8>),
) -> Result<(), FormatError> {
    let colors = DenseColors::of(cloud);
    const FLUSH_AT: usize = 64 << 10;
    let mut bytes = Vec::with_capacity(FLUSH_AT + 64);
    for (row, point) in cloud.points.iter().enumerate() {
        bytes.extend(point.iter().flat_map(|value| value.to_le_bytes()));
        bytes.extend(cloud.sweep[row].to_le_bytes());
        bytes.extend(cloud.age[row].to_le_bytes());
        bytes.push(u8::from(cloud.dynamic[row]));
        bytes.push(u8::from(cloud.converged[row]));
        push_color(colors.color(row), &mut bytes);
        if let Some(intensity) = intensity {
            bytes.extend(intensity[row].to_le_bytes());
        }
        if bytes.len() >= FLUSH_AT {
            out.write_all(&bytes)?;
            bytes.clear();
        }
    }
    out.write_all(&bytes)?;
    Ok(())
}
