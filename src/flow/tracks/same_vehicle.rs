//! Parts of one vehicle that are in different clusters.

use nalgebra::Vector3;

use super::carried::Carried;
use super::live_object::LiveObject;
use crate::flow::data::{OrientedBox, Point, square_distance};

/// Largest length and width of a vehicle that is put together, metres.
const VEHICLE_M: [f32; 2] = [6.5, 2.6];
/// Least length of the longer side of one of its parts, metres. Two persons are not parts of a
/// vehicle.
const PART_SIDE_M: f32 = 1.2;
/// Largest gap between its parts, metres.
const GAP_M: f32 = 1.0;
/// Largest difference of their velocities, m/s.
const SAME_VELOCITY: f32 = 0.5;
/// Least speed of both, m/s. Objects that stand do not show whether they move together.
const LEAST_SPEED: f32 = 1.0;
/// Sweeps over which this holds, one after the other.
const TOGETHER: u32 = 5;

/// Objects that move together, and for how many sweeps.
#[derive(Clone, Debug, Default)]
pub(super) struct Companions(Vec<(u32, u32, u32)>);

impl Companions {
    /// Counts the pairs of `live` objects that move as one vehicle. Where a pair has done so for
    /// [`TOGETHER`] sweeps, its younger object becomes a part of the older. Where the younger alone is
    /// a track, the older becomes a part of it. Returns the parts, as they were before that.
    pub(super) fn join(&mut self, live: &mut Vec<LiveObject>) -> Vec<LiveObject> {
        let mut now = Vec::new();
        let mut joined = vec![false; live.len()];
        for younger in 0..live.len() {
            for older in 0..younger {
                let (a, b) = (&live[older], &live[younger]);
                let seen = a.is_seen() && b.is_seen();
                if joined[older] || joined[younger] || !seen || !is_one(&a.next, &b.next) {
                    continue;
                }
                let ids = (a.id, b.id);
                let before = self.0.iter().find(|&&(a, b, _)| (a, b) == ids);
                let sweeps = before.map_or(1, |&(.., sweeps)| sweeps + 1);
                if sweeps < TOGETHER {
                    now.push((a.id, b.id, sweeps));
                } else {
                    let [whole, part] = match b.confirmed && !a.confirmed {
                        true => [younger, older],
                        false => [older, younger],
                    };
                    let points = core::mem::take(&mut live[part].next.points);
                    live[whole].next.points.extend(points);
                    joined[part] = true;
                }
            }
        }
        let mut joined = joined.into_iter();
        let mut parts: Vec<LiveObject> = live
            .extract_if(.., |_| joined.next().unwrap_or(false))
            .collect();
        for part in &mut parts {
            part.forget_latest(TOGETHER as usize);
        }
        self.0 = now;
        parts
    }
}

/// Whether two objects can be parts of one vehicle.
fn is_one(a: &Carried, b: &Carried) -> bool {
    let apart = (Vector3::from(a.velocity) - Vector3::from(b.velocity)).norm();
    let width = |object: &Carried| object.bounds.size[0].min(object.bounds.size[1]);
    let is_wide =
        |object: &Carried| object.bounds.size[0].max(object.bounds.size[1]) >= PART_SIDE_M;
    let speed = |object: &Carried| object.velocity[0].hypot(object.velocity[1]);
    let center = |object: &Carried| Vector3::from(object.bounds.center).xy();
    let far = (center(a) - center(b)).norm() > VEHICLE_M[0].hypot(VEHICLE_M[1]);
    // Cheap conditions first.
    if far
        || apart > SAME_VELOCITY
        || speed(a).min(speed(b)) < LEAST_SPEED
        || !(is_wide(a) || is_wide(b))
        || width(a).max(width(b)) > VEHICLE_M[1]
    {
        return false;
    }
    let near = |p: &Point| {
        b.points
            .iter()
            .any(|q| square_distance(*p, *q) < GAP_M * GAP_M)
    };
    if !a.points.iter().any(near) {
        return false;
    }
    let [x, y, _] = a.velocity;
    let both = [a.points.as_slice(), &b.points].concat();
    let whole = OrientedBox::enclosing(&both, Some([x, y]));
    whole.size[0] <= VEHICLE_M[0] && whole.size[1] <= VEHICLE_M[1]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::RigidTransform;
    use crate::flow::objects::{Cluster, Objects};
    use crate::flow::tracks::association::Candidate;
    use crate::flow::tracks::live_object::Moment;

    /// Two parts of a vehicle, which are 0.5 m apart and move at a speed, m/s.
    fn two_parts(speed: f32) -> Vec<LiveObject> {
        let part = |x: f32| {
            let points = [0.0, 0.5, 1.0, 1.5].map(|along| [x + along, 5.0, 0.5]);
            let velocity = [speed, 0.0, 0.0];
            let bounds = OrientedBox {
                center: [x + 0.75, 5.0, 0.5],
                size: [1.5, 0.0, 0.0],
                yaw: 0.0,
            };
            let cluster = Cluster {
                points: 4,
                dynamic: true,
                bounds,
                velocity,
                moving: 1.0,
                confidence: 1.0,
                ..Cluster::default()
            };
            let candidate = Candidate {
                points: points.to_vec(),
                center: bounds.center,
                velocity,
                moves: true,
            };
            (cluster, candidate)
        };
        let (clusters, candidates): (Vec<Cluster>, Vec<Candidate>) =
            [part(10.0), part(12.0)].into_iter().unzip();
        let objects = Objects {
            clusters,
            ..Objects::default()
        };
        let moment = Moment {
            objects: &objects,
            ego: &RigidTransform::identity(),
            dt_s: 0.1,
            sweep: 0,
        };
        let object = |index: usize| LiveObject::new(index as u32, &moment, &candidates, index);
        vec![object(0), object(1)]
    }

    #[test]
    fn the_older_part_of_a_vehicle_stays_unless_the_younger_alone_is_a_track() {
        for (confirmed, stays) in [
            ([false, false], 0),
            ([true, false], 0),
            ([true, true], 0),
            ([false, true], 1),
        ] {
            let mut live = two_parts(10.0);
            for (object, confirmed) in live.iter_mut().zip(confirmed) {
                object.confirmed = confirmed;
            }
            let mut companions = Companions::default();
            for sweep in 1..=TOGETHER {
                assert_eq!(live.len(), 2, "before sweep {sweep}");
                companions.join(&mut live);
            }
            let [object] = live.as_slice() else {
                panic!("{} objects", live.len());
            };
            assert_eq!(object.id, stays, "{confirmed:?}");
            assert_eq!(object.next.points.len(), 8);
        }
    }

    #[test]
    fn objects_that_stand_beside_each_other_stay_two() {
        let mut live = two_parts(0.0);
        let mut companions = Companions::default();
        for _ in 0..2 * TOGETHER {
            companions.join(&mut live);
        }
        assert_eq!(live.len(), 2);
    }

    #[test]
    fn a_track_that_becomes_a_part_keeps_its_states_from_before() {
        let mut live = two_parts(10.0);
        let state = live[1].states[0];
        live[1].states = vec![state; 30];
        for object in &mut live {
            object.confirmed = true;
        }
        let mut companions = Companions::default();
        let parts = (0..TOGETHER).flat_map(|_| companions.join(&mut live));
        let tracks: Vec<_> = parts.filter_map(LiveObject::into_track).collect();
        let [track] = tracks.as_slice() else {
            panic!("{} tracks", tracks.len());
        };
        assert_eq!((track.id, track.states.len()), (1, 25));
    }
}
