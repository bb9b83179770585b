//! Failures of a command: a one-line message, and an exit code by kind.

use std::fmt;
use std::process::ExitCode;

use crate::flow::FlowError;
use crate::formats::FormatError;
use crate::text::printable;

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
    TryAgain,
    ReaderGone,
}

impl Failure {
    /// The arguments are contradictory or impossible: exit code 2.
    pub(super) fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::Usage,
            error: error.into(),
        }
    }

    /// An input file or its content cannot be used: exit code 65.
    pub(super) fn bad_input(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::BadInput,
            error: error.into(),
        }
    }

    /// Any other failure: exit code 70.
    pub(super) fn internal(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::Internal,
            error: error.into(),
        }
    }

    /// A file cannot be written. Values that no reader takes come of the input.
    pub(super) fn of_writing(error: anyhow::Error) -> Self {
        match error.downcast_ref() {
            Some(FormatError::NotFinite { .. } | FormatError::OutOfRange { .. }) => {
                Self::bad_input(error)
            }
            _ => Self::internal(error),
        }
    }

    /// Trying again may help: exit code 75.
    pub(super) fn try_again(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::TryAgain,
            error: error.into(),
        }
    }

    /// The reader of stdout closed the pipe. This is not an error: exit code 0 and no message.
    pub(super) fn reader_gone(error: impl Into<anyhow::Error>) -> Self {
        Self {
            kind: Kind::ReaderGone,
            error: error.into(),
        }
    }

    /// Whether an input file or its content is the reason.
    pub(super) fn is_of_input(&self) -> bool {
        self.kind == Kind::BadInput
    }

    /// Whether the reader of stdout has closed the pipe.
    pub(super) fn is_of_reader(&self) -> bool {
        self.kind == Kind::ReaderGone
    }

    pub(super) fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self.kind {
            Kind::ReaderGone => 0,
            Kind::Usage => 2,
            Kind::BadInput => 65,
            Kind::Internal => 70,
            Kind::TryAgain => 75,
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
    /// The error and its causes, on one line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let line = format!("{:#}", self.error);
        f.write_str(&printable(&line))
    }
}
