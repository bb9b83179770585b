//! `fnsf eval`: how good files of flow or of tracks are.

mod print;
mod run;
mod tracks;

pub(super) use run::Eval;
pub(crate) use run::print_score;
