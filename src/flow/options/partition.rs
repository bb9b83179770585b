//! Options of a partition of the source into clusters, each with a field of its own.

/// A partition as in NSFP++ (Najibi et al., ECCV 2022), by the public code that FNSF compared itself
/// with: each DBSCAN cluster of the source is fitted to the target points around it. Points outside
/// every cluster are static.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartitionOptions {
    /// Radius of DBSCAN, metres.
    pub radius_m: f32,
    /// Least number of points within the radius of a core point, itself included.
    pub min_points: usize,
    /// By how much a cluster's box in x and y grows on each side of its longer edge, metres. The
    /// shorter edge grows in proportion. Target points within the grown box are the candidates;
    /// those nearest to the cluster's center are taken, one fewer than the cluster has points.
    pub expansion_m: f32,
}

impl PartitionOptions {
    /// The settings of that code.
    pub fn published() -> Self {
        Self {
            radius_m: 0.8,
            min_points: 30,
            expansion_m: 2.5,
        }
    }
}
