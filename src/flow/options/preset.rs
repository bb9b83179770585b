//! Presets: named sets of options.

use super::field::FieldOptions;
use super::loss::NearestSearch;
use super::objects::ObjectOptions;
use super::pair::{DEFAULT_DT_S, Ego, Ground, Method, Options};

/// A named set of options, from which [`Preset::options`] makes the [`Options`] of an estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// Registration of the ego motion, then an object search in the two sweeps of the pair.
    Default,
    /// As [`Preset::Default`], with a window of up to five sweeps of a sequence.
    Label,
    /// Registration of the ego motion, then a fit of a neural field to the residual motion. Without
    /// a deadline or a warm start it takes 150 iterations on batches of at most 2,048 points.
    Neural,
    /// FNSF (ICCV 2023) with the settings of its published code: a field fitted to the full motion,
    /// ground included.
    Paper,
    /// The baseline of FNSF's comparison: the same network fitted to the truncated Chamfer distance,
    /// whose nearest neighbors are searched among all points.
    NsfpBaseline,
    /// NSFP (Li et al., NeurIPS 2021): as [`Preset::NsfpBaseline`], with a second network that leads
    /// the deformed points back.
    Nsfp,
    /// NSFP++ (Najibi et al., ECCV 2022): a fit as [`Preset::Nsfp`] for each cluster of the points,
    /// after the registration of the ego motion.
    NsfpPlusPlus,
    /// As [`Preset::NsfpPlusPlus`], fitted to distance transforms.
    NsfpPlusPlusDt,
    /// As [`Preset::NsfpBaseline`], with k-d trees for the nearest neighbors.
    NsfpKdtree,
    /// The linear model of FNSF's comparison, fitted to the distance transform.
    FnsfLinear,
    /// The linear model, fitted to the truncated Chamfer distance.
    NsfpLinear,
    /// As [`Preset::NsfpLinear`], with k-d trees for the nearest neighbors.
    NsfpKdtreeLinear,
}

impl Preset {
    /// All presets.
    pub const ALL: [Self; 12] = [
        Self::Default,
        Self::Label,
        Self::Neural,
        Self::Paper,
        Self::NsfpBaseline,
        Self::Nsfp,
        Self::NsfpPlusPlus,
        Self::NsfpPlusPlusDt,
        Self::NsfpKdtree,
        Self::FnsfLinear,
        Self::NsfpLinear,
        Self::NsfpKdtreeLinear,
    ];

    /// The name used by the command line and the service: `default`, `label`, `neural`, `paper`,
    /// `nsfp-baseline`, `nsfp`, `nsfp++`, `nsfp++-dt`, `nsfp-kdtree`,
    /// `fnsf-linear`, `nsfp-linear` or `nsfp-kdtree-linear`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::Label => "label",
            Self::Neural => "neural",
            Self::Paper => "paper",
            Self::NsfpBaseline => "nsfp-baseline",
            Self::Nsfp => "nsfp",
            Self::NsfpPlusPlus => "nsfp++",
            Self::NsfpPlusPlusDt => "nsfp++-dt",
            Self::NsfpKdtree => "nsfp-kdtree",
            Self::FnsfLinear => "fnsf-linear",
            Self::NsfpLinear => "nsfp-linear",
            Self::NsfpKdtreeLinear => "nsfp-kdtree-linear",
        }
    }

    /// Whether the preset fits a neural field. Only such a preset supports snapshots, and only
    /// without a partition.
    pub fn fits_field(self) -> bool {
        matches!(self.options(None).method, Method::Field(_))
    }

    /// Whether the preset has kernels for a GPU.
    pub fn runs_on_gpu(self) -> bool {
        self.options(None)
            .field()
            .is_some_and(FieldOptions::runs_on_gpu)
    }

    /// The presets that fit a neural field.
    pub fn with_field() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|preset| preset.fits_field())
    }

    /// The presets that have kernels for a GPU.
    pub fn with_gpu_kernels() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|preset| preset.runs_on_gpu())
    }

    /// The options of the preset, with `max_points` as [`Options::max_points`].
    ///
    /// With `max_points`, `paper` has the published settings for sampled clouds instead of those
    /// for full clouds.
    pub fn options(self, max_points: Option<usize>) -> Options {
        let method = match self {
            Self::Default => Method::Objects(ObjectOptions::default()),
            Self::Label => Method::Objects(ObjectOptions {
                sweeps: 5,
                ..ObjectOptions::default()
            }),
            Self::Neural => Method::Field(FieldOptions::neural()),
            Self::Paper => Method::Field(FieldOptions::published(max_points.is_some())),
            Self::NsfpBaseline => Method::Field(FieldOptions::nsfp(NearestSearch::BruteForce)),
            Self::Nsfp => Method::Field(FieldOptions::nsfp(NearestSearch::BruteForce).with_cycle()),
            Self::NsfpPlusPlus => {
                Method::Field(FieldOptions::nsfp(NearestSearch::BruteForce).by_cluster())
            }
            Self::NsfpPlusPlusDt => Method::Field(FieldOptions::published(false).by_cluster()),
            Self::NsfpKdtree => Method::Field(FieldOptions::nsfp(NearestSearch::KdTree)),
            Self::FnsfLinear => Method::Field(FieldOptions::published(false).linear()),
            Self::NsfpLinear => {
                Method::Field(FieldOptions::nsfp(NearestSearch::BruteForce).linear())
            }
            Self::NsfpKdtreeLinear => {
                Method::Field(FieldOptions::nsfp(NearestSearch::KdTree).linear())
            }
        };
        let (ground, ego) = match self {
            Self::Default
            | Self::Label
            | Self::Neural
            | Self::NsfpPlusPlus
            | Self::NsfpPlusPlusDt => (Ground::Auto, Ego::Auto),
            _ => (Ground::Keep, Ego::Off),
        };
        Options {
            seed: 0,
            max_points,
            crop_m: None,
            min_range_m: None,
            force: false,
            dt_s: DEFAULT_DT_S,
            newest_first: false,
            ground,
            ego,
            always_deskew: false,
            method,
        }
    }

    /// The options of the preset's field fit.
    #[cfg(test)]
    pub(crate) fn field(self) -> FieldOptions {
        let options = self.options(None);
        options.field().expect("a preset that fits a field").clone()
    }
}
