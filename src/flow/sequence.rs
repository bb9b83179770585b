//! Sequence estimation: takes sweeps one by one and returns the motion of each consecutive pair.
//!
//! Memory does not grow with the length of the sequence: only the sweeps of one window and the
//! motion field of the last pair are held. With a warm start, a field fit starts from the previous
//! field, transformed into the new frame, if that field explains the new pair (see
//! `field/warm_start.rs`). The previous ego motion is then the prior of the registration.
//! Independent of files.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::ops::Range;

use super::data::{Control, Point};
use super::error::FlowError;
use super::estimate::{Estimate, estimate};
use super::field::Backend;
use super::motion::MotionField;
use super::options::{Ego, Ground, Options};
use super::problem::{NeighborSweep, Problem};
use super::select::{FindGround, find_ground, ground_masks, is_in_crop};

/// One sweep of a sequence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sweep {
    /// N points, metres, in the sensor frame of the sweep.
    pub points: Vec<Point>,
    /// N flags: true for ground points. None where the ground is unknown.
    pub ground: Option<Vec<bool>>,
    /// N times of the points, see [`Problem::times`]. None where they are unknown.
    pub times: Option<Vec<f32>>,
    /// Time of the sweep, seconds, on any clock of the sequence. It tells how many intervals lie
    /// between the sweeps of a window. None where it is unknown: they count as evenly spaced.
    pub time_s: Option<f64>,
}

impl Sweep {
    /// The sweep with the ground mask that `options.ground` requires.
    ///
    /// - [`Ground::Keep`]: the mask is removed.
    /// - [`Ground::Auto`]: a missing mask is made by segmenting the points within the crop. A mask
    ///   that is there is kept.
    /// - [`Ground::Mask`]: the sweep is unchanged, even if its mask is missing. The estimate of the
    ///   pair then reports the error.
    #[must_use]
    pub fn prepared(self, options: &Options) -> Self {
        self.prepared_by(options, &find_ground)
    }

    fn prepared_by(mut self, options: &Options, find: FindGround<'_>) -> Self {
        if options.ground == Ground::Keep {
            self.ground = None;
        } else if self.ground.is_none()
            // A missing mask is reported as an error by the estimate of the pair.
            && let Ok([mask]) = ground_masks([(self.points.as_slice(), None)], options, find)
        {
            self.ground = mask.map(Cow::into_owned);
        }
        self
    }

    /// The sweep as a neighbor sweep of a pair, `at` intervals after the pair's source, see
    /// [`NeighborSweep::at`].
    #[must_use]
    pub fn as_neighbor(&self, at: i8) -> NeighborSweep<'_> {
        NeighborSweep {
            points: &self.points,
            ground: self.ground.as_deref(),
            times: self.times.as_deref(),
            at,
        }
    }

    /// The rows of points that are finite, within the crop of `options`, and not nearer than its
    /// `min_range_m`.
    pub fn rows_in_crop(&self, options: &Options) -> Vec<usize> {
        let rows = 0..self.points.len();
        rows.filter(|&row| is_in_crop(self.points[row], options))
            .collect()
    }

    /// The sweep restricted to its [`Self::rows_in_crop`], in the same order.
    ///
    /// # Panics
    /// If the ground mask or the times are so short that a point within the crop has none.
    #[must_use]
    pub fn cropped(self, options: &Options) -> Self {
        let rows = self.rows_in_crop(options);
        let kept = |flags: Vec<bool>| rows.iter().map(|&row| flags[row]).collect();
        let measured = |times: Vec<f32>| rows.iter().map(|&row| times[row]).collect();
        Self {
            points: rows.iter().map(|&row| self.points[row]).collect(),
            ground: self.ground.map(kept),
            times: self.times.map(measured),
            time_s: self.time_s,
        }
    }
}

/// The window of a pair: the range of consecutive sweeps that its estimate uses.
///
/// `pair` is the index of the pair's earlier sweep. `count` is the number of sweeps in the
/// sequence, and `pair + 1 < count` is required; otherwise the range lacks a sweep of the pair.
/// `sweeps` is the window size. It is raised to 2 if it is smaller, and limited to `count`.
///
/// The window contains both sweeps of the pair. It is centered on the pair as far as the ends of
/// the sequence allow. With an odd size the extra sweep lies before the pair.
///
/// # Panics
/// If `count` is 0, in builds with overflow checks. Other builds return an empty range.
pub fn window(pair: usize, count: usize, sweeps: usize) -> Range<usize> {
    let sweeps = sweeps.max(2).min(count);
    let first = pair.saturating_sub(before_pair(sweeps));
    let first = first.min(count - sweeps);
    first..first + sweeps
}

/// Whether the window of a pair lies within the first `count` sweeps of its sequence. The window is
/// then final: later sweeps do not change it, and the pair can be estimated.
///
/// `pair` is the index of the pair's earlier sweep. `sweeps` is the window size; values below 2
/// count as 2.
pub fn is_window_final(pair: usize, count: usize, sweeps: usize) -> bool {
    let sweeps = sweeps.max(2);
    pair.saturating_sub(before_pair(sweeps)) + sweeps <= count
}

/// Number of sweeps before the pair in a centered window.
fn before_pair(sweeps: usize) -> usize {
    (sweeps - 1) / 2
}

/// A pair of a sequence, to be estimated by itself from the sweeps of its [`window`].
#[derive(Clone, Copy, Debug)]
pub struct WindowedPair<'a> {
    /// Index of the pair's earlier sweep.
    pub pair: usize,
    /// Number of sweeps in the sequence, more than `pair + 1`.
    pub count: usize,
    /// Window size in sweeps.
    pub sweeps: usize,
    /// The motion field of the pair before, see [`Problem::before`].
    pub before: Option<&'a MotionField>,
}

impl WindowedPair<'_> {
    /// Estimates the pair. `sweep` returns the sweeps of the window by their index, as
    /// [`Sweep::prepared`] returns them. A neighbor sweep for which it returns none is left out.
    ///
    /// The result has the bits of [`Sequence`] where all sweeps are there.
    ///
    /// # Errors
    /// As [`estimate`].
    ///
    /// # Panics
    /// If `sweep` returns none for a sweep of the pair.
    pub fn estimate<'s>(
        &self,
        backend: &dyn Backend,
        sweep: impl Fn(usize) -> Option<&'s Sweep>,
        options: &Options,
        control: &dyn Control,
    ) -> Result<Estimate, FlowError> {
        let of_pair = |index| sweep(index).expect("both sweeps of the pair are there");
        let (source, target) = (of_pair(self.pair), of_pair(self.pair + 1));
        let ground = source.ground.as_deref();
        let ground = ground.zip(target.ground.as_deref());
        let times = source.times.as_deref();
        let times = times.zip(target.times.as_deref());
        let others = window(self.pair, self.count, self.sweeps);
        let others = others.filter(|&index| index != self.pair && index != self.pair + 1);
        let neighbors: Vec<NeighborSweep> = others
            .filter_map(|index| {
                let neighbor = sweep(index)?;
                let times = [source, target, neighbor].map(|sweep| sweep.time_s);
                let at = neighbor_at(times, index as i64 - self.pair as i64)?;
                Some(neighbor.as_neighbor(at))
            })
            .collect();
        let problem = Problem {
            source: &source.points,
            target: &target.points,
            ground: ground.map(|(source, target)| [source, target]),
            times: times.map(|(source, target)| [source, target]),
            before: self.before,
            neighbors: &neighbors,
        };
        estimate(backend, &problem, options, control)
    }
}

/// The place of a neighbor sweep, [`NeighborSweep::at`]. `times_s` are the times of the source, of the
/// target and of the sweep, seconds. Where one is unknown, the sweep counts as `sweeps` intervals after
/// the source. None if it lies between two intervals of the pair, where the motion of the pair does not
/// tell where an object is, if it has the time of one of the pair, or if it is more than 127 intervals away.
pub fn neighbor_at(times_s: [Option<f64>; 3], sweeps: i64) -> Option<i8> {
    /// Difference from a whole number of intervals.
    const OFF: f64 = 0.2;
    let [Some(source), Some(target), Some(sweep)] = times_s else {
        return i8::try_from(sweeps).ok();
    };
    let intervals = (sweep - source) / (target - source);
    if !intervals.is_finite() {
        return i8::try_from(sweeps).ok();
    }
    let at = intervals.round();
    let is_near = (intervals - at).abs() <= OFF;
    (is_near && at != 0.0 && at != 1.0 && at.abs() <= 127.0).then_some(at as i8)
}

/// A sweep, and the options of the pair that has it as its target.
#[derive(Clone, Debug)]
struct QueuedSweep {
    sweep: Sweep,
    options: Options,
}

/// Streaming estimator of a sequence, pair by pair. `Sequence::default()` starts a sequence.
///
/// The options of the first sweep set the window size ([`Options::sweeps`]). Each pair is estimated
/// from the sweeps of its [`window`]. Its result is delayed until the last of them arrives, or
/// until [`Sequence::finish`]. The motion field of a pair is passed to the next pair as
/// [`Problem::before`].
///
/// Memory does not grow with the length of the sequence: fewer than two windows of sweeps are held.
///
/// ```
/// use fnsf::flow::cpu::CpuBackend;
/// use fnsf::flow::simulate::{Street, StreetOptions};
/// use fnsf::flow::{Preset, Sequence, Sweep, Uncontrolled};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let street = StreetOptions { beams: 16, azimuth_steps: 400, sweeps: 3, ..StreetOptions::default() };
/// let street = Street::new(&street)?;
/// let (backend, options) = (CpuBackend::new(None)?, Preset::Default.options(None));
/// let mut sequence = Sequence::default();
/// let mut flows = Vec::new();
/// for index in 0..3 {
///     let sweep = Sweep { points: street.sweep(index)?.points, ..Sweep::default() };
///     flows.extend(sequence.push(&backend, sweep, &options, &Uncontrolled)?);
/// }
/// assert_eq!(flows.len(), 2);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug, Default)]
pub struct Sequence {
    /// Sweeps that a later pair may still use.
    held: VecDeque<QueuedSweep>,
    /// Number of sweeps pushed so far.
    count: usize,
    /// Index of the next pair.
    next: usize,
    /// Window size in sweeps.
    sweeps: usize,
    before: Option<MotionField>,
}

impl Sequence {
    /// Adds the next sweep and returns the estimates of all pairs whose windows are now complete,
    /// in order. The list is empty where no window is complete.
    ///
    /// `options` are those of the pair that has the sweep as its target. They may differ from sweep
    /// to sweep, except for the window size. The first sweep is the target of no pair; its options
    /// set the window size. The options also prepare the ground mask of the sweep, as
    /// [`Sweep::prepared`] does. A known ego motion is given as [`super::Ego::Given`].
    ///
    /// # Errors
    /// As [`estimate`], for the first pair that is not yet estimated. The sequence is then
    /// unchanged, and the sweep may be pushed again. Where a later pair fails, the estimates before
    /// it are returned and the pair is tried again by the next call.
    pub fn push(
        &mut self,
        backend: &dyn Backend,
        sweep: Sweep,
        options: &Options,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, FlowError> {
        // Segmented once for all pairs that use the sweep.
        let host = backend.host();
        let find = |sweeps: &[&[Point]]| match options.ego {
            Ego::Auto => host.ground_and_surfels(sweeps),
            Ego::Given(_) | Ego::Off => host.ground(sweeps),
        };
        let sweep = sweep.prepared_by(options, &find);
        if self.count == 0 {
            self.sweeps = options.sweeps();
        }
        self.held.push_back(QueuedSweep {
            sweep,
            options: options.clone(),
        });
        self.count += 1;
        let pushed = self.estimates(backend, is_window_final, control);
        if pushed.is_err() {
            self.held.pop_back();
            self.count -= 1;
        } else {
            self.forget();
        }
        pushed
    }

    /// The number of sweeps and the number of estimated pairs so far.
    pub fn position(&self) -> [usize; 2] {
        [self.count, self.next]
    }

    /// Returns the estimates of the remaining pairs at the end of the sequence, in order. Where a
    /// pair after the first of them fails, the list ends before it. Call `finish` until it returns
    /// an empty list.
    ///
    /// # Errors
    /// As [`estimate`], for the first pair that is not yet estimated. The sequence is then
    /// unchanged, and `finish` may be called again.
    pub fn finish(
        &mut self,
        backend: &dyn Backend,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, FlowError> {
        self.estimates(backend, |_, _, _| true, control)
    }

    /// Estimates the next pairs in order, while `is_ready(pair, count, sweeps)` holds and no pair
    /// fails.
    fn estimates(
        &mut self,
        backend: &dyn Backend,
        is_ready: impl Fn(usize, usize, usize) -> bool,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, FlowError> {
        let mut estimates = Vec::new();
        while self.next + 1 < self.count {
            if !is_ready(self.next, self.count, self.sweeps) {
                break;
            }
            let estimate = match self.estimate(backend, self.next, control) {
                Ok(estimate) => estimate,
                Err(error) if estimates.is_empty() => return Err(error),
                Err(_) => break,
            };
            self.before = Some(estimate.motion.clone());
            self.next += 1;
            estimates.push(estimate);
        }
        Ok(estimates)
    }

    /// Estimates a pair from the sweeps of its window.
    fn estimate(
        &self,
        backend: &dyn Backend,
        pair: usize,
        control: &dyn Control,
    ) -> Result<Estimate, FlowError> {
        let windowed = WindowedPair {
            pair,
            count: self.count,
            sweeps: self.sweeps,
            before: self.before.as_ref(),
        };
        windowed.estimate(
            backend,
            |index| Some(&self.at(index).sweep),
            &self.at(pair + 1).options,
            control,
        )
    }

    fn at(&self, index: usize) -> &QueuedSweep {
        &self.held[index + self.held.len() - self.count]
    }

    /// Drops the sweeps that no later pair uses.
    fn forget(&mut self) {
        let sweeps = self.count.max(self.next + 2);
        let first = window(self.next, sweeps, self.sweeps).start;
        while self.count - self.held.len() < first {
            self.held.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_neighbor_sweep_counts_by_its_time_where_sweeps_are_missing() {
        // The sweep at 0.2 s is missing.
        let of = |[source, target]: [f64; 2], other: f64| {
            neighbor_at([Some(source), Some(target), Some(other)], 9)
        };
        assert_eq!(of([0.3, 0.4], 0.1), Some(-2));
        assert_eq!(of([0.3, 0.4], 0.503), Some(2));
        assert_eq!(of([0.1, 0.3], 0.5), Some(2));
        assert_eq!(of([0.1, 0.3], 0.4), None);
        assert_eq!(of([0.1, 0.3], 0.31), None);
        assert_eq!(of([0.1, 0.2], 99.0), None);
        // The newer sweep first.
        assert_eq!(of([0.4, 0.3], 0.1), Some(3));
        assert_eq!(of([0.1, 0.1], 0.3), Some(9));
        assert_eq!(neighbor_at([Some(0.0), None, Some(1.0)], -2), Some(-2));
        assert_eq!(neighbor_at([None; 3], 128), None);
    }

    #[test]
    fn a_window_holds_its_pair_and_is_as_centered_as_the_ends_allow() {
        let five: Vec<_> = (0..8).map(|pair| window(pair, 9, 5)).collect();
        let expected = [0..5, 0..5, 0..5, 1..6, 2..7, 3..8, 4..9, 4..9];
        assert_eq!(five, expected);
        assert_eq!([window(0, 9, 3), window(4, 9, 3)], [0..3, 3..6]);
        assert_eq!([window(1, 3, 5), window(1, 4, 5)], [0..3, 0..4]);
        for pair in 0..8 {
            assert_eq!(window(pair, 9, 2), pair..pair + 2);
            for sweeps in 0..12 {
                let window = window(pair, 9, sweeps);
                assert!(window.contains(&pair) && window.contains(&(pair + 1)));
                assert_eq!(window.len(), sweeps.clamp(2, 9));
            }
        }
    }
}
