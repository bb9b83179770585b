//! Flow out and back in: one row per source point, in the source's order, in any format.
//!
//! It must not know how the flow was found.

use std::io::{Cursor, Write};

use crate::flow::{Point, RigidTransform};
use crate::picture::{INVALID_COLOR, color, full_scale, shown_motion};

use super::cloud::read_columns;
use super::error::{FileKind, FormatError, shorten};
use super::feather::{self, FLOW_COLUMNS, Table, Values};
use super::limits::{check_flag, check_points, check_value};
use super::motion::matrix_rows;
use super::npz::{Npz, NpzWriter};
use super::pair::{check_count, flags};
use super::pcd::{self, Pcd};
use super::ply::{self, Ply};
use super::sniff::{ending, recognize};
use super::{json, npy};

/// Property names of a displacement in PLY and PCD.
const FLOW_AXES: [&str; 3] = ["flow_x", "flow_y", "flow_z"];

/// A flow to be written: N rows in the source's order.
#[derive(Clone, Copy, Debug)]
pub struct FlowTable<'a> {
    /// The source points, metres. Rows without return may be NaN; PLY and PCD keep them so.
    pub source: &'a [Point],
    /// Displacement of each over the pair, metres, ego motion included. Finite in every row.
    pub flow: &'a [Point],
    /// Whether the row has a flow; those left out have zeros.
    pub valid: &'a [bool],
    /// Whether the point moves by itself, where that is known.
    pub dynamic: Option<&'a [bool]>,
    /// The ego motion `target_from_source`, where it is known.
    pub ego: Option<&'a RigidTransform>,
}

/// A flow read back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FlowFile {
    /// N displacements, metres.
    pub flow: Vec<Point>,
    /// Whether each row has a flow, where the file says so.
    pub valid: Option<Vec<bool>>,
    /// Whether each point moves by itself, where the file says so.
    pub dynamic: Option<Vec<bool>>,
}

/// The formats that flow is written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FlowFormat {
    /// `flow` N x 3 float32, `valid` bool, `dynamic` bool and `ego` 4 x 4 float64 where known.
    Npz,
    /// The displacements alone, N x 3 float32.
    Npy,
    /// Argoverse 2's columns and `is_valid`, `is_dynamic`. Float32, so that nothing is lost;
    /// float16, which Argoverse 2 accepts too, would round 1 m to half a millimetre.
    Feather,
    /// Points with `flow_x`, `flow_y`, `flow_z`, `valid`, `dynamic`, and color by direction.
    Ply,
    /// The same, color packed into `rgb`.
    Pcd,
    /// An object with `flow`, `valid`, `dynamic`, `ego`.
    Json,
}

impl FlowFormat {
    /// The endings that [`FlowFormat::from_path`] knows.
    pub const KNOWN: &'static str = ".npz, .npy, .feather, .ply, .pcd, .json";

    /// The format that a file name's ending names.
    ///
    /// # Errors
    /// `UnknownExtension`, which lists the endings that are known.
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

    /// The format of an ending, with or without its dot, in any case.
    ///
    /// # Errors
    /// `UnknownExtension`, which lists the endings that are known.
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

/// Writes a flow.
///
/// # Errors
/// `RowCount` where the table's parts differ in length, `NotFinite` or `OutOfRange` for a
/// displacement that could not be read back, `Write` and `Encode` where writing fails.
pub fn write_flow<W: Write>(
    format: FlowFormat,
    table: &FlowTable<'_>,
    out: &mut W,
) -> Result<(), FormatError> {
    let count = table.source.len();
    check_count("flow", table.flow.len(), count)?;
    check_count("valid", table.valid.len(), count)?;
    if let Some(dynamic) = table.dynamic {
        check_count("dynamic", dynamic.len(), count)?;
    }
    check_points(format.kind(), "flow", table.flow)?;
    match format {
        FlowFormat::Npz => write_npz(table, out),
        FlowFormat::Npy => npy::write_points(out, table.flow),
        FlowFormat::Feather => write_feather(table, out),
        FlowFormat::Ply => write_ply(table, out),
        FlowFormat::Pcd => write_pcd(table, out),
        FlowFormat::Json => {
            let ego = table.ego.map(matrix_rows);
            json::write(out, table.flow, table.valid, table.dynamic, ego)
        }
    }
}

fn write_npz<W: Write>(table: &FlowTable<'_>, out: &mut W) -> Result<(), FormatError> {
    let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
    npz.points("flow", table.flow)?;
    npz.mask("valid", table.valid)?;
    if let Some(dynamic) = table.dynamic {
        npz.mask("dynamic", dynamic)?;
    }
    if let Some(ego) = table.ego {
        npz.matrix("ego", &matrix_rows(ego))?;
    }
    out.write_all(npz.finish()?.get_ref())?;
    Ok(())
}

fn write_feather<W: Write>(table: &FlowTable<'_>, out: &mut W) -> Result<(), FormatError> {
    let axis = |axis: usize| -> Values<'_> {
        Values::Floats(Box::new(table.flow.iter().map(move |flow| flow[axis])))
    };
    let [x, y, z] = FLOW_COLUMNS;
    let mut columns = vec![(x, axis(0)), (y, axis(1)), (z, axis(2))];
    columns.push(("is_valid", Values::Flags(table.valid)));
    if let Some(dynamic) = table.dynamic {
        columns.push(("is_dynamic", Values::Flags(dynamic)));
    }
    feather::write(out, columns)
}

/// The color of every row: by direction, off the ego motion where it is known.
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

fn write_ply<W: Write>(table: &FlowTable<'_>, out: &mut W) -> Result<(), FormatError> {
    let mut properties = vec![("float", "x"), ("float", "y"), ("float", "z")];
    properties.extend(FLOW_AXES.map(|axis| ("float", axis)));
    properties.push(("uchar", "valid"));
    if table.dynamic.is_some() {
        properties.push(("uchar", "dynamic"));
    }
    properties.extend(["red", "green", "blue"].map(|channel| ("uchar", channel)));
    let comment = "flow is the displacement over the pair, metres, ego motion included";
    ply::write_header(out, table.source.len(), &[comment], &properties)?;
    write_rows(table, out, |[red, green, blue], row| {
        row.extend([red, green, blue]);
    })
}

fn write_pcd<W: Write>(table: &FlowTable<'_>, out: &mut W) -> Result<(), FormatError> {
    let mut fields = vec![("x", 4, 'F'), ("y", 4, 'F'), ("z", 4, 'F')];
    fields.extend(FLOW_AXES.map(|axis| (axis, 4, 'F')));
    fields.push(("valid", 1, 'U'));
    if table.dynamic.is_some() {
        fields.push(("dynamic", 1, 'U'));
    }
    fields.push(("rgb", 4, 'F'));
    pcd::write_header(out, table.source.len(), &fields)?;
    // PCL's convention: 0x00rrggbb, its bits taken for a float.
    write_rows(table, out, |[red, green, blue], row| {
        row.extend([blue, green, red, 0]);
    })
}

/// Rows of point, displacement, masks and color, little endian.
fn write_rows<W: Write>(
    table: &FlowTable<'_>,
    out: &mut W,
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
        push_color(color, &mut bytes);
        if bytes.len() >= FLUSH_AT {
            out.write_all(&bytes)?;
            bytes.clear();
        }
    }
    out.write_all(&bytes)?;
    Ok(())
}

/// Reads back a flow in any of the formats that [`write_flow`] writes, recognized by content; also
/// a pair's `.npz` with `flow` and Argoverse 2's `.feather`.
///
/// # Errors
/// As for a cloud, and `RowCount` where masks and flow disagree.
pub fn read_flow(bytes: &[u8], name: Option<&str>) -> Result<FlowFile, FormatError> {
    let file = match recognize(bytes, name)? {
        FileKind::Npy => FlowFile {
            flow: npy::read_file(bytes)?,
            ..FlowFile::default()
        },
        FileKind::Npz => {
            let mut npz = Npz::open(bytes)?;
            let flow = npz.points("flow")?;
            FlowFile {
                flow,
                valid: npz.mask("valid")?,
                dynamic: npz.mask("dynamic")?,
            }
        }
        FileKind::Feather => {
            let table = Table::open(bytes)?;
            FlowFile {
                flow: read_columns(&table, FLOW_COLUMNS)?,
                valid: flags(&table, &["is_valid", "valid"])?,
                dynamic: flags(&table, &["is_dynamic", "dynamic"])?,
            }
        }
        kind @ FileKind::Ply => {
            let ply = Ply::open(bytes)?;
            let has = |name| ply.property(name).is_some();
            Rows::new(kind, has("valid"), has("dynamic"))
                .read(|wanted, take| ply.each(wanted, take))?
        }
        kind @ FileKind::Pcd => {
            let pcd = Pcd::open(bytes)?;
            let has = |name| pcd.field(name).is_some();
            Rows::new(kind, has("valid"), has("dynamic"))
                .read(|wanted, take| pcd.each(wanted, take))?
        }
        FileKind::Json => {
            let (flow, valid, dynamic) = json::read(bytes)?;
            FlowFile {
                flow,
                valid,
                dynamic,
            }
        }
        kind @ (FileKind::KittiBin | FileKind::NuscenesBin) => {
            return Err(kind.unsupported("it holds a cloud, not flow"));
        }
        kind @ (FileKind::Las | FileKind::Png | FileKind::Camera | FileKind::Poses) => {
            return Err(kind.unsupported("no flow is read from it"));
        }
    };
    for (what, mask) in [("valid", &file.valid), ("dynamic", &file.dynamic)] {
        if let Some(mask) = mask {
            check_count(what, mask.len(), file.flow.len())?;
        }
    }
    Ok(file)
}

/// Gathers flow and masks from the rows of a PLY or PCD file.
struct Rows {
    kind: FileKind,
    wanted: Vec<&'static str>,
    file: FlowFile,
}

/// What takes a row of wanted values.
type TakeRow<'a> = &'a mut dyn FnMut(usize, &[f64]) -> Result<(), FormatError>;

impl Rows {
    fn new(kind: FileKind, valid: bool, dynamic: bool) -> Self {
        let mut wanted = FLOW_AXES.to_vec();
        wanted.extend(valid.then_some("valid"));
        wanted.extend(dynamic.then_some("dynamic"));
        let file = FlowFile {
            flow: Vec::new(),
            valid: valid.then(Vec::new),
            dynamic: dynamic.then(Vec::new),
        };
        Self { kind, wanted, file }
    }

    fn read(
        self,
        each: impl FnOnce(&[&str], TakeRow<'_>) -> Result<(), FormatError>,
    ) -> Result<FlowFile, FormatError> {
        let Self {
            kind,
            wanted,
            mut file,
        } = self;
        each(&wanted, &mut |row, values| {
            let mut flow = [0.0; 3];
            for ((component, &value), axis) in flow.iter_mut().zip(values).zip(FLOW_AXES) {
                *component = check_value(kind, row, axis, value)?;
            }
            file.flow.push(flow);
            let mut masks = values.iter().skip(3);
            for (mask, name) in [(&mut file.valid, "valid"), (&mut file.dynamic, "dynamic")] {
                if let Some(mask) = mask
                    && let Some(&value) = masks.next()
                {
                    mask.push(check_flag(kind, row, name, value)?);
                }
            }
            Ok(())
        })?;
        Ok(file)
    }
}
