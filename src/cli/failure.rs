//! How a command fails: one line, and an exit code that says whose fault it was.

use std::fmt;
use std::process::ExitCode;

use crate::flow::FlowError;

/// A failed command.
#[derive(Debug)]
pub(super) struct Failure {
    kind: Kind,
    error: anyhow::Error,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Usage,
    BadInput,
    Internal,
    ReaderGone,
}

impl Failure {
    /// The arguments contradict each other or ask for the impossible.
    pub(super) fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::Usage,
            error: error.into(),
        }
    }

    /// A file, or what is in it, cannot be used.
    pub(super) fn bad_input(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::BadInput,
            error: error.into(),
        }
    }

    /// Something else went wrong.
    pub(super) fn internal(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::Internal,
            error: error.into(),
        }
    }

    /// Nobody reads the answer any more; whoever asked has what it wanted.
    pub(super) fn reader_gone(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::ReaderGone,
            error: error.into(),
        }
    }

    /// Whether there is something to say about it.
    pub(super) fn is_worth_a_word(&self) -> bool {
        self.kind != Kind::ReaderGone
    }

    pub(super) fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self.kind {
            Kind::ReaderGone => 0,
            Kind::Usage => 2,
            Kind::BadInput => 65,
            Kind::Internal => 70,
        })
    }
}

impl From<FlowError> for Failure {
    fn from(error: FlowError) -> Self {
        if error.is_input() {
            Self::bad_input(error)
        } else {
            Self::internal(error)
        }
    }
}

impl fmt::Display for Failure {
    /// The error and its causes on one line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let line = format!("{:#}", self.error);
        f.write_str(&line.replace(['\n', '\r'], " "))
    }
}
