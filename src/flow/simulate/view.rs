//! The true depth of a street through a camera: one exact ray a pixel, no noise, no loss.
//!
//! It must not know the lidar: nothing but the world is common to both.

use super::scene::{FARTHEST_M, Scene, Target};
use super::terrain::Terrain;
use crate::flow::RigidTransform;
use crate::flow::depth::{Camera, DepthImage};
use rayon::prelude::*;

/// What a camera sees from `world_from_camera`; `targets` are in the camera's frame. Depth ends
/// where the lidar's range does.
pub(super) fn depth(
    camera: &Camera,
    terrain: &Terrain,
    world_from_camera: &RigidTransform,
    targets: &[Target],
) -> DepthImage {
    let [width, height] = [camera.width(), camera.height()];
    // A column's rays lie in one plane through the camera, upright in the image; a solid that
    // the plane misses is not met.
    let normals: Vec<[f64; 2]> = (0..width)
        .map(|column| {
            let across = camera.ray(column, 0).x;
            let length = across.hypot(1.0);
            [1.0 / length, -across / length]
        })
        .collect();
    let spread = |target: &Target, meet: &mut dyn FnMut(usize)| {
        let center = target.sensor_from_solid.translation.vector;
        let radius = target.shape.bounding_radius();
        if center.z < -radius {
            return;
        }
        for (column, [x, z]) in normals.iter().enumerate() {
            if (x * center.x + z * center.z).abs() <= radius {
                meet(column);
            }
        }
    };
    let columns = width as usize;
    let scene = Scene::new(terrain, world_from_camera, targets, columns, spread);
    let pixel = |row: u32, column: u32| {
        let direction = camera.ray(column, row).normalize();
        scene
            .first_hit(column as usize, &direction)
            .filter(|(hit, _)| hit.range <= FARTHEST_M)
            .map_or(0.0, |(hit, _)| (hit.range * direction.z) as f32)
    };
    let rows: Vec<Vec<f32>> = (0..height)
        .into_par_iter()
        .map(|row| (0..width).map(|column| pixel(row, column)).collect())
        .collect();
    DepthImage {
        width,
        height,
        metres: rows.concat(),
    }
}
