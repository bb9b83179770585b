//! Every hyper-parameter and its default: the presets are here and nowhere else.

use super::data::RigidTransform;
use super::distance::DistanceOptions;

/// A named set of options.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// Ours: robust rigid alignment, then movers found object by object, everything else still.
    Default,
    /// As default, and a pair of a sequence is found from up to five sweeps, its own among them.
    Label,
    /// Ours with a neural field: robust rigid alignment, then a short stochastic fit of what is left.
    Neural,
    /// The published method with the published code's settings.
    Paper,
}

impl Preset {
    /// All presets.
    pub const ALL: [Self; 4] = [Self::Default, Self::Label, Self::Neural, Self::Paper];
    /// Those that fit a neural field, iteration by iteration: on a card where there is one, and they
    /// can be put down and taken up again.
    pub const FITTED: [Self; 2] = [Self::Neural, Self::Paper];

    /// The name that the command line and the service use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Default => "default",
            Self::Label => "label",
            Self::Neural => "neural",
            Self::Paper => "paper",
        }
    }

    /// The preset's options. With `max_points` the presets that fit a field sample the clouds first,
    /// and `paper` takes the published settings for sampled clouds instead of those for full ones.
    pub fn options(self, max_points: Option<usize>) -> Options {
        match self {
            Self::Default => Options::labelled(max_points, 2),
            Self::Label => Options::labelled(max_points, 5),
            Self::Neural => Options::stochastic(max_points),
            Self::Paper => Options::published(max_points),
        }
    }
}

/// Options of one estimate. Start from a [`Preset`] and change what you must.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Drives every random choice: the same seed gives the same bits.
    pub seed: u64,
    /// Points drawn from what range and ground leave of each cloud; all of them where none. A field is
    /// fitted to the drawn points alone. Movers are found in all points, and those of the source that
    /// were drawn get a flow.
    pub max_points: Option<usize>,
    /// Points with `|x|` or `|y|` beyond this are left out, metres.
    pub range_m: Option<f32>,
    /// What becomes of ground points.
    pub ground: Ground,
    /// The vehicle's own motion.
    pub ego: Ego,
    /// The distance transform.
    pub distance: DistanceOptions,
    /// What is minimized.
    pub loss: LossOptions,
    /// What the network is fed.
    pub inputs: InputNormalization,
    /// Where the network starts.
    pub start: Start,
    /// Adam's step size at the first iteration.
    pub learning_rate: f32,
    /// How the step size falls.
    pub decay: LearningRateSchedule,
    /// Points that an iteration looks at; all of them where none.
    pub batch: Option<usize>,
    /// Which of the fields on the way is the result.
    pub keep: ResultChoice,
    /// When to stop before `max_iterations`.
    pub early_stop: Option<EarlyStopOptions>,
    /// Iterations at most.
    pub max_iterations: usize,
    /// What the network's products are rounded to.
    pub precision: Precision,
    /// How a field that starts as the one of the pair before is fitted; where none, every pair of a
    /// sequence starts afresh.
    pub warm_start: Option<WarmStart>,
    /// Where given, movers are found object by object, and no field is fitted: of the options above
    /// those from `distance` on have no say.
    pub label: Option<ObjectOptions>,
}

impl Options {
    /// FNSF as its published code runs it, for full and for sampled clouds.
    fn published(max_points: Option<usize>) -> Self {
        let (learning_rate, patience) = if max_points.is_some() {
            (0.01, 5)
        } else {
            (0.008, 10)
        };
        Self {
            seed: 0,
            max_points,
            range_m: None,
            ground: Ground::Keep,
            ego: Ego::Off,
            distance: DistanceOptions::default(),
            loss: LossOptions {
                margin_m: 0.0,
                margin_slope: 0.0,
                margin_quantile: None,
                truncation_m: None,
                flow_penalty: 0.0,
            },
            inputs: InputNormalization::Raw,
            start: Start::Xavier,
            learning_rate,
            decay: LearningRateSchedule::Constant,
            batch: None,
            keep: ResultChoice::Best,
            early_stop: Some(EarlyStopOptions {
                patience,
                min_delta_m: 1e-3,
            }),
            max_iterations: 5000,
            precision: Precision::F32,
            warm_start: None,
            label: None,
        }
    }

    /// Sweeps that an estimate looks at where a sequence has them: the pair's two, or more.
    pub fn frames(&self) -> usize {
        match &self.label {
            Some(label) if self.ego != Ego::Off => label.frames.max(2),
            _ => 2,
        }
    }

    /// Iterations that a run usually takes: all of them where no rule stops it; the published rule
    /// stops after 36 to 115.
    pub fn expected_iterations(&self) -> usize {
        match self.early_stop {
            None => self.max_iterations,
            Some(_) => self.max_iterations.min(60),
        }
    }

    /// These options for a fit that starts from the field of the pair before.
    pub(crate) fn warmed(&self, warm_start: WarmStart) -> Self {
        Self {
            max_iterations: warm_start.max_iterations.min(self.max_iterations),
            learning_rate: warm_start.learning_rate,
            ..self.clone()
        }
    }

    /// These options for a run that its deadline cuts short: batches, and a step size that falls to
    /// zero within `iterations`.
    pub(crate) fn under_deadline(&self, batch: usize, iterations: usize) -> Self {
        Self {
            decay: LearningRateSchedule::Cosine,
            batch: Some(batch),
            keep: ResultChoice::Average { decay: 0.9 },
            early_stop: None,
            max_iterations: iterations,
            ..self.clone()
        }
    }

    /// Ours; `docs/numerics.md` shows what each of these choices changes.
    fn stochastic(max_points: Option<usize>) -> Self {
        Self {
            ground: Ground::Auto,
            ego: Ego::Auto,
            loss: LossOptions {
                margin_m: 0.1,
                margin_slope: 0.0,
                margin_quantile: Some(0.9),
                truncation_m: Some(1.0),
                flow_penalty: 0.02,
            },
            inputs: InputNormalization::Centered { scale_m: 10.0 },
            start: Start::ZeroFlow,
            learning_rate: 0.004,
            decay: LearningRateSchedule::Cosine,
            batch: Some(2048),
            keep: ResultChoice::Average { decay: 0.9 },
            early_stop: None,
            max_iterations: 150,
            warm_start: Some(WarmStart {
                max_iterations: 75,
                learning_rate: 0.004,
            }),
            ..Self::published(max_points)
        }
    }
}

/// A fit that starts from the field of the pair before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarmStart {
    /// Iterations at most.
    pub max_iterations: usize,
    /// Adam's step size at the first iteration.
    pub learning_rate: f32,
}

impl Options {
    /// Movers object by object, in `frames` sweeps of a sequence. Ground would tie objects together: it
    /// is found and left out.
    fn labelled(max_points: Option<usize>, frames: usize) -> Self {
        Self {
            ground: Ground::Auto,
            label: Some(ObjectOptions {
                frames,
                ..ObjectOptions::default()
            }),
            warm_start: None,
            ..Self::stochastic(max_points)
        }
    }
}

/// How a run that its deadline cuts short is fitted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeadlineLimits {
    /// Points an iteration looks at, least and most. Half of the fewest is no cheaper on two cores.
    pub(crate) batches: [usize; 2],
    /// Iterations that are worth smaller batches; with the largest batches, more are done.
    pub(crate) iterations: usize,
    /// With fewer iterations the field is worse than none: none are done.
    pub(crate) least_iterations: usize,
}

impl DeadlineLimits {
    /// With or without an ego motion to fall back to.
    pub(crate) fn new(ego: bool) -> Self {
        Self {
            batches: [768, 2048],
            iterations: 150,
            least_iterations: if ego { 40 } else { 10 },
        }
    }
}

/// How movers are found, cluster by cluster; `docs/numerics.md` shows what the choices change.
#[derive(Clone, Debug, PartialEq)]
pub struct ObjectOptions {
    /// Points within this are of one cluster, metres.
    pub cluster_radius_m: f32,
    /// Points within the radius, itself among them, that make a point a cluster's core.
    pub cluster_min_points: usize,
    /// Both clouds are thinned to one point a voxel of this side, metres.
    pub voxel_m: f32,
    /// Normals are those of the points within this of each other, metres, and metres more for each
    /// metre of range.
    pub normal_m: [f32; 2],
    /// What a metre of height counts when matches are sought.
    pub height_weight: f32,
    /// Matches are sought within this, metres.
    pub match_m: f32,
    /// A target point within this of a static source point belongs to it, metres.
    pub static_match_m: f32,
    /// What a metre across a match's normal counts.
    pub tangential_weight: f32,
    /// Distances count no further than this, metres.
    pub truncation_m: f32,
    /// Motions are sought up to this along x and y, metres a sweep.
    pub max_displacement_m: f32,
    /// Side of the bins in which shifts are counted, metres.
    pub bin_m: f32,
    /// Starts that are looked at, besides none.
    pub initial_guesses: usize,
    /// Those are not looked at where a fit from none lays the cluster this near to the target, metres.
    pub close_fit_m: f32,
    /// Cost of a metre of motion, metres, where starts are compared.
    pub displacement_penalty: f32,
    /// No motion is sought where a cluster lies this near to the target without one, metres.
    pub static_fit_m: f32,
    /// Shorter motions are none, metres.
    pub min_motion_m: f32,
    /// A motion must lay the cluster's points this much nearer to the target, metres.
    pub min_gain_m: f32,
    /// Share of the cost without motion that may be left.
    pub max_cost_ratio: f32,
    /// The fall of the cost times the cluster's thinned points must be this, metres.
    pub min_evidence_m: f32,
    /// And this more for each metre of motion: the farther, the more there is to be mistaken for.
    pub min_evidence_slope: f32,
    /// A moved cluster must lie this near to the target, metres.
    pub max_residual_m: f32,
    /// Mean square of the normals along a motion from which a cluster's surfaces hold it.
    pub min_observability: f32,
    /// Share that the other sweep saw through, of the places that a cluster leaves and of those that it
    /// comes to each, from which it moves though its surfaces do not hold it.
    pub min_free_space: f32,
    /// Sum of these shares below which it does not move far, nor at all where only the sweeps around speak
    /// for it.
    pub min_free_space_far: f32,
    /// A piece beside a mover goes with it where this share of its cost is left.
    pub adjacent_cost_ratio: f32,
    /// Points of a mover are not of it where its motion leaves them farther from the target than
    /// none by this, metres.
    pub point_reject_m: f32,
    /// A cluster of as many thinned points that is flatter than `ground_thickness_m` metres is ground.
    pub ground_min_points: usize,
    /// See `ground_min_points`.
    pub ground_thickness_m: f32,
    /// Sweeps that are looked at in all: the pair's two, and others of its sequence where there are.
    pub frames: usize,
    /// The sweeps around say plainly that a cluster moves where its motion leaves this share of its
    /// cost in them and in the nearest,
    pub neighbor_cost_ratio: f32,
    /// and lays it this much nearer to them, metres there and back.
    pub neighbor_gain_m: f32,
}

impl Default for ObjectOptions {
    fn default() -> Self {
        Self {
            cluster_radius_m: 0.5,
            cluster_min_points: 4,
            voxel_m: 0.1,
            normal_m: [0.15, 0.01],
            height_weight: 0.7,
            match_m: 0.7,
            static_match_m: 0.15,
            tangential_weight: 0.2,
            truncation_m: 0.3,
            max_displacement_m: 3.5,
            bin_m: 0.15,
            initial_guesses: 6,
            close_fit_m: 0.05,
            displacement_penalty: 0.05,
            static_fit_m: 0.03,
            min_motion_m: 0.05,
            min_gain_m: 0.015,
            max_cost_ratio: 0.65,
            min_evidence_m: 1.0,
            min_evidence_slope: 3.0,
            max_residual_m: 0.15,
            min_observability: 0.1,
            min_free_space: 0.7,
            min_free_space_far: 0.3,
            adjacent_cost_ratio: 0.7,
            point_reject_m: 0.05,
            ground_min_points: 30,
            ground_thickness_m: 0.2,
            frames: 2,
            neighbor_cost_ratio: 0.7,
            neighbor_gain_m: 0.05,
        }
    }
}

/// What becomes of ground points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ground {
    /// They are points like any other.
    Keep,
    /// Those that the problem's masks name are left out.
    Mask,
    /// Those that the problem's masks name or, where it has none, that
    /// [`super::ground::segment`] finds take no part, and move with the vehicle's own
    /// motion where that is known and the points are not sampled; else they are left out. Where
    /// too little stands on it, it is kept.
    Auto,
}

/// The vehicle's own motion, which carries every static point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ego {
    /// It is part of what the field has to explain.
    Off,
    /// It is estimated first; the field explains the rest.
    Auto,
    /// It is known, as target_from_source; the field explains the rest.
    Given(RigidTransform),
}

/// What is minimized: per point the distance, clamped, plus a penalty on the field's length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossOptions {
    /// Distances below this are good enough, metres: a static surface is sampled at other places
    /// by each sweep, and following the samples is not motion.
    pub margin_m: f32,
    /// The margin grows with a point's range by this, metres a metre: so does the distance between
    /// a lidar's samples.
    pub margin_slope: f32,
    /// Where given, and the ego motion is known, `margin_slope` is raised to this quantile, 0 to 1,
    /// of distance over range before the field moves anything: the sparser the clouds, the wider
    /// the margin. Without the ego motion those distances are motion, and the slope stays.
    pub margin_quantile: Option<f32>,
    /// Distances count no further than this, metres.
    pub truncation_m: Option<f32>,
    /// Weight of the field's length, metres of loss a metre of flow.
    pub flow_penalty: f32,
}

/// What the network is fed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InputNormalization {
    /// Coordinates as they come, metres; about the cloud's mean where that lies far from the origin,
    /// as in no sensor's frame.
    Raw,
    /// Coordinates about the cloud's mean, divided by `scale_m`.
    Centered {
        /// Metres that become one.
        scale_m: f32,
    },
}

/// Where the network starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Xavier-uniform weights in every layer: flows of metres at first.
    Xavier,
    /// Xavier but for the last layer, which is zero: no flow at first.
    ZeroFlow,
}

/// How the step size falls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LearningRateSchedule {
    /// It does not.
    Constant,
    /// Along half a cosine, to zero at `max_iterations`.
    Cosine,
}

/// Which of the fields on the way is the result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ResultChoice {
    /// The one with the lowest loss.
    Best,
    /// The running average of the parameters.
    Average {
        /// Weight of the past at each iteration; ramped up over the first iterations.
        decay: f32,
    },
}

/// What the factors of the network's products are rounded to while it is fitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// Single precision throughout.
    #[default]
    F32,
    /// Features, weights and derivatives of the layers from 128 to 128 features are rounded to
    /// half precision before they are multiplied; sums, parameters, the optimizer, the other
    /// layers, the loss and the evaluation of the result stay single. For cards whose matrix units
    /// pass their self-test; every other device refuses it.
    F16,
}

impl Precision {
    /// All precisions.
    pub const ALL: [Self; 2] = [Self::F32, Self::F16];

    /// The name that the command line and the service use.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        }
    }
}

/// The stopping rule of the published code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EarlyStopOptions {
    /// Iterations without progress before the end.
    pub patience: usize,
    /// Fall of the mean loss that counts as progress, metres.
    pub min_delta_m: f64,
}
