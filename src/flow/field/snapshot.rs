//! Snapshots of an interrupted fit: its state as bytes, from which it resumes with the same bits.
//!
//! ```text
//! identity u64 | iterations u64 | best iteration u64 | best loss f32
//!   | stopping rule: has best u8, best f32, without progress u64
//!   | growth of the batch: doublings u32, has loss u8, loss f32
//!   | number of parameters u64 | parameters, means, squares, kept: f32 each
//! ```
//!
//! This is the body of an envelope, see `data/codec.rs`. Derived values (transposes, the order of
//! the points) are not stored.

use super::codec::{put_parameters, take_parameters};
use super::early_stopping::EarlyStopState;
use super::parameters::Parameters;
use super::schedule::{GrowthState, MOST_DOUBLINGS};
use crate::flow::data::{Envelope, EnvelopeError};

const ENVELOPE: Envelope = Envelope {
    magic: *b"FNSFSNAP",
    version: 5,
};

/// The state of a fit between two iterations.
///
/// It holds the parameters, Adam's moments, the parameters of the result so far, the state of early
/// stopping, and the iteration counts. Together with the points and the options it determines all
/// following iterations.
#[derive(Clone)]
pub struct TrainerState {
    pub(crate) parameters: Parameters,
    /// Adam's running means of the gradients and of their squares.
    pub(crate) moments: [Parameters; 2],
    /// Parameters of the result so far.
    pub(crate) kept: Parameters,
    /// State of early stopping; the default without early stopping.
    pub(crate) seen: EarlyStopState,
    /// Growth of the batch; the default with a constant batch.
    pub(crate) growth: GrowthState,
    pub(crate) iterations: usize,
    pub(crate) best_iteration: usize,
    pub(crate) best_loss: f32,
}

impl TrainerState {
    /// The state before the first iteration.
    pub(crate) fn at_start(parameters: Parameters) -> Self {
        Self {
            moments: [parameters.zeros_like(), parameters.zeros_like()],
            kept: parameters.clone(),
            parameters,
            seen: EarlyStopState::default(),
            growth: GrowthState::default(),
            iterations: 0,
            best_iteration: 0,
            best_loss: f32::INFINITY,
        }
    }
}

/// A field fit stopped between two iterations, to be continued by [`crate::flow::resume`].
///
/// Resumed with the same problem and options, it ends with the same bits as an uninterrupted fit.
/// This holds for any number of threads, and on any device that rounds multiply-adds like the first
/// one.
#[derive(Clone)]
pub struct Snapshot {
    identity: u64,
    state: TrainerState,
}

impl Snapshot {
    /// A snapshot of `state` for the fit with this identity, see [`Self::state_for`].
    pub(crate) fn new(identity: u64, state: TrainerState) -> Self {
        Self { identity, state }
    }

    /// The state, for the fit it belongs to. `identity` is a hash of all inputs and options of the
    /// fit.
    ///
    /// # Errors
    /// [`SnapshotError::Foreign`] for any other fit.
    pub(crate) fn state_for(self, identity: u64) -> Result<TrainerState, SnapshotError> {
        if self.identity == identity {
            Ok(self.state)
        } else {
            Err(SnapshotError::Foreign)
        }
    }

    /// Number of iterations that the fit had done when it was stopped.
    pub fn iterations(&self) -> usize {
        self.state.iterations
    }

    /// The snapshot as bytes, 1.9 MB for a network, with a header, a format version and a checksum.
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
        bytes.extend(state.growth.doublings.to_le_bytes());
        bytes.push(u8::from(state.growth.loss.is_some()));
        bytes.extend(state.growth.loss.unwrap_or(0.0).to_le_bytes());
        bytes.extend((state.parameters.as_slice().len() as u64).to_le_bytes());
        let [means, squares] = &state.moments;
        for array in [&state.parameters, means, squares, &state.kept] {
            put_parameters(&mut bytes, array);
        }
        ENVELOPE.close(bytes)
    }

    /// Reads the output of [`Self::to_bytes`]. Allocates nothing before the length and the checksum
    /// have been verified. [`crate::flow::resume`] checks whether the snapshot fits a problem.
    ///
    /// # Errors
    /// [`SnapshotError::Sealed`] if the bytes are not a snapshot, are of another format version, or
    /// are truncated or altered.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let mut body = ENVELOPE.open(bytes)?;
        let identity = body.number()?;
        let iterations = body.count()?;
        let best_iteration = body.count()?;
        let best_loss = f32::from_le_bytes(body.take()?);
        let [has_best] = body.take()?;
        let best = f32::from_le_bytes(body.take()?);
        let seen = EarlyStopState {
            best: (has_best != 0).then_some(best),
            without_progress: body.count()?,
        };
        let doublings = u32::from_le_bytes(body.take()?);
        let [has_loss] = body.take()?;
        let loss = f32::from_le_bytes(body.take()?);
        let growth = GrowthState {
            doublings: doublings.min(MOST_DOUBLINGS),
            loss: (has_loss != 0).then_some(loss),
        };
        let floats = body.count()?;
        let mut parameters = || take_parameters(&mut body, floats);
        let state = TrainerState {
            parameters: parameters()?,
            moments: [parameters()?, parameters()?],
            kept: parameters()?,
            seen,
            growth,
            iterations,
            best_iteration,
            best_loss,
        };
        body.end()?;
        Ok(Self { identity, state })
    }
}

/// Why a snapshot could not be read or resumed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// The bytes are not a snapshot, are of another format version, or are truncated or altered.
    #[error("no snapshot: {0}")]
    Sealed(#[from] EnvelopeError),
    /// The snapshot was taken with other clouds, other options or another method.
    #[error("the snapshot belongs to another problem or other options")]
    Foreign,
}
