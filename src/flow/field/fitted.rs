//! A fitted field: the result of a fit, of any model.

use super::linear::LinearField;
use super::network::Network;

/// A field that was fitted to a pair: the displacement as a function of the position, both in
/// metres. With an ego motion the position is a source point after the ego motion, in the target's
/// frame.
#[derive(Clone, Debug)]
pub enum FittedField {
    /// The coordinate network of FNSF Section 3.
    Network(Network),
    /// The linear model of FNSF's comparison.
    Linear(LinearField),
}
