//! The CPU backend: prepares targets, starts fits and evaluates networks on a thread pool.

use std::sync::Arc;

use rayon::prelude::*;

use super::kernels::Kernels;
use super::linear::{Encoder, Linear};
use super::mlp::{Mlp, Pass};
use super::mlp_cycle::MlpCycle;
use super::model::Model;
use super::nearest::{BruteForce, KdTrees};
use super::tile::WorkingSets;
use super::trainer::CpuTrainer;
use crate::flow::data::{Control, Point, Random, Uncontrolled};
use crate::flow::distance::{DistanceOptions, DistanceTransform};
use crate::flow::field::{
    Backend, BackendError, ChamferLoss, Conditioning, ConsistencyLoss, CycleLoss, DistanceLoss,
    LinearGrid, Loss, NearestSearcher, Network, OTHER_LOSS, Parameters, PreparedTarget, Schedule,
    Trainer, check_chamfer, length, mlp,
};
use crate::flow::host::Host;
use crate::flow::options::{
    DistanceLossOptions, FieldOptions, LossOptions, ModelOptions, NearestSearch, Precision,
};
use crate::flow::simd::Isa;

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

    /// A backend beside this one, with `threads` threads of its own. Both share what is known of the
    /// latest sweeps.
    ///
    /// # Errors
    /// [`BackendError::Threads`] if the operating system cannot start the threads.
    pub fn beside(&self, threads: usize) -> Result<Self, BackendError> {
        Ok(Self {
            isa: self.isa,
            kernels: Kernels::new(self.isa),
            host: self.host.beside(threads, Some(self.isa.name()))?,
        })
    }

    /// Number of threads.
    pub fn threads(&self) -> usize {
        self.host.threads().current_num_threads()
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

    fn is_cpu(&self) -> bool {
        true
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
                Ok(Box::new(TransformTarget {
                    fits,
                    distance: Arc::new(distance),
                    transform: transform.clone(),
                    to_source: None,
                }))
            }
            LossOptions::Chamfer(options) => {
                check_chamfer(options, target)?;
                let threads = Arc::clone(threads);
                Ok(match options.search {
                    NearestSearch::BruteForce => Box::new(CloudTarget {
                        search: Arc::new(BruteForce::new(self.isa, threads, target)),
                        fits,
                    }),
                    NearestSearch::KdTree => Box::new(CloudTarget {
                        search: Arc::new(KdTrees::new(threads, target)),
                        fits,
                    }),
                })
            }
        }
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let threads = self.host.threads();
        let pass = Pass {
            kernels: self.kernels,
            conditioning: network.conditioning,
            flat: false,
        };
        let model = Mlp::new(pass, Arc::clone(threads));
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
    /// Starts a fit of the model of `options` to `loss`. `to_source` makes the loss to the source,
    /// which a cycle needs.
    fn start<'a, L: Loss + 'a>(
        &self,
        loss: L,
        to_source: impl FnOnce() -> Result<L, BackendError>,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + 'a>, BackendError> {
        let mut random = Random::stream(seed, 0);
        match &options.model {
            ModelOptions::Network(network) => {
                if network.precision == Precision::F16 {
                    let text = "the CPU computes in single precision alone";
                    return Err(BackendError::Unsupported(text));
                }
                let parameters = mlp::initial(network.start, &mut random);
                let schedule = Schedule::new(source, options, &mut random);
                let pass = Pass {
                    kernels: Kernels::new(self.isa),
                    conditioning: Conditioning::new(source, network.inputs),
                    flat: options.bev,
                };
                let threads = Arc::clone(&self.threads);
                if network.cycle {
                    let loss = CycleLoss {
                        forward: loss,
                        backward: to_source()?,
                    };
                    let model = MlpCycle::new(pass, threads);
                    let parameters = MlpCycle::twice(&parameters);
                    Ok(self.trainer(model, loss, schedule, parameters))
                } else {
                    let model = Mlp::new(pass, threads);
                    Ok(self.trainer(model, loss, schedule, parameters))
                }
            }
            ModelOptions::Linear(_) if options.bev => {
                let text = "the linear model has no bird's eye view";
                Err(BackendError::Unsupported(text))
            }
            ModelOptions::Linear(linear) => {
                let grid = LinearGrid::plan(source, linear)?;
                let mut parameters = Parameters::zeros(3 * grid.channel());
                grid.initial(&mut random, parameters.as_mut_slice());
                let schedule = Schedule::new(source, options, &mut random);
                let encoder = Encoder::new(self.isa, Arc::clone(&self.threads), grid);
                let model = Linear::new(encoder, linear.variation_weight);
                Ok(self.trainer(model, loss, schedule, parameters))
            }
        }
    }

    /// The fit of `model` to `loss` from `parameters`.
    fn trainer<'a, M: Model + 'a>(
        &self,
        model: M,
        loss: impl Loss<M::Output> + 'a,
        schedule: Schedule,
        parameters: Parameters,
    ) -> Box<dyn Trainer + 'a> {
        let threads = Arc::clone(&self.threads);
        let weight = schedule.options.consistency_weight;
        if weight > 0.0 {
            let loss = ConsistencyLoss::new(loss, weight, Arc::clone(&threads));
            Box::new(CpuTrainer::new(threads, model, loss, schedule, parameters))
        } else {
            Box::new(CpuTrainer::new(threads, model, loss, schedule, parameters))
        }
    }
}

/// The error of a fit with a cycle to a target that was prepared without one.
const NO_CYCLE: BackendError = BackendError::Unsupported("the target was prepared for no cycle");

/// A target's distance transform.
struct TransformTarget {
    fits: Fits,
    distance: Arc<DistanceTransform>,
    /// The options of the transform.
    transform: DistanceOptions,
    /// The source's distance transform, for a cycle.
    to_source: Option<Arc<DistanceTransform>>,
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

    fn prepare_cycle(
        &mut self,
        source: &[Point],
        control: &dyn Control,
    ) -> Result<(), BackendError> {
        let build = || DistanceTransform::build(source, source, &self.transform, control);
        self.to_source = Some(Arc::new(self.fits.threads.install(build)?));
        Ok(())
    }

    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        let loss_options = options.loss.distance().ok_or(OTHER_LOSS)?;
        let loss = |distance: Arc<DistanceTransform>| DistanceLoss {
            options: loss_options.clone(),
            distance,
        };
        let to_source = || {
            let distance = self.to_source.clone().ok_or(NO_CYCLE)?;
            Ok(loss(distance))
        };
        let to_target = loss(Arc::clone(&self.distance));
        self.fits.start(to_target, to_source, source, options, seed)
    }
}

/// A target cloud with a search of nearest neighbors.
struct CloudTarget<S: NearestSearcher> {
    fits: Fits,
    search: Arc<S>,
}

impl<S: NearestSearcher> PreparedTarget for CloudTarget<S> {
    fn bytes(&self) -> usize {
        size_of_val(self.search.target())
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let nearest = self.search.in_target(points, &Uncontrolled);
        let nearest = nearest.map_err(BackendError::Interrupted)?;
        let target = self.search.target();
        let off = |(&[x, y, z], index): (&Point, u32)| {
            let [to_x, to_y, to_z] = target[index as usize];
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
        let LossOptions::Chamfer(loss_options) = options.loss else {
            return Err(OTHER_LOSS);
        };
        check_chamfer(&loss_options, self.search.target())?;
        let to_source = || {
            Ok(ChamferLoss::new(
                loss_options,
                Arc::new(self.search.over(source)),
            ))
        };
        let to_target = ChamferLoss::new(loss_options, Arc::clone(&self.search));
        self.fits.start(to_target, to_source, source, options, seed)
    }
}
