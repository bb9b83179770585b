//! `fnsf doctor`: what this machine offers, what is missing, and how to mend it.

mod gpus;
mod missing;
mod run;

pub(super) use run::Doctor;
