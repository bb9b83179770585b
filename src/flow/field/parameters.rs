//! Arrays of floats in the layout of a model: its parameters, their gradients, Adam's moments.

use bytemuck::{Pod, Zeroable};

/// Floats of a cache line.
pub(super) const LINE: usize = 16;

/// One cache line of floats.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Line([f32; LINE]);

/// A zero-initialized buffer of floats, aligned to cache lines.
#[derive(Clone)]
pub(crate) struct Aligned(Vec<Line>);

impl Aligned {
    /// A buffer of `floats` zeros, rounded up to a whole line.
    pub(crate) fn zeros(floats: usize) -> Self {
        Self(vec![Line::zeroed(); floats.div_ceil(LINE)])
    }

    pub(crate) fn as_slice(&self) -> &[f32] {
        bytemuck::cast_slice(&self.0)
    }

    pub(crate) fn as_mut_slice(&mut self) -> &mut [f32] {
        bytemuck::cast_slice_mut(&mut self.0)
    }
}

/// The parameters of a model, or an array of the same shape. The model defines the layout.
#[derive(Clone)]
pub(crate) struct Parameters(Aligned);

impl Parameters {
    /// `floats` zeros, rounded up to a whole cache line.
    pub(crate) fn zeros(floats: usize) -> Self {
        Self(Aligned::zeros(floats))
    }

    /// Zeros of the same shape.
    pub(crate) fn zeros_like(&self) -> Self {
        Self::zeros(self.as_slice().len())
    }

    pub(crate) fn as_slice(&self) -> &[f32] {
        self.0.as_slice()
    }

    pub(crate) fn as_mut_slice(&mut self) -> &mut [f32] {
        self.0.as_mut_slice()
    }
}
