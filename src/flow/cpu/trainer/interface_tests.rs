//! The fit of another model to another loss, through the interfaces that the network and the
//! distance transform use.

use std::sync::Arc;

use super::tests::clouds;
use super::*;
use crate::flow::cpu::tile::TILE;
use crate::flow::data::{Random, Uncontrolled};
use crate::flow::field::PointLoss;
use crate::flow::options::FieldOptions;

/// One translation of all points. Its three parameters are the flow.
struct Translation;

impl Model for Translation {
    type WorkingSet = [Point; TILE];

    fn working_set(&self) -> Self::WorkingSet {
        [[0.0; 3]; TILE]
    }

    fn update(&mut self, _: &Parameters) {}

    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        flow: &'a mut Self::WorkingSet,
    ) -> &'a [Point] {
        let floats = parameters.as_slice();
        flow.fill([floats[0], floats[1], floats[2]]);
        &flow[..points.len()]
    }

    fn backward(
        &self,
        _: &Parameters,
        flow_gradients: &[Point],
        _: &mut Self::WorkingSet,
        gradients: &mut Parameters,
    ) {
        for gradient in flow_gradients {
            for (sum, value) in gradients.as_mut_slice().iter_mut().zip(gradient) {
                *sum += value;
            }
        }
    }
}

/// The squared distance to corresponding target points: the nearest ones to the deformed points.
struct NearestPoint {
    target: Vec<Point>,
    nearest: Vec<Point>,
}

impl NearestPoint {
    fn squared(a: &Point, b: &Point) -> f32 {
        a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
    }
}

impl Loss for NearestPoint {
    fn prepare(&mut self, batch: &Batch<'_>, _: &dyn Control) -> Result<(), Interrupt> {
        let nearest = |(point, flow): (&Point, Point)| {
            let deformed: Point = core::array::from_fn(|a| point[a] + flow[a]);
            let by_distance = |a: &&Point, b: &&Point| {
                Self::squared(a, &deformed).total_cmp(&Self::squared(b, &deformed))
            };
            let nearest = self.target.iter().min_by(by_distance);
            *nearest.expect("the target is not empty")
        };
        let flow = (batch.flow)();
        self.nearest = batch.points.iter().zip(flow).map(nearest).collect();
        Ok(())
    }

    fn at(&self, index: usize, point: Point, flow: Point) -> PointLoss {
        let off: Point = core::array::from_fn(|a| point[a] + flow[a] - self.nearest[index][a]);
        PointLoss {
            value: off.iter().map(|o| o * o).sum(),
            gradient: off.map(|o| 2.0 * o),
        }
    }
}

/// The translation after `iterations`, from a fit on `threads` threads.
fn fitted_translation(threads: usize, iterations: usize) -> Point {
    let [source, target] = clouds(600);
    let threads = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
    let loss = NearestPoint {
        target,
        nearest: Vec::new(),
    };
    let mut options = FieldOptions::published(false);
    options.early_stop = None;
    options.max_iterations = iterations;
    let schedule = Schedule::new(&source, &options, &mut Random::new(0));
    let threads = Arc::new(threads.expect("threads"));
    let mut trainer = CpuTrainer::new(threads, Translation, loss, schedule, Parameters::zeros(3));
    let advance = trainer.advance(iterations, &Uncontrolled);
    assert_eq!(advance.expect("the cpu does not fail"), Advance::Continues);
    let flow = trainer.evaluate(&source).expect("the cpu does not fail");
    assert!(flow.iter().all(|own| *own == flow[0]));
    flow[0]
}

#[test]
fn another_model_and_a_coupled_loss_are_fitted_by_the_same_loop() {
    // The clouds differ by this translation. The nearest points are the true ones from the start
    // for most points, and for all near the end.
    const TRUE_M: Point = [0.1, 0.2, 0.0];
    const TOLERANCE_M: f32 = 5e-3;
    let found = fitted_translation(2, 400);
    for axis in 0..3 {
        assert!(
            (found[axis] - TRUE_M[axis]).abs() < TOLERANCE_M,
            "{found:?}"
        );
    }
}

#[test]
fn another_model_has_the_same_bits_for_any_number_of_threads() {
    assert_eq!(fitted_translation(1, 20), fitted_translation(3, 20));
}
