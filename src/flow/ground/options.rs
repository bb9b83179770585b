//! What counts as ground, and the defaults. It must not know how the surface is found.

/// How near the fitted surface a point must lie to be ground.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundOptions {
    /// Points up to this above the surface are ground, metres, at the origin: less than things that
    /// stand on it, more than the noise of a lidar.
    pub height_m: f32,
    /// `height_m` grows with range by this, metres a metre: rings lie farther apart, and the
    /// surface between them is less certain. It stops growing at 40 m.
    pub height_slope: f32,
    /// Points deeper than this below the surface are mirror images, not ground, metres.
    pub depth_m: f32,
    /// Least share, 0 to 1, of the square metres with points, within 40 m, that have to be flat and
    /// on the surface. Below it the sweep has no ground: it was taken off, or there are only walls.
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
