//! Clusters as npz arrays and as JSON objects: writing and reading.

use serde::{Deserialize, Serialize};

use crate::flow::{Cluster, Objects, OrientedBox, Point};
use crate::formats::error::{FileKind, FormatError};
use crate::formats::limits::{check_flag, check_id, check_probability, check_value};
use crate::formats::npy;
use crate::formats::npz::{Npz, NpzWriter};
use crate::formats::pair::check_count;

/// Writes the cluster arrays that [`super::FlowFormat::Npz`] lists.
pub(super) fn put(objects: &Objects, npz: &mut NpzWriter) -> Result<(), FormatError> {
    let Objects {
        cluster,
        confidence,
        moving,
        clusters,
    } = objects;
    npz.array("cluster", |out| npy::write_ids(out, cluster))?;
    npz.values("confidence", confidence)?;
    npz.values("moving", moving)?;
    let points: Vec<u32> = clusters.iter().map(|cluster| cluster.points).collect();
    npz.array("clusters_points", |out| npy::write_counts(out, &points))?;
    let dynamic: Vec<bool> = clusters.iter().map(|cluster| cluster.dynamic).collect();
    npz.mask("clusters_dynamic", &dynamic)?;
    let mut points = |name: &str, point: fn(&Cluster) -> Point| {
        let points: Vec<Point> = clusters.iter().map(point).collect();
        npz.points(name, &points)
    };
    points("clusters_center", |cluster| cluster.bounds.center)?;
    points("clusters_size", |cluster| cluster.bounds.size)?;
    points("clusters_velocity", |cluster| cluster.velocity)?;
    let mut values = |name: &str, value: fn(&Cluster) -> f32| {
        let values: Vec<f32> = clusters.iter().map(value).collect();
        npz.values(name, &values)
    };
    values("clusters_yaw", |cluster| cluster.bounds.yaw)?;
    values("clusters_yaw_rate", |cluster| cluster.yaw_rate)?;
    values("clusters_confidence", |cluster| cluster.confidence)?;
    values("clusters_moving", |cluster| cluster.moving)
}

/// Reads the clusters that [`put`] writes. `None` where the file has none.
pub(super) fn take(npz: &mut Npz<'_>) -> Result<Option<Vec<Cluster>>, FormatError> {
    const KIND: FileKind = FileKind::Npz;
    let Some(counts) = npz.column("clusters_points", |row, value| {
        let points = check_id(KIND, row, "clusters_points", value)?;
        let negative = || KIND.malformed(format!("clusters_points has {points} in row {row}"));
        u32::try_from(points).map_err(|_| negative())
    })?
    else {
        return Ok(None);
    };
    let count = counts.len();
    let dynamic = npz.column("clusters_dynamic", |row, value| {
        check_flag(KIND, row, "clusters_dynamic", value)
    })?;
    let dynamic = dynamic.unwrap_or_default();
    check_count("clusters_dynamic", dynamic.len(), count)?;
    let mut points = |name: &str| {
        let points = npz.points(name)?;
        check_count(name, points.len(), count)?;
        Ok::<_, FormatError>(points)
    };
    let [centers, sizes, velocities] = [
        points("clusters_center")?,
        points("clusters_size")?,
        points("clusters_velocity")?,
    ];
    let mut values =
        |name: &str, check: fn(FileKind, usize, &str, f64) -> Result<f32, FormatError>| {
            let values = npz.column(name, |row, value| check(KIND, row, name, value))?;
            let values = values.unwrap_or_default();
            check_count(name, values.len(), count)?;
            Ok::<_, FormatError>(values)
        };
    let yaws = values("clusters_yaw", check_value)?;
    let yaw_rates = values("clusters_yaw_rate", check_value)?;
    let confidence = values("clusters_confidence", check_probability)?;
    let moving = values("clusters_moving", check_probability)?;
    let clusters = (0..count).map(|row| Cluster {
        points: counts[row],
        dynamic: dynamic[row],
        bounds: OrientedBox {
            center: centers[row],
            size: sizes[row],
            yaw: yaws[row],
        },
        velocity: velocities[row],
        yaw_rate: yaw_rates[row],
        confidence: confidence[row],
        moving: moving[row],
    });
    Ok(Some(clusters.collect()))
}

/// A cluster as a JSON object: center and size in metres, yaw in radians, velocity in m/s, yaw rate
/// in rad/s. All numbers must be finite, because JSON has no others.
#[derive(Serialize, Deserialize)]
pub(super) struct Described {
    points: u32,
    dynamic: bool,
    center: Point,
    size: Point,
    yaw: f32,
    velocity: Point,
    yaw_rate: f32,
    confidence: f32,
    moving: f32,
}

impl From<&Cluster> for Described {
    fn from(cluster: &Cluster) -> Self {
        Self {
            points: cluster.points,
            dynamic: cluster.dynamic,
            center: cluster.bounds.center,
            size: cluster.bounds.size,
            yaw: cluster.bounds.yaw,
            velocity: cluster.velocity,
            yaw_rate: cluster.yaw_rate,
            confidence: cluster.confidence,
            moving: cluster.moving,
        }
    }
}

impl Described {
    /// The cluster, where its numbers are finite and in range. `row` is used in errors.
    pub(super) fn checked(self, kind: FileKind, row: usize) -> Result<Cluster, FormatError> {
        let vectors = [self.center, self.size, self.velocity];
        let values = vectors.iter().flatten().chain([&self.yaw, &self.yaw_rate]);
        for &value in values {
            check_value(kind, row, "clusters", f64::from(value))?;
        }
        check_probability(kind, row, "clusters.confidence", f64::from(self.confidence))?;
        check_probability(kind, row, "clusters.moving", f64::from(self.moving))?;
        Ok(Cluster {
            points: self.points,
            dynamic: self.dynamic,
            bounds: OrientedBox {
                center: self.center,
                size: self.size,
                yaw: self.yaw,
            },
            velocity: self.velocity,
            yaw_rate: self.yaw_rate,
            confidence: self.confidence,
            moving: self.moving,
        })
    }
}
