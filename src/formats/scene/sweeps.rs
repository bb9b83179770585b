//! The sweeps of a scene.

use std::io;
use std::ops::RangeInclusive;
use std::sync::Arc;

use hdf5_reader::group::Group;
use hdf5_reader::storage::RangeRequestStorage;
use hdf5_reader::{Hdf5File, OpenOptions};

use super::arrays::{Array, KIND, declared_bytes, malformed};
use super::filters::filters;
use crate::flow::Point;
use crate::formats::error::FormatError;
use crate::formats::limits::{check_flag, check_value, unfold_budget, unfold_limit};
use crate::formats::pair::check_count;
use crate::formats::point_times::{PointTimes, TimesColumn};

/// The columns of a point or of a displacement.
const AXES: [&str; 3] = ["x", "y", "z"];

/// A scene of OpenSceneFlow: a group for each sweep, whose name is its time, a whole number.
pub struct Scene {
    file: Hdf5File,
    /// Time and name of the group, in order of time.
    sweeps: Vec<(u64, String)>,
}

/// A sweep of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneSweep {
    /// N points, metres, in the sensor's frame.
    pub points: Vec<Point>,
    /// N flags: which points lie on the ground, where known.
    pub ground: Option<Vec<bool>>,
    /// Times of the points, where the file has them.
    pub times: Option<PointTimes>,
    /// Why the times of the points are not used.
    pub refused_times: Option<String>,
}

impl Scene {
    /// Opens a file of `length` bytes. `read_at` fills its buffer with the bytes from an offset.
    ///
    /// # Errors
    /// - `Malformed` for a file that violates the format.
    /// - `Missing` without a group that is named by a time.
    /// - `TooLarge` for arrays that together have far more bytes than the file.
    pub fn open(
        length: u64,
        read_at: impl Fn(u64, &mut [u8]) -> io::Result<()> + Send + Sync + 'static,
    ) -> Result<Self, FormatError> {
        let limit = unfold_limit(usize::try_from(length).unwrap_or(usize::MAX));
        let limit = usize::try_from(limit).unwrap_or(usize::MAX);
        let storage = RangeRequestStorage::new(length, move |offset, len| {
            let mut bytes = vec![0; len];
            read_at(offset, &mut bytes)?;
            Ok(bytes)
        });
        let options = OpenOptions::default()
            .with_max_read_bytes(limit)
            .with_max_chunk_bytes(limit)
            .with_chunk_cache_bytes(0)
            .with_filter_registry(filters(limit));
        let file = Hdf5File::from_storage_with_options(Arc::new(storage), options);
        let file = file.map_err(|error| malformed(&error))?;
        let root = file.root_group().map_err(|error| malformed(&error))?;
        let (groups, _) = root.member_names().map_err(|error| malformed(&error))?;
        let time = |name: String| match name.bytes().all(|byte| byte.is_ascii_digit()) {
            true => Some((name.parse().ok()?, name)),
            false => None,
        };
        let mut sweeps: Vec<(u64, String)> = groups.iter().cloned().filter_map(time).collect();
        sweeps.sort_unstable();
        if sweeps.is_empty() {
            return Err(KIND.missing("a group for each sweep, named by its time", &groups));
        }
        // Many names may lead to one array. A group that cannot be read is an error of its sweep.
        let groups = sweeps.iter().filter_map(|(_, name)| root.group(name).ok());
        let declared = groups.fold(0, |sum: u64, group| {
            sum.saturating_add(declared_bytes(&group))
        });
        if declared > unfold_budget(length) {
            return Err(KIND.too_large(format!(
                "its arrays declare {declared} bytes, far more than a file of {length} bytes holds"
            )));
        }
        Ok(Self { file, sweeps })
    }

    /// The names of the sweeps' groups, in order of time: digits.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.sweeps.iter().map(|(_, name)| name.as_str())
    }

    /// The group of a sweep.
    ///
    /// # Panics
    /// There is no sweep of this index.
    pub(super) fn group(&self, index: usize) -> Result<Group, FormatError> {
        let root = self.file.root_group();
        let group = root.and_then(|root| root.group(&self.sweeps[index].1));
        group.map_err(|error| malformed(&error))
    }

    /// Reads a sweep: `lidar` (N x 3 or more), and where they are there `ground_mask` and `lidar_dt`,
    /// seconds (N).
    ///
    /// # Errors
    /// - `Malformed` for a file that violates the format.
    /// - `Missing` without `lidar`.
    /// - `Unsupported` for an array of another shape, or of anything but numbers and booleans.
    /// - `NotFinite` and `OutOfRange` for a coordinate that is none.
    /// - `TooLarge` for more than [`MAX_POINTS`](crate::formats::MAX_POINTS) points, or an array of more
    ///   bytes than the file may unfold to.
    /// - `RowCount` for an array that does not have a row for each point.
    ///
    /// # Panics
    /// There is no sweep of this index.
    pub fn sweep(&self, index: usize) -> Result<SceneSweep, FormatError> {
        let group = self.group(index)?;
        let points = vectors(&group, "lidar", 3..=usize::MAX)?;
        let points = points.ok_or_else(|| KIND.missing("the array lidar", &[]))?;
        let ground = flags(&group, "ground_mask", points.len())?;
        let mut column = None;
        if let Some(array) = per_point(&group, "lidar_dt", points.len())? {
            let mut times = TimesColumn::named("lidar_dt");
            for row in 0..array.rows {
                let [time] = array.row(row);
                times.push(time);
            }
            column = Some(times);
        }
        let read = TimesColumn::used(column);
        Ok(SceneSweep {
            points,
            ground,
            times: read.times,
            refused_times: read.refused,
        })
    }
}

/// An array of displacements or points: its first three columns, of so many.
pub(super) fn vectors(
    group: &Group,
    name: &str,
    columns: RangeInclusive<usize>,
) -> Result<Option<Vec<Point>>, FormatError> {
    let Some(array) = Array::read(group, name)? else {
        return Ok(None);
    };
    if !columns.contains(&array.columns) {
        let text = format!("{name} has {} columns, not 3", array.columns);
        return Err(KIND.unsupported(text));
    }
    let mut points = Vec::with_capacity(array.rows);
    for row in 0..array.rows {
        let mut point = [0.0; 3];
        for (axis, value) in array.row::<3>(row).into_iter().enumerate() {
            point[axis] = check_value(KIND, row, AXES[axis], value)?;
        }
        points.push(point);
    }
    Ok(Some(points))
}

/// An array with one number for each of `count` points.
pub(super) fn per_point(
    group: &Group,
    name: &str,
    count: usize,
) -> Result<Option<Array>, FormatError> {
    let array = Array::read(group, name)?;
    if let Some(array) = &array {
        check_count(name, array.rows, count)?;
        if array.columns != 1 {
            let text = format!("{name} has {} columns, not 1", array.columns);
            return Err(KIND.unsupported(text));
        }
    }
    Ok(array)
}

/// An array of flags, one for each of `count` points.
pub(super) fn flags(
    group: &Group,
    name: &str,
    count: usize,
) -> Result<Option<Vec<bool>>, FormatError> {
    let Some(array) = per_point(group, name, count)? else {
        return Ok(None);
    };
    let flag = |row| {
        let [value] = array.row(row);
        check_flag(KIND, row, name, value)
    };
    (0..count).map(flag).collect::<Result<_, _>>().map(Some)
}
