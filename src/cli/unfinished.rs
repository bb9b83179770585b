//! Temporary output files, which are removed when a signal ends the program.

use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, Once};

use tempfile::{NamedTempFile, TempPath};
use tokio::signal::unix::{SignalKind, signal};

use crate::sync::locked;

/// Paths of the files being written.
static WRITTEN: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// An output file under a temporary name, until it is complete.
pub(super) struct Unfinished {
    path: TempPath,
}

fn written() -> MutexGuard<'static, Vec<PathBuf>> {
    locked(&WRITTEN)
}

impl Unfinished {
    /// Creates a file with a unique temporary name in the folder of `path`.
    pub(super) fn beside(path: &Path) -> std::io::Result<(Self, File)> {
        remove_on_signals();
        let folder = path.parent().unwrap_or(Path::new("."));
        let name = path.file_name().unwrap_or_default();
        let mut names = written();
        // Only the first 40 characters: `name` may already have the maximum length of a file name.
        let begins: String = name.to_string_lossy().chars().take(40).collect();
        let made: NamedTempFile = tempfile::Builder::new()
            .prefix(&format!("{begins}."))
            .suffix(".part")
            // The mode of a regular new file; the user's umask is applied to it.
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(folder)?;
        let (file, path) = made.into_parts();
        names.push(path.to_path_buf());
        Ok((Self { path }, file))
    }

    /// Renames the file to `path` and replaces any file there.
    pub(super) fn rename(self, path: &Path) -> std::io::Result<()> {
        let mut names = written();
        names.retain(|name| *name != *self.path);
        self.path.persist(path).map_err(|error| error.error)
    }
}

/// SIGXFSZ, the signal for exceeding the file size limit. This is its number on Linux, macOS and
/// the BSDs.
const SIGXFSZ: i32 = 25;

/// Whether a signal was ignored when the program started. Detected on Linux only.
fn is_ignored(kind: SignalKind) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (kind.as_raw_value() - 1) & 1 == 1)
}

/// Starts a thread, once, that removes temporary files when a signal ends the program.
fn remove_on_signals() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let control = || -> std::io::Result<()> {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()?;
            runtime.block_on(async {
                // With a handler installed, exceeding the file size limit is a write error. By
                // default the signal ends the program.
                drop(signal(SignalKind::from_raw(SIGXFSZ))?);
                let ends = [
                    SignalKind::interrupt(),
                    SignalKind::terminate(),
                    SignalKind::hangup(),
                ];
                // Signals that were ignored at the start, by nohup or a shell, stay ignored.
                let ends = ends.into_iter().filter(|kind| !is_ignored(*kind));
                let mut coming = Vec::new();
                for kind in ends {
                    let mut one = signal(kind)?;
                    coming.push(Box::pin(async move {
                        one.recv().await;
                        kind
                    }));
                }
                if coming.is_empty() {
                    return Ok(());
                }
                let (number, ..) = futures_util::future::select_all(coming).await;
                // The lock is held during the removal, so no file is created or renamed meanwhile.
                for path in written().iter() {
                    let _gone_is_fine = std::fs::remove_file(path);
                }
                std::process::exit(128 + number.as_raw_value())
            })
        };
        // If the thread cannot start, a signal leaves a temporary file behind and has no other
        // effect.
        let _without = std::thread::Builder::new()
            .name("signals".to_owned())
            .spawn(move || control().unwrap_or_default());
    });
}
