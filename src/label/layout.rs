//! Layouts of the output: the name and the bytes of a pair's file.

use std::collections::HashMap;

use super::plan::{Plan, PlanError, below};
use crate::flow::{Estimate, Point};
use crate::formats::{
    Av2Challenge, FlowFormat, FlowTable, FormatError, moving_labels, write_av2_challenge,
    write_flow,
};

/// How the outputs lie and what they hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Layout {
    /// DRIVE/SWEEP.npz, all that is known of the flow.
    #[default]
    Npz,
    /// DRIVE/SWEEP.feather: flow, valid, dynamic, cluster, confidence, moving.
    Feather,
    /// SemanticKITTI: DRIVE/labels/SWEEP.label, 251 for a point that moves and 9 for one that does not.
    #[value(name = "semantickitti")]
    SemanticKitti,
    /// Argoverse 2, first challenge: DRIVE/TIMESTAMP.feather, the rows of --masks.
    Av2V1,
    /// Argoverse 2, second challenge: DRIVE/INDEX.feather of every fifth pair, and metadata.json.
    Av2V2,
    /// Argoverse 2, third challenge: DRIVE/TIMESTAMP.feather.
    Av2V3,
}

/// The file with the settings of a run, in its output.
pub(super) const SETTINGS_FILE: &str = "run.json";

/// Pairs of the second challenge are this many sweeps apart.
const V2_STRIDE: usize = 5;

impl Layout {
    /// The name as on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Npz => "npz",
            Self::Feather => "feather",
            Self::SemanticKitti => "semantickitti",
            Self::Av2V1 => "av2-v1",
            Self::Av2V2 => "av2-v2",
            Self::Av2V3 => "av2-v3",
        }
    }

    /// Whether it asks for the rows of masks.
    pub fn needs_masks(self) -> bool {
        self == Self::Av2V1
    }

    /// Whether its labels say what moves, or leave the ego motion out.
    pub fn needs_ego_motion(self) -> bool {
        match self {
            Self::SemanticKitti | Self::Av2V1 | Self::Av2V2 | Self::Av2V3 => true,
            Self::Npz | Self::Feather => false,
        }
    }

    /// Whether it asks for a pair of a drive, by its index.
    pub(super) fn asks_for(self, pair: usize) -> bool {
        self != Self::Av2V2 || pair.is_multiple_of(V2_STRIDE)
    }

    /// The name of a pair's file: `drive` is the drive's name, `key` that of the pair without ending.
    pub(super) fn path(self, drive: &str, pair: usize, key: &str) -> String {
        match self {
            Self::Npz => format!("{key}.npz"),
            Self::SemanticKitti => match key.rsplit_once('/') {
                Some((folder, sweep)) => format!("{folder}/labels/{sweep}.label"),
                None => format!("labels/{key}.label"),
            },
            Self::Feather | Self::Av2V1 | Self::Av2V3 => format!("{key}.feather"),
            Self::Av2V2 => below(drive, &format!("{pair:010}.feather")),
        }
    }

    /// Files of the whole run: name and text.
    pub(super) fn run_files(self) -> &'static [(&'static str, &'static str)] {
        match self {
            Self::Av2V2 => &[("metadata.json", "{\"Is Supervised?\": false}\n")],
            Self::Npz | Self::Feather | Self::SemanticKitti | Self::Av2V1 | Self::Av2V3 => &[],
        }
    }

    /// The bytes of a pair's file. `source` are the N points that the flow starts from. `mask` has a
    /// flag for each.
    ///
    /// # Errors
    /// [`FormatError`] if the mask is that of another sweep, or a number cannot be written.
    pub(super) fn bytes(
        self,
        source: &[Point],
        estimate: &Estimate,
        mask: Option<&[bool]>,
    ) -> Result<Vec<u8>, FormatError> {
        let table = FlowTable::new(source, estimate);
        let mut bytes = Vec::new();
        let out = &mut bytes;
        match self {
            Self::Npz => write_flow(FlowFormat::Npz, &table, out)?,
            Self::Feather => write_flow(FlowFormat::Feather, &table, out)?,
            Self::SemanticKitti => bytes = moving_labels(&table),
            Self::Av2V1 => write_av2_challenge(Av2Challenge::One, &table, mask, out)?,
            Self::Av2V2 => write_av2_challenge(Av2Challenge::Two, &table, mask, out)?,
            Self::Av2V3 => write_av2_challenge(Av2Challenge::Three, &table, mask, out)?,
        }
        Ok(bytes)
    }
}

/// The folder of the marks.
pub(super) const LEFT_OUT: &str = "_left_out";

/// Checks the names of the outputs: each is used once, and none is the folder of another output.
pub(super) fn check_outputs(plan: &Plan, layout: Layout, tracks: bool) -> Result<(), PlanError> {
    let mut known: HashMap<String, &str> = HashMap::new();
    let pairs = plan.all_pairs().filter(|&(_, pair)| layout.asks_for(pair));
    let pairs = pairs.map(|(drive, pair)| {
        let of = &plan.drives()[drive];
        (layout.path(&of.name, pair, &of.key(pair)), &of.sweeps[pair])
    });
    let tracks = plan.drives().iter().filter(|_| tracks);
    let tracks = tracks.map(|drive| (tracks_path(&drive.name), &drive.sweeps[0]));
    for (path, sweep) in pairs.chain(tracks) {
        if let Some(first) = known.insert(path.clone(), &sweep.uri) {
            return Err(PlanError::SameKey {
                first: first.to_owned(),
                second: sweep.uri.clone(),
                key: path,
            });
        }
    }
    for (path, second) in &known {
        let folders = path.match_indices('/').map(|(end, _)| &path[..end]);
        if let Some((folder, first)) = folders.into_iter().find_map(|at| known.get_key_value(at)) {
            return Err(PlanError::FileAndFolder {
                first: (*first).to_owned(),
                second: (*second).to_owned(),
                key: folder.clone(),
            });
        }
    }
    Ok(())
}

/// The mark of a label that is to be replaced once a sweep can be read, by the label's name. It says which
/// one: a sweep of the window that the label lacks, or one of the pair itself, before which the tracks of
/// the drive end.
pub(super) fn left_out_path(path: &str) -> String {
    format!("{LEFT_OUT}/{path}.txt")
}

/// The file of a drive's tracks.
pub(super) fn tracks_path(drive: &str) -> String {
    below(drive, "tracks.json")
}
