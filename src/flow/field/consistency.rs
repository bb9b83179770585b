//! The local consistency of NSFP++ (Najibi et al., ECCV 2022): neighboring points have like flows.
//!
//! Over the N points of a cluster it adds `w/N sum_i sum_j |f_i - f_j|`. Its part of the mean loss
//! is attributed to point i as `w sum_j |f_i - f_j|`.

use std::sync::Arc;

use rayon::prelude::*;

use super::loss::{Batch, Loss, Output, PointLoss};
use crate::flow::data::{Control, Interrupt, Point};

/// Points between two checks of the control.
const ROWS: usize = 1024;
/// Below this difference of two flows, metres, its direction counts in proportion.
const SMALL_M: f32 = 1e-6;

/// A loss with local consistency. Its cost grows with the square of the number of points.
pub(crate) struct ConsistencyLoss<L> {
    loss: L,
    /// `w` above.
    weight: f32,
    threads: Arc<rayon::ThreadPool>,
    /// The term of each point of the batch and its derivative with respect to the point's flow.
    terms: Vec<PointLoss>,
}

impl<L> ConsistencyLoss<L> {
    pub(crate) fn new(loss: L, weight: f32, threads: Arc<rayon::ThreadPool>) -> Self {
        Self {
            loss,
            weight,
            threads,
            terms: Vec::new(),
        }
    }
}

impl<O: Output, L: Loss<O>> Loss<O> for ConsistencyLoss<L> {
    fn prepare(&mut self, batch: &Batch<'_, O>, control: &dyn Control) -> Result<(), Interrupt> {
        self.loss.prepare(batch, control)?;
        let flows: Vec<Point> = (batch.outputs)().into_iter().map(Output::flow).collect();
        self.terms.clear();
        for some in flows.chunks(ROWS) {
            if let Some(interrupt) = control.interrupt() {
                return Err(interrupt);
            }
            let terms = some.par_iter().map(|&flow| term(flow, &flows, self.weight));
            self.threads.install(|| self.terms.par_extend(terms));
        }
        Ok(())
    }

    fn depends_on_earlier(&self, done: usize) -> bool {
        self.loss.depends_on_earlier(done)
    }

    #[inline]
    fn at(&self, index: usize, point: Point, output: O) -> PointLoss<O> {
        let loss = self.loss.at(index, point, output);
        let term = self.terms[index];
        PointLoss {
            value: loss.value + term.value,
            gradient: loss.gradient.plus_flow(term.gradient),
        }
    }
}

/// The term of one flow among all. A pair counts once in the term of each of its points, so the
/// derivative of the sum is twice that of the own term.
fn term(flow: Point, flows: &[Point], weight: f32) -> PointLoss {
    let (mut sum, mut pull) = (0.0, [0.0; 3]);
    for other in flows {
        let off: Point = core::array::from_fn(|a| flow[a] - other[a]);
        let length = (off[0] * off[0] + off[1] * off[1] + off[2] * off[2]).sqrt();
        sum += length;
        let inverse = 1.0 / length.max(SMALL_M);
        for (pull, off) in pull.iter_mut().zip(off) {
            *pull += off * inverse;
        }
    }
    PointLoss {
        value: weight * sum,
        gradient: pull.map(|pull| 2.0 * weight * pull),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::{Random, Uncontrolled};

    /// No loss.
    struct Nothing;

    impl Loss for Nothing {
        fn prepare(&mut self, _: &Batch<'_>, _: &dyn Control) -> Result<(), Interrupt> {
            Ok(())
        }

        fn at(&self, _: usize, _: Point, _: Point) -> PointLoss {
            PointLoss {
                value: 0.0,
                gradient: [0.0; 3],
            }
        }
    }

    const WEIGHT: f32 = 0.05;

    /// `w/N sum_ij |f_i - f_j|` in double precision.
    fn consistency(flows: &[[f64; 3]]) -> f64 {
        let mut sum = 0.0;
        for a in flows {
            for b in flows {
                sum += (0..3).map(|x| (a[x] - b[x]).powi(2)).sum::<f64>().sqrt();
            }
        }
        sum * f64::from(WEIGHT) / flows.len() as f64
    }

    #[test]
    fn value_and_gradient_are_those_of_the_double_sum_at_awkward_sizes() {
        const TOLERANCE: f64 = 1e-4;
        const STEP: f64 = 1e-6;
        let threads = rayon::ThreadPoolBuilder::new().num_threads(2).build();
        let threads = Arc::new(threads.expect("threads"));
        for count in [1, 2, 37, ROWS + 3] {
            let mut random = Random::new(9);
            let mut axis = || random.uniform(-1.0, 1.0) as f32;
            let flows: Vec<Point> = (0..count).map(|_| [axis(), axis(), axis()]).collect();
            let mut loss = ConsistencyLoss::new(Nothing, WEIGHT, Arc::clone(&threads));
            let batch = Batch {
                points: &flows,
                range: &(0..count),
                done: 0,
                outputs: &|| flows.clone(),
            };
            loss.prepare(&batch, &Uncontrolled).expect("no interrupt");
            let losses: Vec<PointLoss> = (0..count)
                .map(|index| loss.at(index, flows[index], flows[index]))
                .collect();
            let mean = losses.iter().map(|l| f64::from(l.value)).sum::<f64>() / count as f64;
            let mut wide: Vec<[f64; 3]> = flows.iter().map(|f| f.map(f64::from)).collect();
            let expected = consistency(&wide);
            let error = (mean - expected).abs() / expected.max(1.0);
            assert!(error < TOLERANCE, "{mean} {expected}");
            for (row, axis) in [(0, 0), (count / 2, 2), (count - 1, 1)] {
                let at = wide[row][axis];
                wide[row][axis] = at + STEP;
                let ahead = consistency(&wide);
                wide[row][axis] = at - STEP;
                let slope = (ahead - consistency(&wide)) / (2.0 * STEP) * count as f64;
                wide[row][axis] = at;
                let gradient = f64::from(losses[row].gradient[axis]);
                let error = (slope - gradient).abs() / slope.abs().max(1.0);
                assert!(
                    error < TOLERANCE || count == 1,
                    "{count}: {slope} {gradient}"
                );
            }
        }
    }
}
