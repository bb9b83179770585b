//! Process-wide settings, made once at the start: open file limit, umask, SIGXFSZ, TLS clients.

use rustix::fs::Mode;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit, umask};
use tokio::signal::unix::{SignalKind, signal};

/// File descriptors reserved for everything but connections: the queue, payloads and devices.
const OTHER_FILES: u64 = 256;

/// SIGXFSZ, raised when a file exceeds its size limit. Linux, macOS and the BSDs use the same
/// number.
const SIGXFSZ: i32 = 25;

/// Raises the limit of open files to the maximum. Returns the number of descriptors left for
/// connections, or `None` if there is no limit.
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

/// Makes new files readable by the server's user only: point clouds reveal where people drive.
pub(super) fn keep_files_private() {
    umask(Mode::RWXG | Mode::RWXO);
}

/// Ignores SIGXFSZ, so that exceeding a file size limit fails the write and does not end the
/// process.
pub(super) fn survive_file_limits() {
    match signal(SignalKind::from_raw(SIGXFSZ)) {
        // Once installed, the handler replaces the default action for the rest of the process.
        Ok(stream) => drop(stream),
        Err(error) => tracing::debug!(%error, "SIGXFSZ is as it was"),
    }
}

/// Names the cryptography of the process's TLS clients: that of its ports.
pub(super) fn name_tls_provider() {
    let _named_already = rustls::crypto::ring::default_provider().install_default();
}
