//! Options of the fit of a field.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::error::InvalidOptions;
use crate::flow::{BatchGrowth, FieldOptions, LossOptions, ModelOptions, Renewal};

/// The largest number of iterations of a fit.
const MOST_ITERATIONS: u32 = 1_000_000;

/// Options of the fit, for the presets that fit a field. Each is refused for a preset that has no
/// use for it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema, clap::Args)]
#[serde(deny_unknown_fields, default)]
pub struct FieldChoices {
    /// Edge of a cell of the distance transform, metres, at least 0.001. 0.1 by default
    #[arg(long, value_name = "M")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cell_m: Option<f64>,
    /// Truncation of the Chamfer distance, metres: points farther from the other cloud count as
    /// zero. 2 by default; 1.4142 is that of NSFP's published code
    #[arg(long, value_name = "M")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truncation_m: Option<f32>,
    /// Edge of a voxel of the linear model, metres, at least 0.01. 2 by default
    #[arg(long, value_name = "M")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub voxel_m: Option<f32>,
    /// Standard deviation of the linear model's Gaussians, metres, 0.5 to 100 voxels; above 2 voxels
    /// the field is smooth. 5 by default
    #[arg(long, value_name = "M")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma_m: Option<f32>,
    /// Weight of the linear model's total variation in the loss, 0 or more. 0.5 by default
    #[arg(long, value_name = "W")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub variation_weight: Option<f32>,
    /// Number of points of the first iterations; needs double-every or double-at-fall. All points by
    /// default. Computed on the CPU
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_points: Option<u32>,
    /// Doubles the points of an iteration after every N iterations
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub double_every: Option<u32>,
    /// Doubles the points of an iteration each time the loss has fallen by this share, above 0 and
    /// below 1
    #[arg(long, value_name = "SHARE", conflicts_with = "double_every")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub double_at_fall: Option<f32>,
    /// After the first 50 iterations, searches the nearest neighbors of the Chamfer distance in
    /// every Nth iteration only. In every iteration by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub renew_every: Option<u32>,
    /// Maximum number of iterations, 1 to 1,000,000
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_iterations: Option<u32>,
    /// Learning rate of the first iteration, above 0
    #[arg(long, value_name = "RATE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub learning_rate: Option<f32>,
    /// Early stopping: ends the fit after N iterations without progress
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patience: Option<u32>,
    /// Early stopping: the decrease of the mean loss that counts as progress, in its unit, metres or
    /// square metres; 0 or more
    #[arg(long, value_name = "LOSS")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_delta: Option<f64>,
    /// Bird's eye view: the flow is estimated in x and y from the points' x and y alone. For a
    /// network, on the CPU
    #[arg(long)]
    #[serde(skip_serializing_if = "core::ops::Not::not")]
    pub bev: bool,
}

impl FieldChoices {
    /// Checks the values, and that `field` has a use for each of them. `field` has these options
    /// already; it is none for a preset without a field.
    ///
    /// # Errors
    /// [`InvalidOptions::NoUse`] for an option without a use, [`InvalidOptions::FieldRange`] for a
    /// value out of range or an incomplete combination, and [`InvalidOptions::Field`] for a value
    /// that the fit refuses.
    pub(super) fn check(
        &self,
        preset: &'static str,
        field: Option<&FieldOptions>,
    ) -> Result<(), InvalidOptions> {
        let fits = field.is_some();
        let loss = field.map(|field| &field.loss);
        let is_distance = matches!(loss, Some(LossOptions::Distance(_)));
        let is_chamfer = matches!(loss, Some(LossOptions::Chamfer(_)));
        let is_linear = field.is_some_and(|field| matches!(field.model, ModelOptions::Linear(_)));
        let is_network = field.is_some_and(|field| field.network().is_some());
        let stops = field.is_some_and(|field| field.early_stop.is_some());
        let uses = [
            ("cell_m", self.cell_m.is_some(), is_distance),
            ("truncation_m", self.truncation_m.is_some(), is_chamfer),
            ("voxel_m", self.voxel_m.is_some(), is_linear),
            ("sigma_m", self.sigma_m.is_some(), is_linear),
            (
                "variation_weight",
                self.variation_weight.is_some(),
                is_linear,
            ),
            ("first_points", self.first_points.is_some(), fits),
            ("double_every", self.double_every.is_some(), fits),
            ("double_at_fall", self.double_at_fall.is_some(), fits),
            ("renew_every", self.renew_every.is_some(), is_chamfer),
            ("max_iterations", self.max_iterations.is_some(), fits),
            ("learning_rate", self.learning_rate.is_some(), fits),
            ("patience", self.patience.is_some(), stops),
            ("min_delta", self.min_delta.is_some(), stops),
            ("bev", self.bev, is_network),
        ];
        if let Some((option, ..)) = uses.into_iter().find(|&(_, given, used)| given && !used) {
            return Err(InvalidOptions::NoUse { option, preset });
        }
        self.check_ranges()?;
        let refused = field.and_then(|field| field.check().err());
        refused.map_or(Ok(()), |error| {
            Err(InvalidOptions::Field(error.to_string()))
        })
    }

    fn check_ranges(&self) -> Result<(), InvalidOptions> {
        let refused = |text: &'static str| Err(InvalidOptions::FieldRange(text));
        if self.double_every.is_some() && self.double_at_fall.is_some() {
            return refused("field.double_every and field.double_at_fall exclude each other");
        }
        let doubles = self.double_every.is_some() || self.double_at_fall.is_some();
        if self.first_points.is_some() != doubles {
            return refused(
                "field.first_points needs one of field.double_every and field.double_at_fall, and they need it",
            );
        }
        let counts = [
            self.first_points,
            self.double_every,
            self.renew_every,
            self.patience,
        ];
        if counts.contains(&Some(0)) {
            return refused(
                "field.first_points, double_every, renew_every and patience are at least 1",
            );
        }
        if self
            .learning_rate
            .is_some_and(|rate| !(rate > 0.0 && rate.is_finite()))
        {
            return refused("field.learning_rate is a finite number above 0");
        }
        if self
            .min_delta
            .is_some_and(|delta| !(delta >= 0.0 && delta.is_finite()))
        {
            return refused("field.min_delta is a finite number, 0 or more");
        }
        if self
            .double_at_fall
            .is_some_and(|share| !(share > 0.0 && share < 1.0))
        {
            return refused("field.double_at_fall is a share above 0 and below 1");
        }
        if self
            .max_iterations
            .is_some_and(|most| most == 0 || most > MOST_ITERATIONS)
        {
            return refused("field.max_iterations is 1 to 1000000");
        }
        Ok(())
    }

    /// Sets the options of `field` that are given here and that it has a use for.
    pub(super) fn apply(&self, field: &mut FieldOptions) {
        match &mut field.loss {
            LossOptions::Distance(loss) => {
                if let Some(cell_m) = self.cell_m {
                    loss.transform.set_cell(cell_m);
                }
            }
            LossOptions::Chamfer(loss) => {
                loss.truncation_m = self.truncation_m.unwrap_or(loss.truncation_m);
                let renewal = |every| Renewal::after_warm_up(every as usize);
                loss.renewal = self.renew_every.map(renewal);
            }
        }
        if let ModelOptions::Linear(linear) = &mut field.model {
            linear.voxel_m = self.voxel_m.unwrap_or(linear.voxel_m);
            linear.sigma_m = self.sigma_m.unwrap_or(linear.sigma_m);
            linear.variation_weight = self.variation_weight.unwrap_or(linear.variation_weight);
        }
        if let Some(first) = self.first_points {
            field.batch = Some(first as usize);
            field.growth = match (self.double_every, self.double_at_fall) {
                (Some(every), _) => Some(BatchGrowth::Iterations(every as usize)),
                (None, share) => share.map(BatchGrowth::LossFall),
            };
        }
        if let Some(most) = self.max_iterations {
            field.max_iterations = most as usize;
        }
        field.learning_rate = self.learning_rate.unwrap_or(field.learning_rate);
        if let Some(rule) = &mut field.early_stop {
            rule.patience = self.patience.map_or(rule.patience, |count| count as usize);
            rule.min_delta = self.min_delta.unwrap_or(rule.min_delta);
        }
        field.bev = self.bev;
    }
}

#[cfg(test)]
mod tests {
    use crate::flow::{BatchGrowth, LossOptions, ModelOptions};
    use crate::job::{DeviceKind, JobOptions};

    fn read(preset: &str, field: &str) -> Result<JobOptions, String> {
        let text = format!(r#"{{"preset":"{preset}","field":{field}}}"#);
        JobOptions::from_json(text.as_bytes()).map_err(|error| error.to_string())
    }

    #[test]
    fn the_options_of_the_fit_reach_the_solver_and_come_back() {
        let text = r#"{"truncation_m":1.5,"voxel_m":5,"sigma_m":12,"variation_weight":0.25,"first_points":500,"double_every":40,"renew_every":5,"max_iterations":77}"#;
        let options = read("nsfp-linear", text).expect("good options");
        let solver = options.solver_options(1000);
        let field = solver.field().expect("a field");
        let ModelOptions::Linear(linear) = &field.model else {
            panic!("a linear model");
        };
        let sizes = [linear.voxel_m, linear.sigma_m, linear.variation_weight];
        assert_eq!(sizes, [5.0, 12.0, 0.25]);
        let LossOptions::Chamfer(loss) = &field.loss else {
            panic!("a Chamfer distance");
        };
        assert_eq!(loss.truncation_m, 1.5);
        assert_eq!(loss.renewal.map(|renewal| renewal.every), Some(5));
        assert_eq!(field.growth, Some(BatchGrowth::Iterations(40)));
        assert_eq!((field.batch, field.max_iterations), (Some(500), 77));
        let again = JobOptions::from_json(options.to_json().as_bytes());
        assert_eq!(again, Ok(options));
    }

    #[test]
    fn a_fine_cell_narrows_the_band_and_a_coarse_one_widens_it() {
        for (cell, band) in [(0.01, 0.64), (0.1, 2.0), (3.0, 3.0)] {
            let options = read("paper", &format!(r#"{{"cell_m":{cell}}}"#)).expect("good options");
            let solver = options.solver_options(1000);
            let loss = solver.field().expect("a field").loss.distance();
            let transform = &loss.expect("a transform").transform;
            assert_eq!(transform.cell_m, cell);
            assert!((transform.band_m - band).abs() < 1e-12, "{transform:?}");
        }
    }

    #[test]
    fn senseless_values_and_options_without_a_use_are_refused_in_one_line() {
        for (preset, field, said) in [
            (
                "fnsf-linear",
                r#"{"sigma_m":0}"#,
                "a sigma of 0 m with voxels of 2 m is not possible",
            ),
            (
                "fnsf-linear",
                r#"{"voxel_m":1e-9}"#,
                "a voxel of 0.000000001 m is not possible",
            ),
            (
                "fnsf-linear",
                r#"{"variation_weight":-1}"#,
                "a weight of -1 for the total variation",
            ),
            (
                "fnsf-linear",
                r#"{"truncation_m":1}"#,
                "field.truncation_m has no effect",
            ),
            (
                "fnsf-linear",
                r#"{"bev":true}"#,
                "field.bev has no effect with preset fnsf-linear",
            ),
            (
                "nsfp",
                r#"{"truncation_m":0}"#,
                "a truncation of 0 m is not possible",
            ),
            ("nsfp", r#"{"renew_every":0}"#, "at least 1"),
            (
                "nsfp",
                r#"{"cell_m":0.1}"#,
                "field.cell_m has no effect with preset nsfp",
            ),
            ("paper", r#"{"cell_m":0}"#, "a cell of 0 m is not possible"),
            (
                "paper",
                r#"{"voxel_m":2}"#,
                "field.voxel_m has no effect with preset paper",
            ),
            (
                "paper",
                r#"{"renew_every":2}"#,
                "field.renew_every has no effect",
            ),
            (
                "paper",
                r#"{"first_points":5}"#,
                "field.first_points needs one of",
            ),
            (
                "paper",
                r#"{"double_every":5}"#,
                "field.first_points needs one of",
            ),
            (
                "paper",
                r#"{"first_points":5,"double_at_fall":1}"#,
                "a share above 0 and below 1",
            ),
            (
                "paper",
                r#"{"max_iterations":0}"#,
                "field.max_iterations is 1 to 1000000",
            ),
            ("paper", r#"{"learning_rate":0}"#, "a finite number above 0"),
            ("paper", r#"{"min_delta":-1}"#, "a finite number, 0 or more"),
            (
                "neural",
                r#"{"patience":5}"#,
                "field.patience has no effect with preset neural",
            ),
            ("paper", r#"{"sigma":1}"#, "unknown field `sigma`"),
            (
                "default",
                r#"{"max_iterations":5}"#,
                "field.max_iterations has no effect",
            ),
        ] {
            let error = read(preset, field).expect_err(field);
            assert!(error.contains(said), "{field}: {error}");
            assert_eq!(error.lines().count(), 1);
        }
    }

    #[test]
    fn a_fit_without_gpu_kernels_asks_for_a_cpu() {
        for (field, kind) in [
            ("{}", None),
            (r#"{"cell_m":0.2}"#, None),
            (r#"{"bev":true}"#, Some(DeviceKind::Cpu)),
            (
                r#"{"first_points":9,"double_at_fall":0.5}"#,
                Some(DeviceKind::Cpu),
            ),
        ] {
            let options = read("paper", field).expect("good options");
            assert_eq!(options.device_kind(), kind, "{field}");
        }
    }
}
