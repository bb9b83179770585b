//! Files on disk to values and back, with errors that name the file.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;

use anyhow::{Context, anyhow};

use super::failure::Failure;
use crate::flow::{Point, RigidTransform};
use crate::formats::{self, FileKind, FlowFile, FormatError, Pair, PairTruth};

/// A whole file, up to the largest that is taken.
pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>, Failure> {
    fs::read(path)
        .with_context(|| format!("cannot read {}", path.display()))
        .map_err(Failure::bad_input)
}

/// Runs a reader over a file.
fn read<T>(
    path: &Path,
    reader: impl FnOnce(&[u8], Option<&str>) -> Result<T, FormatError>,
) -> Result<T, Failure> {
    let bytes = read_bytes(path)?;
    let name = path.file_name().map(|name| name.to_string_lossy());
    reader(&bytes, name.as_deref())
        .with_context(|| path.display().to_string())
        .map_err(Failure::bad_input)
}

/// One sweep of any format.
pub(super) fn read_cloud(path: &Path) -> Result<Vec<Point>, Failure> {
    read(path, formats::read_cloud).map(|cloud| cloud.points)
}

/// Two sweeps in one `.npz`.
pub(super) fn read_pair(path: &Path) -> Result<Pair, Failure> {
    read(path, |bytes, _| {
        if formats::is_pair(bytes) {
            return formats::read_pair(bytes);
        }
        // What it is instead: an error of its own, or a cloud where two are needed.
        formats::read_cloud(bytes, path.to_str()).and(Err(FormatError::Ambiguous(
            "this is one cloud: give the target's file too".to_owned(),
        )))
    })
}

/// A flow of any format.
pub(super) fn read_flow(path: &Path) -> Result<FlowFile, Failure> {
    read(path, formats::read_flow)
}

/// Ground truth: a pair with `flow`, or Argoverse 2's labels.
pub(super) fn read_truth(path: &Path) -> Result<(PairTruth, Pair), Failure> {
    read(path, |bytes, name| {
        if !formats::is_pair(bytes) {
            let kind = formats::recognize(bytes, name)?;
            if kind != FileKind::Feather {
                let detail = "truth is an npz pair with flow, or Argoverse 2's flow_labels.feather";
                return Err(FormatError::Unsupported {
                    kind,
                    detail: detail.to_owned(),
                });
            }
            let labels = formats::read_av2_labels(bytes)?;
            let ground = formats::Ground {
                source: labels.ground,
                target: Vec::new(),
            };
            let pair = Pair {
                ground: Some(ground),
                ..Pair::default()
            };
            return Ok((labels.truth, pair));
        }
        let mut pair = formats::read_pair(bytes)?;
        match pair.truth.take() {
            Some(truth) => Ok((truth, pair)),
            None => Err(FormatError::Missing {
                kind: FileKind::Npz,
                what: "flow".to_owned(),
                present: "two clouds without truth".to_owned(),
            }),
        }
    })
}

/// A rigid motion target_from_source: 16 numbers in rows, or an `.npz` pair with `ego_SE3`.
pub(super) fn read_motion(path: &Path) -> Result<RigidTransform, Failure> {
    let bytes = read_bytes(path)?;
    let motion = if formats::is_pair(&bytes) {
        let pair = formats::read_pair(&bytes).map_err(anyhow::Error::new);
        pair.and_then(|pair| pair.ego.ok_or_else(|| anyhow!("the pair has no ego_SE3")))
    } else {
        formats::read_motion(&bytes).map_err(anyhow::Error::new)
    };
    motion
        .with_context(|| path.display().to_string())
        .map_err(Failure::bad_input)
}

/// Writes a file through `writer`; a failed write leaves no half file under the name.
pub(super) fn write<E: std::error::Error + Send + Sync + 'static>(
    path: &Path,
    writer: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), Failure> {
    let unfinished = path.with_added_extension("part");
    let written = (|| -> anyhow::Result<()> {
        let mut file = BufWriter::new(File::create(&unfinished)?);
        writer(&mut file)?;
        file.flush()?;
        fs::rename(&unfinished, path)?;
        Ok(())
    })();
    written
        .with_context(|| format!("cannot write {}", path.display()))
        .map_err(|error| {
            let _ = fs::remove_file(&unfinished);
            Failure::internal(error)
        })
}
