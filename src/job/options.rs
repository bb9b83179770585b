//! The options of a request: one set of names for the command line, HTTP and gRPC.
//!
//! Every option has a default, and unknown keys are refused. This module maps the names to the
//! solver's options. The values of the presets are in `flow/options/`.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::choices::{EgoChoice, GroundChoice, PrecisionChoice, PresetChoice, Priority};
use super::densify::Densify;
use super::device::{DeviceChoice, DeviceKind};
use super::error::{InvalidOptions, MAX_DEADLINE};
use super::field::FieldChoices;
use super::labels::Labels;
use crate::flow::{self, Ego, FieldOptions, Ground, MIN_POINTS, Precision};
use crate::formats::is_interval;

/// Options of a pair or of a sequence.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct JobOptions {
    /// `default`: the rigid motion of each object, from the two sweeps of the pair; the remaining
    /// points move with the ego motion. `label`: as `default`, and a pair of a sequence uses up to
    /// five sweeps. `neural`: a short, robust fit of a neural field. `paper`: FNSF as published.
    /// `nsfp-baseline`: the baseline that FNSF is compared with, a network fitted to the truncated
    /// Chamfer distance. `nsfp`: the same with NSFP's second network for the backward flow.
    /// `nsfp++`, `nsfp++-dt`: ego motion, then a fit of this kind for each cluster, with the Chamfer
    /// distance or distance transforms. `nsfp-kdtree`: the baseline with k-d trees. `fnsf-linear`, `nsfp-linear`,
    /// `nsfp-kdtree-linear`: FNSF's linear model with the three losses.
    pub preset: PresetChoice,
    /// Seed of the random numbers. On the same device, the same input, options and seed give a
    /// bit-identical result, unless a deadline ends the estimate.
    pub seed: u64,
    /// Maximum number of source points that get a flow, at least 3. They are chosen at random from
    /// a larger cloud. Presets that fit a field sample both clouds and use only the sampled points.
    /// `default` and `label` compute from all points and return the flow of the sampled ones. If
    /// not given, no points are sampled.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_points: Option<u32>,
    /// Points with |x| or |y| above this, metres, are ignored and get no flow. More than 0. No crop
    /// if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop_m: Option<f32>,
    /// Points nearer to the sensor than this, horizontally, metres, are ignored and get no flow. More
    /// than 0. It leaves out the vehicle's own returns. None are left out if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_range_m: Option<f32>,
    /// Time between consecutive sweeps, seconds, for velocities: 0.001 to 60. If not
    /// given, it is taken from the timestamps in the file names, or is 0.1 without them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dt_s: Option<f32>,
    /// Treatment of ground points. `keep`: as any other point. `mask`: points marked in the input's
    /// ground masks are left out and get no flow; refused if a mask is missing. `auto`: ground
    /// points are left out of the method and get the ego-motion flow, or none with `max_points` or
    /// without ego motion; they are taken from the masks, or from a ground segmentation if there
    /// are none. Clouds that are nearly all ground keep it. Default: `auto`; `keep` with the presets
    /// after `neural`, except `nsfp++` and `nsfp++-dt`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ground: Option<GroundChoice>,
    /// The ego motion: `off` (not separated), `auto` (estimated first) or a 4 x 4 matrix
    /// target_from_source, translation in metres. Default: `auto`; `off` with the presets after
    /// `neural`, except `nsfp++` and `nsfp++-dt`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Object>)]
    pub ego: Option<EgoChoice>,
    /// The device for the computation. `neural`, `paper`, `fnsf-linear`, `nsfp-baseline` and
    /// `nsfp-linear` can use a GPU. `default` and `label` compute on the host's CPU; a GPU searches
    /// their clusters where the host has few threads. The other presets compute on the CPU and
    /// refuse `gpu`.
    pub device: DeviceChoice,
    /// `f32`: single precision. `f16`: half precision, for `neural` and `paper` on a GPU whose
    /// matrix units pass their self-test.
    pub precision: PrecisionChoice,
    /// Options of the fit, for the presets that fit a field.
    #[serde(skip_serializing_if = "is_default")]
    pub field: FieldChoices,
    /// Also estimates pairs that are otherwise refused as nonsense: sweeps that do not show one scene,
    /// coordinates that are not metres, and sweeps out of the order of the numbers in their names.
    /// Without overlap the confidence is 0.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub force: bool,
    /// Deadline, milliseconds after the arrival of the request, from 1 to 86,400,000 (one day). The
    /// best flow so far is then returned. A job that has not started by then expires. No deadline
    /// if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline_ms: Option<u64>,
    /// Priority of the job. Jobs of a higher priority start first.
    pub priority: Priority,
    /// Labels of the job, by which lists can be filtered: values by name. At most 16; names of 1 to
    /// 63 letters, digits, `-`, `_`, `.` or `/`, values of at most 255 bytes.
    #[serde(skip_serializing_if = "Labels::is_empty")]
    pub labels: Labels,
    /// Webhook: a URL to which the server posts a notice when the job ends. The server's configuration
    /// must allow the URL. Only for submitted jobs. No notice is sent if not given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub webhook: Option<String>,
    /// URI to which the server writes the result, such as `s3://labels/drive-7/0001.feather`: the ending
    /// chooses the format. In that of a sequence `{index}` stands for the index of each pair; with
    /// `densify` it is that of the dense cloud. The server's configuration must allow the URI. Only for
    /// submitted jobs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub result_uri: Option<String>,
    /// Also computes one dense cloud of a sequence, in addition to its flows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub densify: Option<Densify>,
}

/// Whether nothing is chosen.
fn is_default(choices: &FieldChoices) -> bool {
    *choices == FieldChoices::default()
}

impl JobOptions {
    /// Reads the options from one JSON object and checks them.
    ///
    /// # Errors
    /// - [`InvalidOptions::Json`] if the text is not a JSON object with known keys and readable
    ///   values, or `ego` is a matrix that is not rigid or moves by more than 1e6 m along an axis.
    /// - Otherwise as [`JobOptions::check`].
    pub fn from_json(text: &[u8]) -> Result<Self, InvalidOptions> {
        // serde would read an array as the values of the struct's fields in order.
        if !text.trim_ascii_start().starts_with(b"{") {
            return Err(InvalidOptions::Json("they are one JSON object".to_owned()));
        }
        let options: Self = serde_json::from_slice(text)
            .map_err(|error| InvalidOptions::Json(error.to_string()))?;
        options.check()?;
        Ok(options)
    }

    /// The options as one JSON object. [`JobOptions::from_json`] reads it back if the options pass
    /// [`JobOptions::check`] and a given ego motion moves by at most 1e6 m along each axis.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("every option has a JSON form")
    }

    /// Checks the values and their combinations. A given ego motion is not checked.
    ///
    /// # Errors
    /// The [`InvalidOptions`] of the first option that is refused:
    /// - `MaxPoints`, `Crop`, `MinRange`, `Dt`, `Deadline` for a value out of range.
    /// - `NoUse`, `FieldRange`, `Field` for an option of the fit that the preset has no use for, or
    ///   that is out of range.
    /// - `NoGpuKernels` for device `gpu` with a field that has no kernels for it.
    /// - `HalfOnCpu`, `HalfWithoutKernels` for `f16` with device `cpu` or a preset without kernels
    ///   in half precision.
    /// - `Labels`, `Label` for labels that are too many or malformed.
    /// - `ReferenceTime`, `Densify` for options of a dense cloud that are invalid for every
    ///   sequence.
    pub fn check(&self) -> Result<(), InvalidOptions> {
        if let Some(points) = self.max_points
            && (points as usize) < MIN_POINTS
        {
            return Err(InvalidOptions::MaxPoints(points));
        }
        if let Some(crop) = self.crop_m
            && !(crop.is_finite() && crop > 0.0)
        {
            return Err(InvalidOptions::Crop(crop));
        }
        if let Some(least) = self.min_range_m
            && !(least.is_finite() && least > 0.0)
        {
            return Err(InvalidOptions::MinRange(least));
        }
        if let Some(dt) = self.dt_s
            && !is_interval(dt.into())
        {
            return Err(InvalidOptions::Dt(dt));
        }
        if let Some(millis) = self.deadline_ms
            && (millis == 0 || u128::from(millis) > MAX_DEADLINE.as_millis())
        {
            return Err(InvalidOptions::Deadline(millis));
        }
        if self.precision == PrecisionChoice::F16 && self.device == DeviceChoice::Cpu {
            return Err(InvalidOptions::HalfOnCpu);
        }
        let preset = self.preset.preset();
        let options = self.solver_options(usize::MAX);
        self.field.check(preset.name(), options.field())?;
        let in_half = options.field().is_some_and(FieldOptions::runs_in_half);
        if self.precision == PrecisionChoice::F16 && !in_half {
            return Err(InvalidOptions::HalfWithoutKernels(preset.name()));
        }
        if self.device == DeviceChoice::Gpu && self.needs_cpu() {
            return Err(InvalidOptions::NoGpuKernels(preset.name()));
        }
        self.labels.check()?;
        self.densify.as_ref().map_or(Ok(()), Densify::check)
    }

    /// The required kind of device; none if any kind will do. `f16` requires a GPU, and a field that
    /// has no kernels for a GPU requires a CPU.
    pub fn device_kind(&self) -> Option<DeviceKind> {
        match self.precision {
            PrecisionChoice::F32 if self.needs_cpu() => Some(DeviceKind::Cpu),
            PrecisionChoice::F32 => self.device.kind(),
            PrecisionChoice::F16 => Some(DeviceKind::Gpu),
        }
    }

    /// Whether the options fit a field that has kernels for a GPU.
    pub fn runs_on_gpu(&self) -> bool {
        let options = self.solver_options(usize::MAX);
        options.field().is_some_and(FieldOptions::runs_on_gpu)
    }

    /// Whether the options fit a field that has no kernels for a GPU.
    fn needs_cpu(&self) -> bool {
        self.preset.preset().fits_field() && !self.runs_on_gpu()
    }

    /// The solver's options. `points` is the number of points of the larger cloud. Points are
    /// sampled only if `points` is above `max_points`.
    pub fn solver_options(&self, points: usize) -> flow::Options {
        let drawn = self.max_points.map(|points| points as usize);
        let mut options = self
            .preset
            .preset()
            .options(drawn.filter(|&drawn| drawn < points));
        options.seed = self.seed;
        options.crop_m = self.crop_m;
        options.min_range_m = self.min_range_m;
        options.force = self.force;
        match self.ground {
            None => {}
            Some(GroundChoice::Keep) => options.ground = Ground::Keep,
            Some(GroundChoice::Mask) => options.ground = Ground::Mask,
            Some(GroundChoice::Auto) => options.ground = Ground::Auto,
        }
        match self.ego {
            None => {}
            Some(EgoChoice::Off) => options.ego = Ego::Off,
            Some(EgoChoice::Auto) => options.ego = Ego::Auto,
            Some(EgoChoice::Given(motion)) => options.ego = Ego::Given(motion),
        }
        if let Some(dt_s) = self.dt_s {
            options.dt_s = dt_s;
        }
        if let Some(field) = options.field_mut() {
            self.field.apply(field);
        }
        if let Some(network) = options.field_mut().and_then(|field| field.network_mut()) {
            network.precision = match self.precision {
                PrecisionChoice::F32 => Precision::F32,
                PrecisionChoice::F16 => Precision::F16,
            };
        }
        options
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::Preset;

    #[test]
    fn an_empty_object_is_the_default_and_every_option_comes_back() {
        assert_eq!(JobOptions::from_json(b"{}"), Ok(JobOptions::default()));
        let text = br#"{"preset":"paper","seed":7,"max_points":8192,"crop_m":51.2,"min_range_m":2.5,"force":true,"dt_s":0.05,"ground":"mask",
            "ego":[[1,0,0,2],[0,1,0,0],[0,0,1,0],[0,0,0,1]],"device":"cpu","deadline_ms":300,"priority":"high","labels":{"drive":"7"},"densify":{"reference_time":1.5}}"#;
        let options = JobOptions::from_json(text).expect("good options");
        assert_eq!(options.preset, PresetChoice::Paper);
        assert_eq!(
            JobOptions::from_json(options.to_json().as_bytes()),
            Ok(options)
        );
    }

    #[test]
    fn every_preset_has_its_name_and_goes_to_a_device_that_computes_it() {
        for preset in Preset::ALL {
            let asked = |device: &str| {
                let (name, device) = (preset.name(), format!(r#""device":"{device}""#));
                JobOptions::from_json(format!(r#"{{"preset":"{name}",{device}}}"#).as_bytes())
            };
            let options = asked("auto").expect("good options");
            assert_eq!(options.preset.preset(), preset);
            assert_eq!(
                asked("cpu").map(|options| options.device),
                Ok(DeviceChoice::Cpu)
            );
            let needs_cpu = preset.fits_field() && !preset.runs_on_gpu();
            assert_eq!(options.device_kind(), needs_cpu.then_some(DeviceKind::Cpu));
            let refused = needs_cpu.then_some(InvalidOptions::NoGpuKernels(preset.name()));
            assert_eq!(asked("gpu").err(), refused);
        }
    }

    #[test]
    fn half_precision_asks_for_a_gpu() {
        let options = |text: &str| JobOptions::from_json(text.as_bytes());
        let half = options(r#"{"preset":"neural","precision":"f16"}"#).expect("good options");
        assert_eq!(half.device_kind(), Some(DeviceKind::Gpu));
        assert_eq!(
            half.solver_options(1000)
                .field()
                .and_then(|field| field.network().map(|network| network.precision)),
            Some(Precision::F16)
        );
        let refused = options(r#"{"precision":"f16","device":"cpu"}"#);
        assert_eq!(refused, Err(InvalidOptions::HalfOnCpu));
        for (preset, fits) in [
            ("default", false),
            ("label", false),
            ("neural", true),
            ("paper", true),
            ("nsfp-kdtree", false),
            ("nsfp-baseline", false),
            ("fnsf-linear", false),
        ] {
            let asked = options(&format!(r#"{{"preset":"{preset}","precision":"f16"}}"#));
            let refused = asked.err();
            assert_eq!(
                refused,
                (!fits).then_some(InvalidOptions::HalfWithoutKernels(preset))
            );
        }
        let single = options(r#"{"precision":"f32"}"#);
        assert_eq!(single, Ok(JobOptions::default()));
        assert_eq!(JobOptions::default().device_kind(), None);
    }

    #[test]
    fn unknown_keys_and_senseless_values_are_refused_by_name() {
        for (text, said) in [
            (r#"{"sead":1}"#, "unknown field `sead`"),
            (
                r#"{"preset":"best"}"#,
                "unknown variant `best`, expected one of `default`, `label`, `neural`, `paper`",
            ),
            (
                r#"{"device":"gpu:0"}"#,
                "unknown variant `gpu:0`, expected one of `auto`, `cpu`, `gpu`",
            ),
            (r#"{"max_points":2}"#, "max_points is 2"),
            (r#"{"crop_m":-1}"#, "crop_m is -1"),
            (r#"{"min_range_m":0}"#, "min_range_m is 0"),
            (
                r#"{"dt_s":0}"#,
                "dt_s is 0, 0.001 to 60 seconds are possible",
            ),
            (r#"{"dt_s":60.5}"#, "dt_s is 60.5"),
            (r#"{"deadline_ms":0}"#, "deadline_ms is 0"),
            (r#"{"ego":"yes"}"#, "ego is \"off\", \"auto\""),
            (
                r#"{"ego":[[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#,
                "not a rigid",
            ),
            (
                r#"{"ego":[[1,0,0,1e300],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#,
                "longer than 1e6 m",
            ),
            (r#"{"densify":{}}"#, "missing field `reference_time`"),
            (
                r#"{"densify":{"reference_time":1,"steps":2}}"#,
                "unknown field `steps`",
            ),
            (
                r#"{"densify":{"reference_time":-0.5}}"#,
                "densify.reference_time is -0.5",
            ),
            (
                r#"{"densify":{"reference_time":1,"substeps":65}}"#,
                "densify: 65 substeps: 1 to 64 are possible",
            ),
            (
                r#"{"densify":{"reference_time":1,"later_sweeps":"never"}}"#,
                "unknown variant `never`",
            ),
            (r#"{"seed":-1}"#, "invalid value"),
            (r#"{"seed":1,"seed":2}"#, "duplicate field"),
            ("[]", "options: "),
            ("", "options: "),
        ] {
            let error = JobOptions::from_json(text.as_bytes())
                .expect_err(text)
                .to_string();
            assert!(error.contains(said), "{text}: {error}");
        }
    }

    #[test]
    fn presets_say_what_becomes_of_ground_where_nothing_else_does() {
        let ground = |text: &str| {
            let options: JobOptions = serde_json::from_str(text).expect("sound options");
            options.solver_options(1000).ground
        };
        assert_eq!(ground(r#"{"preset":"label"}"#), Ground::Auto);
        assert_eq!(
            ground(r#"{"preset":"label","ground":"mask"}"#),
            Ground::Mask
        );
        assert_eq!(ground("{}"), Ground::Auto);
        assert_eq!(ground(r#"{"preset":"paper"}"#), Ground::Keep);
    }
}
