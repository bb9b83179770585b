//! The CPU backend: prepares targets, starts fits and evaluates networks on a thread pool.

use std::sync::Arc;

use rayon::prelude::*;

use super::isa::Isa;
use super::kernels::Kernels;
use super::linear::{Encoder, Linear};
use super::model::{Mlp, Model};
use super::nearest::{BruteForce, KdTrees};
use super::tile::WorkingSets;
use super::trainer::CpuTrainer;
use crate::flow::data::{Control, Point, Random, Uncontrolled};
use crate::flow::distance::DistanceTransform;
use crate::flow::field::{
    Backend, BackendError, ChamferLoss, Conditioning, DistanceLoss, LinearGrid, Loss,
    NearestSearcher, Network, Parameters, PreparedTarget, Schedule, Trainer, check_chamfer, length,
    mlp,
};
use crate::flow::host::Host;
use crate::flow::options::{
    DistanceLossOptions, FieldOptions, LossOptions, ModelOptions, NearestSearch, Precision,
};

/// A backend that computes in single precision on a pool of CPU threads.
pub struct CpuBackend {
    isa: Isa,
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
            isa,
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

    fn prepare_target(
        &self,
        source: &[Point],
        target: &[Point],
        options: &LossOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn PreparedTarget>, BackendError> {
        let threads = self.host.threads();
        let fits = Fits {
            isa: self.isa,
            threads: Arc::clone(threads),
        };
        match options {
            LossOptions::Distance(DistanceLossOptions { transform, .. }) => {
                let distance = threads
                    .install(|| DistanceTransform::build(source, target, transform, control))?;
                Ok(Box::new(TransformTarget { fits, distance }))
            }
            LossOptions::Chamfer(options) => {
                check_chamfer(options, target)?;
                let (threads, target) = (Arc::clone(threads), target.to_vec());
                Ok(match options.search {
                    NearestSearch::BruteForce => Box::new(CloudTarget {
                        search: BruteForce::new(self.isa, threads, &target),
                        fits,
                        target,
                    }),
                    NearestSearch::KdTree => Box::new(CloudTarget {
                        search: KdTrees::new(threads, &target),
                        fits,
                        target,
                    }),
                })
            }
        }
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let threads = self.host.threads();
        let model = Mlp::new(self.kernels, Arc::clone(threads), network.conditioning);
        let working_sets = WorkingSets::new(threads, || model.working_set());
        Ok(model.evaluate(&network.parameters, points, &working_sets))
    }
}

/// What every fit on this backend needs.
struct Fits {
    isa: Isa,
    threads: Arc<rayon::ThreadPool>,
}

impl Fits {
    /// Starts a fit of the model of `options` to `loss`.
    fn start<'a>(
        &self,
        loss: impl Loss + 'a,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + 'a>, BackendError> {
        let mut random = Random::stream(seed, 0);
        let threads = Arc::clone(&self.threads);
        match &options.model {
            ModelOptions::Network(network) => {
                if network.precision == Precision::F16 {
                    let text = "the CPU computes in single precision alone";
                    return Err(BackendError::Unsupported(text));
                }
                let parameters = mlp::initial(network.start, &mut random);
                let schedule = Schedule::new(source, options, &mut random);
                let conditioning = Conditioning::new(source, network.inputs);
                let model = Mlp::new(Kernels::new(self.isa), Arc::clone(&threads), conditioning);
                let trainer = CpuTrainer::new(threads, model, loss, schedule, parameters);
                Ok(Box::new(trainer))
            }
            ModelOptions::Linear(linear) => {
                let grid = LinearGrid::plan(source, linear)?;
                let mut parameters = Parameters::zeros(3 * grid.channel());
                grid.initial(&mut random, parameters.as_mut_slice());
                let schedule = Schedule::new(source, options, &mut random);
                let encoder = Encoder::new(self.isa, Arc::clone(&threads), grid);
                let model = Linear::new(encoder, linear.variation_weight);
                let trainer = CpuTrainer::new(threads, model, loss, schedule, parameters);
                Ok(Box::new(trainer))
            }
        }
    }
}

/// The error of a fit to another kind of loss than the one that the target was prepared for.
const OTHER_LOSS: BackendError =
    BackendError::Unsupported("the target was prepared for another kind of loss");

/// A target's distance transform.
struct TransformTarget {
    fits: Fits,
    distance: DistanceTransform,
}

impl PreparedTarget for TransformTarget {
    fn bytes(&self) -> usize {
        self.distance.bytes()
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let sample = |&point: &Point| self.distance.sample(point).distance;
        let sampled = || points.par_iter().map(sample).collect();
        Ok(self.fits.threads.install(sampled))
    }

    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        let loss = DistanceLoss {
            options: options.loss.distance().ok_or(OTHER_LOSS)?.clone(),
            distance: &self.distance,
        };
        self.fits.start(loss, source, options, seed)
    }
}

/// A target cloud with a search of nearest neighbors.
struct CloudTarget<S: NearestSearcher> {
    fits: Fits,
    target: Vec<Point>,
    search: S,
}

impl<S: NearestSearcher> PreparedTarget for CloudTarget<S> {
    fn bytes(&self) -> usize {
        size_of_val(self.target.as_slice())
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let nearest = self.search.in_target(points, &Uncontrolled);
        let nearest = nearest.map_err(BackendError::Interrupted)?;
        let off = |(&[x, y, z], index): (&Point, u32)| {
            let [to_x, to_y, to_z] = self.target[index as usize];
            length([to_x - x, to_y - y, to_z - z])
        };
        Ok(points.iter().zip(nearest).map(off).collect())
    }

    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        let LossOptions::Chamfer(options_of_loss) = &options.loss else {
            return Err(OTHER_LOSS);
        };
        check_chamfer(options_of_loss, &self.target)?;
        let loss = ChamferLoss::new(*options_of_loss, &self.target, &self.search);
        self.fits.start(loss, source, options, seed)
    }
}
