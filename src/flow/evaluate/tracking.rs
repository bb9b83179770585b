//! Metrics of tracks: CLEAR MOT (Bernardin and Stiefelhagen 2008), IDF1 (Ristani et al. 2016) and
//! HOTA (Luiten et al. 2021), by the distance of centers in the plane.

use std::collections::BTreeMap;

use super::assignment::{Edge, assign, assignment};
use crate::flow::tracks::{Track, TrackState};

/// Least speed of a true object that is to be found, m/s.
pub const TRACKED_FROM_MPS: f32 = 1.0;
/// Fewest points of a true object that is to be found.
pub const TRACKED_FROM_POINTS: u32 = 10;
/// Distance of centers within which a found object is a true one, metres.
pub const MATCHED_WITHIN_M: f64 = 2.0;
/// Levels of the similarity over which HOTA is averaged: 0.05, 0.1, ..., 0.95.
const LEVELS: usize = 19;
/// Additional weight of a match that is kept: above the sum of the similarities of a sweep.
const KEPT: f64 = 1e4;

/// An object in one sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackedObject {
    /// Identity, unique among the true or among the found objects of the sequence.
    pub id: u32,
    /// Center, x and y, metres. True and found objects have the same frame.
    pub position: [f32; 2],
}

/// The objects of one sweep.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrackedSweep {
    /// True objects that are to be found.
    pub truth: Vec<TrackedObject>,
    /// True objects that need not be found. What is found there counts neither for nor against.
    pub ignored: Vec<TrackedObject>,
    /// Found objects.
    pub found: Vec<TrackedObject>,
}

/// The objects of the sweeps of one sequence, from its true and its found tracks.
///
/// True objects of at least [`TRACKED_FROM_MPS`] in the plane and [`TRACKED_FROM_POINTS`] are to be
/// found, the others are ignored.
pub fn tracked_sweeps(truth: &[Track], found: &[Track]) -> Vec<TrackedSweep> {
    let mut sweeps: BTreeMap<u32, TrackedSweep> = BTreeMap::new();
    let states = |tracks: &[Track]| -> Vec<(TrackedObject, TrackState)> {
        let of = |track: &Track| {
            let id = track.id;
            let states = track.states.iter().map(move |state| {
                let [x, y, _] = state.bounds.center;
                let position = [x, y];
                (TrackedObject { id, position }, *state)
            });
            states.collect::<Vec<_>>()
        };
        tracks.iter().flat_map(of).collect()
    };
    for (object, state) in states(truth) {
        let sweep = sweeps.entry(state.sweep).or_default();
        let [x, y, _] = state.velocity;
        if state.points >= TRACKED_FROM_POINTS && x.hypot(y) >= TRACKED_FROM_MPS {
            sweep.truth.push(object);
        } else {
            sweep.ignored.push(object);
        }
    }
    for (object, state) in states(found) {
        sweeps.entry(state.sweep).or_default().found.push(object);
    }
    sweeps.into_values().collect()
}

/// Metrics of the tracks of sequences.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackingMetrics {
    /// True objects, summed over sweeps.
    pub truth: usize,
    /// Found objects, summed over sweeps, without those at ignored objects.
    pub found: usize,
    /// True objects with a found one within [`MATCHED_WITHIN_M`].
    pub matches: usize,
    /// Changes of the found identity of a true object.
    pub switches: usize,
    /// Mean distance of matched centers, metres. Zero if there are none.
    pub distance_m: f64,
    /// Multiple object tracking accuracy: one minus misses, false objects and switches over true
    /// objects. Zero if there are no true objects.
    pub mota: f64,
    /// F1 measure of the sweeps that the best assignment of whole identities explains, 0 to 1.
    pub idf1: f64,
    /// Higher order tracking accuracy, 0 to 1, with the similarity `1 - distance / 2 m`.
    pub hota: f64,
}

/// Accumulator of the metrics over sequences.
#[derive(Clone, Debug, Default)]
pub struct TrackingPool {
    sweeps: Vec<TrackedSweep>,
    /// Number of matches that the best assignment of whole identities explains, summed over sequences.
    explained: f64,
    /// Numbers of true and of found identities so far.
    identities: [u32; 2],
}

impl TrackingPool {
    /// Adds a sequence. Identities of other sequences are other objects.
    pub fn add(&mut self, sequence: &[TrackedSweep]) {
        let first = self.sweeps.len();
        let mut known = [BTreeMap::new(), BTreeMap::new()];
        for sweep in sequence {
            let mut numbered = |which: usize, objects: &[TrackedObject]| -> Vec<TrackedObject> {
                let (known, next) = (&mut known[which], &mut self.identities[which]);
                let number = |object: &TrackedObject| {
                    let id = *known.entry(object.id).or_insert_with(|| {
                        *next += 1;
                        *next
                    });
                    TrackedObject { id, ..*object }
                };
                objects.iter().map(number).collect()
            };
            let sweep = TrackedSweep {
                truth: numbered(0, &sweep.truth),
                ignored: numbered(0, &sweep.ignored),
                found: numbered(1, &sweep.found),
            };
            self.sweeps.push(without_ignored(sweep));
        }
        self.explained += explained(&self.sweeps[first..]);
    }

    /// The metrics of all sequences together.
    pub fn metrics(&self) -> TrackingMetrics {
        let mut metrics = TrackingMetrics {
            truth: self.sweeps.iter().map(|sweep| sweep.truth.len()).sum(),
            found: self.sweeps.iter().map(|sweep| sweep.found.len()).sum(),
            ..TrackingMetrics::default()
        };
        self.clear_mot(&mut metrics);
        metrics.idf1 = 2.0 * self.explained / (metrics.truth + metrics.found).max(1) as f64;
        metrics.hota = self.hota();
        metrics
    }

    /// Matches, switches, distance and MOTA. A match of the sweep before is kept as long as it is
    /// near enough; the others are assigned with the least sum of distances.
    fn clear_mot(&self, metrics: &mut TrackingMetrics) {
        // The last match of each object, and those of the sweep before.
        let mut last: BTreeMap<u32, u32> = BTreeMap::new();
        let mut previous: BTreeMap<u32, u32> = BTreeMap::new();
        let mut distance = 0.0;
        for sweep in &self.sweeps {
            let weights = |t: &TrackedObject, f: &TrackedObject| {
                let is_kept = previous.get(&t.id) == Some(&f.id) && similarity(t, f) > 0.0;
                similarity(t, f) + if is_kept { KEPT } else { 0.0 }
            };
            let matched = assign(&sweep.truth, &sweep.found, weights);
            previous.clear();
            for (truth, found) in matched {
                let (truth, found) = (&sweep.truth[truth], &sweep.found[found]);
                previous.insert(truth.id, found.id);
                let before = last.insert(truth.id, found.id);
                metrics.switches += usize::from(before.is_some_and(|id| id != found.id));
                metrics.matches += 1;
                distance += distance_m(truth, found);
            }
        }
        metrics.distance_m = distance / metrics.matches.max(1) as f64;
        let errors = (metrics.truth - metrics.matches)
            + (metrics.found - metrics.matches)
            + metrics.switches;
        if metrics.truth > 0 {
            metrics.mota = 1.0 - errors as f64 / metrics.truth as f64;
        }
    }

    /// HOTA, averaged over the levels of similarity.
    fn hota(&self) -> f64 {
        let mut alignment: BTreeMap<(u32, u32), f64> = BTreeMap::new();
        let mut counts: [BTreeMap<u32, f64>; 2] = Default::default();
        for TrackedSweep { truth, found, .. } in &self.sweeps {
            for (objects, counts) in [truth, found].into_iter().zip(&mut counts) {
                for object in objects {
                    *counts.entry(object.id).or_default() += 1.0;
                }
            }
            let row = |t: &TrackedObject| found.iter().map(|f| similarity(t, f)).sum::<f64>();
            let column = |f: &TrackedObject| truth.iter().map(|t| similarity(t, f)).sum::<f64>();
            for t in truth {
                for f in found.iter().filter(|f| similarity(t, f) > 0.0) {
                    let here = similarity(t, f);
                    *alignment.entry((t.id, f.id)).or_default() +=
                        here / (row(t) + column(f) - here);
                }
            }
        }
        let union = |t: u32, f: u32, common: f64| counts[0][&t] + counts[1][&f] - common;
        let mut matches: Vec<BTreeMap<(u32, u32), f64>> = vec![BTreeMap::new(); LEVELS];
        for TrackedSweep { truth, found, .. } in &self.sweeps {
            let weight = |t: &TrackedObject, f: &TrackedObject| {
                let common = alignment.get(&(t.id, f.id)).copied().unwrap_or(0.0);
                common / union(t.id, f.id, common) * similarity(t, f)
            };
            for (t, f) in assign(truth, found, weight) {
                let (t, f) = (&truth[t], &found[f]);
                for (level, matches) in matches.iter_mut().enumerate() {
                    if similarity(t, f) >= (level + 1) as f64 / (LEVELS + 1) as f64 {
                        *matches.entry((t.id, f.id)).or_default() += 1.0;
                    }
                }
            }
        }
        let objects: f64 = counts.iter().flat_map(BTreeMap::values).sum();
        let at = |matches: &BTreeMap<(u32, u32), f64>| {
            let right: f64 = matches.values().sum();
            let association = matches.iter().map(|(&(t, f), &n)| n * n / union(t, f, n));
            let association = association.sum::<f64>() / right.max(1.0);
            let detection = right / (objects - right).max(1.0);
            (detection * association).sqrt()
        };
        matches.iter().map(at).sum::<f64>() / LEVELS as f64
    }
}

/// Number of matches in the sweeps of one sequence that the best assignment of whole identities explains.
fn explained(sweeps: &[TrackedSweep]) -> f64 {
    let mut together: BTreeMap<[u32; 2], f64> = BTreeMap::new();
    for sweep in sweeps {
        for truth in &sweep.truth {
            for found in sweep.found.iter().filter(|f| similarity(truth, f) > 0.0) {
                *together.entry([truth.id, found.id]).or_default() += 1.0;
            }
        }
    }
    let edges: Vec<Edge> = together
        .iter()
        .map(|(ids, &weight)| Edge {
            ends: ids.map(|id| id as usize),
            weight,
        })
        .collect();
    let assigned = assignment(&edges).into_iter();
    assigned.map(|edge| edge.weight).sum()
}

/// The sweep without its ignored objects, and without the found objects that are assigned to them.
fn without_ignored(mut sweep: TrackedSweep) -> TrackedSweep {
    let truth = sweep.truth.len();
    let all = [sweep.truth.as_slice(), &sweep.ignored].concat();
    let mut kept = vec![true; sweep.found.len()];
    for (object, found) in assign(&all, &sweep.found, similarity) {
        kept[found] = object < truth;
    }
    let mut kept = kept.into_iter();
    sweep.found.retain(|_| kept.next().unwrap_or(true));
    sweep.ignored.clear();
    sweep
}

fn distance_m(a: &TrackedObject, b: &TrackedObject) -> f64 {
    let [x, y] = [0, 1].map(|axis| f64::from(a.position[axis] - b.position[axis]));
    x.hypot(y)
}

/// 1 for one position, 0 from [`MATCHED_WITHIN_M`] on.
fn similarity(a: &TrackedObject, b: &TrackedObject) -> f64 {
    (1.0 - distance_m(a, b) / MATCHED_WITHIN_M).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(id: u32, x: f32) -> TrackedObject {
        TrackedObject {
            id,
            position: [x, 0.0],
        }
    }

    fn metrics(sweeps: &[TrackedSweep]) -> TrackingMetrics {
        let mut pool = TrackingPool::default();
        pool.add(sweeps);
        pool.metrics()
    }

    /// Ten sweeps of two objects 10 m apart, with what `found` finds of them.
    fn two(found: impl Fn(usize) -> Vec<TrackedObject>) -> Vec<TrackedSweep> {
        let sweep = |index| TrackedSweep {
            truth: vec![at(1, index as f32), at(2, 10.0 + index as f32)],
            ignored: Vec::new(),
            found: found(index),
        };
        (0..10).map(sweep).collect()
    }

    #[test]
    fn what_is_found_as_it_is_has_the_best_metrics() {
        let right = |index: usize| vec![at(8, index as f32), at(9, 10.0 + index as f32)];
        let metrics = metrics(&two(right));
        assert_eq!(
            (metrics.truth, metrics.found, metrics.matches),
            (20, 20, 20)
        );
        assert_eq!((metrics.switches, metrics.distance_m), (0, 0.0));
        assert_eq!([metrics.mota, metrics.idf1, metrics.hota], [1.0; 3]);
    }

    #[test]
    fn large_identities_of_several_sequences_are_different_objects() {
        let mut pool = TrackingPool::default();
        for _ in 0..2 {
            let of = |index: usize| {
                let x = index as f32;
                vec![at(u32::MAX, x), at(u32::MAX - 1, 10.0 + x)]
            };
            let mut sequence = two(of);
            for sweep in &mut sequence {
                sweep.truth.clone_from(&sweep.found);
            }
            pool.add(&sequence);
        }
        let metrics = pool.metrics();
        assert_eq!(
            (metrics.truth, metrics.matches, metrics.switches),
            (40, 40, 0)
        );
        assert_eq!([metrics.mota, metrics.idf1, metrics.hota], [1.0; 3]);
    }

    #[test]
    fn an_identity_that_changes_is_a_switch_and_halves_what_one_identity_explains() {
        let changed = |index: usize| {
            let id = if index < 5 { 8 } else { 7 };
            vec![at(id, index as f32), at(9, 10.0 + index as f32)]
        };
        let metrics = metrics(&two(changed));
        assert_eq!((metrics.matches, metrics.switches), (20, 1));
        assert!((metrics.mota - 0.95).abs() < 1e-12);
        assert!((metrics.idf1 - 0.75).abs() < 1e-12);
        // Detection is right. Association: 10 of 20 at 1, two times 5 of 20 at 1/2.
        assert!((metrics.hota - 0.75_f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn a_match_is_kept_from_the_sweep_before_and_from_no_earlier_one() {
        let sweep = |found| TrackedSweep {
            truth: vec![at(1, 0.0)],
            ignored: Vec::new(),
            found,
        };
        let both = || vec![at(8, 1.9), at(7, 0.1)];
        let first = || vec![at(8, 0.0)];
        let kept = metrics(&[sweep(first()), sweep(both())]);
        assert_eq!(kept.switches, 0);
        assert!((kept.distance_m - 0.95).abs() < 1e-6);
        let lost = metrics(&[sweep(first()), sweep(Vec::new()), sweep(both())]);
        assert_eq!(lost.switches, 1);
        assert!((lost.distance_m - 0.05).abs() < 1e-6);
    }

    #[test]
    fn misses_false_objects_and_distance_cost_what_they_are() {
        let half = |index: usize| {
            let mut found = vec![at(8, index as f32 + 1.0)];
            if index == 0 {
                found.push(at(5, 100.0));
            }
            found
        };
        let metrics = metrics(&two(half));
        assert_eq!((metrics.found, metrics.matches), (11, 10));
        assert!((metrics.mota - (1.0 - 11.0 / 20.0)).abs() < 1e-12);
        assert!((metrics.distance_m - 1.0).abs() < 1e-6);
        assert!((metrics.idf1 - 20.0 / 31.0).abs() < 1e-12);
        // At ten of nineteen levels a match: 10 of 21 objects, associated without an error.
        let hota = 10.0 / 19.0 * (10.0_f64 / 21.0).sqrt();
        assert!((metrics.hota - hota).abs() < 1e-9, "{}", metrics.hota);
    }

    #[test]
    fn objects_at_ignored_ones_count_neither_way_and_sequences_are_apart() {
        let sweep = |found| TrackedSweep {
            truth: vec![at(1, 0.0)],
            ignored: vec![at(2, 30.0)],
            found,
        };
        let mut pool = TrackingPool::default();
        pool.add(&[sweep(vec![at(1, 0.1), at(2, 30.5)])]);
        pool.add(&[sweep(vec![at(2, 0.1)])]);
        let metrics = pool.metrics();
        assert_eq!((metrics.truth, metrics.found), (2, 2));
        assert_eq!((metrics.matches, metrics.switches), (2, 0));
        assert!((metrics.idf1 - 1.0).abs() < 1e-12);
        assert_eq!(
            TrackingPool::default().metrics(),
            TrackingMetrics::default()
        );
    }
}
