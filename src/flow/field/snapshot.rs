//! An optimization put down, to be taken up again with the same bits: its state, as bytes.
//!
//! ```text
//! identity u64 | iterations u64 | best iteration u64 | best loss f32
//!   | stopping rule: has best u8, best f32, without progress u64
//!   | parameters, means, squares, kept: f32 each
//! ```
//!
//! Sealed as `sealed.rs` says. What can be derived (transposes, the points' order) is left out. Knows no files.

use super::early_stopping::Seen;
use super::mlp::Parameters;
use crate::flow::data::{Envelope, EnvelopeError, Hash, PARAMETERS_BYTES, Point, put_parameters};
use crate::flow::motion::MotionField;
use crate::flow::options::Options;
use crate::flow::select::Selection;

const ENVELOPE: Envelope = Envelope {
    magic: *b"FNSFSNAP",
    version: 3,
    body: Some(8 + 8 + 8 + 4 + 1 + 4 + 8 + ARRAYS * PARAMETERS_BYTES),
};
/// Parameters, two moments, the kept parameters.
const ARRAYS: usize = 4;

/// What the iterations that follow depend on, besides points and options.
#[derive(Clone)]
pub struct TrainerState {
    pub(crate) parameters: Parameters,
    /// Adam's means of the gradients and of their squares.
    pub(crate) moments: [Parameters; 2],
    /// The result so far.
    pub(crate) kept: Parameters,
    /// What the stopping rule has seen; nothing where there is none.
    pub(crate) seen: Seen,
    pub(crate) iterations: usize,
    pub(crate) best_iteration: usize,
    pub(crate) best_loss: f32,
}

impl TrainerState {
    /// Before the first iteration.
    pub(crate) fn at_start(parameters: Parameters) -> Self {
        Self {
            moments: [Parameters::zeros(), Parameters::zeros()],
            kept: parameters.clone(),
            parameters,
            seen: Seen::default(),
            iterations: 0,
            best_iteration: 0,
            best_loss: f32::INFINITY,
        }
    }
}

/// An optimization between two iterations. Resumed with the same problem and options it ends with the
/// bits of one that was never put down, whatever the number of threads, and on any device that
/// rounds as the first one does.
#[derive(Clone)]
pub struct Snapshot {
    identity: u64,
    state: TrainerState,
}

impl Snapshot {
    /// `state` of the optimization of `selection` by `options`, after the pair of `before`.
    pub(crate) fn new(
        selection: &Selection,
        options: &Options,
        before: Option<&MotionField>,
        state: TrainerState,
    ) -> Self {
        Self {
            identity: identity(selection, options, before),
            state,
        }
    }

    /// The state, for the optimization that it belongs to.
    ///
    /// # Errors
    /// [`SnapshotError::Foreign`] for any other.
    pub(crate) fn state_for(
        self,
        selection: &Selection,
        options: &Options,
        before: Option<&MotionField>,
    ) -> Result<TrainerState, SnapshotError> {
        if self.identity == identity(selection, options, before) {
            Ok(self.state)
        } else {
            Err(SnapshotError::Foreign)
        }
    }

    /// Iterations done.
    pub fn iterations(&self) -> usize {
        self.state.iterations
    }

    /// The snapshot as bytes, 1.9 MB.
    pub fn to_bytes(&self) -> Vec<u8> {
        let state = &self.state;
        let mut bytes = ENVELOPE.begin();
        bytes.extend(self.identity.to_le_bytes());
        bytes.extend((state.iterations as u64).to_le_bytes());
        bytes.extend((state.best_iteration as u64).to_le_bytes());
        bytes.extend(state.best_loss.to_le_bytes());
        bytes.push(u8::from(state.seen.best.is_some()));
        bytes.extend(state.seen.best.unwrap_or(0.0).to_le_bytes());
        bytes.extend((state.seen.without_progress as u64).to_le_bytes());
        let [means, squares] = &state.moments;
        for array in [&state.parameters, means, squares, &state.kept] {
            put_parameters(&mut bytes, array);
        }
        ENVELOPE.close(bytes)
    }

    /// Reads what [`Self::to_bytes`] wrote; nothing is allocated before all is known to be there.
    ///
    /// # Errors
    /// [`SnapshotError`] where the bytes are no snapshot, of another version, torn or altered.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let mut body = ENVELOPE.open(bytes)?;
        let identity = body.number()?;
        let iterations = body.count()?;
        let best_iteration = body.count()?;
        let best_loss = f32::from_le_bytes(body.take()?);
        let [has_best] = body.take()?;
        let best = f32::from_le_bytes(body.take()?);
        let seen = Seen {
            best: (has_best != 0).then_some(best),
            without_progress: body.count()?,
        };
        let state = TrainerState {
            parameters: body.parameters()?,
            moments: [body.parameters()?, body.parameters()?],
            kept: body.parameters()?,
            seen,
            iterations,
            best_iteration,
            best_loss,
        };
        body.end()?;
        Ok(Self { identity, state })
    }
}

/// What a snapshot belongs to: both clouds as they take part, in the fit and in the ego motion, the
/// field before them, and every option but the memory that the machine allows.
fn identity(selection: &Selection, options: &Options, before: Option<&MotionField>) -> u64 {
    let mut options = options.clone();
    options.distance.max_bytes = 0;
    let mut hash = Hash(Hash::default().of(format!("{options:?}").as_bytes()));
    let mut cloud = |points: &[Point]| {
        hash.word(points.len() as u64);
        for [x, y, z] in points.iter().map(|point| point.map(f32::to_bits)) {
            hash.word(u64::from(x) << 32 | u64::from(y));
            hash.word(u64::from(z));
        }
    };
    cloud(&selection.source);
    cloud(&selection.target);
    selection
        .registration_clouds
        .iter()
        .flatten()
        .for_each(|points| cloud(points));
    if let Some(field) = before {
        field
            .to_bytes()
            .into_iter()
            .for_each(|byte| hash.word(byte.into()));
    }
    hash.0
}

/// Why a snapshot was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// The bytes are no sound snapshot of this version.
    #[error("no snapshot: {0}")]
    Sealed(#[from] EnvelopeError),
    /// Taken of other clouds or by other options.
    #[error("the snapshot belongs to another problem or other options")]
    Foreign,
}
