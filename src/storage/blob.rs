//! The blobs of a job, their paths, and the errors of the store.

use std::io;

use object_store::path::Path;

use crate::fault::Fault;
use crate::job::JobId;

/// Whether a write waits for the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fsync {
    /// It waits: the blob is on disk when the write returns. An object store always does.
    Yes,
    /// It does not wait: the blob survives a crash of the process, but perhaps not of the machine.
    No,
}

/// A blob of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blob {
    /// One of its sweeps, by index from 0.
    Sweep(u32),
    /// The latest snapshot of its optimization.
    Snapshot,
    /// The flow, or the dense cloud, of one attempt, by attempt number.
    Result(u32),
    /// The motion field of one attempt, by attempt number, for the jobs that follow and for the
    /// dense cloud. A late attempt cannot change a field that was already read.
    Field(u32),
}

/// Why an operation of the store failed. [`BlobError::fault`] classifies it.
#[derive(Debug, thiserror::Error)]
#[error("the blob store failed: {0}")]
pub struct BlobError(#[from] object_store::Error);

impl BlobError {
    /// Whether the operation failed because the blob or file does not exist.
    pub fn is_missing(&self) -> bool {
        self.fault() == Fault::Missing
    }

    /// Whether a name leads to nothing that can be read as a file, now and later: a folder, a device, a
    /// loop of links, a file that is too large, or an impossible name.
    pub fn is_unusable(&self) -> bool {
        const LOOP: i32 = rustix::io::Errno::LOOP.raw_os_error();
        use io::ErrorKind::{
            FileTooLarge, InvalidFilename, InvalidInput, IsADirectory, NotADirectory,
        };
        let kinds = [
            FileTooLarge,
            InvalidFilename,
            InvalidInput,
            IsADirectory,
            NotADirectory,
        ];
        let of_system = Fault::io_error(&self.0);
        matches!(self.0, object_store::Error::InvalidPath { .. })
            || of_system.is_some_and(|error| {
                kinds.contains(&error.kind()) || error.raw_os_error() == Some(LOOP)
            })
    }

    /// The cause: [`Fault::Missing`] if the blob or file does not exist, [`Fault::Full`] if no more
    /// data can be written, otherwise [`Fault::Machine`].
    pub fn fault(&self) -> Fault {
        match &self.0 {
            object_store::Error::NotFound { .. } => Fault::Missing,
            error => Fault::of(error),
        }
    }
}

impl From<io::Error> for BlobError {
    fn from(error: io::Error) -> Self {
        Self(object_store::Error::Generic {
            store: "files",
            source: Box::new(error),
        })
    }
}

/// Free space of the file system that holds the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FreeSpace {
    /// Free bytes for unprivileged processes.
    pub bytes: u64,
    /// Files and folders that can still be created; `None` if the file system does not count them.
    pub inodes: Option<u64>,
}

/// The folder of a job. Ids begin with their time, so the jobs of one parent folder were created
/// within about one minute.
pub(super) fn folder(id: JobId) -> String {
    let name = id.to_string();
    format!("jobs/{}/{name}", &name[..8])
}

/// The path of a blob below the root of the store.
pub(super) fn path(id: JobId, blob: Blob) -> Path {
    let folder = folder(id);
    Path::from(match blob {
        Blob::Sweep(index) => format!("{folder}/sweep-{index}"),
        Blob::Snapshot => format!("{folder}/snapshot"),
        Blob::Result(attempt) => format!("{folder}/result-{attempt}"),
        Blob::Field(attempt) => format!("{folder}/field-{attempt}"),
    })
}
