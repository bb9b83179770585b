//! Drives with tracked boxes, and the estimates of their pairs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::{Estimate, Point, Preset, RigidTransform, Sequence, Sweep};
use fnsf::formats::read_cloud;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use super::clock::Clock;

/// Margin of a box to the sides, and the height at its foot that counts as ground, metres.
const MARGIN_M: f64 = 0.1;
const FOOT_M: f64 = 0.2;

/// A box of `tracks.json`, in the sensor's frame of its sweep.
#[derive(serde::Deserialize)]
pub(crate) struct TrackedBox {
    /// A text or a number.
    pub(crate) id: serde_json::Value,
    #[serde(rename = "type")]
    pub(crate) class: String,
    pub(crate) center: [f64; 3],
    pub(crate) size: [f64; 3],
    pub(crate) yaw: f64,
}

impl TrackedBox {
    pub(crate) fn pose(&self) -> RigidTransform {
        Isometry3::from_parts(
            Translation3::from(self.center),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw),
        )
    }

    pub(crate) fn holds(&self, point: Point) -> bool {
        let [x, y, z] = self
            .pose()
            .inverse_transform_point(&point3(point))
            .coords
            .into();
        let [length, width, height] = self.size.map(|side| side / 2.0);
        x.abs() <= length + MARGIN_M
            && y.abs() <= width + MARGIN_M
            && (FOOT_M - height..=height + MARGIN_M).contains(&z)
    }
}

pub(crate) fn point3(point: Point) -> Point3<f64> {
    Point3::from(point.map(f64::from))
}

/// A drive: its sweeps in order, and the boxes of each by id.
pub(crate) struct Drive {
    pub(crate) name: &'static str,
    pub(crate) sweeps: Vec<Vec<Point>>,
    pub(crate) boxes: Vec<BTreeMap<String, TrackedBox>>,
}

impl Drive {
    /// The sweeps `files`, numbered from `first`, with the boxes in `folder/tracks.json`.
    fn read(
        name: &'static str,
        folder: &Path,
        files: &[PathBuf],
        first: usize,
    ) -> anyhow::Result<Self> {
        let read = |path: &PathBuf| {
            let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
            anyhow::Ok(read_cloud(&bytes, path.to_str())?.points)
        };
        let tracks = std::fs::read(folder.join("tracks.json"))?;
        let mut tracks: BTreeMap<usize, Vec<TrackedBox>> = serde_json::from_slice(&tracks)?;
        let boxes = (first..first + files.len()).map(|number| {
            let boxes = tracks.remove(&number).unwrap_or_default();
            boxes.into_iter().map(|b| (b.id.to_string(), b)).collect()
        });
        Ok(Self {
            name,
            boxes: boxes.collect(),
            sweeps: files.iter().map(read).collect::<Result<_, _>>()?,
        })
    }
}

/// The drives `traffic` and `kitti_drive` (with the sweeps of `kitti_0000`) in the folder
/// `FNSF_REAL_DATA`.
pub(crate) fn read_drives() -> anyhow::Result<[Drive; 2]> {
    let data = std::env::var_os("FNSF_REAL_DATA").context("set FNSF_REAL_DATA")?;
    let data = Path::new(&data);
    let files = |folder: &str, digits: usize, numbers: std::ops::Range<usize>| {
        let name = |number| data.join(folder).join(format!("{number:0digits$}.pcd"));
        numbers.map(name).collect::<Vec<_>>()
    };
    let kitti = [
        files("kitti_0000", 10, 0..11),
        files("kitti_drive", 10, 11..40),
    ]
    .concat();
    Ok([
        Drive::read(
            "traffic",
            &data.join("traffic"),
            &files("traffic", 6, 10..30),
            10,
        )?,
        Drive::read("kitti_drive", &data.join("kitti_drive"), &kitti, 0)?,
    ])
}

/// The estimates of all consecutive pairs of `sweeps`, without ground masks, and the seconds that
/// they took.
pub(crate) fn estimates(
    sweeps: &[Vec<Point>],
    backend: &CpuBackend,
    preset: Preset,
) -> anyhow::Result<(Vec<Estimate>, f64)> {
    let options = preset.options(None);
    let mut sequence = Sequence::default();
    let clock = Clock::start();
    let mut estimates = Vec::new();
    for points in sweeps {
        let sweep = Sweep {
            points: points.clone(),
            ground: None,
            ..Sweep::default()
        };
        estimates.extend(sequence.push(backend, sweep, &options, &clock)?);
    }
    loop {
        let last = sequence.finish(backend, &clock)?;
        if last.is_empty() {
            break;
        }
        estimates.extend(last);
    }
    Ok((estimates, fnsf::flow::Control::seconds(&clock)))
}
