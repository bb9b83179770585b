//! The estimates of a sequence, sweep by sweep, with the tracks of its moving objects.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, TryLockError};

use fnsf::flow::field::Backend;
use fnsf::flow::tracks::{TrackError, Tracker, push_and_correct};
use fnsf::flow::{self, Ego, Estimate, FlowError, Method, Point, Sweep};
use fnsf::formats::{SweepClock, pair_interval_s};
use fnsf::job::{EgoChoice, JobOptions};
use pyo3::prelude::*;
use pyo3::types::PyList;

use crate::arrays::{Mask, Matrix, PointArray, Values, column, motion, points};
use crate::errors::{Error, input, internal};
use crate::estimate::{Place, answer, clock_of, options_of};
use crate::objects;
use crate::supervision::Watch;

/// A pair whose estimate may need later sweeps.
struct Waiting {
    sweeps: [Arc<[Point]>; 2],
    options: JobOptions,
}

/// What a sequence keeps between two calls.
struct State {
    place: Place,
    sequence: flow::Sequence,
    waiting: VecDeque<Waiting>,
    last: Option<(Arc<[Point]>, Option<SweepClock>)>,
    /// Time of the last sweep after the first, seconds, by the intervals of the pairs.
    time_s: f64,
    tracker: Option<Tracker>,
    /// Whether estimates were lost by an exception after they were made.
    is_cut: bool,
    /// The process that began it.
    process: u32,
}

/// The estimates of the consecutive pairs of a sequence.
#[pyclass(frozen, module = "fnsf._native")]
pub(crate) struct Sequence(Mutex<State>);

impl Sequence {
    /// The state. One thread at a time may push.
    fn state(&self) -> PyResult<MutexGuard<'_, State>> {
        match self.0.try_lock() {
            Ok(state) if state.process != std::process::id() => Err(Error::new_err(
                "this sequence was begun before a fork, and its threads are in the other process: begin another one",
            )),
            Ok(state) if state.is_cut => Err(Error::new_err(
                "an exception ended this sequence: flows that were found by then are lost; begin another one",
            )),
            Ok(state) => Ok(state),
            Err(TryLockError::Poisoned(state)) => Ok(state.into_inner()),
            Err(TryLockError::WouldBlock) => Err(Error::new_err(
                "another thread uses this sequence: sweeps are pushed one after the other",
            )),
        }
    }
}

impl State {
    /// Does `work` on the sequence. Where an exception loses estimates, the sequence has ended.
    fn run(
        &mut self,
        py: Python<'_>,
        watch: &Watch,
        progress: Option<&Bound<'_, PyAny>>,
        work: impl Fn(&mut flow::Sequence, &dyn Backend) -> Result<Vec<Estimate>, FlowError> + Sync,
    ) -> PyResult<Vec<Estimate>> {
        let before = self.sequence.position();
        let sequence = &mut self.sequence;
        let done = self
            .place
            .run(py, watch, progress, |backend| work(sequence, backend));
        self.is_cut = done.is_err() && self.sequence.position() != before;
        done
    }

    /// The complete pairs as dictionaries, corrected by the tracks where they are kept.
    fn complete<'py>(
        &mut self,
        py: Python<'py>,
        estimates: Vec<Estimate>,
        out: &Bound<'py, PyList>,
    ) -> PyResult<()> {
        // Until all of them are in the list.
        self.is_cut = true;
        for mut estimate in estimates {
            let pair = self.waiting.pop_front();
            let pair = pair.ok_or_else(|| internal("an estimate without its pair"))?;
            let [source, target] = estimate.sweeps([&pair.sweeps[0], &pair.sweeps[1]]);
            if let Some(tracker) = &mut self.tracker {
                let dt_s = pair.options.solver_options(0).dt_s;
                push_and_correct(tracker, [&source, &target], &mut estimate, dt_s)
                    .map_err(input)?;
            }
            let [source, target] = &pair.sweeps;
            out.append(answer(py, estimate, &pair.options, [source, target])?)?;
        }
        self.is_cut = false;
        Ok(())
    }
}

#[pymethods]
impl Sequence {
    #[new]
    #[pyo3(signature = (options, *, device="auto", threads=None, track=false))]
    fn new(
        py: Python<'_>,
        options: &str,
        device: &str,
        threads: Option<usize>,
        track: bool,
    ) -> PyResult<Self> {
        let options = options_of(options)?;
        if matches!(options.ego, Some(EgoChoice::Given(_))) {
            return Err(input("ego is the motion of one pair: give it to push"));
        }
        let solver = options.solver_options(0);
        if track && !matches!(solver.method, Method::Objects(_)) {
            return Err(input(TrackError::NoObjects));
        }
        if track && solver.ego == Ego::Off {
            return Err(input(TrackError::NoEgoMotion));
        }
        Ok(Self(Mutex::new(State {
            place: Place::open(py, device, threads, options)?,
            sequence: flow::Sequence::default(),
            waiting: VecDeque::new(),
            last: None,
            time_s: 0.0,
            tracker: track.then(Tracker::default),
            is_cut: false,
            process: std::process::id(),
        })))
    }

    /// Adds a sweep, N x 3 metres, and returns the pairs that are complete with it. `ego` and `dt_s`
    /// are those of the pair that has the sweep as its target. Without `dt_s`, points with times give
    /// the interval.
    #[pyo3(signature = (sweep, *, mask=None, times=None, ego=None, dt_s=None, deadline=None, progress=None))]
    #[expect(
        clippy::too_many_arguments,
        reason = "the arguments of the Python method, named at its only call"
    )]
    fn push<'py>(
        &self,
        py: Python<'py>,
        sweep: PointArray<'py>,
        mask: Option<Mask<'py>>,
        times: Option<Values<'py>>,
        ego: Option<Matrix<'py>>,
        dt_s: Option<f32>,
        deadline: Option<f64>,
        progress: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyList>> {
        let watch = Watch::new(deadline)?;
        let mut state = self.state()?;
        let state = &mut *state;
        let cloud: Arc<[Point]> = points("sweep", &sweep)?.into();
        let count = cloud.len();
        let mask = mask.map(|mask| column("the ground mask", &mask, count));
        let times = times.map(|times| column("times", &times, count));
        let mut sweep = Sweep {
            points: cloud.to_vec(),
            ground: mask.transpose()?,
            times: times.transpose()?,
            time_s: None,
        };
        let clock = sweep
            .times
            .as_ref()
            .map(|times| clock_of(&sweep.points, times));
        let last_clock = state.last.as_ref().and_then(|(_, clock)| *clock);
        let mut options = state.place.options.clone();
        options.dt_s = dt_s
            .or(options.dt_s)
            .or_else(|| pair_interval_s(["", ""], [last_clock, clock]));
        options.check().map_err(input)?;
        let larger = count.max(state.last.as_ref().map_or(0, |(last, _)| last.len()));
        let mut solver = options.solver_options(larger);
        if let Some(ego) = ego {
            if solver.ego == Ego::Off {
                return Err(input(
                    "this sequence has ego=\"off\", so that push takes no ego",
                ));
            }
            solver.ego = Ego::Given(motion("ego", &ego)?);
        }
        let time_s = match state.last {
            Some(_) => state.time_s + f64::from(solver.dt_s),
            None => 0.0,
        };
        sweep.time_s = Some(time_s);
        let estimates = state.run(py, &watch, progress.as_ref(), |sequence, backend| {
            sequence.push(backend, sweep.clone(), &solver, &watch)
        })?;
        state.time_s = time_s;
        if let Some((last, _)) = state.last.replace((Arc::clone(&cloud), clock)) {
            let sweeps = [last, cloud];
            state.waiting.push_back(Waiting { sweeps, options });
        }
        let complete = PyList::empty(py);
        state.complete(py, estimates, &complete)?;
        Ok(complete)
    }

    /// Returns the remaining pairs at the end of the sequence.
    #[pyo3(signature = (*, deadline=None, progress=None))]
    fn finish<'py>(
        &self,
        py: Python<'py>,
        deadline: Option<f64>,
        progress: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyList>> {
        let watch = Watch::new(deadline)?;
        let mut state = self.state()?;
        let state = &mut *state;
        let complete = PyList::empty(py);
        while !state.waiting.is_empty() {
            let estimates = state.run(py, &watch, progress.as_ref(), |sequence, backend| {
                sequence.finish(backend, &watch)
            });
            let estimates = match estimates {
                // The flows before a pair that fails; the next call says why.
                Err(error) if error.is_instance_of::<Error>(py) && !complete.is_empty() => break,
                Err(error) => {
                    state.is_cut |= !complete.is_empty();
                    return Err(error);
                }
                Ok(estimates) if estimates.is_empty() => break,
                Ok(estimates) => estimates,
            };
            state.complete(py, estimates, &complete)?;
        }
        Ok(complete)
    }

    /// The tracks of the pairs that are complete, as a structured array; none where they are not
    /// kept.
    fn tracks<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let tracker = self.state()?.tracker.clone();
        let tracks = tracker.map(|tracker| objects::tracks(py, &tracker.finish()));
        tracks.transpose()
    }
}
