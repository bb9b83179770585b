//! Association: which clusters of a sweep are which of the objects that were carried into it.

use crate::flow::data::{Point, square_distance, stride_sample};
use crate::flow::spatial::ColumnIndex;

/// Distance within which a point of an object and a point of a cluster are the same surface,
/// metres.
const REACH_M: f32 = 0.5;
/// Points of an object or of a cluster that look for the other.
const SAMPLED: usize = 256;
/// Smallest overlap of an object and its cluster.
const LEAST_OVERLAP: f32 = 0.3;
/// Smallest share of the points of a fragment that lie on the object.
const LEAST_SHARE: f32 = 0.5;
/// Distance between a lost object and the moving cluster that it is found as, metres, and its
/// growth while the object is hidden, m/s.
const FOUND_WITHIN_M: [f32; 2] = [1.0, 2.0];
/// Difference of their velocities, m/s, and its growth, m/s2.
const SAME_VELOCITY: [f32; 2] = [2.0, 3.0];

/// An object as association sees it: predicted in the sweep.
#[derive(Clone, Copy, Debug)]
pub(super) struct Predicted<'a> {
    /// Some of its points, metres.
    pub(super) points: &'a [Point],
    /// Its center, metres.
    pub(super) center: Point,
    /// Its velocity, m/s.
    pub(super) velocity: Point,
    /// Seconds since it was observed, before this sweep.
    pub(super) hidden_s: f32,
}

/// A cluster as association sees it.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    /// Its points, metres.
    pub(super) points: Vec<Point>,
    /// Its center, metres.
    pub(super) center: Point,
    /// Its velocity, m/s.
    pub(super) velocity: Point,
    /// Whether it moves.
    pub(super) moves: bool,
}

/// The overlap of objects and clusters, and what follows from it.
#[derive(Debug, PartialEq)]
pub(super) struct Association {
    /// For each object, its cluster.
    pub(super) cluster: Vec<Option<usize>>,
    /// For each cluster that no object has, the object that it is a fragment of.
    pub(super) fragment_of: Vec<Option<usize>>,
}

/// Assigns the `clusters` of a sweep to the `objects`, predicted in the sweep.
///
/// The overlap of an object and a cluster is the geometric mean of two shares: of the object's
/// points within 0.5 m of a point of any cluster and nearest to this one, and of the cluster's
/// points likewise. Pairs are taken in descending order of their overlap. A moving cluster that is
/// left over and has half of its points on an object with a cluster is a fragment of that object.
/// Other moving clusters are what is left of the objects that have a similar place and velocity,
/// the nearest first.
pub(super) fn associate(objects: &[Predicted<'_>], clusters: &[Candidate]) -> Association {
    let surfaces: Vec<&[Point]> = objects.iter().map(|object| object.points).collect();
    let points: Vec<&[Point]> = clusters.iter().map(|c| c.points.as_slice()).collect();
    let forward = shares(&surfaces, &points);
    let backward = shares(&points, &surfaces);
    let mut pairs: Vec<(f32, usize, usize)> = Vec::new();
    for (object, shares) in forward.iter().enumerate() {
        for &(cluster, share) in shares {
            let back = backward[cluster].iter().find(|&&(o, _)| o == object);
            let overlap = (share * back.map_or(0.0, |&(_, share)| share)).sqrt();
            if overlap >= LEAST_OVERLAP {
                pairs.push((overlap, object, cluster));
            }
        }
    }
    pairs.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut found = Association {
        cluster: vec![None; objects.len()],
        fragment_of: vec![None; clusters.len()],
    };
    let mut taken = vec![false; clusters.len()];
    for (_, object, cluster) in pairs {
        if found.cluster[object].is_none() && !taken[cluster] {
            found.cluster[object] = Some(cluster);
            taken[cluster] = true;
        }
    }
    for (cluster, candidate) in clusters.iter().enumerate() {
        if candidate.moves && !taken[cluster] {
            let best = backward[cluster]
                .iter()
                .filter(|&&(object, share)| found.cluster[object].is_some() && share >= LEAST_SHARE)
                .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
            found.fragment_of[cluster] = best.map(|&(object, _)| object);
        }
    }
    find_again(objects, clusters, &mut taken, &mut found);
    found
}

/// Assigns moving clusters that are left over to objects without a cluster.
fn find_again(
    objects: &[Predicted<'_>],
    clusters: &[Candidate],
    taken: &mut [bool],
    found: &mut Association,
) {
    let length = |a: Point, b: Point| square_distance(a, b).sqrt();
    let mut pairs: Vec<(f32, usize, usize)> = Vec::new();
    for (number, object) in objects.iter().enumerate() {
        let bound = |[base, slope]: [f32; 2]| base + slope * object.hidden_s;
        for (cluster, candidate) in clusters.iter().enumerate() {
            let distance = length(object.center, candidate.center);
            if candidate.moves
                && distance <= bound(FOUND_WITHIN_M)
                && length(object.velocity, candidate.velocity) <= bound(SAME_VELOCITY)
            {
                pairs.push((distance, number, cluster));
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for (_, object, cluster) in pairs {
        let is_free = !taken[cluster] && found.fragment_of[cluster].is_none();
        if found.cluster[object].is_none() && is_free {
            found.cluster[object] = Some(cluster);
            taken[cluster] = true;
        }
    }
}

/// For each set of `from`, the sets of `to` that some of its points are nearest to within
/// [`REACH_M`], each with the share of the points, 0 to 1.
fn shares(from: &[&[Point]], to: &[&[Point]]) -> Vec<Vec<(usize, f32)>> {
    let mut all: Vec<Point> = Vec::new();
    let mut owners: Vec<usize> = Vec::new();
    for (owner, points) in to.iter().enumerate() {
        all.extend(*points);
        owners.resize(all.len(), owner);
    }
    let index = ColumnIndex::new(&all, REACH_M);
    let of = |points: &&[Point]| {
        let sample = stride_sample(points, SAMPLED);
        let nearest = |&point: &Point| index.nearest(point, REACH_M);
        let mut hits: Vec<usize> = sample
            .iter()
            .filter_map(nearest)
            .map(|(row, _)| owners[row as usize])
            .collect();
        hits.sort_unstable();
        hits.chunk_by(|a, b| a == b)
            .map(|same| (same[0], same.len() as f32 / sample.len() as f32))
            .collect()
    };
    from.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of points of side `side` metres with its corner at `x`.
    fn block(x: f32, side: f32) -> Vec<Point> {
        let steps = (side / 0.2) as usize;
        let point = |i: usize| [x + (i % steps) as f32 * 0.2, (i / steps) as f32 * 0.2, 0.0];
        (0..steps * steps).map(point).collect()
    }

    fn center(points: &[Point]) -> Point {
        core::array::from_fn(|a| points.iter().map(|p| p[a]).sum::<f32>() / points.len() as f32)
    }

    fn candidate(points: Vec<Point>, moves: bool) -> Candidate {
        Candidate {
            center: center(&points),
            points,
            velocity: [0.0; 3],
            moves,
        }
    }

    fn predicted(points: &[Point]) -> Predicted<'_> {
        Predicted {
            points,
            center: center(points),
            velocity: [0.0; 3],
            hidden_s: 0.0,
        }
    }

    #[test]
    fn each_object_takes_the_cluster_that_it_falls_on() {
        let objects = [block(0.0, 2.0), block(10.0, 2.0), block(20.0, 2.0)];
        let objects = objects.each_ref().map(|points| predicted(points));
        let clusters = [10.2, 40.0, -0.2].map(|x| candidate(block(x, 2.0), true));
        let found = associate(&objects, &clusters);
        assert_eq!(found.cluster, [Some(2), Some(0), None]);
        assert_eq!(found.fragment_of, [None; 3]);
    }

    #[test]
    fn an_object_does_not_become_the_wall_that_it_stands_at() {
        let object = block(10.0, 1.0);
        let wall = candidate(block(0.0, 20.0), false);
        let found = associate(&[predicted(&object)], &[wall]);
        assert_eq!(found.cluster, [None]);
    }

    #[test]
    fn a_moving_piece_of_an_object_is_its_fragment_and_what_stands_is_not() {
        let object = block(0.0, 4.0);
        let pieces = |moves| {
            let large = candidate(block(0.0, 3.0), true);
            [large, candidate(block(3.2, 0.8), moves)]
        };
        let found = associate(&[predicted(&object)], &pieces(true));
        assert_eq!(found.cluster, [Some(0)]);
        assert_eq!(found.fragment_of, [None, Some(0)]);
        let found = associate(&[predicted(&object)], &pieces(false));
        assert_eq!(found.fragment_of, [None, None]);
    }

    #[test]
    fn an_object_that_was_hidden_is_found_again_at_a_distance_if_it_moves_alike() {
        let object = block(0.0, 1.0);
        let found = |hidden_s: f32, speed: f32| {
            let hidden = Predicted {
                hidden_s,
                ..predicted(&object)
            };
            let mut cluster = candidate(block(2.0, 1.0), true);
            cluster.velocity = [speed, 0.0, 0.0];
            associate(&[hidden], &[cluster]).cluster[0]
        };
        assert_eq!(found(0.6, 1.0), Some(0));
        assert_eq!(found(0.3, 1.0), None);
        assert_eq!(found(0.6, 9.0), None);
    }
}
