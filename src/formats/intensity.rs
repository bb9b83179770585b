//! Intensities of the points of a sweep: the strength of each return, in the unit of its sensor.

use super::bin;
use super::error::{FileKind, FormatError};
use super::feather::Table;
use super::las_read::Las;
use super::npz::Npz;
use super::pcd::Pcd;
use super::ply::Ply;
use super::sniff::recognize;

/// Names of a column of intensities; the first that is there is read. The last is CloudCompare's.
const NAMES: [&str; 3] = ["intensity", "intensities", "scalar_Intensity"];

fn named(has: impl Fn(&str) -> bool) -> Option<&'static str> {
    NAMES.into_iter().find(|name| has(name))
}

/// The intensity of each row of a file that [`read_cloud`](super::read_cloud) reads, as the file has
/// it: a column of one of the names of npz, PLY, PCD and feather, the fourth float of a raw file, and that of
/// LAS. None where the file has none. An npz may have another number of intensities than points.
///
/// # Errors
/// As for [`read_cloud`](super::read_cloud), but that values need not be finite.
pub fn read_intensity(bytes: &[u8], name: Option<&str>) -> Result<Option<Vec<f32>>, FormatError> {
    let mut found = Vec::new();
    let mut take = |_: usize, values: &[f64]| {
        found.extend(values.iter().map(|&value| value as f32));
        Ok(())
    };
    match recognize(bytes, name)? {
        FileKind::Npz => {
            let mut npz = Npz::open(bytes)?;
            let name = named(|name| npz.has(name)).unwrap_or_default();
            return npz.column(name, |_, value| Ok(value as f32));
        }
        FileKind::Feather => {
            let table = Table::open(bytes)?;
            let name = named(|name| table.has(name)).unwrap_or_default();
            return table.column(name, |_, value| Ok(value as f32));
        }
        FileKind::Ply => {
            let ply = Ply::open(bytes)?;
            let Some(name) = named(|name| ply.property(name).is_some()) else {
                return Ok(None);
            };
            ply.each(&[name], &mut take)?;
        }
        FileKind::Pcd => {
            let pcd = Pcd::open(bytes)?;
            let Some(name) = named(|name| pcd.field(name).is_some()) else {
                return Ok(None);
            };
            pcd.each(&[name], &mut take)?;
        }
        FileKind::Las => found = Las::open(bytes)?.intensities().map(f32::from).collect(),
        kind @ (FileKind::KittiBin | FileKind::NuscenesBin) => {
            return bin::read_intensity(bytes, kind).map(Some);
        }
        _ => return Ok(None),
    }
    Ok(Some(found))
}
