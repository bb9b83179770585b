//! A pair of sweeps with its ground truth, ground masks and ego motion where known.
//!
//! Read from `.npz` with the array names that are common in scene flow, and from Argoverse 2's
//! labels.

use std::io::Write;

use super::cloud::read_columns;
use super::error::{FileKind, FormatError};
use super::feather::{FLOW_COLUMNS, Table};
use super::limits::{MAX_POINTS, check_category, check_flag, check_points};
use super::motion::{ego_motion, matrix_rows};
use super::npy;
use super::npz::{Npz, NpzWriter};
use super::sniff::is_zip;
use crate::flow::{Point, RigidTransform};

const KIND: FileKind = FileKind::Npz;

/// Two sweeps, with the known data on the motion between them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pair {
    /// The source sweep: N points, metres, in its own sensor frame.
    pub source: Vec<Point>,
    /// The target sweep: M points, metres, in its own sensor frame.
    pub target: Vec<Point>,
    /// The true motion of the source points, where known.
    pub truth: Option<PairTruth>,
    /// The ground masks of both sweeps, where known.
    pub ground: Option<Ground>,
    /// The ego motion `target_from_source`, where known.
    pub ego: Option<RigidTransform>,
}

/// The true motion of a sweep's N points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PairTruth {
    /// N displacements from the source sweep's time to the target's, metres, ego motion included.
    pub flow: Vec<Point>,
    /// N flags: whether the displacement is known.
    pub valid: Vec<bool>,
    /// N flags: whether the point moves relative to the static world.
    pub dynamic: Option<Vec<bool>>,
    /// N flags: whether the point lies on a labelled object.
    pub foreground: Option<Vec<bool>>,
    /// N Argoverse 2 categories; 0 for a point of none.
    pub category: Option<Vec<u8>>,
}

/// Ground masks: which points of either sweep lie on the ground.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ground {
    /// N flags, one per source point.
    pub source: Vec<bool>,
    /// M flags, one per target point.
    pub target: Vec<bool>,
}

/// Argoverse 2's labels of one sweep of N points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Av2Labels {
    /// The true motion.
    pub truth: PairTruth,
    /// N flags: which points lie on the ground.
    pub ground: Vec<bool>,
}

/// Whether the bytes are an `.npz` with arrays `pc1` and `pc2`. False for an archive that cannot be
/// opened. The arrays themselves are not read.
pub fn is_pair(bytes: &[u8]) -> bool {
    is_zip(bytes) && Npz::open(bytes).is_ok_and(|npz| npz.has("pc1") && npz.has("pc2"))
}

/// Reads a pair from an `.npz` with `pc1` (N x 3) and `pc2` (M x 3), metres.
///
/// Optional arrays are:
/// - `flow` (N x 3): the true displacements, metres.
/// - `ground1` (N) and `ground2` (M): the ground masks, both or neither.
/// - `ego_SE3` (4 x 4): the ego motion `target_from_source`, translation in metres.
///
/// The following arrays are read only if the file has `flow`:
/// - `valid` (N): whether the displacement is known. Without it all rows are valid.
/// - `dynamic` (N): whether the point moves relative to the static world.
/// - `category` (N): Argoverse 2's category, 0 to 255.
/// - `box_id` (N): negative for points on no object.
/// - `classes` (N): 0 for points on no object. Ignored if there is a `box_id`.
///
/// Columns of `pc1`, `pc2` and `flow` after the third are ignored. In a mask, every number except 0
/// is true.
///
/// # Errors
/// - `Unrecognized` for bytes that are not a zip archive.
/// - `Missing` where `pc1` or `pc2` is missing.
/// - `Malformed` for a file that violates its format or is truncated, for an array compressed by
///   another method than deflate, and for a category that is not a whole number from 0 to 255.
/// - `Unsupported` for an array of another type or shape, an npy version other than 1 to 3, or an
///   encrypted archive, and where only one of the two ground masks is present.
/// - `NotFinite` for a coordinate or displacement that is NaN or infinite, and for a NaN in a mask,
///   in `box_id` or in `classes`.
/// - `OutOfRange` for a coordinate or displacement over 1e6 m in magnitude.
/// - `TooLarge` for an array of more than [`MAX_POINTS`] rows, or an archive of more than 1,024
///   members. Also for arrays that together decompress to more than 4 GiB, or to more than 32 MiB
///   plus 32 times the size of the file.
/// - `RowCount` where an array does not have the N or M rows of its cloud.
/// - `Motion` where `ego_SE3` is not a rigid motion, or a component of its translation is over
///   1e6 m in magnitude.
pub fn read_pair(bytes: &[u8]) -> Result<Pair, FormatError> {
    read_pair_within(bytes, MAX_POINTS)
}

/// As [`read_pair`], with at most `most` points per cloud. A file that declares more is refused
/// before memory is allocated for them.
///
/// # Errors
/// As for [`read_pair`], and `TooLarge` for an array of more than `most` rows.
pub fn read_pair_within(bytes: &[u8], most: usize) -> Result<Pair, FormatError> {
    if !is_zip(bytes) {
        return Err(FormatError::Unrecognized(
            "a pair is an npz with pc1 and pc2".to_owned(),
        ));
    }
    let mut npz = Npz::open_within(bytes, most)?;
    let source = npz.points("pc1")?;
    let target = npz.points("pc2")?;
    let truth = read_truth(&mut npz, source.len())?;
    let ground = match (npz.mask("ground1")?, npz.mask("ground2")?) {
        (Some(first), Some(second)) => {
            check_count("ground1", first.len(), source.len())?;
            check_count("ground2", second.len(), target.len())?;
            Some(Ground {
                source: first,
                target: second,
            })
        }
        (None, None) => None,
        _ => return Err(KIND.unsupported("ground1 and ground2 come together or not at all")),
    };
    let ego = npz
        .matrix("ego_SE3")?
        .map(|rows| ego_motion(&rows))
        .transpose()?;
    Ok(Pair {
        source,
        target,
        truth,
        ground,
        ego,
    })
}

fn read_truth(npz: &mut Npz<'_>, count: usize) -> Result<Option<PairTruth>, FormatError> {
    if !npz.has("flow") {
        return Ok(None);
    }
    let flow = npz.points("flow")?;
    check_count("flow", flow.len(), count)?;
    let valid = npz.mask("valid")?.unwrap_or_else(|| vec![true; count]);
    check_count("valid", valid.len(), count)?;
    let dynamic = npz.mask("dynamic")?;
    if let Some(dynamic) = &dynamic {
        check_count("dynamic", dynamic.len(), count)?;
    }
    let foreground = match npz.column("box_id", on_object)? {
        None => npz.mask("classes")?,
        foreground => foreground,
    };
    if let Some(foreground) = &foreground {
        check_count("box_id or classes", foreground.len(), count)?;
    }
    let category = npz.column("category", |row, value| {
        check_category(KIND, row, "category", value)
    })?;
    if let Some(category) = &category {
        check_count("category", category.len(), count)?;
    }
    Ok(Some(PairTruth {
        flow,
        valid,
        dynamic,
        foreground,
        category,
    }))
}

/// Which points have a category.
pub(super) fn of_some_category(category: &[u8]) -> Vec<bool> {
    category.iter().map(|&category| category != 0).collect()
}

/// Whether a `box_id` is that of an object.
fn on_object(row: usize, id: f64) -> Result<bool, FormatError> {
    check_flag(KIND, row, "box_id", id)?;
    Ok(id >= 0.0)
}

pub(super) fn check_count(what: &str, found: usize, expected: usize) -> Result<(), FormatError> {
    if found == expected {
        Ok(())
    } else {
        Err(FormatError::RowCount {
            what: what.to_owned(),
            found,
            expected,
        })
    }
}

/// Writes a pair with the array names that [`read_pair`] reads. `foreground` is written as
/// `box_id`, 0 on objects and -1 off them.
///
/// # Errors
/// - `RowCount` where the pair's lists differ in length.
/// - `NotFinite` for a coordinate or displacement that is NaN or infinite. Points without return
///   are therefore refused.
/// - `OutOfRange` for a coordinate or displacement over 1e6 m in magnitude.
/// - `Write` where writing to `out` fails, `Encode` where encoding fails.
pub fn write_pair_npz(pair: &Pair, out: &mut dyn Write) -> Result<(), FormatError> {
    let mut npz = NpzWriter::new();
    let count = pair.source.len();
    let mut points = |name: &str, points: &[Point]| {
        check_points(KIND, name, points)?;
        npz.points(name, points)
    };
    points("pc1", &pair.source)?;
    points("pc2", &pair.target)?;
    if let Some(truth) = &pair.truth {
        check_count("flow", truth.flow.len(), count)?;
        check_count("valid", truth.valid.len(), count)?;
        points("flow", &truth.flow)?;
        npz.mask("valid", &truth.valid)?;
        if let Some(dynamic) = &truth.dynamic {
            check_count("dynamic", dynamic.len(), count)?;
            npz.mask("dynamic", dynamic)?;
        }
        if let Some(foreground) = &truth.foreground {
            check_count("foreground", foreground.len(), count)?;
            let ids: Vec<i32> = foreground
                .iter()
                .map(|&on| if on { 0 } else { -1 })
                .collect();
            npz.array("box_id", |out| npy::write_ids(out, &ids))?;
        }
        if let Some(category) = &truth.category {
            check_count("category", category.len(), count)?;
            let ids: Vec<i32> = category.iter().map(|&category| category.into()).collect();
            npz.array("category", |out| npy::write_ids(out, &ids))?;
        }
    }
    if let Some(ground) = &pair.ground {
        check_count("ground1", ground.source.len(), count)?;
        check_count("ground2", ground.target.len(), pair.target.len())?;
        npz.mask("ground1", &ground.source)?;
        npz.mask("ground2", &ground.target)?;
    }
    if let Some(ego) = &pair.ego {
        npz.matrix("ego_SE3", &matrix_rows(ego))?;
    }
    out.write_all(&npz.finish()?)?;
    Ok(())
}

/// Reads Argoverse 2's `flow_labels.feather`, with these columns:
/// - `flow_tx_m`, `flow_ty_m` and `flow_tz_m`: the true displacements, metres.
/// - `is_ground_0` or `is_ground`: the ground mask.
/// - `is_valid` or `valid`: whether the displacement is known. Without it all rows are valid.
/// - `dynamic` or `is_dynamic`: whether the point moves. Optional.
/// - `classes` or `classes_0`: the category, 0 to 255. Optional. Foreground is every category
///   except 0, which is NONE, as in Argoverse 2's own evaluation.
///
/// # Errors
/// - `Malformed` for bytes that are not an intact feather file, and for a category that is not a
///   whole number from 0 to 255.
/// - `Missing` where a column of the flow or the ground column is missing.
/// - `Unsupported` for a flow column that is not of floats, a column with missing values or without
///   numbers, nested or big-endian columns, or a compression other than LZ4.
/// - `NotFinite` for a displacement that is NaN or infinite, and for a NaN in a mask.
/// - `OutOfRange` for a displacement over 1e6 m along an axis.
/// - `TooLarge` for more than [`MAX_POINTS`] rows. Also where the displacements, at 12 bytes a row,
///   take more than 4 GiB, or more than 32 MiB plus 32 times the size of the file.
pub fn read_av2_labels(bytes: &[u8]) -> Result<Av2Labels, FormatError> {
    let table = Table::open(bytes)?;
    let flow = read_columns(&table, FLOW_COLUMNS)?;
    let ground = match flags(&table, &["is_ground_0", "is_ground"])? {
        Some(ground) => ground,
        None => return Err(FileKind::Feather.missing("column is_ground_0", &table.names())),
    };
    let valid = flags(&table, &["is_valid", "valid"])?.unwrap_or_else(|| vec![true; flow.len()]);
    let dynamic = flags(&table, &["dynamic", "is_dynamic"])?;
    let categories = |name: &str| {
        table.column(name, |row, value| {
            check_category(FileKind::Feather, row, name, value)
        })
    };
    let category = match categories("classes")? {
        None => categories("classes_0")?,
        category => category,
    };
    Ok(Av2Labels {
        truth: PairTruth {
            flow,
            valid,
            dynamic,
            foreground: category.as_deref().map(of_some_category),
            category,
        },
        ground,
    })
}

/// The first existing column of `names`, as a mask: nonzero is true. `None` where none exists.
pub(super) fn flags(table: &Table<'_>, names: &[&str]) -> Result<Option<Vec<bool>>, FormatError> {
    let Some(name) = names.iter().find(|name| table.has(name)) else {
        return Ok(None);
    };
    table.column(name, |row, value| {
        check_flag(FileKind::Feather, row, name, value)
    })
}
