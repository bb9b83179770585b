//! A sequence: sweeps in, the motion of each consecutive pair out.
//!
//! Keeps the sweeps of a window and the last pair's field, whatever the length. Each fit starts from the
//! field before it, carried into the new frame, where the options have a warm start and that explains
//! the new pair (`warm_start.rs` says how it is judged); the vehicle's motion is sought about the one
//! before then. Knows no files.

use std::collections::VecDeque;
use std::ops::Range;

use super::data::{Control, Point};
use super::error::FlowError;
use super::estimate::{Estimate, estimate};
use super::field::Backend;
use super::motion::MotionField;
use super::options::{Ground, Options};
use super::registration::NeighborSweep;
use super::select::{FindGround, Problem, find_ground, ground_of, is_in_range};

/// One sweep of a sequence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sweep {
    /// N points, metres, in the sensor's frame of the sweep.
    pub points: Vec<Point>,
    /// N flags: which points are ground, where the sweep says so.
    pub ground: Option<Vec<bool>>,
}

impl Sweep {
    /// The sweep as `options` take it: its ground found where it is wanted and not known, and
    /// forgotten where it is kept.
    #[must_use]
    pub fn prepared(self, options: &Options) -> Self {
        self.prepared_by(options, &find_ground)
    }

    fn prepared_by(mut self, options: &Options, find: FindGround<'_>) -> Self {
        match options.ground {
            Ground::Keep => self.ground = None,
            Ground::Mask => {}
            Ground::Auto if self.ground.is_some() => {}
            Ground::Auto => {
                let [found] = ground_of([&self.points], options, find);
                self.ground = Some(found);
            }
        }
        self
    }

    /// The points alone that `options` let take part in a dense cloud: those in range.
    #[must_use]
    pub fn cropped(self, options: &Options) -> Self {
        let rows: Vec<usize> = (0..self.points.len())
            .filter(|&row| is_in_range(self.points[row], options))
            .collect();
        Self {
            points: rows.iter().map(|&row| self.points[row]).collect(),
            ground: self
                .ground
                .map(|ground| rows.iter().map(|&row| ground[row]).collect()),
        }
    }
}

/// Which of `sweeps` sweeps the pair of sweep `pair` and the next is estimated from, where it may
/// see `frames`: as many consecutive ones as there are, the pair among them, as centered as the ends
/// of the sequence allow; the sweep that one side has more is before the pair.
pub fn window(pair: usize, sweeps: usize, frames: usize) -> Range<usize> {
    let frames = frames.max(2).min(sweeps);
    let first = pair.saturating_sub(before_pair(frames));
    let first = first.min(sweeps - frames);
    first..first + frames
}

/// Whether no sweep to come after the first `sweeps` changes the window of a pair.
pub fn is_whole(pair: usize, sweeps: usize, frames: usize) -> bool {
    let frames = frames.max(2);
    pair.saturating_sub(before_pair(frames)) + frames <= sweeps
}

/// Sweeps of a centered window before its pair.
fn before_pair(frames: usize) -> usize {
    (frames - 1) / 2
}

/// A sweep, and the options of the pair that it is the target of.
#[derive(Clone, Debug)]
struct Held {
    sweep: Sweep,
    options: Options,
}

/// The pairs of a sequence, one after the other.
///
/// Where the first sweep's options ask for more sweeps than the pair's own ([`Options::frames`]), a
/// pair is estimated from its [`window`], by nothing but the sweeps in it: it has to wait for the last
/// of them, and at most as many sweeps are held as the window has.
#[derive(Clone, Debug, Default)]
pub struct Sequence {
    /// The sweeps that pairs to come may see.
    held: VecDeque<Held>,
    /// Sweeps that there have been.
    count: usize,
    /// The pair that is next.
    next: usize,
    /// Sweeps of a window.
    frames: usize,
    before: Option<MotionField>,
}

impl Sequence {
    /// Takes the next sweep, and gives the motion of every pair whose sweeps are now all there, in
    /// order. `options` are those of the pair that ends in the sweep, and may change from sweep to
    /// sweep, but for how many sweeps a pair sees: where the vehicle's motion is known,
    /// [`super::Ego::Given`] says it.
    ///
    /// # Errors
    /// As [`estimate`], of the first pair that is not there yet; the sequence is left as it was, and the
    /// sweep may be pushed again. A pair behind one that is given is tried again with the next sweep.
    pub fn push(
        &mut self,
        backend: &dyn Backend,
        sweep: Sweep,
        options: &Options,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, FlowError> {
        // Once for all that see it.
        let find = |sweeps: &[&[Point]]| backend.host().ground(sweeps);
        let sweep = sweep.prepared_by(options, &find);
        if self.count == 0 {
            self.frames = options.frames();
        }
        self.held.push_back(Held {
            sweep,
            options: options.clone(),
        });
        self.count += 1;
        let pushed = self.estimates(backend, is_whole, control);
        if pushed.is_err() {
            self.held.pop_back();
            self.count -= 1;
        } else {
            self.forget();
        }
        pushed
    }

    /// Gives the motion of the pairs that were waiting for sweeps to come, as there are none: to be
    /// asked until nothing more is given.
    ///
    /// # Errors
    /// As [`estimate`], of the first pair that is not there yet; the sequence is left as it was, and may
    /// be finished again.
    pub fn finish(
        &mut self,
        backend: &dyn Backend,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, FlowError> {
        self.estimates(backend, |_, _, _| true, control)
    }

    /// The next pairs, as long as `is_ready` says so of a pair, the sweeps so far and those of a window,
    /// and none of them fails.
    fn estimates(
        &mut self,
        backend: &dyn Backend,
        is_ready: impl Fn(usize, usize, usize) -> bool,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, FlowError> {
        let mut estimates = Vec::new();
        while self.next + 1 < self.count {
            if !is_ready(self.next, self.count, self.frames) {
                break;
            }
            let estimate = match self.estimate(backend, self.next, control) {
                Ok(estimate) => estimate,
                Err(error) if estimates.is_empty() => return Err(error),
                Err(_) => break,
            };
            self.before = Some(estimate.field.clone());
            self.next += 1;
            estimates.push(estimate);
        }
        Ok(estimates)
    }

    /// The motion of a pair, from the sweeps of its window.
    fn estimate(
        &self,
        backend: &dyn Backend,
        pair: usize,
        control: &dyn Control,
    ) -> Result<Estimate, FlowError> {
        let (source, target) = (&self.at(pair).sweep, self.at(pair + 1));
        let ground = source.ground.as_deref();
        let ground = ground.zip(target.sweep.ground.as_deref());
        let others = window(pair, self.count, self.frames);
        let others = others.filter(|&place| place != pair && place != pair + 1);
        let around: Vec<NeighborSweep> = others
            .filter_map(|place| {
                let Sweep { points, ground } = &self.at(place).sweep;
                let ground = ground.as_deref();
                // Farther sweeps than that are of no use.
                let at = i8::try_from(place as i64 - pair as i64).ok()?;
                Some(NeighborSweep { points, ground, at })
            })
            .collect();
        let problem = Problem {
            source: &source.points,
            target: &target.sweep.points,
            ground: ground.map(|(source, target)| [source, target]),
            before: self.before.as_ref(),
            around: &around,
        };
        estimate(backend, &problem, &target.options, control)
    }

    fn at(&self, place: usize) -> &Held {
        &self.held[place + self.held.len() - self.count]
    }

    /// Lets go of the sweeps that no pair to come may see.
    fn forget(&mut self) {
        let sweeps = self.count.max(self.next + 2);
        let first = window(self.next, sweeps, self.frames).start;
        while self.count - self.held.len() < first {
            self.held.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_holds_its_pair_and_is_as_centered_as_the_ends_allow() {
        let five: Vec<_> = (0..8).map(|pair| window(pair, 9, 5)).collect();
        let expected = [0..5, 0..5, 0..5, 1..6, 2..7, 3..8, 4..9, 4..9];
        assert_eq!(five, expected);
        assert_eq!([window(0, 9, 3), window(4, 9, 3)], [0..3, 3..6]);
        assert_eq!([window(1, 3, 5), window(1, 4, 5)], [0..3, 0..4]);
        for pair in 0..8 {
            assert_eq!(window(pair, 9, 2), pair..pair + 2);
            for frames in 0..12 {
                let window = window(pair, 9, frames);
                assert!(window.contains(&pair) && window.contains(&(pair + 1)));
                assert_eq!(window.len(), frames.clamp(2, 9));
            }
        }
    }
}
