//! TODO doc

use super::isa::Isa;
use super::{inference, trainer};
use std::sync::Arc;

use rayon::prelude::*;

use super::kernels::Kernels;
use super::tile::WorkingSets;
use crate::flow::data::{Control, Point};
use crate::flow::distance::{DistanceOptions, DistanceTransform};
use crate::flow::field::{Backend, BackendError, Network, Trainer, Transform};
use crate::flow::host::Host;
use crate::flow::options::{Options, Precision};

/// The CPU, or a set of its threads.
pub struct CpuBackend {
    kernels: Kernels,
    host: Host,
}

impl CpuBackend {
    /// The CPU's fastest instruction set on `threads` threads; on all cores where none are named.
    ///
    /// # Errors
    /// Where the operating system gives no threads.
    pub fn new(threads: Option<usize>) -> Result<Self, BackendError> {
        Self::with_isa(Isa::available()[0], threads)
    }

    /// As [`Self::new`], with an instruction set of [`Isa::available`].
    ///
    /// # Errors
    /// Where the operating system gives no threads.
    ///
    /// # Panics
    /// Where the machine lacks the instruction set.
    pub fn with_isa(isa: Isa, threads: Option<usize>) -> Result<Self, BackendError> {
        Ok(Self {
            kernels: Kernels::new(isa),
            host: Host::new(threads, Some(isa.name()))?,
        })
    }
}

impl Backend for CpuBackend {
    fn name(&self) -> String {
        self.host.name().to_owned()
    }

    fn host(&self) -> &Host {
        &self.host
    }

    fn transform(
        &self,
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn Transform>, BackendError> {
        let threads = self.host.threads();
        let distance = threads
            .install(|| DistanceTransform::build_watched(source, target, options, control))?;
        let (kernels, threads) = (self.kernels, Arc::clone(threads));
        Ok(Box::new(CpuTransform {
            kernels,
            threads,
            distance,
        }))
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        Ok(inference::evaluate(
            &self.kernels,
            self.host.threads(),
            &WorkingSets::new(self.host.threads()),
            (&network.parameters, &network.conditioning),
            points,
        ))
    }
}

/// A distance transform in memory, and what will fit a field to it.
pub(super) struct CpuTransform {
    pub(super) kernels: Kernels,
    pub(super) threads: Arc<rayon::ThreadPool>,
    pub(super) distance: DistanceTransform,
}

impl Transform for CpuTransform {
    fn bytes(&self) -> usize {
        self.distance.bytes()
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let sample = |&point: &Point| self.distance.sample(point).distance;
        let sampled = || points.par_iter().map(sample).collect();
        Ok(self.threads.install(sampled))
    }

    fn start(
        &self,
        source: &[Point],
        options: &Options,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        if options.precision == Precision::F16 {
            let text = "the CPU computes in single precision alone";
            return Err(BackendError::Unsupported(text));
        }
        Ok(Box::new(trainer::CpuTrainer::new(self, source, options)))
    }
}
