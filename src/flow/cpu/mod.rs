//! The CPU backend: vector kernels on all cores. Knows nothing of the GPU backend.

mod evaluate;
mod isa;
mod kernels;
mod lanes;
mod passes;
mod tile;
mod trainer;
mod workload;

pub use isa::Isa;
pub use workload::{NetworkWorkload, multiply_add_peak};

use std::sync::Arc;

use rayon::prelude::*;

use super::around::AlignedSweep;
use super::backend::{Backend, BackendError, Trainer, Transform};
use super::distance::{DistanceOptions, DistanceTransform};
use super::ego;
use super::field::Network;
use super::label::{self, Labelled};
use super::options::{LabelOptions, Options, Precision};
use super::points::{Point, RigidTransform};
use super::watch::Watch;
use kernels::Kernels;
use tile::WorkingSets;

/// The CPU, or a set of its threads.
pub struct CpuBackend {
    isa: Isa,
    kernels: Kernels,
    threads: Arc<rayon::ThreadPool>,
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
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads.unwrap_or(0))
            .thread_name(|i| format!("fnsf-cpu-{i}"))
            .build()
            .map_err(|error| BackendError::Threads(error.to_string()))?;
        Ok(Self {
            isa,
            kernels: Kernels::new(isa),
            threads: Arc::new(threads),
        })
    }
}

impl Backend for CpuBackend {
    fn name(&self) -> String {
        format!(
            "cpu ({}, {} threads)",
            self.isa.name(),
            self.threads.current_num_threads()
        )
    }

    fn host(&self) -> String {
        self.name()
    }

    fn transform(
        &self,
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        watch: &dyn Watch,
    ) -> Result<Box<dyn Transform>, BackendError> {
        let distance = self
            .threads
            .install(|| DistanceTransform::build_watched(source, target, options, watch))?;
        let (kernels, threads) = (self.kernels, Arc::clone(&self.threads));
        Ok(Box::new(CpuTransform {
            kernels,
            threads,
            distance,
        }))
    }

    fn align(
        &self,
        source: &[Point],
        target: &[Point],
        prior: &RigidTransform,
        watch: &dyn Watch,
    ) -> RigidTransform {
        let align = || ego::align(source, target, prior, watch);
        self.threads.install(align)
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        Ok(evaluate::evaluate(
            &self.kernels,
            &self.threads,
            &WorkingSets::new(&self.threads),
            (&network.parameters, &network.conditioning),
            points,
        ))
    }

    fn movers(
        &self,
        source: &[Point],
        target: &[Point],
        around: &[AlignedSweep],
        options: &LabelOptions,
        watch: &dyn Watch,
    ) -> Labelled {
        let find = || label::label(source, target, around, options, watch);
        self.threads.install(find)
    }
}

/// A distance transform in memory, and what will fit a field to it.
struct CpuTransform {
    kernels: Kernels,
    threads: Arc<rayon::ThreadPool>,
    distance: DistanceTransform,
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
