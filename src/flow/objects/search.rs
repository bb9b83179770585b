//! The object search on a pair: clustering, the search for each cluster's motion, acceptance and
//! assignment.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::clouds::{SourceCloud, TargetCloud};
use super::cluster_cost::{ClusterSearch, Cost};
use super::features::ConfidenceFeatures;
use super::features::{Findings, SearchedCluster};
use super::free_space::FreeSpace;
use super::hough::TranslationVotes;
use super::hypothesis::Hypothesis;
use super::labels::ClusterLabels;
use super::motion_field::ObjectMotions;
use super::neighbor_view::NeighborView;
use super::packed::{ClusterRecord, FoundInScene, PackedScene};
use super::scene::Scene;
use super::{accept, assign, features, free_space};
use crate::flow::data::AlignedSweep;
use crate::flow::data::{Control, Interrupt, Point, Progress, RigidTransform, locked};
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::NOISE;
use crate::flow::spatial::dbscan;

/// Clusters between two reports of progress.
const CLUSTERS_AT_ONCE: usize = 32;
/// Expected time to match the clouds, relative to that of preparing each: 0.1 to 0.2, with a margin.
const SCENES: f64 = 0.3;
/// Expected time of the stages after the cluster searches, relative to that of all before them: 0.6
/// to 1, the latter with a million points.
const REST: f64 = 1.0;
/// Factor on both where a device finds the normals. They take a third to a half of the host's time to
/// prepare the clouds.
const WITHOUT_NORMALS: f64 = 2.0;

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
    /// Whether a device searched the clusters, and not the host's threads.
    pub on_device: bool,
    /// Seconds of the phases, by the control's clock.
    pub seconds: SearchSeconds,
    /// Why not all clusters were searched; none if all were. [`Interrupt::Deadline`] also stands
    /// for too little time left before the deadline.
    pub interrupted: Option<Interrupt>,
}

/// Seconds of the phases of an object search, by the control's clock. Zero if it keeps no time, and
/// for phases that an interrupt left out.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SearchSeconds {
    /// Clustering, downsampling, normals, rays, and the indices of the clouds.
    pub preparation: f64,
    /// The search of all clusters. Where a device searches them, also the normals.
    pub clusters: f64,
    /// The assignment of motions to clusters and points, and their confidence features.
    pub assignment: f64,
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
            on_device: false,
            seconds: SearchSeconds::default(),
            interrupted: Some(interrupted),
        }
    }
}

/// Finds the normals of a scene and searches its clusters, the first ones first, until the second
/// argument is true.
pub(crate) type ClusterDevice<'a, E> =
    dyn Fn(&PackedScene, &dyn Fn() -> bool) -> Result<FoundInScene, E> + Sync + 'a;

/// Searches `clouds` for moving objects. Large clusters are searched first, by `device` if there is
/// one whose limits the options keep. Clusters that were not searched because `control` interrupted
/// or the time was too short are static.
///
/// # Errors
/// That of the device.
pub(crate) fn find_objects<E: Send>(
    clouds: &SearchClouds<'_>,
    options: &ObjectOptions,
    device: Option<&ClusterDevice<'_, E>>,
    control: &dyn Control,
) -> Result<ObjectSearch, E> {
    let SearchClouds { source, target, .. } = *clouds;
    if let Some(interrupt) = out_of_time(control, 0.0) {
        return Ok(ObjectSearch::nothing(interrupt));
    }
    let began = control.seconds();
    let clustered = || {
        let labels = dbscan::clusters(source, options.cluster_radius_m, options.cluster_min_points);
        let cloud = SourceCloud::new(source, &labels, options);
        (labels, cloud)
    };
    let others = || -> Vec<TargetCloud> {
        let sweeps =
            std::iter::once(target).chain(clouds.neighbors.iter().map(|sweep| &sweep.points[..]));
        let sweeps: Vec<&[Point]> = sweeps.collect();
        let prepared = sweeps.par_iter().map(|sweep| {
            let mut cloud = TargetCloud::new(sweep, options);
            if device.is_none() {
                cloud.find_normals(options);
            }
            cloud
        });
        prepared.collect()
    };
    let free_space = || FreeSpace::new(clouds.sweeps, clouds.times, &clouds.target_from_source);
    let ((labels, downsampled), (mut others, free_space)) =
        rayon::join(clustered, || rayon::join(others, free_space));
    let fits = || !downsampled.members.is_empty() && PackedScene::fits(&others, options);
    // A buffer of no clusters cannot be bound.
    let on_device = device.filter(|_| fits());
    if on_device.is_none() {
        let others = others.par_iter_mut();
        others.for_each(|cloud| cloud.find_normals(options));
    }
    let margin = on_device.map_or(1.0, |_| WITHOUT_NORMALS);
    let clouds_seconds = control.seconds() - began;
    if let Some(interrupt) = out_of_time(control, clouds_seconds * SCENES * margin) {
        return Ok(ObjectSearch::nothing(interrupt));
    }
    let (mut scene, votes) = rayon::join(
        || Scene::new(&downsampled, &others[0], options),
        || TranslationVotes::new(&others[0], options),
    );
    let mut neighbors: Vec<NeighborView<'_>> = clouds
        .neighbors
        .par_iter()
        .zip(&others[1..])
        .map(|(sweep, cloud)| NeighborView::new(&downsampled, sweep, cloud, options))
        .collect();
    let prepared_at = control.seconds();
    let rest = (prepared_at - began) * REST * margin;
    let order = large_first(&downsampled);
    let found = on_device.map(|device| {
        let packed = PackedScene::new(&scene, &neighbors, &votes, &order);
        let found = device(&packed, &|| out_of_time(control, rest).is_some())?;
        Ok((packed.clusters, found))
    });
    let found = found.transpose()?;
    if let Some((_, found)) = &found {
        let mut normals = found.normals.iter().map(|&[x, y, z, _]| [x, y, z]);
        scene.take_normals(&mut normals);
        for neighbor in &mut neighbors {
            neighbor.scene.take_normals(&mut normals);
        }
    }
    let views = Views {
        scene: &scene,
        neighbors: &neighbors,
        free_space: &free_space,
        votes: &votes,
    };
    let on_device = found.is_some();
    let Progressed {
        searched,
        clusters,
        interrupted,
        ..
    } = match found {
        Some((clusters, found)) => judge_all(&views, &clusters, &found, rest, control),
        None => search_all(&views, &order, rest, control),
    };
    let costs = searched.iter().flatten();
    let costs = costs.map(|found| f64::from(found.cost().forward_m));
    let sum_m: f64 = costs.sum();
    let unsearched = SearchedCluster::not(options);
    let searched = searched
        .into_iter()
        .map(|found| found.unwrap_or(unsearched));
    let searched: Vec<SearchedCluster> = searched.collect();
    let searched_at = control.seconds();
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
    let evidence = features::evidence(&findings, source, &labels);
    let parts = ClusterLabels::new(&labels, &spread.cluster_motion, &point_motion, movers.len());
    Ok(ObjectSearch {
        evidence,
        parts,
        motions,
        clusters,
        all_clusters: searched.len(),
        cost_m: match clusters {
            0 => f64::INFINITY,
            searched => sum_m / searched as f64,
        },
        on_device,
        seconds: SearchSeconds {
            preparation: prepared_at - began,
            clusters: searched_at - prepared_at,
            assignment: control.seconds() - searched_at,
        },
        interrupted,
    })
}

/// What the search of a cluster reads.
struct Views<'a> {
    scene: &'a Scene<'a>,
    neighbors: &'a [NeighborView<'a>],
    free_space: &'a FreeSpace,
    votes: &'a TranslationVotes,
}

/// The clusters in the order in which they are searched.
fn large_first(source: &SourceCloud) -> Vec<u32> {
    let members = &source.members;
    let mut order: Vec<u32> = (0..members.len() as u32).collect();
    order.sort_by_key(|&cluster| std::cmp::Reverse(members[cluster as usize].len()));
    order
}

/// The clusters as searched so far.
struct Progressed {
    /// Of each cluster, if it was searched.
    searched: Vec<Option<SearchedCluster>>,
    /// Clusters that were searched.
    clusters: usize,
    /// The sum of their costs, metres, in the order in which they were finished.
    sum_m: f64,
    interrupted: Option<Interrupt>,
}

impl Progressed {
    /// None of so many clusters is searched.
    fn none(clusters: usize) -> Self {
        Self {
            searched: vec![None; clusters],
            clusters: 0,
            sum_m: 0.0,
            interrupted: None,
        }
    }

    /// Adds the result of a cluster, and reports every group of clusters.
    fn add(&mut self, cluster: u32, found: SearchedCluster, control: &dyn Control) {
        self.searched[cluster as usize] = Some(found);
        self.sum_m += f64::from(found.cost().forward_m);
        self.clusters += 1;
        let total = self.searched.len();
        if self.clusters.is_multiple_of(CLUSTERS_AT_ONCE) || self.clusters == total {
            control.progress(Progress {
                done: self.clusters,
                total,
                loss: self.sum_m / self.clusters as f64,
            });
        }
    }
}

/// Why a search must end, where the control ends it or less than `needed` seconds are left.
fn out_of_time(control: &dyn Control, needed: f64) -> Option<Interrupt> {
    let late = control.seconds_left().is_some_and(|left| left < needed);
    control.interrupt().or(late.then_some(Interrupt::Deadline))
}

/// Judges what a device found of the first `clusters`. It ended before all were searched where less than
/// `rest` seconds were left for what follows.
fn judge_all(
    views: &Views<'_>,
    clusters: &[ClusterRecord],
    found: &FoundInScene,
    rest: f64,
    control: &dyn Control,
) -> Progressed {
    let all = clusters.par_iter().zip(&found.clusters);
    let judged = all.map(|(cluster, found)| {
        let (still, best) = found.unpacked(cluster);
        let mover = ClusterSearch::new(views.scene, views.neighbors, cluster.label);
        judged(views, &mover, still, best)
    });
    let judged: Vec<SearchedCluster> = judged.collect();
    let is_whole = judged.len() == clusters.len();
    let mut progressed = Progressed::none(clusters.len());
    for (cluster, found) in clusters.iter().zip(judged) {
        progressed.add(cluster.label, found, control);
    }
    if !is_whole {
        progressed.interrupted = out_of_time(control, rest).or(Some(Interrupt::Deadline));
    }
    progressed
}

/// Searches all clusters in `order` on the host's threads, as long as `rest` seconds are left for what
/// follows.
fn search_all(views: &Views<'_>, order: &[u32], rest: f64, control: &dyn Control) -> Progressed {
    let progressed = Mutex::new(Progressed::none(order.len()));
    // Each thread takes the largest cluster that is left.
    let next = AtomicUsize::new(0);
    let search_next = || -> Option<()> {
        let cluster = *order.get(next.fetch_add(1, Ordering::Relaxed))?;
        if let Some(interrupt) = out_of_time(control, rest) {
            next.store(order.len(), Ordering::Relaxed);
            locked(&progressed).interrupted = Some(interrupt);
            return None;
        }
        let found = search(views, cluster);
        locked(&progressed).add(cluster, found, control);
        Some(())
    };
    rayon::scope(|scope| {
        for _ in 0..rayon::current_num_threads() {
            scope.spawn(|_| while search_next().is_some() {});
        }
    });
    progressed
        .into_inner()
        .unwrap_or_else(PoisonError::into_inner)
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
    let scene = views.scene;
    let mover = ClusterSearch::new(scene, views.neighbors, cluster);
    let still = mover.standing_still();
    let members = &scene.source.members[cluster as usize];
    let is_searched = members.len() >= scene.options.cluster_min_points;
    let best = is_searched.then(|| mover.search(views.votes, still));
    judged(views, &mover, still, best.flatten())
}

/// The result for a cluster with its best hypothesis: whether it is accepted.
fn judged(
    views: &Views<'_>,
    mover: &ClusterSearch<'_>,
    still: Cost,
    best: Option<Hypothesis>,
) -> SearchedCluster {
    let Views {
        scene, free_space, ..
    } = *views;
    let needed = best.is_some_and(|found| {
        let members = scene.source.members[mover.cluster as usize].iter();
        let points: Vec<Point> = members
            .map(|&row| scene.source.points[row as usize])
            .collect();
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
