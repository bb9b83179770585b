//! The ego motion of a pair: given, or estimated by registration.

use crate::flow::data::{Control, EarlierDeadline, Point, RigidTransform, stride_sample};
use crate::flow::host::Host;
use crate::flow::options::{Ego, Method, Options};
use crate::flow::problem::Problem;
use crate::flow::registration::Registration;
use crate::flow::select::Selection;

/// Points sampled from each cloud for a registration under time pressure. Accuracy is then worse
/// than a millimetre.
const SAMPLED_POINTS: usize = 8192;
/// Remaining time per point above which all points are registered, seconds. Used where the speed of
/// the machine has not been measured. It is four times the cost on a slow core.
const SECONDS_PER_POINT: f64 = 5e-7;

/// Whether the remaining time allows a registration of all points of the selection.
pub(super) fn has_time_for_all(selection: &Selection, control: &dyn Control) -> bool {
    let clouds = selection.registration_clouds.iter().flatten();
    has_time_for(clouds.map(|cloud| cloud.len()).sum(), control)
}

/// Whether the remaining time allows a registration of `points` points.
pub(super) fn has_time_for(points: usize, control: &dyn Control) -> bool {
    let ample = SECONDS_PER_POINT * points as f64;
    control.seconds_left().is_none_or(|left| left > ample)
}

/// The initial guess of the ego motion: that of the pair before where the options start from its field,
/// otherwise the identity. Without a warm start a pair is independent of the others.
pub(super) fn prior(problem: &Problem, options: &Options) -> RigidTransform {
    let before = match &options.method {
        Method::Field(field) => problem.before.filter(|_| field.warm_start.is_some()),
        Method::Objects(_) => None,
    };
    before.and_then(|field| field.ego).unwrap_or_default()
}

/// The ego motion as target_from_source, with `prior` as the initial guess; none with [`Ego::Off`], and
/// where no time is left for a registration. That of [`Ego::Given`] has no covariance.
///
/// Uses all points of the registration clouds if `whole` is set, otherwise a sample. At a deadline
/// the registration returns its motion so far.
pub(super) fn ego_motion(
    host: &Host,
    selection: &Selection,
    ego: Ego,
    prior: &RigidTransform,
    whole: bool,
    control: &dyn Control,
) -> Option<Registration> {
    let on_time = EarlierDeadline {
        control,
        reserve: 0.0,
    };
    let align = |[source, target]: [&[Point]; 2]| host.align(source, target, prior, &on_time);
    match (ego, &selection.registration_clouds) {
        (Ego::Given(motion), _) => Some(Registration::given(motion)),
        (Ego::Auto, Some(_)) if on_time.interrupt().is_some() => None,
        (Ego::Auto, Some([source, target])) if whole => Some(align([source, target])),
        (Ego::Auto, Some(clouds)) => {
            let [source, target] = clouds
                .each_ref()
                .map(|all| stride_sample(all, SAMPLED_POINTS));
            Some(align([&source, &target]))
        }
        (Ego::Off, _) | (Ego::Auto, None) => None,
    }
}
