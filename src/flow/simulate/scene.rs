//! Ray casting from a common origin: solids, nearest first, and the ground.
//!
//! Rays are grouped in columns. The caller lists the solids that each column can hit.

use nalgebra::{Matrix3, Vector3};

use super::shapes::{Hit, Shape};
use super::terrain::Terrain;
use crate::flow::data::RigidTransform;

/// Maximum range, metres. Returns from farther away are dropped.
pub(super) const FARTHEST_M: f64 = 120.0;

/// A solid in the sensor's frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Target {
    pub(super) shape: Shape,
    /// Pose of the solid, sensor_from_solid.
    pub(super) sensor_from_solid: RigidTransform,
    /// Index of the object it belongs to, -1 for none.
    pub(super) object: i32,
}

/// A target, preprocessed for many rays from the sensor's origin.
struct Prepared {
    shape: Shape,
    origin: Vector3<f64>,
    solid_from_sensor: Matrix3<f64>,
    object: i32,
    nearest: f64,
}

/// The scene of a sweep or an image.
pub(super) struct Scene<'a> {
    terrain: &'a Terrain,
    world_from_sensor: &'a RigidTransform,
    targets: Vec<Prepared>,
    /// Per column: the targets that its rays can hit, nearest first.
    columns: Vec<Vec<u32>>,
}

impl<'a> Scene<'a> {
    /// Sorts the targets by distance and lists for each of `columns` columns those that its rays
    /// can hit. `spread` calls its second argument with the index of each such column.
    pub(super) fn new(
        terrain: &'a Terrain,
        world_from_sensor: &'a RigidTransform,
        targets: &[Target],
        columns: usize,
        spread: impl Fn(&Target, &mut dyn FnMut(usize)),
    ) -> Self {
        let reach = |target: &Target| {
            let center = target.sensor_from_solid.translation.vector;
            center.norm() - target.shape.bounding_radius()
        };
        let mut near: Vec<(f64, &Target)> = targets
            .iter()
            .map(|target| (reach(target), target))
            .filter(|&(nearest, _)| nearest < FARTHEST_M)
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0));

        let mut columns = vec![Vec::new(); columns];
        for (index, (_, target)) in near.iter().enumerate() {
            spread(target, &mut |column| columns[column].push(index as u32));
        }
        Self {
            terrain,
            world_from_sensor,
            targets: near.into_iter().map(Prepared::new).collect(),
            columns,
        }
    }

    /// First hit of a ray of unit length: a solid with its object, or the ground with none.
    pub(super) fn first_hit(
        &self,
        column: usize,
        direction: &Vector3<f64>,
    ) -> Option<(Hit, Option<i32>)> {
        let mut first: Option<(Hit, Option<i32>)> = None;
        let mut limit = FARTHEST_M + 1.0;
        for &index in &self.columns[column] {
            let target = &self.targets[index as usize];
            if target.nearest > limit {
                break;
            }
            let local = target.solid_from_sensor * direction;
            if let Some(hit) = target.shape.hit(&target.origin, &local)
                && hit.range < limit
            {
                limit = hit.range;
                first = Some((hit, Some(target.object)));
            }
        }
        let origin = self.world_from_sensor.translation.vector;
        let world_direction = self.world_from_sensor.rotation * direction;
        let ground = self.terrain.hit(&origin, &world_direction, limit);
        ground.map(|hit| (hit, None)).or(first)
    }
}

impl Prepared {
    fn new((nearest, target): (f64, &Target)) -> Self {
        let solid_from_sensor = target.sensor_from_solid.inverse();
        Self {
            shape: target.shape,
            origin: solid_from_sensor.translation.vector,
            solid_from_sensor: *solid_from_sensor.rotation.to_rotation_matrix().matrix(),
            object: target.object,
            nearest,
        }
    }
}
