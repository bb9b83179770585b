//! Poses of a sequence's sweeps: KITTI's text, JSON, and Argoverse 2's table.
//!
//! A pose is `world_from_frame`. The ego motion between two sweeps is
//! `world_from_target.inv_mul(&world_from_source)`.

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use super::camera::with_last_row;
use super::error::{FileKind, FormatError, shorten};
use super::feather;
use super::feather::Table;
use super::motion::rigid_motion;
use super::timestamps::{SweepTime, TimeUnit};
use crate::flow::RigidTransform;

const KIND: FileKind = FileKind::Poses;

/// Largest number of poses in one file.
const MAX_POSES: usize = 1_000_000;

/// Tolerance of a stored quaternion's length from 1; float32 ones are within 1e-6.
const UNIT_TOLERANCE: f64 = 1e-3;

/// Argoverse 2's columns of a rotation and a translation, metres.
const AV2_COLUMNS: [&str; 7] = ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"];

/// Reads the pose `world_from_frame` of every sweep, translations in metres. `sweeps` are the
/// sweeps' file names. The poses are returned in the same order. The format is recognized by
/// content.
///
/// - KITTI's odometry text: 12 numbers a line, the first three rows of a 4 x 4 matrix. KITTI's own
///   poses are those of camera 0; see [`super::read_camera0_from_lidar`].
/// - JSON: an array of 4 x 4 matrices, row by row.
/// - Argoverse 2's `city_SE3_egovehicle.feather`: for each sweep the first row whose `timestamp_ns`
///   equals the time in the sweep's name. They are compared in float64, which resolves 64 ns at
///   Argoverse 2's times.
///
/// Text and JSON have one pose for every sweep, in order, or the poses of a whole drive. In the
/// latter case a sweep whose name is a number gets the pose with that index, counted from 0. A name
/// is read without its folder and without everything from its first dot.
///
/// The ego motion between two sweeps is `world_from_target.inv_mul(&world_from_source)`.
///
/// # Errors
/// - `Malformed` for a line of text that is not 12 numbers, for JSON that is not an array of 4 x 4
///   matrices, for bytes of no known format, and for a damaged feather file. Also for a pose of
///   text or JSON that is not finite or not rigid; the error names its sweep.
/// - `RowCount` where text or JSON has neither one pose for every sweep nor a pose at the index
///   that each sweep's name gives.
/// - `Unsupported` for feather, where a sweep's name has no time stamp in nanoseconds. Also where a
///   column has missing values, no numbers or a compression other than LZ4, and for nested or
///   big-endian columns.
/// - `Missing` for feather, where no row has the time of a sweep, or a column is missing.
/// - `Motion` for a pose of feather whose quaternion's length is not within 1e-3 of 1, or whose
///   translation is not finite.
/// - `TooLarge` for more than a million poses, or a feather file of far more rows than its size can
///   hold.
pub fn read_poses(bytes: &[u8], sweeps: &[&str]) -> Result<Vec<RigidTransform>, FormatError> {
    if bytes.starts_with(feather::MAGIC) {
        let poses = TimedPoses::read(bytes)?;
        return sweeps.iter().map(|sweep| poses.pose(sweep)).collect();
    }
    let poses = read_list(bytes)?;
    let chosen: Option<Vec<&[[f64; 4]; 4]>> = if poses.len() == sweeps.len() {
        Some(poses.iter().collect())
    } else {
        let pose = |frame: &&str| poses.get(stem(frame).parse::<usize>().ok()?);
        sweeps.iter().map(pose).collect()
    };
    let Some(chosen) = chosen else {
        return Err(wrong_count(poses.len(), sweeps.len()));
    };
    let poses = sweeps.iter().zip(chosen);
    poses.map(|(sweep, rows)| rigid_pose(sweep, rows)).collect()
}

/// A file of poses from which the poses of a sequence are taken sweep by sweep, where the number of
/// sweeps is not known in advance. Text and JSON have exactly one pose for every sweep, in order; see
/// [`read_poses`] for the formats.
pub struct PoseFile(Poses);

enum Poses {
    /// Matrices of text or JSON, in the order of the sweeps.
    Listed(Vec<[[f64; 4]; 4]>),
    /// Argoverse 2's table.
    Timed(TimedPoses),
}

impl PoseFile {
    /// Reads the poses.
    ///
    /// # Errors
    /// Those of [`read_poses`] that concern the whole file.
    pub fn open(bytes: &[u8]) -> Result<Self, FormatError> {
        Ok(Self(match bytes.starts_with(feather::MAGIC) {
            true => Poses::Timed(TimedPoses::read(bytes)?),
            false => Poses::Listed(read_list(bytes)?),
        }))
    }

    /// The pose `world_from_frame` of the sweep with index `index` from 0, whose file name is
    /// `sweep`.
    ///
    /// # Errors
    /// As for [`read_poses`]; `RowCount` where there is no pose with that index.
    pub fn pose(&self, index: usize, sweep: &str) -> Result<RigidTransform, FormatError> {
        match &self.0 {
            Poses::Timed(poses) => poses.pose(sweep),
            Poses::Listed(poses) => match poses.get(index) {
                Some(rows) => rigid_pose(sweep, rows),
                None => Err(wrong_count(poses.len(), index + 1)),
            },
        }
    }

    /// Checks the number of poses after all `sweeps` sweeps.
    ///
    /// # Errors
    /// `RowCount` where text or JSON has another number of poses.
    pub fn check_count(&self, sweeps: usize) -> Result<(), FormatError> {
        match &self.0 {
            Poses::Listed(poses) if poses.len() != sweeps => Err(wrong_count(poses.len(), sweeps)),
            _ => Ok(()),
        }
    }
}

fn wrong_count(found: usize, expected: usize) -> FormatError {
    FormatError::RowCount {
        what: "the file of poses".to_owned(),
        found,
        expected,
    }
}

fn read_list(bytes: &[u8]) -> Result<Vec<[[f64; 4]; 4]>, FormatError> {
    match bytes.trim_ascii_start().first() {
        Some(b'[') => serde_json::from_slice(bytes)
            .map_err(|error| KIND.malformed(format!("not an array of 4 x 4 matrices: {error}"))),
        _ => read_text(bytes),
    }
}

fn rigid_pose(sweep: &str, rows: &[[f64; 4]; 4]) -> Result<RigidTransform, FormatError> {
    rigid_motion(rows).map_err(|_| {
        KIND.malformed(format!(
            "the pose of {} is no rigid transform of finite numbers",
            shorten(sweep)
        ))
    })
}

/// A file's name without folder, and without everything after its first dot.
fn stem(frame: &str) -> &str {
    let file = frame.rsplit(['/', '\\']).next().unwrap_or(frame);
    file.split_once('.').map_or(file, |(stem, _)| stem)
}

fn read_text(bytes: &[u8]) -> Result<Vec<[[f64; 4]; 4]>, FormatError> {
    let text = std::str::from_utf8(bytes).map_err(|_| {
        KIND.malformed("neither 12 numbers a line, nor JSON, nor Argoverse 2's feather")
    })?;
    let mut poses = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim().is_empty() {
            continue;
        }
        if poses.len() == MAX_POSES {
            return Err(KIND.too_large(format!("more than {MAX_POSES} poses")));
        }
        let wrong = || KIND.malformed(format!("line {} is not 12 numbers", index + 1));
        let mut words = line.split_ascii_whitespace();
        let mut numbers = [0.0; 12];
        for number in &mut numbers {
            let word = words.next().ok_or_else(wrong)?;
            *number = word.parse().map_err(|_| wrong())?;
        }
        if words.next().is_some() {
            return Err(wrong());
        }
        poses.push(with_last_row(&numbers));
    }
    Ok(poses)
}

/// The rows of Argoverse 2's table in the order of their times.
struct TimedPoses {
    /// The time, nanoseconds, and the values of [`AV2_COLUMNS`].
    rows: Vec<(f64, [f64; 7])>,
}

impl TimedPoses {
    fn read(bytes: &[u8]) -> Result<Self, FormatError> {
        let table = Table::open(bytes)?;
        if table.rows() > MAX_POSES {
            return Err(FileKind::Feather.too_large(format!("more than {MAX_POSES} poses")));
        }
        // Numbers of real poses hardly compress: a row takes more than a quarter of its memory.
        let (size, rows) = (bytes.len(), table.rows());
        if rows > size / (size_of::<(f64, [f64; 7])>() / 4) {
            return Err(FileKind::Feather.too_large(format!("{size} bytes claim {rows} poses")));
        }
        let mut rows = vec![(0.0, [0.0; 7]); rows];
        table.each("timestamp_ns", |row, stamp| {
            rows[row].0 = stamp;
            Ok(())
        })?;
        for (column, name) in AV2_COLUMNS.into_iter().enumerate() {
            table.each(name, |row, value| {
                rows[row].1[column] = value;
                Ok(())
            })?;
        }
        // Stable: of rows with one time the first one counts.
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(Self { rows })
    }

    fn pose(&self, sweep: &str) -> Result<RigidTransform, FormatError> {
        // Nanoseconds in float64, as `Table::each` gives them.
        let in_nanoseconds = |time: &SweepTime| time.unit == TimeUnit::Nanoseconds;
        let stamp = SweepTime::from_name(sweep).filter(in_nanoseconds);
        let stamp = stamp.map(|time| time.ticks);
        // A clock that began later has fewer digits.
        let stamp = stamp.or_else(|| stem(sweep).parse().ok());
        let Some(time) = stamp.map(|stamp| stamp as f64) else {
            return Err(FileKind::Feather.unsupported(format!(
                "poses are found by time stamp, and the sweep {} is not named by one",
                shorten(sweep)
            )));
        };
        let first = self
            .rows
            .partition_point(|row| row.0.total_cmp(&time).is_lt());
        let Some((_, values)) = self.rows.get(first).filter(|row| row.0 == time) else {
            let present = [format!("{} poses of other times", self.rows.len())];
            let what = format!("a pose at the time of {}", shorten(sweep));
            return Err(FileKind::Feather.missing(what, &present));
        };
        let [w, x, y, z, translation @ ..] = *values;
        let rotation = Quaternion::new(w, x, y, z);
        let is_unit = (rotation.norm() - 1.0).abs() <= UNIT_TOLERANCE;
        if !is_unit || translation.iter().any(|metres| !metres.is_finite()) {
            return Err(FormatError::Motion("a pose is not a rigid transform"));
        }
        Ok(RigidTransform::from_parts(
            Translation3::from(translation),
            UnitQuaternion::from_quaternion(rotation),
        ))
    }
}
