//! TODO doc

mod codec;
pub(crate) mod control;
mod dense_cloud;
mod lazy;
mod oriented_box;
mod point;
mod rng;

pub use codec::SealError;
pub use control::{Interrupt, Progress, Unwatched, Watch};
pub use dense_cloud::DenseCloud;
pub use oriented_box::Bounds;
pub use point::{DYNAMIC_M, MIN_POINTS, Point, RigidTransform};

pub(crate) use codec::{Body, Hash, PARAMETERS_BYTES, Seal, put_parameters};
pub(crate) use lazy::get_or_compute;
pub(crate) use point::{all_moved, evenly, floor, moved, square_distance};
pub(crate) use rng::Random;
