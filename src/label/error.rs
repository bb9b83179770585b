//! Errors of a run.

use super::datasets::DatasetError;
use super::manifest::ManifestError;
use super::places::PlaceError;
use super::plan::PlanError;

/// The output belongs to a run with other settings.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the output belongs to a run with another {differing}: {theirs} there, {ours} here; choose a new output"
)]
pub struct OtherRun {
    /// The first setting that differs.
    pub differing: String,
    /// Its value in the output.
    pub theirs: String,
    /// Its value here.
    pub ours: String,
}

/// Why a run cannot begin, or had to stop.
#[derive(Debug, thiserror::Error)]
pub enum LabelError {
    /// A store cannot be used.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// The manifest cannot be used.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The data set cannot be used.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// There is nothing to label.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The output belongs to a run with other settings.
    #[error(transparent)]
    OtherRun(OtherRun),
    /// The output holds no run.
    #[error("{0} holds no run: it has no run.json")]
    NoRun(String),
    /// The settings of the output cannot be read.
    #[error("{0} cannot be read: {1}")]
    BadRun(String, String),
    /// A sweep has no pose, and the ego motion is to come from poses. The text says which sweep, or
    /// which file of poses cannot be read.
    #[error("{0}: leave out --known-poses, or give every sweep of the manifest one")]
    NoPose(String),
    /// The output does not keep the first of two writers.
    #[error(
        "{0} replaces an object that is there although it was asked not to: choose a store with conditional writes"
    )]
    NoConditionalWrites(String),
    /// The machine cannot start what the run needs.
    #[error("the run cannot start: {0}")]
    Machine(#[from] std::io::Error),
}

impl LabelError {
    /// Whether trying again may help.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::Place(error) | Self::Dataset(DatasetError::Place(error)) => error.may_pass(),
            Self::Machine(_) => true,
            _ => false,
        }
    }
}
