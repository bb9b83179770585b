//! True depth image of a street: one exact ray per pixel, without noise and loss.

use rayon::prelude::*;

use super::scene::{FARTHEST_M, Scene, Target};
use super::terrain::Terrain;
use crate::flow::data::RigidTransform;
use crate::flow::depth::{Camera, DepthImage};

/// Depth image of a camera at `world_from_camera`; `targets` are in the camera's frame. The maximum
/// range is that of the lidar.
pub(super) fn depth(
    camera: &Camera,
    terrain: &Terrain,
    world_from_camera: &RigidTransform,
    targets: &[Target],
) -> DepthImage {
    let [width, height] = [camera.width(), camera.height()];
    // The rays of a column lie in one plane through the camera center. A solid that does not
    // intersect the plane is skipped.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;
    use crate::flow::depth::Intrinsics;
    use crate::flow::simulate::shapes::Shape;

    /// A wide camera that faces along the street's x, slightly downward.
    fn camera() -> (Camera, RigidTransform) {
        let intrinsics = Intrinsics {
            fx: 30.0,
            fy: 30.0,
            cx: 29.5,
            cy: 14.5,
        };
        let camera = Camera::new(intrinsics, RigidTransform::identity(), [60, 30]).unwrap();
        let tilted = nalgebra::UnitQuaternion::from_euler_angles(-1.7, 0.0, -1.6);
        let pose = RigidTransform::from_parts([0.0, 0.0, 1.7].into(), tilted);
        (camera, pose)
    }

    fn solids(world_from_camera: &RigidTransform, random: &mut Random) -> Vec<Target> {
        let shapes = [
            Shape::Box([0.5, 1.5, 1.0]),
            Shape::Cylinder {
                radius: 0.3,
                half_height: 2.0,
            },
            Shape::Ellipsoid([2.0, 1.0, 0.8]),
        ];
        let solid = |index: usize| {
            let position = [
                random.uniform(-30.0, 60.0),
                random.uniform(-30.0, 30.0),
                random.uniform(0.0, 4.0),
            ];
            let turn = nalgebra::UnitQuaternion::from_euler_angles(
                random.uniform(-0.2, 0.2),
                0.0,
                random.uniform(-3.0, 3.0),
            );
            let world_from_solid = RigidTransform::from_parts(position.into(), turn);
            Target {
                shape: shapes[index % 3],
                sensor_from_solid: world_from_camera.inv_mul(&world_from_solid),
                object: index as i32,
            }
        };
        (0..120).map(solid).collect()
    }

    #[test]
    fn no_column_misses_a_solid_that_its_rays_meet() {
        let mut random = Random::new(3);
        let terrain = Terrain::new(0.002, &mut random);
        let (camera, pose) = camera();
        let targets = solids(&pose, &mut random);
        let image = depth(&camera, &terrain, &pose, &targets);
        let everything = Scene::new(&terrain, &pose, &targets, 1, |_, meet| meet(0));
        let [mut solids, mut ground] = [0, 0];
        for (index, &found) in image.metres.iter().enumerate() {
            let ray = camera.ray(index as u32 % 60, index as u32 / 60).normalize();
            let hit = everything.first_hit(0, &ray);
            let hit = hit.filter(|(hit, _)| hit.range <= FARTHEST_M);
            let expected = hit.map_or(0.0, |(hit, _)| (hit.range * ray.z) as f32);
            assert_eq!(found, expected, "pixel {index}");
            match hit {
                Some((_, Some(_))) => solids += 1,
                Some((_, None)) => ground += 1,
                None => {}
            }
        }
        assert!(solids > 100 && ground > 100, "{solids} {ground}");
    }
}
