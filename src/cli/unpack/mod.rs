//! `fnsf unpack`: the sweeps of a recording or of a scene as files.

mod arguments;
mod recording;
mod scene;
mod sweep_file;

use std::fs::File;
use std::os::unix::fs::FileExt;

use anyhow::Context;

pub(super) use self::arguments::Unpack;
use super::failure::Failure;
use crate::formats::{FileKind, recognize};

impl Unpack {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let open = || -> std::io::Result<(File, u64, bool)> {
            let file = File::open(&self.file)?;
            let about = file.metadata()?;
            let mut beginning = [0; 8];
            // A scene is read here and there. A recording may come through a pipe.
            let read = match about.is_file() {
                true => file.read_at(&mut beginning, 0)?,
                false => 0,
            };
            let kind = recognize(&beginning[..read], None);
            Ok((file, about.len(), kind.ok() == Some(FileKind::Hdf5)))
        };
        let (file, length, is_scene) = open()
            .with_context(|| format!("cannot read {}", self.file.display()))
            .map_err(Failure::bad_input)?;
        match is_scene {
            true => self.scene(file, length),
            false => self.recording(file, length),
        }
    }
}
