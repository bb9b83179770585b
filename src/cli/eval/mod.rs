//! `fnsf eval`: how good files of flow or of tracks are.

mod buckets;
mod report;
mod run;
mod tracks;

pub(super) use report::truth_of;
pub(super) use run::Eval;
pub(crate) use run::print_score;
