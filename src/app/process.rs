//! What the operating system lets this process do, set once at the start.

use rustix::fs::Mode;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit, umask};
use tokio::signal::unix::{SignalKind, signal};

/// Files that are not connections: the queue's, payloads that are read and written, devices.
const OTHER_FILES: u64 = 256;

/// The signal of a file that may not grow any more; its number on Linux, macOS and the BSDs.
const SIGXFSZ: i32 = 25;

/// Raises the number of files that may be open as far as the system lets it. Says how many of them
/// may be connections; none where there is no limit.
pub(super) fn raise_open_files() -> Option<usize> {
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        maximum: limit.maximum,
    };
    let now = match setrlimit(Resource::Nofile, raised) {
        Ok(()) => limit.maximum,
        Err(error) => {
            tracing::warn!(%error, "the number of open files was not raised");
            limit.current
        }
    };
    let others = |all: u64| OTHER_FILES.min(all / 2);
    now.map(|all| usize::try_from(all - others(all)).unwrap_or(usize::MAX))
}

/// Keeps what is written from here on to the user who runs this: clouds say where people drive.
pub(super) fn keep_files_private() {
    umask(Mode::RWXG | Mode::RWXO);
}

/// A file that may not grow is an error of a write, not the end of the process.
pub(super) fn survive_file_limits() {
    match signal(SignalKind::from_raw(SIGXFSZ)) {
        // Once there is a handler the default is gone for good.
        Ok(stream) => drop(stream),
        Err(error) => tracing::debug!(%error, "SIGXFSZ is as it was"),
    }
}
