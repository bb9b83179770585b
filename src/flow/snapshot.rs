//! An optimization put down, to be taken up again with the same bits: its state, as bytes.
//!
//! ```text
//! magic 8 | version u32 | identity u64 | iterations u64 | best iteration u64 | best loss f64
//!   | stopping rule: has best u8, best f64, without progress u64 | floats u64
//!   | parameters, means, squares, kept: floats x f32 each | checksum u64
//! ```
//!
//! Little-endian. What can be derived (transposes, the points' order) is left out. Knows no files.

use super::early_stop::Seen;
use super::field::mlp::{LAID_OUT, Parameters};
use super::options::Options;
use super::points::Point;
use super::preprocess::Selection;

const MAGIC: [u8; 8] = *b"FNSFSNAP";
const VERSION: u32 = 1;
/// Bytes before the floats.
const HEADER: usize = 8 + 4 + 8 + 8 + 8 + 8 + 1 + 8 + 8 + 8;
/// Parameters, two moments, the kept parameters.
const ARRAYS: usize = 4;
/// Bytes of a snapshot.
const LENGTH: usize = HEADER + ARRAYS * LAID_OUT * size_of::<f32>() + size_of::<u64>();

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
    pub(crate) best_loss: f64,
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
            best_loss: f64::INFINITY,
        }
    }
}

/// An optimization between two iterations. Resumed with the same problem, options and kind of
/// device it ends with the bits of one that was never put down, whatever the number of threads.
#[derive(Clone)]
pub struct Snapshot {
    identity: u64,
    state: TrainerState,
}

impl Snapshot {
    /// `state` of the optimization of `selection` by `options`.
    pub(crate) fn new(selection: &Selection, options: &Options, state: TrainerState) -> Self {
        Self {
            identity: identity(selection, options),
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
    ) -> Result<TrainerState, SnapshotError> {
        if self.identity == identity(selection, options) {
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
        let mut bytes = Vec::with_capacity(LENGTH);
        bytes.extend(MAGIC);
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(self.identity.to_le_bytes());
        bytes.extend((state.iterations as u64).to_le_bytes());
        bytes.extend((state.best_iteration as u64).to_le_bytes());
        bytes.extend(state.best_loss.to_le_bytes());
        bytes.push(u8::from(state.seen.best.is_some()));
        bytes.extend(state.seen.best.unwrap_or(0.0).to_le_bytes());
        bytes.extend((state.seen.without_progress as u64).to_le_bytes());
        bytes.extend((LAID_OUT as u64).to_le_bytes());
        let [means, squares] = &state.moments;
        for array in [&state.parameters, means, squares, &state.kept] {
            bytes.extend(
                array
                    .as_slice()
                    .iter()
                    .flat_map(|value| value.to_le_bytes()),
            );
        }
        let checksum = Hash::default().of(&bytes);
        bytes.extend(checksum.to_le_bytes());
        bytes
    }

    /// Reads what [`Self::to_bytes`] wrote; nothing is allocated before all is known to be there.
    ///
    /// # Errors
    /// [`SnapshotError`] where the bytes are no snapshot, of another version, torn or altered.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        if !bytes.starts_with(&MAGIC) {
            return Err(SnapshotError::NotASnapshot);
        }
        let mut rest = Reader(&bytes[MAGIC.len()..]);
        let version = u32::from_le_bytes(rest.take()?);
        if version != VERSION {
            return Err(SnapshotError::Version { version });
        }
        if bytes.len() != LENGTH {
            return Err(SnapshotError::Length {
                bytes: bytes.len(),
                expected: LENGTH,
            });
        }
        let (sound, checksum) = bytes.split_at(LENGTH - size_of::<u64>());
        if checksum != Hash::default().of(sound).to_le_bytes() {
            return Err(SnapshotError::Damaged);
        }
        let identity = rest.number()?;
        let iterations = rest.count()?;
        let best_iteration = rest.count()?;
        let best_loss = f64::from_bits(rest.number()?);
        let [has_best] = rest.take()?;
        let best = f64::from_bits(rest.number()?);
        let seen = Seen {
            best: (has_best != 0).then_some(best),
            without_progress: rest.count()?,
        };
        if rest.count()? != LAID_OUT {
            return Err(SnapshotError::Damaged);
        }
        let state = TrainerState {
            parameters: rest.parameters()?,
            moments: [rest.parameters()?, rest.parameters()?],
            kept: rest.parameters()?,
            seen,
            iterations,
            best_iteration,
            best_loss,
        };
        Ok(Self { identity, state })
    }
}

/// The bytes that are left to read.
struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], SnapshotError> {
        let (taken, rest) = self.0.split_first_chunk().ok_or(SnapshotError::Damaged)?;
        self.0 = rest;
        Ok(*taken)
    }

    fn number(&mut self) -> Result<u64, SnapshotError> {
        self.take().map(u64::from_le_bytes)
    }

    fn count(&mut self) -> Result<usize, SnapshotError> {
        usize::try_from(self.number()?).map_err(|_| SnapshotError::Damaged)
    }

    fn parameters(&mut self) -> Result<Parameters, SnapshotError> {
        let mut parameters = Parameters::zeros();
        for value in parameters.as_mut_slice() {
            *value = f32::from_le_bytes(self.take()?);
        }
        Ok(parameters)
    }
}

/// FNV-1a over 64 bits: a single altered byte always shows.
struct Hash(u64);

impl Default for Hash {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Hash {
    fn word(&mut self, word: u64) {
        self.0 = (self.0 ^ word).wrapping_mul(0x0000_0100_0000_01b3);
    }

    fn of(mut self, bytes: &[u8]) -> u64 {
        bytes.iter().for_each(|&byte| self.word(u64::from(byte)));
        self.0
    }
}

/// What a snapshot belongs to: both clouds as they take part, in the fit and in the ego motion, and
/// every option but the memory that the machine allows.
fn identity(selection: &Selection, options: &Options) -> u64 {
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
        .surroundings
        .iter()
        .flatten()
        .for_each(|points| cloud(points));
    hash.0
}

/// Why a snapshot was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// The bytes are something else.
    #[error("not a snapshot")]
    NotASnapshot,
    /// Written by another version.
    #[error("a snapshot of version {version}, this program reads version {VERSION}")]
    Version {
        /// The version it names.
        version: u32,
    },
    /// Bytes are missing, or there are too many.
    #[error("a snapshot of {bytes} bytes, {expected} are expected")]
    Length {
        /// Bytes there.
        bytes: usize,
        /// Bytes of a snapshot.
        expected: usize,
    },
    /// The checksum is wrong.
    #[error("the snapshot is damaged")]
    Damaged,
    /// Taken of other clouds or by other options.
    #[error("the snapshot belongs to another problem or other options")]
    Foreign,
}
