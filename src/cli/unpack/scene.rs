//! The sweeps of a scene of OpenSceneFlow as files.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use anyhow::{Context, anyhow};

use super::arguments::Unpack;
use super::sweep_file::{folder_of, write_sweep};
use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::output::{complain, say};
use crate::cli::terminal::bar;
use crate::formats::{FormatError, Scene, SceneSweep, write_pair_npz};
use crate::text::grouped;

/// What was written of a scene.
#[derive(Default)]
struct Written {
    sweeps: usize,
    points: usize,
    timed: usize,
    pairs: usize,
    /// Pairs whose ground is known.
    grounded: usize,
    /// Pairs whose ego motion is not known.
    without_ego: usize,
    /// Why the times of the points of a sweep are not used.
    refused_times: Option<String>,
    damaged: usize,
}

impl Unpack {
    pub(super) fn scene(&self, file: File, length: u64) -> Result<(), Failure> {
        if self.topic.is_some() {
            return Err(Failure::usage(anyhow!("--topic is for recordings")));
        }
        let named = || self.file.display().to_string();
        let read_at = move |offset: u64, bytes: &mut [u8]| file.read_exact_at(bytes, offset);
        let scene = Scene::open(length, read_at)
            .with_context(named)
            .map_err(Failure::bad_input)?;
        let stem = self.file.file_stem().unwrap_or_default().to_string_lossy();
        let name = folder_of(&stem);
        if self.list {
            let sweeps = grouped(scene.names().len());
            return say(format_args!("{name}: {sweeps} sweeps"));
        }
        let written = self.write_scene(&scene, Path::new(&name))?;
        say(format_args!(
            "{name}: {} sweeps, {} points, in {}",
            grouped(written.sweeps),
            grouped(written.points),
            self.output().join(&name).display()
        ))?;
        if written.pairs > 0 {
            let pairs = grouped(written.pairs);
            let masks = match written.grounded {
                0 => "",
                _ => " and ground masks",
            };
            say(format_args!("  {pairs} pairs with true flow{masks}"))?;
        }
        if written.without_ego > 0 {
            let pairs = grouped(written.without_ego);
            say(format_args!(
                "  the true ego motion of {pairs} pairs is not known"
            ))?;
        }
        match &written.refused_times {
            Some(why) => say(format_args!(
                "  the times of the points are not used: {why}"
            ))?,
            None if written.timed > 0 => say(format_args!("  with the times of the points"))?,
            None => {}
        }
        match written.damaged {
            0 => Ok(()),
            damaged => Err(Failure::bad_input(anyhow!(
                "{damaged} sweeps or pairs cannot be read; the others are written"
            ))),
        }
    }

    /// Writes the sweeps, and the pairs whose flow is known, to a folder in the output.
    fn write_scene(&self, scene: &Scene, folder: &Path) -> Result<Written, Failure> {
        let names: Vec<&str> = scene.names().collect();
        let end = self.skip.saturating_add(self.limit.unwrap_or(usize::MAX));
        let range = self.skip.min(names.len())..end.min(names.len());
        let bar = bar(
            range.len() as u64,
            "{wide_bar:.cyan/blue} {pos} of {len} sweeps",
        );
        let mut written = Written::default();
        let mut before: Option<SceneSweep> = None;
        for index in range {
            bar.inc(1);
            let mut leave_out = |error: &FormatError, what: &str, index: usize| {
                written.damaged += 1;
                let name = names[index];
                bar.suspend(|| complain(format_args!("the {what} {name} is left out: {error}")));
            };
            let sweep = match scene.sweep(index) {
                Ok(sweep) => sweep,
                Err(error) => {
                    leave_out(&error, "sweep", index);
                    before = None;
                    continue;
                }
            };
            let pair = before
                .take()
                .map(|source| scene.pair(index - 1, [&source, &sweep]));
            let pair = match pair.transpose() {
                Ok(pair) => pair.flatten(),
                Err(error) => {
                    leave_out(&error, "truth of", index - 1);
                    None
                }
            };
            let path =
                |index: usize, ending: &str| folder.join(format!("{}.{ending}", names[index]));
            let times = sweep.times.as_ref();
            write_sweep(self.output(), &path(index, "pcd"), &sweep.points, times)?;
            written.sweeps += 1;
            written.points += sweep.points.len();
            written.timed += usize::from(sweep.times.is_some());
            written.refused_times = written
                .refused_times
                .take()
                .or_else(|| sweep.refused_times.clone());
            if let Some(pair) = pair {
                files::write_below(self.output(), &path(index - 1, "npz"), |file| {
                    write_pair_npz(&pair, file)
                })?;
                written.pairs += 1;
                written.grounded += usize::from(pair.ground.is_some());
                written.without_ego += usize::from(pair.ego.is_none());
            }
            before = Some(sweep);
        }
        bar.finish_and_clear();
        Ok(written)
    }
}
