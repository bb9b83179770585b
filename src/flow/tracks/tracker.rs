//! The tracker: takes the estimates of a sequence pair by pair.

use super::association::{Association, Candidate, associate};
use super::live_object::{LiveObject, Moment, moves};
use super::same_vehicle::Companions;
use super::track::Track;
use crate::flow::data::{Point, RigidTransform};
use crate::flow::estimate::Estimate;
use crate::flow::objects::{Cluster, Objects};

/// A sweep of N rows with its clusters and their motion to the next sweep.
#[derive(Clone, Copy, Debug)]
pub struct ClusteredSweep<'a> {
    /// N points in the frame of the sweep, metres.
    pub points: &'a [Point],
    /// The clusters of the points.
    pub objects: &'a Objects,
    /// The ego motion, next sweep from this sweep, metres.
    pub ego: &'a RigidTransform,
    /// Time to the next sweep, seconds.
    pub dt_s: f32,
}

impl<'a> ClusteredSweep<'a> {
    /// The source sweep of an estimate, N points in its frame, metres. `dt_s` is the time to the
    /// target, seconds.
    ///
    /// # Errors
    /// [`TrackError::NoObjects`] and [`TrackError::NoEgoMotion`].
    pub fn new(points: &'a [Point], estimate: &'a Estimate, dt_s: f32) -> Result<Self, TrackError> {
        Ok(Self {
            points,
            objects: estimate.objects().ok_or(TrackError::NoObjects)?,
            ego: estimate.ego.as_ref().ok_or(TrackError::NoEgoMotion)?,
            dt_s,
        })
    }
}

/// Why an estimate cannot be tracked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TrackError {
    /// The estimate has no clusters.
    #[error("tracks need clusters: use the preset default or label")]
    NoObjects,
    /// The estimate has no ego motion.
    #[error("tracks need the ego motion")]
    NoEgoMotion,
    /// The numbers of points differ.
    #[error("{points} points for an estimate of {rows} rows")]
    Rows {
        /// Number of points given.
        points: usize,
        /// Number of rows of the estimate.
        rows: usize,
    },
}

/// A cluster that belongs to an object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackedCluster {
    /// Index of the cluster in [`Objects::clusters`].
    pub cluster: u32,
    /// Identity of the object.
    pub id: u32,
    /// Whether the object is known to be a track. Objects that move for a sweep or two may not
    /// become one.
    pub confirmed: bool,
    /// Whether the estimate says that the cluster stands, and the object cannot have stopped.
    pub missed: bool,
    /// Velocity of the object with the ego motion taken out, m/s along the axes of the sweep's frame.
    pub velocity: Point,
    /// Yaw rate of the object, rad/s.
    pub yaw_rate: f32,
}

/// Streaming tracker of a sequence. `Tracker::default()` starts a sequence.
///
/// Its time is proportional to the points of a sweep, its memory to the states of the tracks.
#[derive(Clone, Debug, Default)]
pub struct Tracker {
    /// Number of sweeps so far.
    sweeps: u32,
    /// Number of identities so far.
    ids: u32,
    live: Vec<LiveObject>,
    companions: Companions,
    ended: Vec<Track>,
}

impl Tracker {
    /// Takes the next sweep. Returns the clusters that belong to objects.
    ///
    /// # Errors
    /// [`TrackError::Rows`]; the tracker is then unchanged.
    pub fn push(&mut self, sweep: &ClusteredSweep<'_>) -> Result<Vec<TrackedCluster>, TrackError> {
        let (points, rows) = (sweep.points.len(), sweep.objects.cluster.len());
        if points != rows {
            return Err(TrackError::Rows { points, rows });
        }
        let moment = Moment {
            objects: sweep.objects,
            ego: sweep.ego,
            dt_s: sweep.dt_s,
            sweep: self.sweeps,
        };
        self.sweeps += 1;
        let clusters = candidates(sweep.points, &moment);
        let predicted: Vec<_> = self.live.iter().map(LiveObject::predicted).collect();
        let found = associate(&predicted, &clusters);
        let tracked = self.advance(&moment, &clusters, &found);
        let parts = self.companions.join(&mut self.live);
        let live = std::mem::take(&mut self.live).into_iter();
        let (live, lost): (Vec<_>, Vec<_>) = live.partition(LiveObject::is_alive);
        self.live = live;
        let ended = parts.into_iter().chain(lost);
        self.ended.extend(ended.filter_map(LiveObject::into_track));
        Ok(tracked)
    }

    /// Ends the sequence and returns all its tracks, in the order of their identities. The last
    /// sweep, which has no estimate, gets predicted states.
    pub fn finish(mut self) -> Vec<Track> {
        let mut tracks = self.ended;
        for mut object in self.live.drain(..) {
            if object.is_seen() {
                object.states.push(object.next.state(self.sweeps));
            }
            tracks.extend(object.into_track());
        }
        tracks.sort_by_key(|track| track.id);
        tracks
    }

    /// Moves all objects on to the next sweep, and makes new ones of the moving clusters that are
    /// left.
    fn advance(
        &mut self,
        moment: &Moment<'_>,
        clusters: &[Candidate],
        found: &Association,
    ) -> Vec<TrackedCluster> {
        let mut known = Vec::new();
        let mut taken = vec![false; clusters.len()];
        for (number, object) in self.live.iter_mut().enumerate() {
            let Some(main) = found.cluster[number] else {
                object.hide(moment);
                continue;
            };
            let fragments = (0..clusters.len()).filter(|&c| found.fragment_of[c] == Some(number));
            let parts: Vec<usize> = [main].into_iter().chain(fragments).collect();
            object.observe(moment, clusters, &parts);
            for part in parts {
                taken[part] = true;
                known.push(tracked(object, clusters, part));
            }
        }
        for (cluster, candidate) in clusters.iter().enumerate() {
            if candidate.moves && !taken[cluster] {
                self.ids += 1;
                let object = LiveObject::new(self.ids, moment, clusters, cluster);
                known.push(tracked(&object, clusters, cluster));
                self.live.push(object);
            }
        }
        known
    }
}

/// The clusters of a sweep as association sees them.
fn candidates(points: &[Point], moment: &Moment<'_>) -> Vec<Candidate> {
    let Objects {
        cluster, clusters, ..
    } = moment.objects;
    let candidate = |cluster: &Cluster| Candidate {
        points: Vec::new(),
        center: cluster.bounds.center,
        velocity: cluster.velocity,
        moves: moves(cluster),
    };
    let mut candidates: Vec<Candidate> = clusters.iter().map(candidate).collect();
    for (&cluster, &point) in cluster.iter().zip(points) {
        if let Ok(cluster) = usize::try_from(cluster) {
            candidates[cluster].points.push(point);
        }
    }
    candidates
}

/// What the caller learns of a cluster of `object` in the sweep that it was observed in last.
fn tracked(object: &LiveObject, clusters: &[Candidate], cluster: usize) -> TrackedCluster {
    let now = object.states.last().copied().unwrap_or_default();
    TrackedCluster {
        cluster: cluster as u32,
        id: object.id,
        confirmed: object.confirmed,
        // A part of it may move while its main cluster stands.
        missed: object.is_missed() && !clusters[cluster].moves,
        velocity: now.velocity,
        yaw_rate: now.yaw_rate,
    }
}
