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
        let made: NamedTempFile = tempfile::Builder::new()
            .prefix(&format!("{}.", name.to_string_lossy()))
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

/// From here on a signal that ends the program takes unfinished files with it.
fn remove_on_signals() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let watch = || -> std::io::Result<()> {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()?;
            runtime.block_on(async {
                let mut interrupt = signal(SignalKind::interrupt())?;
                let mut terminate = signal(SignalKind::terminate())?;
                let mut hangup = signal(SignalKind::hangup())?;
                let number = tokio::select! {
                    _ = interrupt.recv() => SignalKind::interrupt(),
                    _ = terminate.recv() => SignalKind::terminate(),
                    _ = hangup.recv() => SignalKind::hangup(),
                };
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
            .spawn(move || watch().unwrap_or_default());
    });
}
