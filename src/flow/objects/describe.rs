//! Description of a sweep's clusters: bounding boxes, velocities and confidences.

use rayon::prelude::*;

use super::confidence::Probabilities;
use super::features::ConfidenceFeatures;
use super::labels::ClusterLabels;
use super::search::ObjectSearch;
use crate::flow::data::{DYNAMIC_M, OrientedBox, Point, RigidTransform, transform_point};

/// The clusters of a sweep of N rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Objects {
    /// N indices into `clusters`, one for each row; [`Objects::NONE`] for rows in no cluster. No
    /// row has a cluster if the search was interrupted before or right after the clustering.
    pub cluster: Vec<i32>,
    /// N confidences, 0 to 1: the probability that the end-point error of a row's flow is below
    /// [`super::CONFIDENT_WITHIN_M`]. Zero for rows without a flow. Zero also for rows off the
    /// ground if the search was interrupted before or right after the clustering.
    pub confidence: Vec<f32>,
    /// N probabilities, 0 to 1: the probability that a row's point is displaced by at least
    /// [`DYNAMIC_M`], ego motion taken out. Zero wherever the confidence is.
    pub moving: Vec<f32>,
    /// K clusters, in descending order of their number of points.
    pub clusters: Vec<Cluster>,
}

/// A cluster: a moving object with the fragments that share its motion, or a static set of points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cluster {
    /// Number of rows of the sweep in this cluster.
    pub points: u32,
    /// Whether it moves with respect to the world: in one sweep interval its center is displaced
    /// horizontally by at least [`DYNAMIC_M`] (0.05 m), ego motion taken out.
    pub dynamic: bool,
    /// Upright bounding box of its points in the source's frame, metres. If the search found a
    /// motion, the box's length is the side whose direction is nearest to it. Otherwise it is the
    /// longer side.
    pub bounds: OrientedBox,
    /// Velocity of its center with the ego motion taken out, m/s along the axes of the source's
    /// frame: the displacement over [`crate::flow::Options::dt_s`]. Zero if the search found no
    /// motion. It can be above zero where `dynamic` is false.
    pub velocity: Point,
    /// Yaw rate about the vertical, rad/s, positive counterclockwise. Zero if the search found no
    /// motion.
    pub yaw_rate: f32,
    /// Mean confidence of its points, 0 to 1.
    pub confidence: f32,
    /// Mean of [`Objects::moving`] of its points, 0 to 1.
    pub moving: f32,
}

impl Objects {
    /// The value in [`Self::cluster`] of a row in no cluster.
    pub const NONE: i32 = -1;

    /// Describes the clusters of a sweep of `count` rows. `rows` are the rows that took part, and
    /// `points` their positions, metres in the source's frame. `search` is the search on these
    /// points with the `ego` motion (`target_from_source`) taken out. `dt_s` is the sweep interval,
    /// seconds.
    pub(crate) fn new(
        count: usize,
        rows: &[usize],
        points: &[Point],
        search: &ObjectSearch,
        ego: &RigidTransform,
        dt_s: f32,
    ) -> Self {
        let mut objects = Self {
            cluster: vec![Self::NONE; count],
            confidence: vec![0.0; count],
            moving: vec![0.0; count],
            clusters: Vec::new(),
        };
        let probabilities = search
            .evidence
            .par_iter()
            .map(ConfidenceFeatures::probabilities);
        let probabilities: Vec<Probabilities> = probabilities.collect();
        for (&row, probabilities) in rows.iter().zip(probabilities) {
            (objects.confidence[row], objects.moving[row]) =
                (probabilities.confidence, probabilities.moving);
        }
        let ClusterLabels { of, motions } = &search.parts;
        let mut members: Vec<Vec<usize>> = vec![Vec::new(); motions.len()];
        for (i, &cluster) in of
            .iter()
            .enumerate()
            .filter(|&(_, &c)| c != ClusterLabels::NONE)
        {
            objects.cluster[rows[i]] = cluster as i32;
            members[cluster as usize].push(i);
        }
        // The first clusters hold most of the points, so each cluster is a task of its own.
        let described = motions.par_iter().zip(&members).with_max_len(1);
        let described = described.map(|(&motion, members)| {
            let points: Vec<Point> = members.iter().map(|&i| points[i]).collect();
            let mean = |probabilities: &[f32]| {
                let sum: f32 = members.iter().map(|&i| probabilities[rows[i]]).sum();
                sum / members.len().max(1) as f32
            };
            let mut cluster = Cluster {
                points: points.len() as u32,
                confidence: mean(&objects.confidence),
                moving: mean(&objects.moving),
                ..Cluster::default()
            };
            let Some(motion) = motion else {
                cluster.bounds = OrientedBox::enclosing(&points, None);
                return cluster;
            };
            // The displacement depends little on the exact center.
            let center = OrientedBox::enclosing(&points, None).center;
            let way = search
                .motions
                .displacement(motion, transform_point(ego, center));
            let way = ego.inverse_transform_vector(&way.map(f64::from).into());
            let [x, y, z] = [way.x, way.y, way.z].map(|c| c as f32);
            cluster.velocity = [x, y, z].map(|c| c / dt_s);
            cluster.yaw_rate = search.motions.turn(motion) / dt_s;
            cluster.bounds = OrientedBox::enclosing(&points, Some([x, y]));
            cluster.dynamic = x.hypot(y) >= DYNAMIC_M;
            cluster
        });
        objects.clusters = described.collect();
        objects
    }

    /// Multiplies the confidences and the probabilities of motion of rows and clusters by `factor`, 0 to
    /// 1.
    pub(crate) fn scale_probabilities(&mut self, factor: f32) {
        let clusters = self.clusters.iter_mut();
        let of_clusters = clusters.flat_map(|of| [&mut of.confidence, &mut of.moving]);
        let of_rows = self.confidence.iter_mut().chain(&mut self.moving);
        for probability in of_rows.chain(of_clusters) {
            *probability *= factor;
        }
    }

    /// Sets the confidence and the probability of motion of rows without a flow to zero.
    pub(crate) fn clear_invalid(&mut self, valid: &[bool]) {
        for probabilities in [&mut self.confidence, &mut self.moving] {
            for (probability, _) in probabilities
                .iter_mut()
                .zip(valid)
                .filter(|&(_, valid)| !valid)
            {
                *probability = 0.0;
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
    use crate::flow::problem::Problem;
    use crate::flow::simulate::{Street, StreetOptions};

    #[test]
    fn clusters_of_a_street_hold_their_points_and_those_that_move_go_where_their_points_do() {
        /// Difference that the ego motion's rotation and rounding leave between the flow of the
        /// points and that of their box.
        const TOLERANCE_M: f32 = 0.3;
        let street = StreetOptions {
            seed: 3,
            beams: 32,
            azimuth_steps: 1000,
            ..StreetOptions::default()
        };
        let pair = Street::new(&street).and_then(|street| street.pair(0));
        let pair = pair.expect("a street");
        let problem = Problem::pair(&pair.source, &pair.target);
        let backend = CpuBackend::new(None).expect("threads");
        let options = Preset::Default.options(None);
        let estimate = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
        let objects = estimate.objects().cloned().expect("objects");
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
            let way = x.hypot(y) * options.dt_s;
            if cluster.dynamic {
                moving += 1;
                let [x, y] = [x, y].map(|c| c * options.dt_s);
                assert!((x - way * cos).hypot(y - way * sin) < way, "forward");
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
                let off = (mean(0).hypot(mean(1)) - way).abs();
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
        let mean = |dynamic: bool| {
            let clusters = objects.clusters.iter().filter(|c| c.dynamic == dynamic);
            let probabilities: Vec<f32> = clusters.map(|cluster| cluster.moving).collect();
            probabilities.iter().sum::<f32>() / probabilities.len() as f32
        };
        let (moves, stands) = (mean(true), mean(false));
        assert!(moves > 0.5 && stands < 0.1, "{moves} {stands}");
    }
}
