//! Writes flows.

use std::io::Write;

use super::table::FLOW_AXES;
use super::table::FlowTable;
use super::{json, objects};
use crate::formats::error::{FileKind, FormatError, shorten};
use crate::formats::feather::{FLOW_COLUMNS, Values};
use crate::formats::limits::check_points;
use crate::formats::motion::matrix_rows;
use crate::formats::npz::NpzWriter;
use crate::formats::pair::check_count;
use crate::formats::sniff::ending;
use crate::formats::{feather, npy, pcd, ply};
use crate::picture::{INVALID_COLOR, color, full_scale, shown_motion};

/// The formats that flow is written in. Displacements are in metres. `dynamic`, `ego`, `cluster`,
/// `confidence`, `moving` and the clusters are written only where they are known, and only by the formats
/// that list them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FlowFormat {
    /// Arrays `flow` N x 3 float32, `valid` and `dynamic` bool, `ego` 4 x 4 float64
    /// (`target_from_source`, row by row, translation in metres), `cluster` int32, `confidence`
    /// and `moving` float32.
    ///
    /// The K clusters are arrays of K rows:
    /// - `clusters_points` uint32, `clusters_dynamic` bool.
    /// - K x 3 float32: `clusters_center` (metres), `clusters_size` (length, width and height in
    ///   metres) and `clusters_velocity` (m/s).
    /// - float32: `clusters_yaw` (radians), `clusters_yaw_rate` (rad/s), `clusters_confidence` and
    ///   `clusters_moving` (0 to 1).
    Npz,
    /// The displacements alone, N x 3 float32.
    Npy,
    /// Argoverse 2's columns `flow_tx_m`, `flow_ty_m` and `flow_tz_m`, float32. Also `is_valid` and
    /// `is_dynamic` bool, `cluster` int32, `confidence` and `moving` float32. LZ4-compressed.
    Feather,
    /// Binary little endian: source points x y z (metres) and `flow_x`, `flow_y`, `flow_z`,
    /// float32. Then `valid` and `dynamic` uint8, `cluster` int32, `confidence` and `moving` float32, and a
    /// color by direction of motion, `red`, `green`, `blue`, uint8.
    Ply,
    /// Binary, with the fields of PLY; the color is packed into `rgb`.
    Pcd,
    /// An object with `flow`, `valid`, `dynamic`, `ego` (null where unknown), `cluster`,
    /// `confidence`, `moving`, `clusters`.
    Json,
}

impl FlowFormat {
    /// The endings that [`FlowFormat::from_path`] accepts, as text for messages.
    pub const KNOWN: &'static str = ".npz, .npy, .feather, .ply, .pcd, .json";

    /// The format of a file name's ending, in upper or lower case.
    ///
    /// # Errors
    /// `UnknownExtension` for any other name; it lists the known endings.
    pub fn from_path(path: &std::path::Path) -> Result<Self, FormatError> {
        let name = path
            .file_name()
            .map(|name| name.to_string_lossy())
            .unwrap_or_default();
        Self::from_extension(&ending(&name)).map_err(|_| FormatError::UnknownExtension {
            name: shorten(&name),
            known: Self::KNOWN,
        })
    }

    /// The format of an ending, with or without its dot, in upper or lower case.
    ///
    /// # Errors
    /// `UnknownExtension` for any other ending; it lists the known ones.
    pub fn from_extension(extension: &str) -> Result<Self, FormatError> {
        let bare = extension
            .strip_prefix('.')
            .unwrap_or(extension)
            .to_ascii_lowercase();
        Ok(match bare.as_str() {
            "npz" => Self::Npz,
            "npy" => Self::Npy,
            "feather" => Self::Feather,
            "ply" => Self::Ply,
            "pcd" => Self::Pcd,
            "json" => Self::Json,
            _ => {
                let name = shorten(extension);
                return Err(FormatError::UnknownExtension {
                    name,
                    known: Self::KNOWN,
                });
            }
        })
    }

    fn kind(self) -> FileKind {
        match self {
            Self::Npz => FileKind::Npz,
            Self::Npy => FileKind::Npy,
            Self::Feather => FileKind::Feather,
            Self::Ply => FileKind::Ply,
            Self::Pcd => FileKind::Pcd,
            Self::Json => FileKind::Json,
        }
    }
}

/// Writes a flow of N rows.
///
/// The source points are not checked: they may be NaN. The clusters and probabilities are not checked
/// either, and must be finite to be read back.
///
/// # Errors
/// - `RowCount` where the table's lists differ in length.
/// - `NotFinite` for a displacement that is NaN or infinite, and `OutOfRange` for one over 1e6 m
///   along an axis, also in rows that are not valid.
/// - `Write` where writing to `out` fails. For feather this is `Encode`, as is a failure to encode.
pub fn write_flow(
    format: FlowFormat,
    table: &FlowTable<'_>,
    out: &mut dyn Write,
) -> Result<(), FormatError> {
    let count = table.source.len();
    check_count("flow", table.flow.len(), count)?;
    check_count("valid", table.valid.len(), count)?;
    if let Some(dynamic) = table.dynamic {
        check_count("dynamic", dynamic.len(), count)?;
    }
    if let Some(objects) = table.objects {
        check_count("cluster", objects.cluster.len(), count)?;
        check_count("confidence", objects.confidence.len(), count)?;
        check_count("moving", objects.moving.len(), count)?;
    }
    check_points(format.kind(), "flow", table.flow)?;
    match format {
        FlowFormat::Npz => write_npz(table, out),
        FlowFormat::Npy => npy::write_points(out, table.flow),
        FlowFormat::Feather => write_feather(table, out),
        FlowFormat::Ply => write_ply(table, out),
        FlowFormat::Pcd => write_pcd(table, out),
        FlowFormat::Json => json::write(table, out),
    }
}

fn write_npz(table: &FlowTable<'_>, out: &mut dyn Write) -> Result<(), FormatError> {
    let mut npz = NpzWriter::new();
    npz.points("flow", table.flow)?;
    npz.mask("valid", table.valid)?;
    if let Some(dynamic) = table.dynamic {
        npz.mask("dynamic", dynamic)?;
    }
    if let Some(ego) = table.ego {
        npz.matrix("ego", &matrix_rows(ego))?;
    }
    if let Some(found) = table.objects {
        objects::put(found, &mut npz)?;
    }
    out.write_all(&npz.finish()?)?;
    Ok(())
}

fn write_feather(table: &FlowTable<'_>, out: &mut dyn Write) -> Result<(), FormatError> {
    let axis = |axis: usize| -> Values<'_> {
        Values::Floats(Box::new(table.flow.iter().map(move |flow| flow[axis])))
    };
    let [x, y, z] = FLOW_COLUMNS;
    let mut columns = vec![(x, axis(0)), (y, axis(1)), (z, axis(2))];
    columns.push(("is_valid", Values::Flags(table.valid)));
    if let Some(dynamic) = table.dynamic {
        columns.push(("is_dynamic", Values::Flags(dynamic)));
    }
    if let Some(objects) = table.objects {
        columns.push(("cluster", Values::Ids(&objects.cluster)));
        for (name, probabilities) in [
            ("confidence", &objects.confidence),
            ("moving", &objects.moving),
        ] {
            let probabilities = probabilities.iter().copied();
            columns.push((name, Values::Floats(Box::new(probabilities))));
        }
    }
    feather::write(out, columns)
}

/// The color of every row, by direction of motion, with the ego motion taken out where it is known.
fn colors(table: &FlowTable<'_>) -> Vec<[u8; 3]> {
    let motion = shown_motion(table.source, table.flow, table.ego);
    let scale = full_scale(&motion, table.valid);
    let color_of = |(&motion, &valid)| {
        if valid {
            color(motion, scale)
        } else {
            INVALID_COLOR
        }
    };
    motion.iter().zip(table.valid).map(color_of).collect()
}

fn write_ply(table: &FlowTable<'_>, out: &mut dyn Write) -> Result<(), FormatError> {
    let mut properties = vec![("float", "x"), ("float", "y"), ("float", "z")];
    properties.extend(FLOW_AXES.map(|axis| ("float", axis)));
    properties.push(("uchar", "valid"));
    if table.dynamic.is_some() {
        properties.push(("uchar", "dynamic"));
    }
    if table.objects.is_some() {
        properties.extend([
            ("int", "cluster"),
            ("float", "confidence"),
            ("float", "moving"),
        ]);
    }
    properties.extend(["red", "green", "blue"].map(|channel| ("uchar", channel)));
    let comment = "flow is the displacement over the pair, metres, ego motion included";
    ply::write_header(out, table.source.len(), &[comment], &properties)?;
    write_rows(table, out, |[red, green, blue], row| {
        row.extend([red, green, blue]);
    })
}

fn write_pcd(table: &FlowTable<'_>, out: &mut dyn Write) -> Result<(), FormatError> {
    let mut fields = vec![("x", 4, 'F'), ("y", 4, 'F'), ("z", 4, 'F')];
    fields.extend(FLOW_AXES.map(|axis| (axis, 4, 'F')));
    fields.push(("valid", 1, 'U'));
    if table.dynamic.is_some() {
        fields.push(("dynamic", 1, 'U'));
    }
    if table.objects.is_some() {
        fields.extend([
            ("cluster", 4, 'I'),
            ("confidence", 4, 'F'),
            ("moving", 4, 'F'),
        ]);
    }
    fields.push(("rgb", 4, 'F'));
    pcd::write_header(out, table.source.len(), &fields)?;
    write_rows(table, out, |color, row| row.extend(pcd::rgb(color)))
}

/// Writes rows of point, displacement, flags, cluster, probabilities and color, little endian.
fn write_rows(
    table: &FlowTable<'_>,
    out: &mut dyn Write,
    push_color: impl Fn([u8; 3], &mut Vec<u8>),
) -> Result<(), FormatError> {
    const FLUSH_AT: usize = 64 << 10;
    let mut bytes = Vec::with_capacity(FLUSH_AT + 64);
    for (row, color) in colors(table).into_iter().enumerate() {
        for value in table.source[row].iter().chain(&table.flow[row]) {
            bytes.extend(value.to_le_bytes());
        }
        bytes.push(u8::from(table.valid[row]));
        bytes.extend(table.dynamic.map(|dynamic| u8::from(dynamic[row])));
        if let Some(objects) = table.objects {
            bytes.extend(objects.cluster[row].to_le_bytes());
            bytes.extend(objects.confidence[row].to_le_bytes());
            bytes.extend(objects.moving[row].to_le_bytes());
        }
        push_color(color, &mut bytes);
        if bytes.len() >= FLUSH_AT {
            out.write_all(&bytes)?;
            bytes.clear();
        }
    }
    out.write_all(&bytes)?;
    Ok(())
}
