//! The final cluster of each source point: a moving object with the fragments assigned to it, or a
//! static cluster.

use crate::flow::spatial::NOISE;

/// The final clusters of a source of N points: K clusters, in descending order of their number of
/// points. A cluster is a moving object with the fragments assigned to it, or a static cluster.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ClusterLabels {
    /// N cluster indices, 0 to K - 1, one for each source point; [`ClusterLabels::NONE`] for a
    /// point in no cluster. If a cluster moves, those of its points that do not follow its motion
    /// are in no cluster.
    pub of: Vec<u32>,
    /// K entries, one for each cluster: the index of its motion in [`super::ObjectMotions`]; none
    /// if the cluster is static.
    pub motions: Vec<Option<u32>>,
}

impl ClusterLabels {
    /// The value in [`Self::of`] of a point in no cluster.
    pub const NONE: u32 = NOISE;

    /// From the DBSCAN `labels` of the source points. `cluster_motion` gives for each DBSCAN
    /// cluster the cluster whose motion it has, `point_motion` for each point the index of its
    /// motion, of `count`; [`NOISE`] is no motion.
    ///
    /// Points rejected from a moving object are in no cluster, since it is unknown which object
    /// they belong to.
    pub(super) fn new(
        labels: &[u32],
        cluster_motion: &[u32],
        point_motion: &[u32],
        count: usize,
    ) -> Self {
        let groups = count + cluster_motion.len();
        let of = labels.iter().zip(point_motion).map(|(&label, &owner)| {
            let stands = |label: u32| cluster_motion.get(label as usize) == Some(&NOISE);
            match owner {
                NOISE if stands(label) => count as u32 + label,
                owner => owner,
            }
        });
        let of: Vec<u32> = of.collect();
        let mut points = vec![0_usize; groups];
        for &group in of.iter().filter(|&&group| group != NOISE) {
            points[group as usize] += 1;
        }
        let mut order: Vec<u32> = (0..groups as u32).collect();
        order.retain(|&group| points[group as usize] > 0);
        order.sort_by_key(|&group| std::cmp::Reverse(points[group as usize]));
        let mut numbers = vec![NOISE; groups];
        for (number, &group) in (0..).zip(&order) {
            numbers[group as usize] = number;
        }
        let number = |group: u32| numbers.get(group as usize).copied().unwrap_or(NOISE);
        Self {
            of: of.into_iter().map(number).collect(),
            motions: order
                .into_iter()
                .map(|group| Some(group).filter(|&group| (group as usize) < count))
                .collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Point;
    use crate::flow::objects::motion_field::ObjectMotions;
    use crate::flow::objects::planar_motion::PlanarMotion;

    #[test]
    fn a_piece_is_of_the_mover_that_it_goes_with_and_what_stands_keeps_its_cluster() {
        let motion = PlanarMotion::still([0.0; 2]).shifted([1.0, 0.0]);
        // A car in two fragments, a wall, a stray point, and a point rejected from the car.
        let source: Vec<Point> = [0.0, 0.2, 1.0, 9.0, 9.2, 9.4, 9.6, 30.0, 3.0]
            .map(|x| [x, 0.0, 0.0])
            .to_vec();
        let labels = [0, 0, 1, 2, 2, 2, 2, NOISE, 0];
        let point_motion = [0, 0, 0, NOISE, NOISE, NOISE, NOISE, NOISE, NOISE];
        let point_motion =
            ObjectMotions::new(vec![motion], &source, &point_motion).owners_at(&source);
        let parts = ClusterLabels::new(&labels, &[0, 0, NOISE], &point_motion, 1);
        const NONE: u32 = ClusterLabels::NONE;
        assert_eq!(parts.of, [1, 1, 1, 0, 0, 0, 0, NONE, NONE]);
        assert_eq!(parts.motions, [None, Some(0)]);
    }

    #[test]
    fn nothing_has_no_clusters() {
        let none = ClusterLabels::new(&[NOISE], &[], &[NOISE], 0);
        assert_eq!(none.of, [ClusterLabels::NONE]);
        assert!(none.motions.is_empty());
    }
}
