//! The card's matrix units and half precision on them: the tile that they multiply, the kernels in
//! their place among an iteration's, and whether they can be trusted. Knows neither pairs nor
//! stopping rules.

use wgpu::CooperativeScalarType as Scalar;

use super::backend::{Buffers, Card, allocated, spread};
use super::iteration::{Dispatch, Phase};
use super::pipelines::{HALF_SOURCES, HalfKernels};
use super::self_test;
use super::tiling::Wave;
use crate::flow::field::{BackendError, MIDDLE_LAYERS, WIDTH};

/// What the kernels of half precision ask of a card.
const FEATURES: wgpu::Features = wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX
    .union(wgpu::Features::SHADER_F16)
    .union(wgpu::Features::SUBGROUP);

/// What to ask of a card that offers a tile, when it is opened: the features, and leave to use those
/// that wgpu calls experimental.
#[expect(
    unsafe_code,
    reason = "wgpu gives its matrix operations to nobody else"
)]
pub(super) fn asked_for() -> (wgpu::Features, wgpu::ExperimentalFeatures) {
    // SAFETY: asks who calls to accept that experimental features may have defects that make them
    // undefined. Of these features the kernels of half precision alone make use; their access to
    // memory is within their buffers by construction, and their results are compared with those of
    // single precision before anything relies on them.
    let experiments = unsafe { wgpu::ExperimentalFeatures::enabled() };
    (FEATURES, experiments)
}

/// Halves of a lane: its middle layers' weights.
const LANE_HALVES: u64 = (MIDDLE_LAYERS * WIDTH * WIDTH) as u64;

/// The tile that the units multiply: its sides, all three alike.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tile {
    /// 8 x 8 x 8.
    Eight,
    /// 16 x 16 x 16.
    Sixteen,
}

impl Tile {
    /// The largest tile of halves with sums in single precision that the card offers.
    ///
    /// # Errors
    /// What the card lacks.
    pub(super) fn offered(adapter: &wgpu::Adapter) -> Result<Self, String> {
        let lacking = FEATURES - adapter.features();
        if !lacking.is_empty() {
            return Err(format!("its driver lacks {lacking}"));
        }
        let all = adapter.cooperative_matrix_properties();
        let offers = |side: u32| {
            all.iter().any(|tile| {
                [tile.m_size, tile.n_size, tile.k_size] == [side; 3]
                    && (tile.ab_type, tile.cr_type) == (Scalar::F16, Scalar::F32)
            })
        };
        [(16, Self::Sixteen), (8, Self::Eight)]
            .into_iter()
            .find(|&(side, _)| offers(side))
            .map(|(_, tile)| tile)
            .ok_or_else(|| "no tile of its matrix units is 16x16x16 or 8x8x8 f16 -> f32".to_owned())
    }

    /// The name that reports use.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Eight => "8x8x8 f16 -> f32",
            Self::Sixteen => "16x16x16 f16 -> f32",
        }
    }

    /// The kernels' entry points and sources.
    pub(super) fn sources(self) -> &'static [(&'static str, &'static str)] {
        match self {
            Self::Eight => &HALF_SOURCES[0],
            Self::Sixteen => &HALF_SOURCES[1],
        }
    }
}

/// Matrix units that passed their self-test.
#[derive(Debug)]
pub(super) struct Units {
    pub(super) tile: Tile,
    kernels: HalfKernels,
    /// The middle layers' weights, see `halve.wgsl`: 0.2 MB a lane beyond the card's budget, taken
    /// when somebody first asks for half precision.
    halves: wgpu::Buffer,
}

impl Units {
    /// Builds the kernels and tests them against those of single precision.
    ///
    /// # Errors
    /// Why there is no half precision on this card.
    pub(super) fn new(card: &Card, tile: Tile) -> Result<Self, String> {
        Self::tested(card, tile, tile.sources())
    }

    /// As above, from these sources.
    pub(super) fn tested(
        card: &Card,
        tile: Tile,
        sources: &[(&str, &str)],
    ) -> Result<Self, String> {
        let text = |error: BackendError| error.to_string();
        let halves = |lanes: u64| {
            let usage = wgpu::BufferUsages::STORAGE;
            allocated(&card.device, "halves", lanes * LANE_HALVES * 2, usage).map_err(text)
        };
        let units = Self {
            tile,
            kernels: HalfKernels::new(&card.device, sources).map_err(text)?,
            halves: halves(1)?,
        };
        self_test::run(card, &units)?;
        Ok(Self {
            halves: halves(card.budget.lanes)?,
            ..units
        })
    }
}

/// The kernels of half precision, bound to a submission's buffers.
pub(super) struct HalfPhases<'a> {
    kernels: &'a HalfKernels,
    halve: wgpu::BindGroup,
    forward: wgpu::BindGroup,
    backward: wgpu::BindGroup,
    gradients: wgpu::BindGroup,
    outer_gradients: wgpu::BindGroup,
}

impl<'a> HalfPhases<'a> {
    pub(super) fn bind(
        card: &Card,
        buffers: &Buffers,
        units: &'a Units,
        tiles: &wgpu::Buffer,
        chunks: &wgpu::Buffer,
    ) -> Self {
        let Buffers {
            store,
            networks,
            activations,
            deltas,
            flows,
            loss_gradients,
            partials,
            lanes,
            steps,
            statuses,
            ..
        } = buffers;
        let kernels = &units.kernels;
        let halves = &units.halves;
        Self {
            kernels,
            halve: card.bound(&kernels.halve, &[lanes, statuses, networks, halves]),
            forward: card.bound(
                &kernels.forward,
                &[
                    store,
                    networks,
                    lanes,
                    steps,
                    tiles,
                    statuses,
                    halves,
                    flows,
                    activations,
                ],
            ),
            backward: card.bound(
                &kernels.backward,
                &[
                    networks,
                    tiles,
                    statuses,
                    loss_gradients,
                    activations,
                    lanes,
                    steps,
                    halves,
                    deltas,
                ],
            ),
            gradients: card.bound(
                &kernels.gradients,
                &[
                    steps,
                    chunks,
                    statuses,
                    activations,
                    deltas,
                    lanes,
                    partials,
                ],
            ),
            outer_gradients: card.bound(
                &kernels.outer_gradients,
                &[
                    store,
                    lanes,
                    steps,
                    chunks,
                    statuses,
                    activations,
                    deltas,
                    loss_gradients,
                    partials,
                ],
            ),
        }
    }

    /// What is dispatched in half precision; none where the phase is the same in both.
    pub(super) fn dispatches(
        &self,
        phase: Phase,
        wave: &Wave,
        lanes: u32,
    ) -> Option<Vec<Dispatch<'_>>> {
        let kernels = self.kernels;
        // A workgroup does half of a tile.
        let halves = spread(2 * wave.tiles as u32);
        let chunks = wave.chunks as u32;
        Some(match phase {
            Phase::Halve => {
                let groups = LANE_HALVES as u32 / 4 / HALVE_GROUP;
                vec![(&kernels.halve, &self.halve, [groups, lanes])]
            }
            Phase::Forward => vec![(&kernels.forward, &self.forward, halves)],
            Phase::Backward => vec![(&kernels.backward, &self.backward, halves)],
            Phase::Gradients => vec![
                (
                    &kernels.gradients,
                    &self.gradients,
                    [chunks, MIDDLE_LAYERS as u32],
                ),
                (&kernels.outer_gradients, &self.outer_gradients, [chunks, 2]),
            ],
            Phase::Transpose => Vec::new(),
            Phase::Query | Phase::Judge | Phase::Step => return None,
        })
    }
}

/// Invocations of a workgroup of `halve.wgsl`.
const HALVE_GROUP: u32 = 256;
