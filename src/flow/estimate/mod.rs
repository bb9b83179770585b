//! The loop: select, transform, align, then forward, query, backward and Adam until the end.
//!
//! FNSF Section 3: `theta* = argmin mean_p D(p + g(p; theta))`. Sees only the backend's traits.
//! What becomes of it under a deadline is in `deadline.rs`.

mod run;
#[cfg(test)]
mod tests;

pub use run::{Estimate, PhaseSeconds, StopReason, estimate, resume};
