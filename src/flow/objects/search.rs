//! The object search on a pair: clustering, the search for each cluster's motion, acceptance and
//! assignment.

use rayon::prelude::*;

use super::features::ConfidenceFeatures;
use super::features::{Findings, SearchedCluster};
use super::free_space::FreeSpace;
use super::hough::TranslationVotes;
use super::hypothesis::{ClusterSearch, Hypothesis};
use super::labels::ClusterLabels;
use super::motion_field::ObjectMotions;
use super::neighbor_view::NeighborView;
use super::scene::{Scene, SourceCloud};
use super::{accept, assign, features, free_space};
use crate::flow::data::AlignedSweep;
use crate::flow::data::{Control, Interrupt, Point, Progress, RigidTransform};
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::NOISE;
use crate::flow::spatial::dbscan;

/// Clusters between two checks of `control`.
const CLUSTERS_AT_ONCE: usize = 32;
/// Expected time to prepare the scene, relative to that of the clustering: 2 to 4, with a margin.
const SCENE: f64 = 5.0;
/// Expected time of the stages after the cluster searches, relative to that of the scene.
const REST: f64 = 0.5;

/// The clouds of an object search, metres.
#[derive(Clone, Copy, Debug)]
pub struct SearchClouds<'a> {
    /// N source points off the ground, all finite, in the target's frame: the ego motion is taken
    /// out.
    pub source: &'a [Point],
    /// M target points off the ground, all finite, in the target's frame.
    pub target: &'a [Point],
    /// Neighbor sweeps of the sequence in the target's frame, nearest in time first. Empty for a
    /// pair alone.
    pub neighbors: &'a [AlignedSweep],
    /// The complete source and target, each in its own frame, with the ground and the points that
    /// are not searched. Points that are not finite are ignored. The rays from each frame's origin
    /// to its points show free space, so the origin must be at the sensor or near it.
    pub sweeps: [&'a [Point]; 2],
    /// Where `source` and `target` are deskewed: the times of the points of `sweeps`, which are not,
    /// in sweep intervals after the time of their sweep.
    pub times: Option<[&'a [f32]; 2]>,
    /// The ego motion, from the source's frame to the target's, metres; the identity if it is
    /// unknown.
    pub target_from_source: RigidTransform,
}

/// The result of an object search on a pair of N source points.
#[derive(Debug)]
pub struct ObjectSearch {
    /// The rigid motions of the moving objects, as a field over space. It has none if the search
    /// was interrupted before or right after the clustering.
    pub motions: ObjectMotions,
    /// The final cluster of each source point. Empty if the search was interrupted before or right
    /// after the clustering.
    pub parts: ClusterLabels,
    /// N sets of confidence features, one for each source point. Empty if the search was
    /// interrupted before or right after the clustering.
    pub evidence: Vec<ConfidenceFeatures>,
    /// Number of clusters that were searched.
    pub clusters: usize,
    /// Number of DBSCAN clusters; zero if the search was interrupted before or right after the
    /// clustering.
    pub all_clusters: usize,
    /// Mean forward cost of the clusters that were searched, metres. The forward cost of a cluster
    /// is the mean truncated distance of its points from the target, after its accepted motion or
    /// at rest. Infinite if no cluster was searched.
    pub cost_m: f64,
    /// Why not all clusters were searched; none if all were. [`Interrupt::Deadline`] also stands
    /// for too little time left before the deadline.
    pub interrupted: Option<Interrupt>,
}

impl ObjectSearch {
    /// Residual flow of the N `source` points of the search, metres, ego motion taken out. It is
    /// [`ObjectMotions::residual_at`] at these points, without another search for their objects.
    pub(crate) fn residual_of(&self, source: &[Point]) -> Vec<Point> {
        let motion = |position: usize| {
            let cluster = *self.parts.of.get(position)?;
            *self.parts.motions.get(cluster as usize)?
        };
        let positions = source.iter().enumerate();
        let residual = positions.map(|(position, &point)| match motion(position) {
            None => [0.0; 3],
            Some(motion) => self.motions.displacement(motion, point),
        });
        residual.collect()
    }

    /// The empty result of a search that was interrupted at its start.
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

/// Searches `clouds` for moving objects. Large clusters are searched first. Clusters that were not
/// searched because `control` interrupted or the time was too short are static.
pub(crate) fn find_objects(
    clouds: &SearchClouds<'_>,
    options: &ObjectOptions,
    control: &dyn Control,
) -> ObjectSearch {
    let SearchClouds { source, target, .. } = *clouds;
    if let Some(interrupt) = out_of_time(control, 0.0) {
        return ObjectSearch::nothing(interrupt);
    }
    let began = control.seconds();
    let labels = dbscan::clusters(source, options.cluster_radius_m, options.cluster_min_points);
    let clustering = control.seconds() - began;
    if let Some(interrupt) = out_of_time(control, clustering * SCENE) {
        return ObjectSearch::nothing(interrupt);
    }
    let began = control.seconds();
    let downsampled = SourceCloud::new(source, &labels, options);
    let scene = Scene::new(&downsampled, target, options);
    let free_space = FreeSpace::new(clouds.sweeps, clouds.times, &clouds.target_from_source);
    let votes = TranslationVotes::new(&scene);
    let neighbors: Vec<NeighborView<'_>> = clouds
        .neighbors
        .par_iter()
        .map(|sweep| NeighborView::new(&downsampled, sweep, options))
        .collect();
    let rest = (control.seconds() - began) * REST;

    let views = Views {
        scene: &scene,
        neighbors: &neighbors,
        free_space: &free_space,
        votes: &votes,
    };
    let Progressed {
        searched,
        clusters,
        sum_m,
        interrupted,
    } = search_all(&views, rest, control);
    let needed: Vec<_> = searched.iter().map(SearchedCluster::found).collect();
    let spread = assign::spread(&scene, &neighbors, &needed);
    let (movers, numbers) = numbered(&needed);
    let number = |cluster: &u32| numbers.get(*cluster as usize).copied().unwrap_or(NOISE);
    let point_motion: Vec<u32> = spread.point_motion.iter().map(number).collect();
    let motions = needed.iter().flatten().map(|found| found.motion);
    let motions = ObjectMotions::new(motions.collect(), &downsampled.points, &point_motion);
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
        all_clusters: searched.len(),
        cost_m: match clusters {
            0 => f64::INFINITY,
            searched => sum_m / searched as f64,
        },
        interrupted,
    }
}

/// What the search of a cluster reads.
struct Views<'a> {
    scene: &'a Scene<'a>,
    neighbors: &'a [NeighborView<'a>],
    free_space: &'a FreeSpace,
    votes: &'a TranslationVotes,
}

/// The clusters as searched so far.
struct Progressed {
    /// Of each cluster; clusters that were not searched stand still.
    searched: Vec<SearchedCluster>,
    /// Clusters that were searched.
    clusters: usize,
    /// The sum of their costs, metres.
    sum_m: f64,
    interrupted: Option<Interrupt>,
}

/// Why a search must end, where the control ends it or less than `needed` seconds are left.
fn out_of_time(control: &dyn Control, needed: f64) -> Option<Interrupt> {
    let late = control.seconds_left().is_some_and(|left| left < needed);
    control.interrupt().or(late.then_some(Interrupt::Deadline))
}

/// Searches all clusters, large ones first, as long as `rest` seconds are left for what follows.
fn search_all(views: &Views<'_>, rest: f64, control: &dyn Control) -> Progressed {
    let members = &views.scene.source.members;
    let mut order: Vec<u32> = (0..members.len() as u32).collect();
    order.sort_by_key(|&cluster| std::cmp::Reverse(members[cluster as usize].len()));
    let mut progressed = Progressed {
        searched: vec![SearchedCluster::not(views.scene.options); order.len()],
        clusters: 0,
        sum_m: 0.0,
        interrupted: None,
    };
    for some in order.chunks(CLUSTERS_AT_ONCE) {
        progressed.interrupted = out_of_time(control, rest);
        if progressed.interrupted.is_some() {
            break;
        }
        let found: Vec<SearchedCluster> = some
            .par_iter()
            .map(|&cluster| search(views, cluster))
            .collect();
        for (&cluster, found) in some.iter().zip(found) {
            progressed.searched[cluster as usize] = found;
            progressed.sum_m += f64::from(found.cost().forward_m);
        }
        progressed.clusters += some.len();
        control.progress(Progress {
            done: progressed.clusters,
            total: order.len(),
            loss: progressed.sum_m / progressed.clusters as f64,
        });
    }
    progressed
}

/// The clusters with a motion, and of each cluster its index among them or [`NOISE`].
fn numbered(found: &[Option<Hypothesis>]) -> (Vec<u32>, Vec<u32>) {
    let movers: Vec<u32> = (0..)
        .zip(found)
        .filter_map(|(cluster, found)| found.map(|_| cluster))
        .collect();
    let mut numbers = vec![NOISE; found.len()];
    for (number, &cluster) in (0..).zip(&movers) {
        numbers[cluster as usize] = number;
    }
    (movers, numbers)
}

/// Searches for the motion of one cluster.
fn search(views: &Views<'_>, cluster: u32) -> SearchedCluster {
    let Views {
        scene,
        neighbors,
        free_space,
        votes,
    } = *views;
    let members = &scene.source.members[cluster as usize];
    let mover = ClusterSearch::new(scene, neighbors, cluster);
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
