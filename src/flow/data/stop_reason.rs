//! Why a method ended.

/// The reason why a method ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// The object search covered all clusters.
    Completed,
    /// The early-stopping rule ended the fit.
    Converged,
    /// The fit did its maximum number of iterations.
    MaxIterations,
    /// The deadline ended, shortened or prevented a part of the method: points of the registration,
    /// deskewing, neighbor sweeps, clusters, iterations or rows. The flow is the best that the time allowed.
    /// With every other reason, the flow of a pair by itself is the one without a deadline.
    Deadline,
}

impl StopReason {
    /// All reasons.
    pub const ALL: [Self; 4] = [
        Self::Completed,
        Self::Converged,
        Self::MaxIterations,
        Self::Deadline,
    ];

    /// The name used in reports: `completed`, `converged`, `max_iterations` or `deadline`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::Converged => "converged",
            Self::MaxIterations => "max_iterations",
            Self::Deadline => "deadline",
        }
    }
}
