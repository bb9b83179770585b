//! The CPU backend: builds the distance transform, starts fits and evaluates networks on a thread
//! pool.

use std::sync::Arc;

use rayon::prelude::*;

use super::inference;
use super::isa::Isa;
use super::kernels::Kernels;
use super::model::{Mlp, Model};
use super::tile::WorkingSets;
use super::trainer::CpuTrainer;
use crate::flow::data::{Control, Point, Random};
use crate::flow::distance::{DistanceOptions, DistanceTransform};
use crate::flow::field::{
    Backend, BackendError, Conditioning, DistanceLoss, Network, Schedule, Trainer, Transform, mlp,
};
use crate::flow::host::Host;
use crate::flow::options::{FieldOptions, Precision};

/// A backend that computes in single precision on a pool of CPU threads.
pub struct CpuBackend {
    kernels: Kernels,
    host: Host,
}

impl CpuBackend {
    /// A backend with the machine's fastest instruction set on `threads` threads. None or zero
    /// stands for the default of rayon: the environment variable `RAYON_NUM_THREADS` if it is set,
    /// else one thread per logical core.
    ///
    /// # Errors
    /// [`BackendError::Threads`] if the operating system cannot start the threads.
    pub fn new(threads: Option<usize>) -> Result<Self, BackendError> {
        Self::with_isa(Isa::available()[0], threads)
    }

    /// A backend with the instruction set `isa`, on `threads` threads as in [`Self::new`].
    ///
    /// # Errors
    /// [`BackendError::Threads`] if the operating system cannot start the threads.
    ///
    /// # Panics
    /// If `isa` is not one of [`Isa::available`].
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
        let distance =
            threads.install(|| DistanceTransform::build(source, target, options, control))?;
        let (kernels, threads) = (self.kernels, Arc::clone(threads));
        Ok(Box::new(CpuTransform {
            kernels,
            threads,
            distance,
        }))
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let model = Mlp::new(self.kernels, network.conditioning);
        let threads = self.host.threads();
        let working_sets = WorkingSets::new(threads, || model.working_set());
        let parameters = &network.parameters;
        Ok(inference::evaluate(
            &model,
            parameters,
            threads,
            &working_sets,
            points,
        ))
    }
}

/// A distance transform in memory, with the kernels and threads that fit a field to it.
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
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        if options.precision == Precision::F16 {
            let text = "the CPU computes in single precision alone";
            return Err(BackendError::Unsupported(text));
        }
        let mut random = Random::stream(seed, 0);
        let parameters = mlp::initial(options.start, &mut random);
        let schedule = Schedule::new(source, options, &mut random);
        let model = Mlp::new(self.kernels, Conditioning::new(source, options.inputs));
        let loss = DistanceLoss {
            options: options.loss,
            distance: &self.distance,
        };
        let threads = Arc::clone(&self.threads);
        Ok(Box::new(CpuTrainer::new(
            threads, model, loss, schedule, parameters,
        )))
    }
}
