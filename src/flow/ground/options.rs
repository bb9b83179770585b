//! Options of the ground segmentation and their defaults.

/// Tolerances of the ground segmentation, relative to the fitted surface of the ground.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundOptions {
    /// Upper tolerance at the origin, metres: points less than this above the surface are ground.
    /// Choose it below the height of objects on the ground and above the noise of the lidar.
    pub height_m: f32,
    /// Growth of the upper tolerance with horizontal range, metres per metre. Beyond a range of 40
    /// m the tolerance stays constant.
    pub height_slope: f32,
    /// Lower tolerance, metres: points this much or more below the surface are not ground. They are
    /// taken for mirror images.
    pub depth_m: f32,
    /// Least share, 0 to 1, of the occupied 1 m x 1 m columns within 40 m that must be flat and on
    /// the surface. Below it, or with fewer than 16 such columns, the sweep has no ground: the
    /// ground was removed beforehand, or there are only walls.
    pub min_share: f32,
}

impl Default for GroundOptions {
    fn default() -> Self {
        Self {
            height_m: 0.1,
            height_slope: 0.005,
            depth_m: 0.5,
            min_share: 0.2,
        }
    }
}
