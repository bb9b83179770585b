//! Reading of flow files, in every format in which flow is written.

use super::table::FLOW_AXES;
use super::table::FlowFile;
use super::{json, objects};
use crate::formats::cloud::read_columns;
use crate::formats::error::{FileKind, FormatError};
use crate::formats::feather::{FLOW_COLUMNS, Table};
use crate::formats::limits::{MAX_POINTS, check_flag, check_id, check_probability, check_value};
use crate::formats::motion::ego_motion;
use crate::formats::npy;
use crate::formats::npz::Npz;
use crate::formats::pair::{check_count, flags};
use crate::formats::pcd::Pcd;
use crate::formats::ply::Ply;
use crate::formats::sniff::recognize;

/// Reads a flow in any of the formats that [`super::write_flow`] writes. Also reads `flow` of a
/// pair's `.npz`, and Argoverse 2's `.feather`. `bytes` is the whole file. The format is recognized
/// by content. `name` is a file name or path; it only affects the error for a file of another kind.
/// Files of more than [`MAX_POINTS`] rows are refused, except for JSON, which has no limit.
///
/// # Errors
/// - `Unrecognized` and `Ambiguous` as for [`recognize`].
/// - `Malformed` for a file that violates its format or is truncated. Also for a cluster index that
///   is not a whole number of 32 bits or not below the number of clusters, and for a
///   confidence or a probability of motion outside of 0 to 1.
/// - `Unsupported` for raw floats, which hold a cloud, and for arrays or columns of another type or
///   shape.
/// - `Missing` where the flow, or the center, size or velocity of the clusters, is missing.
/// - `Motion` for an ego motion that is not rigid.
/// - `NotFinite` for a displacement or a number of a cluster that is not finite, and for a NaN in a
///   mask. `OutOfRange` for a displacement or a number of a cluster over 1e6 in magnitude.
/// - `TooLarge` for too many rows, for an `.npz` of more than 1,024 members, or where compressed
///   data takes more than 4 GiB, or more than 32 MiB plus 32 times the size of the file.
/// - `RowCount` where the columns differ in length, or another array of the clusters is missing.
pub fn read_flow(bytes: &[u8], name: Option<&str>) -> Result<FlowFile, FormatError> {
    let file = match recognize(bytes, name)? {
        FileKind::Npy => FlowFile {
            flow: npy::read_file(bytes, MAX_POINTS)?,
            ..FlowFile::default()
        },
        kind @ FileKind::Npz => {
            let mut npz = Npz::open(bytes)?;
            FlowFile {
                flow: npz.points("flow")?,
                valid: npz.mask("valid")?,
                dynamic: npz.mask("dynamic")?,
                cluster: npz.column("cluster", |row, id| check_id(kind, row, "cluster", id))?,
                confidence: npz.column("confidence", |row, probability| {
                    check_probability(kind, row, "confidence", probability)
                })?,
                moving: npz.column("moving", |row, probability| {
                    check_probability(kind, row, "moving", probability)
                })?,
                clusters: objects::take(&mut npz)?,
                ego: npz.matrix("ego")?.as_ref().map(ego_motion).transpose()?,
            }
        }
        kind @ FileKind::Feather => {
            let table = Table::open(bytes)?;
            FlowFile {
                flow: read_columns(&table, FLOW_COLUMNS)?,
                valid: flags(&table, &["is_valid", "valid"])?,
                dynamic: flags(&table, &["is_dynamic", "dynamic"])?,
                cluster: table.column("cluster", |row, id| check_id(kind, row, "cluster", id))?,
                confidence: table.column("confidence", |row, probability| {
                    check_probability(kind, row, "confidence", probability)
                })?,
                moving: table.column("moving", |row, probability| {
                    check_probability(kind, row, "moving", probability)
                })?,
                ..FlowFile::default()
            }
        }
        kind @ FileKind::Ply => {
            let ply = Ply::open(bytes)?;
            let has = |name: &str| ply.property(name).is_some();
            Rows::new(kind, has).read(|wanted, take| ply.each(wanted, take))?
        }
        kind @ FileKind::Pcd => {
            let pcd = Pcd::open(bytes)?;
            let has = |name: &str| pcd.field(name).is_some();
            Rows::new(kind, has).read(|wanted, take| pcd.each(wanted, take))?
        }
        FileKind::Json => json::read(bytes)?,
        kind @ (FileKind::KittiBin | FileKind::NuscenesBin) => {
            return Err(kind.unsupported("it holds a cloud, not flow"));
        }
        kind @ (FileKind::Las
        | FileKind::Mcap
        | FileKind::Hdf5
        | FileKind::Png
        | FileKind::Camera
        | FileKind::Poses) => {
            return Err(kind.unsupported("no flow is read from it"));
        }
    };
    let count = file.flow.len();
    for (what, rows) in [
        ("valid", file.valid.as_ref().map(Vec::len)),
        ("dynamic", file.dynamic.as_ref().map(Vec::len)),
        ("cluster", file.cluster.as_ref().map(Vec::len)),
        ("confidence", file.confidence.as_ref().map(Vec::len)),
        ("moving", file.moving.as_ref().map(Vec::len)),
    ] {
        check_count(what, rows.unwrap_or(count), count)?;
    }
    if let (Some(cluster), Some(clusters)) = (&file.cluster, &file.clusters)
        && let Some(id) = cluster
            .iter()
            .find(|&&id| id >= 0 && id as usize >= clusters.len())
    {
        let (kind, known) = (recognize(bytes, name)?, clusters.len());
        return Err(kind.malformed(format!("cluster is {id} where there are {known} clusters")));
    }
    Ok(file)
}

/// Collects flow and its optional columns from the rows of a PLY or PCD file.
struct Rows {
    kind: FileKind,
    wanted: Vec<&'static str>,
    file: FlowFile,
}

/// A callback that takes the index and the wanted values of a row.
type TakeRow<'a> = &'a mut dyn FnMut(usize, &[f64]) -> Result<(), FormatError>;

impl Rows {
    /// For a file in which the columns exist for which `has` is true.
    fn new(kind: FileKind, has: impl Fn(&str) -> bool) -> Self {
        let mut wanted = FLOW_AXES.to_vec();
        let columns = ["valid", "dynamic", "cluster", "confidence", "moving"];
        wanted.extend(columns.into_iter().filter(|column| has(column)));
        let file = FlowFile {
            valid: has("valid").then(Vec::new),
            dynamic: has("dynamic").then(Vec::new),
            cluster: has("cluster").then(Vec::new),
            confidence: has("confidence").then(Vec::new),
            moving: has("moving").then(Vec::new),
            ..FlowFile::default()
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
            let mut rest = values.iter().skip(3);
            let mut next = || rest.next().copied().unwrap_or_default();
            if let Some(valid) = &mut file.valid {
                valid.push(check_flag(kind, row, "valid", next())?);
            }
            if let Some(dynamic) = &mut file.dynamic {
                dynamic.push(check_flag(kind, row, "dynamic", next())?);
            }
            if let Some(cluster) = &mut file.cluster {
                cluster.push(check_id(kind, row, "cluster", next())?);
            }
            if let Some(confidence) = &mut file.confidence {
                confidence.push(check_probability(kind, row, "confidence", next())?);
            }
            if let Some(moving) = &mut file.moving {
                moving.push(check_probability(kind, row, "moving", next())?);
            }
            Ok(())
        })?;
        Ok(file)
    }
}
