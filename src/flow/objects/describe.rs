//! What a sweep's points are parts of: clusters, their boxes and velocities, and how sure it all is.
//!
//! It must not know how clusters and their motions were found.

use rayon::prelude::*;

use super::labels::ClusterLabels;
use super::search::ObjectSearch;
use crate::flow::data::{DYNAMIC_M, OrientedBox, Point, RigidTransform, transform_point};

/// The clusters of a sweep of N rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Objects {
    /// N places in `clusters`, one of each row; [`Objects::NONE`] where a row is of none.
    pub cluster: Vec<i32>,
    /// N chances, 0 to 1, that a row's flow is less than [`super::SURE_M`] off; zero where it has none.
    pub confidence: Vec<f32>,
    /// K clusters, those with the most points first.
    pub clusters: Vec<Cluster>,
}

/// Points that belong together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cluster {
    /// Points that it has.
    pub points: u32,
    /// Whether it moves by itself.
    pub dynamic: bool,
    /// Where it is in the source, as its points show it; along its motion where it moves.
    pub bounds: OrientedBox,
    /// How far its center moves over the gap between the sweeps, ego motion left out: metres along
    /// the axes of the source. Zero where it stands still.
    pub velocity: Point,
    /// Radians that it turns about the vertical meanwhile, counterclockwise.
    pub yaw_rate: f32,
    /// The mean confidence of its points.
    pub confidence: f32,
}

impl Objects {
    /// Of no cluster.
    pub const NONE: i32 = -1;

    /// Of a sweep of `count` rows, of which `rows` were looked at: their `points`, metres in the
    /// sweep's frame, are what `labelled` speaks of, with the `ego` motion taken out.
    pub(crate) fn new(
        count: usize,
        rows: &[usize],
        points: &[Point],
        labelled: &ObjectSearch,
        ego: &RigidTransform,
    ) -> Self {
        let mut objects = Self {
            cluster: vec![Self::NONE; count],
            confidence: vec![0.0; count],
            clusters: Vec::new(),
        };
        for (&row, evidence) in rows.iter().zip(&labelled.evidence) {
            objects.confidence[row] = evidence.confidence();
        }
        let ClusterLabels { of, motions } = &labelled.parts;
        let mut members: Vec<Vec<usize>> = vec![Vec::new(); motions.len()];
        for (i, &cluster) in of
            .iter()
            .enumerate()
            .filter(|&(_, &c)| c != ClusterLabels::NONE)
        {
            objects.cluster[rows[i]] = cluster as i32;
            members[cluster as usize].push(i);
        }
        let described = motions.par_iter().zip(&members).map(|(&motion, members)| {
            let points: Vec<Point> = members.iter().map(|&i| points[i]).collect();
            let sure: f32 = members.iter().map(|&i| objects.confidence[rows[i]]).sum();
            let mut cluster = Cluster {
                points: points.len() as u32,
                confidence: sure / points.len().max(1) as f32,
                ..Cluster::default()
            };
            let Some(motion) = motion else {
                cluster.bounds = OrientedBox::around(&points, None);
                return cluster;
            };
            // Where its center goes does not depend much on where exactly that is.
            let center = OrientedBox::around(&points, None).center;
            let way = labelled
                .motions
                .displacement(motion, transform_point(ego, center));
            let way = ego.inverse_transform_vector(&way.map(f64::from).into());
            cluster.velocity = [way.x, way.y, way.z].map(|c| c as f32);
            cluster.yaw_rate = labelled.motions.turn(motion);
            let [x, y, _] = cluster.velocity;
            cluster.bounds = OrientedBox::around(&points, Some([x, y]));
            cluster.dynamic = x.hypot(y) >= DYNAMIC_M;
            cluster
        });
        objects.clusters = described.collect();
        objects
    }

    /// Nothing is sure of rows that have no flow.
    pub(crate) fn sure_of(&mut self, valid: &[bool]) {
        for (confidence, &valid) in self.confidence.iter_mut().zip(valid) {
            if !valid {
                *confidence = 0.0;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::cpu::CpuBackend;
    use crate::flow::data::Uncontrolled;
    use crate::flow::estimate::estimate;
    use crate::flow::options::Preset;
    use crate::flow::select::Problem;
    use crate::flow::simulate::{Street, StreetOptions};

    #[test]
    fn clusters_of_a_street_hold_their_points_and_those_that_move_go_where_their_points_do() {
        /// What the ego motion's rotation and rounding leave between a point's flow and its box's.
        const TOLERANCE_M: f32 = 0.3;
        let street = StreetOptions {
            seed: 3,
            beams: 32,
            azimuth_steps: 1000,
            ..StreetOptions::default()
        };
        let pair = Street::new(&street).and_then(|street| street.pair(0));
        let pair = pair.expect("a street");
        let problem = Problem {
            source: &pair.source,
            target: &pair.target,
            ground: None,
            before: None,
            around: &[],
        };
        let backend = CpuBackend::new(None).expect("threads");
        let options = Preset::Default.options(None);
        let estimate = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
        let objects = estimate.objects.expect("objects");
        let dynamic = estimate.dynamic.expect("the ego motion is known");
        let sizes = objects.clusters.iter().map(|cluster| cluster.points);
        assert!(sizes.is_sorted_by(|a, b| a >= b));
        let mut moving = 0;
        for (number, cluster) in (0..).zip(&objects.clusters) {
            let rows = || (0..pair.source.len()).filter(|&row| objects.cluster[row] == number);
            assert_eq!(rows().count(), cluster.points as usize);
            let OrientedBox { center, size, yaw } = cluster.bounds;
            let (sin, cos) = yaw.sin_cos();
            for row in rows() {
                let [x, y, z] = core::array::from_fn(|a| pair.source[row][a] - center[a]);
                let [x, y] = [x * cos + y * sin, y * cos - x * sin];
                for (off, size) in [x, y, z].into_iter().zip(size) {
                    assert!(off.abs() <= size / 2.0 + 1e-3, "{cluster:?}");
                }
                assert_eq!(dynamic[row], cluster.dynamic, "{cluster:?}");
            }
            let [x, y, _] = cluster.velocity;
            let speed = x.hypot(y);
            if cluster.dynamic {
                moving += 1;
                assert!((x - speed * cos).hypot(y - speed * sin) < speed, "forward");
                let ego = estimate.ego.expect("it is known");
                let still = transform_point(&ego, center);
                let rows: Vec<usize> = rows().collect();
                let mean = |a: usize| {
                    let of = |&row: &usize| {
                        let aligned = transform_point(&ego, pair.source[row]);
                        pair.source[row][a] + estimate.flow[row][a] - aligned[a]
                    };
                    rows.iter().map(of).sum::<f32>() / rows.len() as f32
                };
                let off = (mean(0).hypot(mean(1)) - speed).abs();
                assert!(off < TOLERANCE_M, "{cluster:?} {still:?} {off}");
            } else {
                assert_eq!(cluster.velocity, [0.0; 3]);
            }
        }
        assert!(moving >= 2, "{moving} of them move");
        let sure = objects.confidence.iter().zip(&estimate.valid);
        for (&confidence, &valid) in sure {
            assert!((0.0..=1.0).contains(&confidence));
            assert!(valid == (confidence > 0.0));
        }
    }
}
