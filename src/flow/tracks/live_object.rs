//! An object that is followed: its states so far, and its prediction in the next sweep.

use nalgebra::Vector3;

use super::association::{Candidate, Predicted};
use super::carried::{Carried, rotated};
use super::fitted_box;
use super::track::{Track, TrackState};
use crate::flow::data::{OrientedBox, Point, RigidTransform, stride_sample, transform_point};
use crate::flow::objects::{Cluster, Objects};

/// Points of an object that are carried on.
const CARRIED: usize = 256;
/// Seconds for which a hidden object is carried on.
const HIDDEN_S: f32 = 1.0;
/// Largest acceleration of an object, m/s2. A motion that needs more was estimated wrongly.
const ACCELERATION: f32 = 12.0;
/// Sweeps in which an object must move, one after the other, to be a track.
const MOVING_SWEEPS: u32 = 3;
/// Least way that its velocities add up to by then, metres.
const LEAST_WAY_M: f32 = 0.3;
/// Largest difference between the way of its center and that of its velocities, relative to the latter.
const WAY_DIFFERENCE: f32 = 0.5;
/// Least height of a track, metres. Flatter objects are rings on the ground that an object hides.
const LEAST_HEIGHT_M: f32 = 0.3;
/// Least probability that a cluster moves.
const LEAST_MOVING: f32 = 0.5;
/// Share of the predicted way that an object must come by to have moved unnoticed.
const UNNOTICED: f32 = 0.5;

/// A sweep and the motion of its pair.
pub(super) struct Moment<'a> {
    pub(super) objects: &'a Objects,
    /// Next sweep from this sweep.
    pub(super) ego: &'a RigidTransform,
    /// Time to the next sweep, seconds.
    pub(super) dt_s: f32,
    /// Index of the sweep.
    pub(super) sweep: u32,
}

/// Whether a cluster moves with sufficient probability.
pub(super) fn moves(cluster: &Cluster) -> bool {
    cluster.dynamic && cluster.moving >= LEAST_MOVING
}

/// An object that is followed.
#[derive(Clone, Debug)]
pub(super) struct LiveObject {
    pub(super) id: u32,
    pub(super) states: Vec<TrackState>,
    /// The object in the next sweep, as predicted.
    pub(super) next: Carried,
    /// Whether it is known to be a track.
    pub(super) confirmed: bool,
    /// Seconds for which it has been hidden: 0 where it was observed in the last sweep.
    hidden_s: f32,
    /// Seconds from the sweep before to the last one.
    interval_s: f32,
    /// Sweeps in which it moved, up to now and without a gap.
    moved: u32,
    /// Its center when it was first seen, in the frame of the next sweep.
    birth: Point,
    /// Sum of its displacements since then, along the axes of the next sweep's frame.
    way: Point,
    /// Where it was first seen to stand in the sweeps up to now, in the frame of the next sweep,
    /// and the seconds since.
    stopped: Option<(Point, f32)>,
}

impl LiveObject {
    /// The object of identity `id` that is first seen as one moving cluster.
    pub(super) fn new(
        id: u32,
        moment: &Moment<'_>,
        clusters: &[Candidate],
        cluster: usize,
    ) -> Self {
        let Cluster {
            bounds,
            velocity,
            yaw_rate,
            ..
        } = moment.objects.clusters[cluster];
        let mut object = Self {
            id,
            states: Vec::new(),
            next: Carried {
                points: Vec::new(),
                bounds,
                velocity,
                yaw_rate,
            },
            confirmed: false,
            hidden_s: 0.0,
            interval_s: moment.dt_s,
            moved: 0,
            birth: bounds.center,
            way: [0.0; 3],
            stopped: None,
        };
        object.observe(moment, clusters, &[cluster]);
        object
    }

    /// The object as it is looked for in the next sweep.
    pub(super) fn predicted(&self) -> Predicted<'_> {
        Predicted {
            points: &self.next.points,
            center: self.next.bounds.center,
            velocity: self.next.velocity,
            hidden_s: self.hidden_s,
        }
    }

    /// Whether the object is followed further.
    pub(super) fn is_alive(&self) -> bool {
        self.hidden_s < HIDDEN_S && (self.moved > 0 || self.confirmed)
    }

    /// Whether it stood in the last sweep, and cannot have stopped.
    pub(super) fn is_missed(&self) -> bool {
        self.stopped.is_some()
    }

    /// Whether the object was observed in the last sweep.
    pub(super) fn is_seen(&self) -> bool {
        self.hidden_s == 0.0
    }

    /// Observes the object as the clusters `parts`, the main one first.
    pub(super) fn observe(&mut self, moment: &Moment<'_>, clusters: &[Candidate], parts: &[usize]) {
        let of = |part: usize| moment.objects.clusters[part];
        let main = of(parts[0]);
        let points: Vec<Point> = parts
            .iter()
            .flat_map(|&part| &clusters[part].points)
            .copied()
            .collect();
        let weight = |part: &usize| of(*part).confidence * of(*part).points as f32;
        let confidence = parts.iter().map(weight).sum::<f32>() / points.len().max(1) as f32;
        let velocity = self.velocity_as(&main, moment.dt_s);
        let heading = if moves(&main) {
            velocity[1].atan2(velocity[0])
        } else {
            self.next.bounds.yaw
        };
        let bounds = match parts {
            [_] => main.bounds,
            _ => OrientedBox::enclosing(&points, Some([heading.cos(), heading.sin()])),
        };
        let now = Carried {
            points: stride_sample(&points, CARRIED),
            bounds: fitted_box::headed(&bounds, heading),
            velocity,
            yaw_rate: if self.is_missed() {
                self.next.yaw_rate
            } else {
                main.yaw_rate
            },
        };
        self.states.push(TrackState {
            points: points.len() as u32,
            confidence,
            ..now.state(moment.sweep)
        });
        self.moved = if moves(&main) { self.moved + 1 } else { 0 };
        self.hidden_s = 0.0;
        self.confirmed |= self.moved >= MOVING_SWEEPS
            && self.has_come(bounds.center)
            && self.height_m() >= LEAST_HEIGHT_M;
        self.carry(&now, moment);
    }

    /// Predicts the object where it is hidden.
    pub(super) fn hide(&mut self, moment: &Moment<'_>) {
        self.states.push(self.next.state(moment.sweep));
        self.moved = 0;
        self.hidden_s += moment.dt_s;
        self.carry(&self.next.clone(), moment);
    }

    /// Takes back its states in the last sweeps.
    pub(super) fn forget_latest(&mut self, sweeps: usize) {
        self.states
            .truncate(self.states.len().saturating_sub(sweeps));
        while self.states.last().is_some_and(|state| state.points == 0) {
            self.states.pop();
        }
    }

    /// The track, without the predicted states after the object was lost. None if it is not
    /// confirmed, or has no states.
    pub(super) fn into_track(mut self) -> Option<Track> {
        if !self.is_seen() {
            self.forget_latest(0);
        }
        fitted_box::fit(&mut self.states);
        let is_track = self.confirmed && !self.states.is_empty();
        is_track.then_some(Track {
            id: self.id,
            states: self.states,
        })
    }

    /// The velocity of the object as `cluster`, m/s.
    ///
    /// It is the cluster's, as far as the object can change its velocity since it was last seen. A
    /// cluster that stands where the object cannot have stopped has the velocity that was predicted:
    /// its motion was missed, until the way of its center shows that it stands.
    fn velocity_as(&mut self, cluster: &Cluster, dt_s: f32) -> Point {
        let before = Vector3::from(self.next.velocity);
        let change = Vector3::from(cluster.velocity) - before;
        // The velocities are those in the middle of their intervals.
        let most = ACCELERATION * (self.hidden_s + 0.5 * (self.interval_s + dt_s));
        if cluster.dynamic || change.norm() <= most {
            self.stopped = None;
            let share = (most / change.norm().max(f32::MIN_POSITIVE)).min(1.0);
            return (before + change * share).into();
        }
        let (place, seconds) = *self.stopped.get_or_insert((cluster.bounds.center, 0.0));
        let come = Vector3::from(cluster.bounds.center) - Vector3::from(place);
        let predicted = before.norm() * seconds;
        if predicted > LEAST_WAY_M && come.norm() < UNNOTICED * predicted {
            self.stopped = None;
            return cluster.velocity;
        }
        before.into()
    }

    /// Whether the way from its birth to `center` is that of its velocities.
    fn has_come(&self, center: Point) -> bool {
        let way = Vector3::from(self.way);
        let come = Vector3::from(center) - Vector3::from(self.birth);
        let off = (come - way).xy().norm();
        way.norm() >= LEAST_WAY_M && off <= WAY_DIFFERENCE * way.norm()
    }

    /// Mean height of its boxes, metres.
    fn height_m(&self) -> f32 {
        let sum: f32 = self.states.iter().map(|state| state.bounds.size[2]).sum();
        sum / self.states.len().max(1) as f32
    }

    /// Predicts the next sweep from the object as it is `now`.
    fn carry(&mut self, now: &Carried, moment: &Moment<'_>) {
        let way = Vector3::from(self.way) + Vector3::from(now.velocity) * moment.dt_s;
        self.way = rotated(moment.ego, way.into());
        self.birth = transform_point(moment.ego, self.birth);
        self.stopped = self
            .stopped
            .map(|(place, since)| (transform_point(moment.ego, place), since + moment.dt_s));
        self.next = now.later(moment.ego, moment.dt_s);
        self.interval_s = moment.dt_s;
    }
}
