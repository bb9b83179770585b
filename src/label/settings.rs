//! The settings of a run, which all its processes share: `run.json` in the output.

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::error::{LabelError, OtherRun};
use super::layout::SETTINGS_FILE;
use super::places::{Place, PlaceError};
use super::types::Inputs;
use crate::job::{DeviceChoice, JobOptions};

/// What determines the outputs of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Version of the program.
    pub fnsf: String,
    /// Options of the estimates, as JSON.
    pub options: serde_json::Value,
    /// Name of the layout.
    pub layout: String,
    /// Whether the ego motion is that of the plan's poses.
    pub poses: bool,
    /// Whether tracks are written, and correct the flows.
    pub tracks: bool,
    /// Whether the times of points are not read.
    pub ignore_times: bool,
    /// Where the masks are, for a layout that asks for them.
    pub masks: Option<String>,
    /// Number of pairs of the plan.
    pub pairs: usize,
    /// [`Plan::hash`](super::Plan::hash).
    pub plan: String,
}

impl Settings {
    /// The settings of a run of this program.
    pub fn new(inputs: &Inputs<'_>) -> Self {
        let options = JobOptions {
            // Farms have mixed machines. On two devices fields differ by rounding.
            device: DeviceChoice::default(),
            ..inputs.options.clone()
        };
        Self {
            fnsf: env!("CARGO_PKG_VERSION").to_owned(),
            options: serde_json::from_str(&options.to_json()).unwrap_or_default(),
            layout: inputs.layout.name().to_owned(),
            poses: inputs.poses,
            tracks: inputs.tracks,
            ignore_times: inputs.ignore_times,
            masks: inputs.masks.as_ref().map(|masks| masks.uri("")),
            pairs: inputs.plan.pairs(),
            plan: inputs.plan.hash(inputs.poses),
        }
    }

    /// Writes the settings into a new output, or compares them with those of an output that has some.
    ///
    /// # Errors
    /// [`LabelError::OtherRun`], and [`LabelError::Place`].
    pub(super) async fn agree(&self, output: &Place) -> Result<(), LabelError> {
        let text = serde_json::to_vec_pretty(self).expect("settings have a JSON form");
        if output.put_new(SETTINGS_FILE, Bytes::from(text)).await? {
            return Ok(());
        }
        let theirs = Self::read(output).await?;
        match theirs.difference(self) {
            None => Ok(()),
            Some(other) => Err(LabelError::OtherRun(other)),
        }
    }

    /// Reads the settings of an output.
    pub(super) async fn read(output: &Place) -> Result<Self, LabelError> {
        let bytes = match output.read(SETTINGS_FILE).await {
            Err(PlaceError::Missing(_)) => return Err(LabelError::NoRun(output.uri(""))),
            read => read?,
        };
        serde_json::from_slice(&bytes)
            .map_err(|error| LabelError::BadRun(output.uri(SETTINGS_FILE), error.to_string()))
    }

    fn difference(&self, ours: &Self) -> Option<OtherRun> {
        let values =
            [self, ours].map(|settings| serde_json::to_value(settings).unwrap_or_default());
        let [theirs, ours] = &values;
        let names = theirs.as_object()?.keys();
        let differing = names
            .into_iter()
            .find(|name| theirs[*name] != ours[*name])?;
        Some(OtherRun {
            differing: differing.clone(),
            theirs: theirs[differing].to_string(),
            ours: ours[differing].to_string(),
        })
    }
}
