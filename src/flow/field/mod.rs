//! The neural scene flow prior: a continuous flow field fitted to one pair, evaluated at any point.

mod adam;
mod backend;
mod budget;
mod chamfer;
mod check;
mod codec;
mod consistency;
mod cycle;
mod early_stopping;
mod error;
mod fit;
mod fitted;
mod linear;
mod loss;
pub mod mlp;
mod network;
mod parameters;
mod placed;
pub(crate) mod reduction;
#[cfg(test)]
pub(crate) mod reference;
mod schedule;
mod snapshot;
mod warm_start;

pub use backend::{Advance, Backend, BackendError, FitReport, PreparedTarget, Trainer};
pub(crate) use backend::{OTHER_LOSS, check_state};
pub use fitted::FittedField;
pub use linear::{LinearError, LinearField};
pub use mlp::{HIDDEN_LAYERS, MIDDLE_LAYERS, PARAMETERS, WIDTH};
pub use network::Network;
pub use snapshot::{Snapshot, SnapshotError, TrainerState};

pub(crate) use budget::prepare_target;
pub(crate) use chamfer::{ChamferLoss, NearestSearcher, chamfer_work, check_chamfer};
pub(crate) use codec::{put_parameters, take_parameters};
pub(crate) use consistency::ConsistencyLoss;
pub(crate) use cycle::CycleLoss;
pub(crate) use early_stopping::EarlyStop;
#[cfg(feature = "gpu")]
pub(crate) use early_stopping::EarlyStopState;
pub(crate) use error::FitError;
pub(crate) use fit::{Fit, Fitted};
pub(crate) use linear::{LinearGrid, ROW, VARIATION_SMOOTHING};
pub(crate) use loss::{Batch, DistanceLoss, Loss, Output, length};
pub(crate) use mlp::{
    Conditioning, LAID_OUT, PANEL, first_layer, last_layer, middle_layer, transpose_middle_layers,
};
pub(crate) use parameters::{Aligned, Parameters};
pub(crate) use placed::Placed;
#[cfg(any(feature = "gpu", test))]
pub(crate) use reduction::MOST_POINTS;
#[cfg(feature = "gpu")]
pub(crate) use reduction::STRETCH;
pub(crate) use reduction::{Chunks, tree_sum};
#[cfg(test)]
pub(crate) use reference::{
    ReferenceLoss, ReferenceNetwork, chamfer_distance, cycle_loss, first_cycle_losses,
    first_losses, mean_distance,
};
#[cfg(feature = "gpu")]
pub(crate) use schedule::GrowthState;
pub(crate) use schedule::Schedule;
pub(crate) use warm_start::Prior;
