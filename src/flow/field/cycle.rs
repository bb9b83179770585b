//! The cycle consistency of NSFP (Li et al., NeurIPS 2021): a second field leads the deformed source
//! back.
//!
//! With `q_i = p_i + f_i` and the flow `b_i` back from there, it is `L_target(q) + L_source(q - b)`.
//! The first term is the loss to the target, the second the same loss to the source.

use super::loss::{Batch, Loss, PointLoss};
use crate::flow::data::{Control, Interrupt, Point};

/// The sum of a loss to the target and of one to the source.
pub(crate) struct CycleLoss<L: Loss> {
    /// Of the deformed source, to the target.
    pub(crate) forward: L,
    /// Of the deformed source led back, to the source.
    pub(crate) backward: L,
}

/// `point + flow`.
#[inline]
fn moved(point: Point, flow: Point) -> Point {
    core::array::from_fn(|a| point[a] + flow[a])
}

impl<L: Loss> Loss<[Point; 2]> for CycleLoss<L> {
    const COUPLES: bool = L::COUPLES;

    fn prepare(
        &mut self,
        batch: &Batch<'_, [Point; 2]>,
        control: &dyn Control,
    ) -> Result<(), Interrupt> {
        if !L::COUPLES {
            return Ok(());
        }
        let outputs = (batch.outputs)();
        let forward = Batch {
            points: batch.points,
            range: batch.range,
            done: batch.done,
            outputs: &|| outputs.iter().map(|output| output[0]).collect(),
        };
        self.forward.prepare(&forward, control)?;
        let pairs = batch.points.iter().zip(&outputs);
        let deformed: Vec<Point> = pairs
            .map(|(&point, output)| moved(point, output[0]))
            .collect();
        let backward = Batch {
            points: &deformed,
            range: batch.range,
            done: batch.done,
            outputs: &|| outputs.iter().map(|output| output[1].map(|b| -b)).collect(),
        };
        self.backward.prepare(&backward, control)
    }

    fn depends_on_earlier(&self, done: usize) -> bool {
        self.forward.depends_on_earlier(done)
    }

    #[inline]
    fn at(&self, index: usize, point: Point, [flow, back]: [Point; 2]) -> PointLoss<[Point; 2]> {
        let forward = self.forward.at(index, point, flow);
        let backward = self
            .backward
            .at(index, moved(point, flow), back.map(|b| -b));
        PointLoss {
            value: forward.value + backward.value,
            gradient: [
                moved(forward.gradient, backward.gradient),
                backward.gradient.map(|g| -g),
            ],
        }
    }
}
