//! Returns of the vehicle that carries the sensor: its hood, roof and mirrors.
//!
//! They are at rest relative to the sensor. With the ego motion taken out they move against the
//! world, as an object that the sensor sits in.

use super::describe::{Cluster, Objects};
use crate::flow::data::{Point, RigidTransform, square_distance, transform_point};

/// Distance from the sensor within which a cluster can be a part of the vehicle, metres. A rider who
/// keeps up beside a car is farther away.
const WITHIN_M: f32 = 2.0;
/// Largest motion of such a part relative to the sensor, metres a sweep.
const AT_REST_M: f32 = 0.05;
/// Least motion of the sensor by which a part of its vehicle can be told from the world, metres a
/// sweep.
const DRIVES_M: f32 = 0.2;

impl Objects {
    /// Takes the clusters of the vehicle itself away and returns their rows. `source` are the N points
    /// of the rows, and `measured` the same points before any deskewing, by which they are near the
    /// sensor. `ego` is the ego motion, target_from_source, and `dt_s` the sweep interval, seconds. A
    /// vehicle that moves by less than 0.2 m a sweep cannot be told from the world.
    pub(crate) fn take_own(
        &mut self,
        [source, measured]: [&[Point]; 2],
        ego: &RigidTransform,
        dt_s: f32,
    ) -> Vec<usize> {
        let mut deskewed_by = vec![[0.0; 2]; self.clusters.len()];
        for ((&cluster, to), from) in self.cluster.iter().zip(source).zip(measured) {
            if let Ok(index) = usize::try_from(cluster)
                && self.clusters[index].dynamic
            {
                let count = self.clusters[index].points as f32;
                for axis in 0..2 {
                    deskewed_by[index][axis] += (to[axis] - from[axis]) / count;
                }
            }
        }
        let clusters = self.clusters.iter().zip(deskewed_by);
        let own: Vec<bool> = clusters
            .map(|(cluster, by)| is_own(cluster, by, ego, dt_s))
            .collect();
        let mut next = 0;
        let numbers: Vec<i32> = own
            .iter()
            .map(|&is_own| {
                let number = if is_own { Self::NONE } else { next };
                next += i32::from(!is_own);
                number
            })
            .collect();
        let mut rows = Vec::new();
        for (row, cluster) in self.cluster.iter_mut().enumerate() {
            if let Ok(index) = usize::try_from(*cluster) {
                *cluster = numbers[index];
                if own[index] {
                    rows.push(row);
                }
            }
        }
        let mut own = own.into_iter();
        self.clusters.retain(|_| !own.next().unwrap_or(false));
        rows
    }
}

/// Whether a cluster is a part of the vehicle that carries the sensor: near to it, at rest relative
/// to it, and moving. Deskewing has moved its points by the mean `deskewed_by`, metres.
fn is_own(cluster: &Cluster, deskewed_by: [f32; 2], ego: &RigidTransform, dt_s: f32) -> bool {
    let center = cluster.bounds.center;
    let length = |a: Point, b: Point| square_distance(a, b).sqrt();
    let moved = core::array::from_fn(|a| center[a] + cluster.velocity[a] * dt_s);
    cluster.dynamic
        && (center[0] - deskewed_by[0]).hypot(center[1] - deskewed_by[1]) <= WITHIN_M
        && length(transform_point(ego, center), center) >= DRIVES_M
        && length(transform_point(ego, moved), center) <= AT_REST_M
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::OrientedBox;

    /// A cluster at `center` that moves by `way` in a sweep of 0.1 s.
    fn cluster(center: Point, way: Point) -> Cluster {
        Cluster {
            points: 1,
            dynamic: way != [0.0; 3],
            bounds: OrientedBox {
                center,
                ..OrientedBox::default()
            },
            velocity: way.map(|c| c * 10.0),
            ..Cluster::default()
        }
    }

    fn taken(clusters: Vec<Cluster>, drive_m: f32, deskewed_m: f32) -> (Vec<usize>, Vec<i32>) {
        let count = clusters.len();
        let [source, measured] = [deskewed_m, 0.0].map(|x| vec![[x, 0.0, 0.0]; count + 1]);
        let mut objects = Objects {
            cluster: (0..count as i32).chain([Objects::NONE]).collect(),
            confidence: vec![0.5; count + 1],
            moving: vec![0.5; count + 1],
            clusters,
        };
        let ego = RigidTransform::translation(-f64::from(drive_m), 0.0, 0.0);
        let rows = objects.take_own([&source, &measured], &ego, 0.1);
        assert_eq!(objects.clusters.len() + rows.len(), count);
        (rows, objects.cluster)
    }

    #[test]
    fn what_keeps_up_with_the_sensor_and_is_near_is_the_vehicle_and_others_keep_their_order() {
        let clusters = vec![
            cluster([9.0, 0.0, 0.0], [0.6, 0.0, 0.0]),
            cluster([0.8, 0.3, -0.5], [0.6, 0.01, 0.0]),
            cluster([1.0, 0.0, -0.5], [0.0; 3]),
            cluster([1.0, 0.0, -0.5], [0.4, 0.0, 0.0]),
        ];
        let (rows, left) = taken(clusters, 0.6, 0.0);
        assert_eq!(rows, [1]);
        assert_eq!(left, [0, -1, 1, 2, -1]);
    }

    #[test]
    fn of_a_vehicle_that_hardly_moves_nothing_is_taken() {
        let (rows, _) = taken(vec![cluster([0.8, 0.3, -0.5], [0.1, 0.0, 0.0])], 0.1, 0.0);
        assert!(rows.is_empty());
    }

    #[test]
    fn what_is_near_is_near_where_it_was_measured() {
        // At 30 m/s deskewing moves a point of the middle of the sweep by 1.5 m.
        let hood = || vec![cluster([3.0, 0.0, -0.5], [3.0, 0.0, 0.0])];
        assert_eq!(taken(hood(), 3.0, 1.5).0, [0]);
        assert!(taken(hood(), 3.0, 0.0).0.is_empty());
    }
}
