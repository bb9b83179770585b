//! Files that are being written, and that no signal leaves behind.

use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};

use tempfile::{NamedTempFile, TempPath};
use tokio::signal::unix::{SignalKind, signal};

/// The names of files that are being written.
static WRITTEN: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// A file under a name of its own, until it is whole.
pub(super) struct Unfinished {
    path: TempPath,
}

fn written() -> MutexGuard<'static, Vec<PathBuf>> {
    WRITTEN.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Unfinished {
    /// Makes a file beside `place`, under a name that nobody else has.
    pub(super) fn beside(place: &Path) -> std::io::Result<(Self, File)> {
        remove_on_signals();
        let folder = place.parent().unwrap_or(Path::new("."));
        let name = place.file_name().unwrap_or_default();
        let mut names = written();
        // A name may be as long as a name can be.
        let begins: String = name.to_string_lossy().chars().take(40).collect();
        let made: NamedTempFile = tempfile::Builder::new()
            .prefix(&format!("{begins}."))
            .suffix(".part")
            // As any file is made: what the user's mask leaves of it.
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(folder)?;
        let (file, path) = made.into_parts();
        names.push(path.to_path_buf());
        Ok((Self { path }, file))
    }

    /// Gives the file its name, over what had it.
    pub(super) fn rename(self, place: &Path) -> std::io::Result<()> {
        let mut names = written();
        names.retain(|name| *name != *self.path);
        self.path.persist(place).map_err(|error| error.error)
    }
}

/// The signal of a file that may not grow any more; its number on Linux, macOS and the BSDs.
const SIGXFSZ: i32 = 25;

/// Whether a signal was ignored when the program was started; not known but on Linux.
fn is_ignored(kind: SignalKind) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask >> (kind.as_raw_value() - 1) & 1 == 1)
}

/// From here on a signal that ends the program takes unfinished files with it.
fn remove_on_signals() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let control = || -> std::io::Result<()> {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()?;
            runtime.block_on(async {
                // A file that may not grow is an error of a write, not the end of the program.
                drop(signal(SignalKind::from_raw(SIGXFSZ))?);
                let ends = [
                    SignalKind::interrupt(),
                    SignalKind::terminate(),
                    SignalKind::hangup(),
                ];
                // What nohup and shells have told it to ignore stays ignored.
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
                // Nothing is written between this and the end.
                for path in written().iter() {
                    let _gone_is_fine = std::fs::remove_file(path);
                }
                std::process::exit(128 + number.as_raw_value())
            })
        };
        // Without it a signal leaves a file behind, and nothing worse.
        let _without = std::thread::Builder::new()
            .name("signals".to_owned())
            .spawn(move || control().unwrap_or_default());
    });
}
