//! Options of the estimate of one pair, for both methods.

use super::field::FieldOptions;
use super::objects::ObjectOptions;
use crate::flow::data::RigidTransform;

/// Default time from the source sweep to the target sweep, seconds: a lidar at 10 Hz.
pub const DEFAULT_DT_S: f32 = 0.1;

/// Least overlap of a pair, 0 to 1. Sweeps of one scene have 0.64 or more, half a second apart and
/// with 16 beams as well. Sweeps of two scenes have 0.25 at most (`docs/experiments/overlap.md`).
pub const LEAST_OVERLAP: f32 = 0.35;
/// Overlap from which the alignment counts as certain. Between the two the confidence falls.
pub const CERTAIN_OVERLAP: f32 = 0.6;
/// Largest median distance of a sweep's points from their middle, metres. Lidars reach 300 m.
pub const MAX_SPREAD_M: f32 = 1000.0;

/// Options of one estimate. Start from a [`super::Preset`] and change single values.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Seed of all random choices (weights, sampling, batches). Without a deadline, the same seed
    /// gives bit-identical results on the same device.
    pub seed: u64,
    /// Maximum number of points sampled from each cloud after the crop and the ground removal; none
    /// for all. Only the sampled source points get a flow. A field is fitted to the sampled points
    /// only. The object search uses all points.
    pub max_points: Option<usize>,
    /// Half the side of the square crop around the origin of the sensor frame, metres. Points with
    /// a larger `|x|` or `|y|` are excluded. None for no crop.
    pub crop_m: Option<f32>,
    /// Least horizontal distance from the origin of the sensor frame, metres. Nearer points are
    /// excluded: they are mostly the vehicle's own returns. None to keep them.
    pub min_range_m: Option<f32>,
    /// Time from the source sweep to the target sweep, seconds, above zero. The velocity of a
    /// cluster is its displacement divided by this time, and its yaw rate is its rotation divided
    /// by it.
    pub dt_s: f32,
    /// Whether the source was measured after the target. It matters to the times of points alone.
    pub newest_first: bool,
    /// Handling of ground points.
    pub ground: Ground,
    /// Handling of the ego motion.
    pub ego: Ego,
    /// Whether pairs are estimated that are otherwise refused as nonsense: sweeps that do not show
    /// one scene, and coordinates that are not metres.
    pub force: bool,
    /// Whether sweeps with times are deskewed even where they do not fit better then.
    pub always_deskew: bool,
    /// Method that estimates the residual motion.
    pub method: Method,
}

/// Method that estimates the residual motion, with the ego motion taken out.
#[derive(Clone, Debug, PartialEq)]
pub enum Method {
    /// Object search: a rigid motion for each moving cluster. All other points are static.
    Objects(ObjectOptions),
    /// Neural field fitted to the pair (FNSF Section 3).
    Field(FieldOptions),
}

impl Options {
    /// The largest number of sweeps that an estimate uses, the two of the pair included.
    ///
    /// It is [`ObjectOptions::sweeps`], but at least 2. A field uses 2, and so do objects with
    /// [`Ego::Off`]. An estimate uses fewer sweeps if its problem has fewer neighbor sweeps.
    pub fn sweeps(&self) -> usize {
        match &self.method {
            Method::Objects(objects) if self.ego != Ego::Off => objects.sweeps.max(2),
            Method::Objects(_) | Method::Field(_) => 2,
        }
    }

    /// The time of the target less that of the source, seconds: [`Self::dt_s`], or its negative.
    pub(crate) fn elapsed_s(&self) -> f32 {
        if self.newest_first {
            -self.dt_s
        } else {
            self.dt_s
        }
    }

    /// Whether the motion of a pair is known at its source's points alone, as that of objects and of
    /// clusters is. Densification then asks it once a step.
    pub fn is_known_at_points(&self) -> bool {
        match &self.method {
            Method::Objects(_) => true,
            Method::Field(field) => field.partition.is_some(),
        }
    }

    /// The options of the field fit; none for objects.
    pub fn field(&self) -> Option<&FieldOptions> {
        match &self.method {
            Method::Field(field) => Some(field),
            Method::Objects(_) => None,
        }
    }

    /// Mutable access to the options of the field fit; none for objects.
    pub fn field_mut(&mut self) -> Option<&mut FieldOptions> {
        match &mut self.method {
            Method::Field(field) => Some(field),
            Method::Objects(_) => None,
        }
    }

    /// Mutable access to the options of the object search; none for a field.
    pub fn objects_mut(&mut self) -> Option<&mut ObjectOptions> {
        match &mut self.method {
            Method::Objects(objects) => Some(objects),
            Method::Field(_) => None,
        }
    }
}

/// Handling of ground points by the method. The registration uses them in every case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ground {
    /// Ground points take part like all other points. Ground masks are ignored.
    Keep,
    /// Points of the problem's ground masks are excluded and get no flow. Without masks the
    /// estimate fails with [`crate::flow::FlowError::NoGroundMask`].
    Mask,
    /// Points of the problem's ground masks are excluded. Without masks,
    /// [`crate::flow::ground::segment()`] with default options finds the points to exclude.
    ///
    /// Ground points get the flow of the ego motion if [`Options::ego`] is not [`Ego::Off`] and
    /// [`Options::max_points`] is none. Otherwise they get no flow. If fewer than
    /// [`crate::flow::MIN_POINTS`] other points remain in a cloud, the ground of both clouds takes
    /// part.
    Auto,
}

/// Handling of the ego motion, the rigid motion of the sensor between the two sweeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ego {
    /// Not separated: the method estimates the full motion.
    Off,
    /// Estimated by registration. The method estimates the residual motion.
    Auto,
    /// Given as target_from_source; the pair is not registered. The method estimates the residual
    /// motion.
    Given(RigidTransform),
}

impl Ego {
    /// The choice for a pair of a sequence. `poses` are the poses world_from_sensor of its source and
    /// target, where they are known. Otherwise a given motion leads from the earlier sweep to the later one.
    /// A pair that `leads_back` has the later sweep as its source, and gets the inverse.
    #[must_use]
    pub fn of_pair(self, poses: Option<[RigidTransform; 2]>, leads_back: bool) -> Self {
        match (poses, self) {
            (Some([source, target]), _) => Self::Given(target.inv_mul(&source)),
            (None, Self::Given(motion)) if leads_back => Self::Given(motion.inverse()),
            (None, choice) => choice,
        }
    }
}
