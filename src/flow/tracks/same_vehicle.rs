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
/// Sweeps over which this holds, one after the other.
const TOGETHER: u32 = 5;

/// Objects that move together, and for how many sweeps.
#[derive(Clone, Debug, Default)]
pub(super) struct Companions(Vec<(u32, u32, u32)>);

impl Companions {
    /// Counts the pairs of `live` objects that move as one vehicle. Where a pair has done so for
    /// [`TOGETHER`] sweeps, its younger object becomes a part of the older.
    pub(super) fn join(&mut self, live: &mut Vec<LiveObject>) {
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
                    let points = live[younger].next.points.clone();
                    live[older].next.points.extend(points);
                    joined[younger] = true;
                }
            }
        }
        let mut joined = joined.into_iter();
        live.retain(|_| !joined.next().unwrap_or(false));
        self.0 = now;
    }
}

/// Whether two objects can be parts of one vehicle.
fn is_one(a: &Carried, b: &Carried) -> bool {
    let apart = (Vector3::from(a.velocity) - Vector3::from(b.velocity)).norm();
    let width = |object: &Carried| object.bounds.size[0].min(object.bounds.size[1]);
    let is_wide =
        |object: &Carried| object.bounds.size[0].max(object.bounds.size[1]) >= PART_SIDE_M;
    // Cheap conditions first.
    if apart > SAME_VELOCITY || !(is_wide(a) || is_wide(b)) || width(a).max(width(b)) > VEHICLE_M[1]
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
