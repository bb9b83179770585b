//! Clusters as arrays and as JSON. It must not know how they were found.

use std::io::{Seek, Write};

use serde::Serialize;

use crate::flow::{Cluster, Objects, Point};
use crate::formats::error::FormatError;
use crate::formats::npy;
use crate::formats::npz::NpzWriter;

/// Writes what [`super::FlowFormat::Npz`] lists.
pub(super) fn put<W: Write + Seek>(
    objects: &Objects,
    npz: &mut NpzWriter<W>,
) -> Result<(), FormatError> {
    let Objects {
        cluster,
        confidence,
        clusters,
    } = objects;
    npz.array("cluster", |out| npy::write_ids(out, cluster))?;
    npz.array("confidence", |out| npy::write_values(out, confidence))?;
    let points: Vec<u32> = clusters.iter().map(|cluster| cluster.points).collect();
    npz.array("clusters_points", |out| npy::write_counts(out, &points))?;
    let dynamic: Vec<bool> = clusters.iter().map(|cluster| cluster.dynamic).collect();
    npz.mask("clusters_dynamic", &dynamic)?;
    let boxes = clusters.iter().map(|Cluster { bounds, .. }| {
        let ([x, y, z], [length, width, height]) = (bounds.center, bounds.size);
        [x, y, z, length, width, height, bounds.yaw]
    });
    let boxes: Vec<[f32; 7]> = boxes.collect();
    npz.array("clusters_box", |out| npy::write_rows(out, &boxes))?;
    let velocities: Vec<Point> = clusters.iter().map(|cluster| cluster.velocity).collect();
    npz.points("clusters_velocity", &velocities)?;
    let mut values = |name: &str, value: fn(&Cluster) -> f32| {
        let values: Vec<f32> = clusters.iter().map(value).collect();
        npz.array(name, |out| npy::write_values(out, &values))
    };
    values("clusters_yaw_rate", |cluster| cluster.yaw_rate)?;
    values("clusters_confidence", |cluster| cluster.confidence)
}

/// A cluster in JSON.
#[derive(Serialize)]
pub(in crate::formats) struct Described {
    points: u32,
    dynamic: bool,
    center: Point,
    size: Point,
    yaw: f32,
    velocity: Point,
    yaw_rate: f32,
    confidence: f32,
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
        }
    }
}
