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
            let length = file.metadata()?.len();
            let mut beginning = [0; 8];
            let read = file.read_at(&mut beginning, 0)?;
            let kind = recognize(&beginning[..read], None);
            Ok((file, length, kind.ok() == Some(FileKind::Hdf5)))
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
