//! Options of the object search.

/// Options of the object search, which estimates a rigid motion for each cluster of the source.
///
/// The stages, in order: DBSCAN clustering, voxel downsampling, Hough voting over translations for
/// initial guesses, a Gauss-Newton fit of a planar motion, acceptance tests, and the assignment of
/// motions to small clusters and single points beside moving objects. All distances are measured
/// after the ego motion has been taken out. `docs/experiments/objects.md` measures the effect of
/// the choices.
#[derive(Clone, Debug, PartialEq)]
pub struct ObjectOptions {
    /// DBSCAN radius, metres, above zero. Points this close to a core point join its cluster.
    /// Larger values merge neighboring objects, smaller ones split sparse objects.
    pub cluster_radius_m: f32,
    /// Least number of points within `cluster_radius_m`, the point itself included, that make a
    /// point a DBSCAN core point. Raising it turns sparse points into noise. Clusters with fewer
    /// voxel-downsampled points get no motion search.
    pub cluster_min_points: usize,
    /// Voxel size of the downsampling of all clouds, metres, above zero. One point per voxel is
    /// kept. Larger values are faster and coarser.
    pub voxel_m: f32,
    /// Radius of the neighborhood of a target normal: `[base, slope]`, metres and metres per metre
    /// of horizontal range. It is limited to `match_m`. Larger values give normals to sparser
    /// points and smooth small surfaces.
    pub normal_m: [f32; 2],
    /// Factor on height differences in nearest-neighbor searches, and in the distance to a target
    /// point except along its normal. Below 1, because the rings of a lidar are farther apart than
    /// the samples along a ring.
    pub height_weight: f32,
    /// Radius of the nearest-neighbor search, metres, with heights scaled by `height_weight`. A
    /// point without a target point within this radius costs `truncation_m`. A cluster or point is
    /// adjacent to a moving object if they are this close.
    pub match_m: f32,
    /// Static match distance, metres, with heights scaled by `height_weight`. It must be at most
    /// `match_m`. A cluster counts as clearly static if at least nine in ten of its points are this
    /// close to the target. Target points this close to such a cluster belong to it, and no other
    /// cluster is matched to them. Larger values exclude more of the target.
    pub static_match_m: f32,
    /// Weight of the full offset `d` to a target point, relative to its component along the normal
    /// `n`. The distance is `sqrt((n.d)^2 + (tangential_weight * |d|)^2)`, with heights in `|d|`
    /// scaled by `height_weight`. It is `|d|` where there is no normal. 0 is point to plane; larger
    /// values constrain sliding along a surface more.
    pub tangential_weight: f32,
    /// Truncation of the distance of a point to its match, metres. It limits the cost of points
    /// without a counterpart, such as occluded ones.
    pub truncation_m: f32,
    /// Largest displacement along x and along y in the Hough voting, metres per sweep interval. It
    /// limits the speed of the objects that can be found. The accumulator grows with its square.
    pub max_displacement_m: f32,
    /// Bin size of the Hough voting over translations, metres, above zero. Points vote if their
    /// heights differ by at most 1.5 bins.
    pub bin_m: f32,
    /// Number of initial guesses taken from the peaks of the Hough voting, besides zero motion. The
    /// two of least cost are fitted. Larger values cost time.
    pub initial_guesses: usize,
    /// The Hough voting is skipped if the fit from zero motion brings the mean distance of the
    /// cluster to the target below this, metres. Larger values save time and may miss a better
    /// motion.
    pub close_fit_m: f32,
    /// Penalty of the displacement when initial guesses and their fits are compared, metres of cost
    /// per metre. Larger values prefer shorter motions.
    pub displacement_penalty: f32,
    /// A cluster is static, and its search is skipped, if its mean distance to the target without
    /// motion is below this, metres. Larger values save time and miss slow objects.
    pub static_fit_m: f32,
    /// Acceptance: minimum displacement of the cluster's center, metres per sweep interval.
    /// Clusters with a shorter motion are static.
    pub min_motion_m: f32,
    /// Acceptance: minimum decrease of the cluster's mean distance to the target, metres. The
    /// search also ends early where no fit reaches it.
    pub min_gain_m: f32,
    /// Acceptance: maximum ratio of the cost with the motion to the cost without it. The cost is
    /// the mean distance of the cluster to the target plus that of the target around it to the
    /// cluster, averaged with the neighbor sweeps. Smaller values are stricter.
    pub max_cost_ratio: f32,
    /// Acceptance: minimum evidence of a motion, metres times points. The evidence is the decrease
    /// of the cost, summed over the pair and the neighbor sweeps, times the number of
    /// voxel-downsampled points of the cluster. Larger values reject small clusters.
    pub min_evidence_m: f32,
    /// Additional minimum evidence per metre of displacement, metres times points per metre. A
    /// longer displacement has more surfaces that it can match by mistake.
    pub min_evidence_slope: f32,
    /// Acceptance: maximum mean distance of the moved cluster to the target, metres. A neighbor
    /// sweep contributes evidence only if the mean distance of the cluster to it, moved or not, is
    /// at most this.
    pub max_residual_m: f32,
    /// Acceptance: minimum observability, the mean square of the matched normals' component along
    /// the motion, 0 to 1. A wall that slides in its own plane has 0. A target point without a
    /// normal counts 1/3. Free-space or neighbor evidence can replace it. Larger values reject more
    /// sliding surfaces.
    pub min_observability: f32,
    /// Normal motion that replaces `min_observability`, metres: minimum root mean square of the
    /// displacement of the cluster's surfaces along their normals. It is also required of a motion
    /// whose translation alone does not reach `min_gain_m`. It finds the flat side of a vehicle that
    /// turns. Ignored where free-space evidence says that the cluster stayed. Larger values reject
    /// more.
    pub min_normal_motion_m: f32,
    /// Free-space evidence that replaces `min_observability`, 0 to 1. It is the minimum share of
    /// the vacated positions that rays of the target passed through, and also of the newly occupied
    /// positions that rays of the source passed through. Larger values demand more evidence.
    pub min_free_space: f32,
    /// Minimum sum of the two shares of free-space evidence, 0 to 2. Below it, a motion of at least
    /// 0.4 m plus 0.02 m per metre of range is rejected. A shorter one is rejected if only neighbor
    /// evidence replaces the observability. Ignored where one of the shares is unknown. Larger
    /// values reject more.
    pub min_free_space_far: f32,
    /// Assignment: maximum ratio of the cost with the motion of an adjacent moving object to the
    /// cost without it. A noise point below this ratio gets that motion, and so does a cluster
    /// without a motion if the object is larger. Larger values let moving objects absorb more.
    pub adjacent_cost_ratio: f32,
    /// Assignment: a point of a moving object becomes static if the motion increases its distance
    /// to the target by more than this, metres. The increase is averaged over the points of its
    /// cluster within 0.3 m. Larger values keep more points.
    pub point_reject_m: f32,
    /// Acceptance: number of voxel-downsampled points from which a cluster thinner than
    /// `ground_thickness_m` is rejected as ground that the segmentation missed.
    pub ground_min_points: usize,
    /// Acceptance: minimum height range, metres, between the 5th and the 95th percentile of a
    /// cluster with `ground_min_points` points or more. Larger values reject more flat clusters.
    pub ground_thickness_m: f32,
    /// Number of sweeps in the window: the pair's two, and neighbor sweeps as far as the sequence
    /// has them. Values below 2 count as 2. More sweeps give more evidence, cost time, and delay
    /// the result in a sequence. Without an ego motion no neighbor sweeps are used.
    pub sweeps: usize,
    /// Neighbor evidence that replaces `min_observability`: maximum ratio of the cost with the
    /// motion to the cost without it. It must hold in the neighbor sweep nearest in time, and in
    /// all neighbor sweeps together. Smaller values are stricter.
    pub neighbor_cost_ratio: f32,
    /// Neighbor evidence: minimum decrease of the cost by the motion, metres. The cost is the
    /// distance from the cluster to the sweep plus that back. The decrease must reach it in the
    /// nearest sweep, and in the weighted mean of all neighbor sweeps. Larger values are stricter.
    pub neighbor_gain_m: f32,
    /// Neighbor evidence of a slow object, which also replaces `min_gain_m` and, where the target
    /// does not show the object, `max_residual_m`: maximum ratio of the mean distance of the cluster
    /// from the neighbor sweeps with the motion to that without it. Each sweep has the same weight,
    /// and none may contradict the motion. Smaller values are stricter.
    pub slow_cost_ratio: f32,
    /// Neighbor evidence of a slow object: minimum decrease of that distance by the motion, metres.
    /// Larger values are stricter.
    pub slow_gain_m: f32,
}

impl Default for ObjectOptions {
    fn default() -> Self {
        Self {
            cluster_radius_m: 0.5,
            cluster_min_points: 4,
            voxel_m: 0.1,
            normal_m: [0.15, 0.01],
            height_weight: 0.7,
            match_m: 0.7,
            static_match_m: 0.15,
            tangential_weight: 0.2,
            truncation_m: 0.3,
            max_displacement_m: 3.5,
            bin_m: 0.15,
            initial_guesses: 6,
            close_fit_m: 0.05,
            displacement_penalty: 0.05,
            static_fit_m: 0.03,
            min_motion_m: 0.05,
            min_gain_m: 0.015,
            max_cost_ratio: 0.65,
            min_evidence_m: 1.0,
            min_evidence_slope: 3.0,
            max_residual_m: 0.15,
            min_observability: 0.1,
            min_normal_motion_m: 0.08,
            min_free_space: 0.7,
            min_free_space_far: 0.3,
            adjacent_cost_ratio: 0.7,
            point_reject_m: 0.05,
            ground_min_points: 30,
            ground_thickness_m: 0.2,
            sweeps: 2,
            neighbor_cost_ratio: 0.7,
            neighbor_gain_m: 0.05,
            slow_cost_ratio: 0.5,
            slow_gain_m: 0.03,
        }
    }
}
