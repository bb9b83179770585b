//! Tracks of the moving objects of a sequence: options, and the files that they are written to.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::anyhow;
use clap::Args;

use super::failure::Failure;
use super::files;
use super::output::say;
use crate::flow::tracks::{Tracker, push_and_correct};
use crate::flow::{Ego, Estimate, Method, Point, RigidTransform};
use crate::formats::write_tracks;
use crate::job::JobOptions;
use crate::picture;
use crate::picture::TracksFromAbove;
use crate::text::grouped;

/// Fewest sweeps of a sequence with tracks: an object must move in three pairs.
const FEWEST_SWEEPS: usize = 4;

/// Options of the tracks.
#[derive(Clone, Debug, Args)]
pub(super) struct TrackArguments {
    /// File for the tracks of a sequence, as JSON: each moving object has an id, and in each sweep
    /// a box, a velocity and a yaw rate. Needs four sweeps or more, and preset default or label.
    /// The flows that are written beside get the motions of tracks that their pairs missed
    #[arg(long, value_name = "OUT.json")]
    tracks: Option<PathBuf>,
    /// File for a picture of the tracks from above, all in the frame of the last sweep
    #[arg(long, value_name = "OUT.png")]
    tracks_picture: Option<PathBuf>,
}

/// The tracker of a sequence, and what its picture shows.
pub(super) struct Tracking<'a> {
    arguments: &'a TrackArguments,
    tracker: Tracker,
    /// The pose of each sweep in the frame of the first.
    poses: Vec<RigidTransform>,
    /// The points of the last sweep but one.
    last: Option<Arc<[Point]>>,
    /// Points whose missed motion was corrected.
    corrected: usize,
}

impl TrackArguments {
    /// The files that are written.
    pub(super) fn outputs(&self) -> impl Iterator<Item = &PathBuf> {
        [&self.tracks, &self.tracks_picture].into_iter().flatten()
    }

    /// The tracker for a sequence of `sweeps` sweeps; none where no tracks are asked for.
    ///
    /// # Errors
    /// Where the sequence or the options allow no tracks.
    pub(super) fn start(
        &self,
        sweeps: usize,
        options: &JobOptions,
    ) -> Result<Option<Tracking<'_>>, Failure> {
        if self.outputs().next().is_none() {
            return Ok(None);
        }
        let solver = options.solver_options(0);
        let refused = if sweeps < FEWEST_SWEEPS {
            Some(format!(
                "tracks need {FEWEST_SWEEPS} sweeps or more, {sweeps} are given"
            ))
        } else if !matches!(solver.method, Method::Objects(_)) {
            Some("tracks need clusters: use --preset default or label".to_owned())
        } else if solver.ego == Ego::Off {
            Some("tracks need the ego motion: leave --ego off away".to_owned())
        } else if self
            .tracks_picture
            .as_ref()
            .is_some_and(|path| path.extension().is_none_or(|e| e != "png"))
        {
            Some("a picture's name ends in .png".to_owned())
        } else {
            None
        };
        if let Some(refused) = refused {
            return Err(Failure::usage(anyhow!(refused)));
        }
        Ok(Some(Tracking {
            arguments: self,
            tracker: Tracker::default(),
            poses: vec![RigidTransform::identity()],
            last: None,
            corrected: 0,
        }))
    }
}

impl Tracking<'_> {
    /// Takes the sweeps of a pair, source and target, with its estimate, and gives the estimate the
    /// motions of the tracks that it missed. `dt_s` is the time between the sweeps, seconds.
    pub(super) fn push(
        &mut self,
        sweeps: [&Arc<[Point]>; 2],
        estimate: &mut Estimate,
        dt_s: f32,
    ) -> Result<(), Failure> {
        let [source, target] = sweeps;
        let corrected = push_and_correct(&mut self.tracker, [source, target], estimate, dt_s);
        self.corrected += corrected.map_err(Failure::internal)?;
        if let (Some(ego), Some(pose)) = (estimate.ego, self.poses.last()) {
            self.poses.push(pose * ego.inverse());
        }
        self.last = Some(Arc::clone(source));
        Ok(())
    }

    /// Whether a pair was taken.
    pub(super) fn has_pairs(&self) -> bool {
        self.last.is_some()
    }

    /// Writes the tracks and their picture. Prints what was written, unless `quiet`.
    pub(super) fn finish(self, quiet: bool) -> Result<(), Failure> {
        let tracks = self.tracker.finish();
        if let Some(path) = &self.arguments.tracks {
            files::write(path, |file| write_tracks(&tracks, file))?;
        }
        if let Some(path) = &self.arguments.tracks_picture {
            let image = picture::tracks_from_above(&TracksFromAbove {
                tracks: &tracks,
                poses: &self.poses,
                points: self.last.as_deref().unwrap_or_default(),
            });
            files::write(path, |file| picture::write_png(&image, file))?;
        }
        if quiet {
            return Ok(());
        }
        let (tracks, corrected) = (grouped(tracks.len()), grouped(self.corrected));
        say(format_args!(
            "{tracks} tracks, {corrected} points of missed motions corrected"
        ))?;
        self.arguments
            .outputs()
            .try_for_each(|path| say(format_args!("  wrote {}", path.display())))
    }
}
