//! stub
use super::{FlowError, Options, Problem};
/// stub
#[derive(Clone, Copy, Debug)]
pub struct Price {
    /** s */
    pub source_points: usize,
    /** t */
    pub target_points: usize,
    /** b */
    pub bricks: usize,
    /** b */
    pub bytes: usize,
    /** m */
    pub multiply_adds: f64,
}
/// stub
pub fn price(problem: &Problem, _options: &Options) -> Result<Price, FlowError> {
    Ok(Price {
        source_points: problem.source.len(),
        target_points: problem.target.len(),
        bricks: 0,
        bytes: 0,
        multiply_adds: 5e10,
    })
}
