//! Basic data types of the numerics: points and transforms, control, random numbers and the
//! envelope of binary formats.

mod aligned_sweep;
mod angle;
mod codec;
pub(crate) mod control;
mod dense_cloud;
#[cfg(feature = "gpu")]
mod largest;
mod lazy;
mod lock;
mod oriented_box;
mod point;
mod rigid_motion;
mod rng;
mod screw;
mod stop_reason;

pub use aligned_sweep::AlignedSweep;
pub use codec::EnvelopeError;
pub use control::{Control, Interrupt, Progress, Uncontrolled};

pub(crate) use control::EarlierDeadline;
pub use dense_cloud::DenseCloud;
pub use oriented_box::OrientedBox;
pub use point::{DYNAMIC_M, MIN_POINTS, Point, RigidTransform};
pub use rigid_motion::rigid_motion_between;
pub use stop_reason::StopReason;

pub(crate) use angle::atan2;
pub(crate) use codec::{Body, Envelope, Hash};
#[cfg(feature = "gpu")]
pub(crate) use largest::largest;
pub(crate) use lazy::get_or_compute;
pub(crate) use lock::locked;
pub(crate) use point::{floors, square_distance, stride_sample, transform_point, transform_points};
pub(crate) use rng::Random;
pub(crate) use screw::Screw;
