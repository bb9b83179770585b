//! The local consistency of NSFP++ (Najibi et al., ECCV 2022): neighboring points have like flows.
//!
//! Over the N points of a cluster it adds `w/N sum_i sum_j |f_i - f_j|`. Its part of the mean loss
//! is attributed to point i as `w sum_j |f_i - f_j|`.

use std::sync::Arc;

use rayon::prelude::*;

use super::loss::{Batch, Loss, Output, PointLoss};
use super::reduction::tree_sum;
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
    const COUPLES: bool = true;

    fn prepare(&mut self, batch: &Batch<'_, O>, control: &dyn Control) -> Result<(), Interrupt> {
        // Computed once for both.
        let outputs = (batch.outputs)();
        let shared = Batch {
            points: batch.points,
            range: batch.range,
            done: batch.done,
            outputs: &|| outputs.clone(),
        };
        self.loss.prepare(&shared, control)?;
        let flows: Vec<Point> = outputs.iter().map(|output| output.flow()).collect();
        let columns = Columns::new(&flows);
        self.terms.clear();
        for some in flows.chunks(ROWS) {
            if let Some(interrupt) = control.interrupt() {
                return Err(interrupt);
            }
            let terms = some
                .par_iter()
                .map(|&flow| term(flow, &columns, self.weight));
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

/// Flows of a row of [`Columns`].
const ROW: usize = 16;

/// The flows, component by component, in rows of [`ROW`].
struct Columns {
    rows: Vec<[[f32; ROW]; 3]>,
    /// Flows that the last row holds beyond those given. They are copies of the last flow.
    copies: usize,
}

impl Columns {
    fn new(flows: &[Point]) -> Self {
        let row = |flows: &[Point]| {
            let component =
                |axis: usize| core::array::from_fn(|lane| flows[lane.min(flows.len() - 1)][axis]);
            [component(0), component(1), component(2)]
        };
        Self {
            rows: flows.chunks(ROW).map(row).collect(),
            copies: flows.len().next_multiple_of(ROW) - flows.len(),
        }
    }
}

/// The term of one flow among all. A pair counts once in the term of each of its points, so the
/// derivative of the sum is twice that of the own term.
fn term(flow: Point, flows: &Columns, weight: f32) -> PointLoss {
    let (mut sums, mut pulls) = ([0.0; ROW], [[0.0; ROW]; 3]);
    let mut add = |row: &[[f32; ROW]; 3], lanes: usize| {
        for lane in 0..lanes {
            let off: Point = core::array::from_fn(|axis| flow[axis] - row[axis][lane]);
            let length = (off[0] * off[0] + off[1] * off[1] + off[2] * off[2]).sqrt();
            let inverse = 1.0 / length.max(SMALL_M);
            sums[lane] += length;
            for (pulls, off) in pulls.iter_mut().zip(off) {
                pulls[lane] += off * inverse;
            }
        }
    };
    if let Some((last, whole)) = flows.rows.split_last() {
        whole.iter().for_each(|row| add(row, ROW));
        add(last, ROW - flows.copies);
    }
    PointLoss {
        value: weight * tree_sum(sums),
        gradient: pulls.map(|pulls| 2.0 * weight * tree_sum(pulls)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::{Random, Uncontrolled};

    /// No loss.
    struct Nothing;

    impl Loss for Nothing {
        const COUPLES: bool = false;

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
