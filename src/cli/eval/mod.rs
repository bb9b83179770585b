//! `fnsf eval`: how good flow files are.

mod report;
mod run;

pub(super) use report::truth_of;
pub(super) use run::Eval;
pub(crate) use run::print_score;
