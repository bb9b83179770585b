//! The matrix units of a GPU: required features and supported tile sizes.

use wgpu::CooperativeScalarType as Scalar;

use super::pipelines::HALF_SOURCES;

/// The features that the half-precision kernels require.
const FEATURES: wgpu::Features = wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX
    .union(wgpu::Features::SHADER_F16)
    .union(wgpu::Features::SUBGROUP);

/// The features to request when a GPU with a supported tile is opened, and the permission to use
/// features that wgpu calls experimental.
#[expect(unsafe_code, reason = "wgpu requires it for matrix operations")]
pub(super) fn asked_for() -> (wgpu::Features, wgpu::ExperimentalFeatures) {
    // SAFETY: the caller must accept that experimental features may have defects that cause
    // undefined behavior. Only the half-precision kernels use these features. Their memory accesses
    // are within their buffers by construction. Their results are compared with those of single
    // precision before they are used.
    let experiments = unsafe { wgpu::ExperimentalFeatures::enabled() };
    (FEATURES, experiments)
}

/// The tile that the matrix units multiply; all three sides are equal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tile {
    /// 8 x 8 x 8.
    Eight,
    /// 16 x 16 x 16.
    Sixteen,
}

impl Tile {
    /// The largest supported tile with half-precision factors and single-precision sums.
    ///
    /// # Errors
    /// The feature or tile that the GPU lacks.
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

    /// The name used in reports.
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
