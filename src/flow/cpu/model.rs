//! The models that the CPU can fit: the flow of points as a function of parameters.

use super::kernels::Kernels;
use super::tile::Tile;
use crate::flow::data::Point;
use crate::flow::field::{Conditioning, Parameters, mlp, transpose_middle_layers};

/// A model that a field can be fitted with. It computes tiles of up to [`TILE`](super::tile::TILE)
/// points, each in the working set of one thread.
pub(super) trait Model: Send + Sync {
    /// The working set of one thread.
    type WorkingSet: Send;

    /// A new working set.
    fn working_set(&self) -> Self::WorkingSet;

    /// Updates what the model derives from its parameters. Called before the first iteration and
    /// after every change of `parameters`.
    fn update(&mut self, parameters: &Parameters);

    /// The flow of each point, metres. Keeps what [`Self::backward`] needs in `working_set`.
    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        working_set: &'a mut Self::WorkingSet,
    ) -> &'a [Point];

    /// Adds the derivatives of the loss with respect to the parameters to `gradients`.
    /// `flow_gradients` are its derivatives with respect to the flows of the last
    /// [`Self::forward`].
    fn backward(
        &self,
        parameters: &Parameters,
        flow_gradients: &[Point],
        working_set: &mut Self::WorkingSet,
        gradients: &mut Parameters,
    );
}

/// The coordinate network of FNSF, Section 3.
pub(super) struct Mlp {
    kernels: Kernels,
    conditioning: Conditioning,
    /// The transposed weights of the middle layers.
    transposed: Parameters,
}

impl Mlp {
    pub(super) fn new(kernels: Kernels, conditioning: Conditioning) -> Self {
        Self {
            kernels,
            conditioning,
            transposed: mlp::zeros(),
        }
    }
}

impl Model for Mlp {
    type WorkingSet = Tile;

    fn working_set(&self) -> Tile {
        Tile::new()
    }

    fn update(&mut self, parameters: &Parameters) {
        transpose_middle_layers(parameters, &mut self.transposed);
    }

    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        tile: &'a mut Tile,
    ) -> &'a [Point] {
        tile.load(points.iter().map(|&point| self.conditioning.apply(point)));
        self.kernels.forward(parameters, tile);
        &tile.outputs[..points.len()]
    }

    fn backward(
        &self,
        parameters: &Parameters,
        flow_gradients: &[Point],
        tile: &mut Tile,
        gradients: &mut Parameters,
    ) {
        tile.output_gradients[..flow_gradients.len()].copy_from_slice(flow_gradients);
        self.kernels
            .backward(parameters, &self.transposed, tile, gradients);
    }
}
