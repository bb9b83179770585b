//! TODO doc

use super::features::ConfidenceFeatures;
use super::labels::ClusterLabels;
use super::motion_field::ObjectMotions;
use super::{accept, assign, features, free_space};
use crate::flow::spatial::dbscan;
use rayon::prelude::*;

use super::features::{Findings, SearchedCluster};
use super::free_space::FreeSpace;
use super::hough::TranslationVotes;
use super::hypothesis::Mover;
use super::neighbor_view::NeighborView;
use super::scene::{Scene, Thinned};
use crate::flow::data::{Control, Interrupt, Point, Progress, RigidTransform};
use crate::flow::options::ObjectOptions;
use crate::flow::registration::AlignedSweep;
use crate::flow::spatial::NOISE;

/// Clusters between two looks at the watch.
const CLUSTERS_AT_ONCE: usize = 32;
/// What the scene takes, in times of the clustering: 2 to 4.
const SCENE: f64 = 5.0;
/// What is left to do once clusters have been searched, in times of the scene.
const REST: f64 = 0.5;

/// What movers are sought in: metres.
#[derive(Clone, Copy, Debug)]
pub struct SearchClouds<'a> {
    /// Points off the ground in the target's frame, every number finite: the source's, the ego motion
    /// taken out, and the target's.
    pub source: &'a [Point],
    /// See `source`.
    pub target: &'a [Point],
    /// Other sweeps of the sequence.
    pub around: &'a [AlignedSweep],
    /// The source and the target as they came, ground, points out of range and all, each in its own
    /// frame, whose origin is the sensor or about it: what was seen through on the way to them.
    pub sweeps: [&'a [Point]; 2],
    /// The ego motion; none where it is not known.
    pub target_from_source: RigidTransform,
}

/// The movers of a pair.
#[derive(Debug)]
pub struct ObjectSearch {
    /// How they move.
    pub motions: ObjectMotions,
    /// Which cluster each source point is of.
    pub parts: ClusterLabels,
    /// N: what is known of each source point's motion.
    pub evidence: Vec<ConfidenceFeatures>,
    /// Clusters that were looked at.
    pub clusters: usize,
    /// Clusters that there are.
    pub all_clusters: usize,
    /// How far their points lie from the target in the end, metres: the mean over the clusters.
    pub cost_m: f64,
    /// Why not all clusters were looked at.
    pub interrupted: Option<Interrupt>,
}

impl ObjectSearch {
    /// How far each of the `source` points that it is of moves, metres, the ego motion left out: as
    /// [`ObjectMotions::residual_at`] says it, without looking for their objects again.
    pub(crate) fn residual_of(&self, source: &[Point]) -> Vec<Point> {
        let motion = |place: usize| {
            let cluster = *self.parts.of.get(place)?;
            *self.parts.motions.get(cluster as usize)?
        };
        let places = source.iter().enumerate();
        let residual = places.map(|(place, &point)| match motion(place) {
            None => [0.0; 3],
            Some(motion) => self.motions.displacement(motion, point),
        });
        residual.collect()
    }

    /// Nothing was looked at.
    fn nothing(interrupted: Interrupt) -> Self {
        Self {
            motions: ObjectMotions::none(),
            parts: ClusterLabels::default(),
            evidence: Vec::new(),
            clusters: 0,
            all_clusters: 0,
            cost_m: f64::INFINITY,
            interrupted: Some(interrupted),
        }
    }
}

/// Finds what moves in `clouds`. Large clusters come first; those that the watch leaves no time for
/// stand still.
pub(crate) fn find_objects(
    clouds: &SearchClouds<'_>,
    options: &ObjectOptions,
    control: &dyn Control,
) -> ObjectSearch {
    let SearchClouds { source, target, .. } = *clouds;
    let late = |needed: f64| {
        let late = control.seconds_left().is_some_and(|left| left < needed);
        control.interrupt().or(late.then_some(Interrupt::Deadline))
    };
    if let Some(interrupt) = late(0.0) {
        return ObjectSearch::nothing(interrupt);
    }
    let began = control.seconds();
    let labels = dbscan::clusters(source, options.cluster_radius_m, options.cluster_min_points);
    let clustering = control.seconds() - began;
    if let Some(interrupt) = late(clustering * SCENE) {
        return ObjectSearch::nothing(interrupt);
    }
    let began = control.seconds();
    let thinned = Thinned::new(source, &labels, options);
    let scene = Scene::new(&thinned, target, options);
    let free_space = FreeSpace::new(clouds.sweeps, &clouds.target_from_source);
    let votes = TranslationVotes::new(&scene);
    let around: Vec<NeighborView<'_>> = clouds
        .around
        .par_iter()
        .map(|sweep| NeighborView::new(&thinned, sweep, options))
        .collect();
    let rest = (control.seconds() - began) * REST;

    let mut order: Vec<u32> = (0..thinned.members.len() as u32).collect();
    order.sort_by_key(|&cluster| std::cmp::Reverse(thinned.members[cluster as usize].len()));
    let mut searched = vec![SearchedCluster::not(options); order.len()];
    let (mut clusters, mut sum_m) = (0, 0.0);
    let mut interrupted = None;
    for some in order.chunks(CLUSTERS_AT_ONCE) {
        interrupted = late(rest);
        if interrupted.is_some() {
            break;
        }
        let found: Vec<SearchedCluster> = some
            .par_iter()
            .map(|&cluster| search(&scene, &around, &free_space, &votes, cluster))
            .collect();
        for (&cluster, found) in some.iter().zip(found) {
            searched[cluster as usize] = found;
            sum_m += f64::from(found.cost().forward_m);
        }
        clusters += some.len();
        control.progress(Progress {
            iteration: clusters,
            max_iterations: order.len(),
            loss: sum_m / clusters as f64,
        });
    }
    let needed: Vec<_> = searched.iter().map(SearchedCluster::found).collect();
    let spread = assign::spread(&scene, &around, &needed);
    let movers: Vec<u32> = (0..)
        .zip(&needed)
        .filter_map(|(cluster, found)| found.map(|_| cluster))
        .collect();
    let mut numbers = vec![NOISE; needed.len()];
    for (number, &cluster) in (0..).zip(&movers) {
        numbers[cluster as usize] = number;
    }
    let number = |cluster: &u32| numbers.get(*cluster as usize).copied().unwrap_or(NOISE);
    let point_motion: Vec<u32> = spread.point_motion.iter().map(number).collect();
    let motions = needed.iter().flatten().map(|found| found.motion);
    let motions = ObjectMotions::new(motions.collect(), &thinned.points, &point_motion);
    let point_motion = motions.owners_at(source);
    let findings = Findings {
        scene: &scene,
        searched: &searched,
        spread: &spread,
        motions: &motions,
        movers: &movers,
        point_motion: &point_motion,
    };
    ObjectSearch {
        evidence: features::evidence(&findings, source, &labels),
        parts: ClusterLabels::new(&labels, &spread.cluster_motion, &point_motion, movers.len()),
        motions,
        clusters,
        all_clusters: order.len(),
        cost_m: sum_m / clusters.max(1) as f64,
        interrupted,
    }
}

/// Looks for the motion of a cluster.
fn search(
    scene: &Scene<'_>,
    around: &[NeighborView<'_>],
    free_space: &FreeSpace,
    votes: &TranslationVotes,
    cluster: u32,
) -> SearchedCluster {
    let members = &scene.source.members[cluster as usize];
    let mover = Mover::new(scene, around, cluster);
    let still = mover.standing_still();
    if members.len() < scene.options.cluster_min_points {
        return SearchedCluster {
            still,
            best: None,
            needed: false,
        };
    }
    let points: Vec<Point> = members
        .iter()
        .map(|&row| scene.source.points[row as usize])
        .collect();
    let best = mover.search(votes, still);
    let needed = best.is_some_and(|found| {
        let seen = || {
            let motion = &found.motion;
            let [x, y] = motion.center;
            let clear_m = free_space::passed_m(x.hypot(y));
            let vacated = mover.vacated(motion, clear_m);
            let far = motion.length_m() >= 2.0 * clear_m;
            free_space.of(&vacated, &mover.occupied(motion, clear_m), far)
        };
        accept::is_needed(&found, &points, seen, scene.options)
    });
    SearchedCluster {
        still,
        best,
        needed,
    }
}
