//! Occlusion filter: removes points that are visible only through a nearer surface. A sparse cloud
//! of a car, for instance, has holes through which the background is projected.
//!
//! A pixel is hidden if nearer pixels surround it. One side alone does not count: the road rises to
//! the horizon, and the house beside a car begins at the car's edge.

use rayon::prelude::*;

use super::camera::Camera;
use super::image::DepthImage;

/// Parameters of the occlusion filter, [`DepthImage::without_occluded`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Occlusion {
    /// Search radius, pixels: the window is a square that extends this far to each side of a pixel.
    /// With 0 no pixel has a nearer one. The time grows with the square of the radius.
    pub reach_px: usize,
    /// A pixel of the window counts as nearer if its depth is smaller by more than this fraction of
    /// the central pixel's depth, 0 to 1.
    pub nearer: f32,
    /// Number of the four quadrants of the window, 1 to 4, that must contain a nearer pixel. With 0
    /// every pixel is hidden, with more than 4 none.
    pub quadrants: u32,
}

/// Search radius as an angle, radians. The holes of an accumulated cloud stay below it. It is about
/// twice the spacing of the beams of an HDL-64E.
const REACH_RAD: f64 = 1.0 / 60.0;

/// Maximum search radius, pixels; the time grows with its square.
const MAX_REACH_PX: usize = 16;

impl Occlusion {
    /// Default parameters for clouds of a spinning lidar that are projected into `camera`. The
    /// search radius is 1/60 rad (about one degree) at the focal length `fx`, limited to 2 to 16
    /// pixels. A pixel counts as nearer if its depth is smaller by more than 5%, and all four
    /// quadrants must contain one.
    pub fn of(camera: &Camera) -> Self {
        let reach_px = (camera.intrinsics().fx * REACH_RAD).round() as usize;
        Self {
            reach_px: reach_px.clamp(2, MAX_REACH_PX),
            nearer: 0.05,
            quadrants: 4,
        }
    }
}

impl DepthImage {
    /// The image without hidden pixels: points that were seen through the gaps of a nearer surface.
    /// Their depths are 0 in the result.
    ///
    /// A pixel is hidden if at least [`Occlusion::quadrants`] of the four quadrants around it
    /// contain a nearer pixel. With the default of four, nearer pixels on one side alone do not
    /// hide it. The road therefore keeps its horizon, and a wall its edge beside a car. Runs on the
    /// rayon pool of the calling thread.
    pub fn without_occluded(&self, occlusion: &Occlusion) -> DepthImage {
        let width = (self.width as usize).max(1);
        let metres = (0..self.metres.len()).into_par_iter().map(|index| {
            let depth = self.metres[index];
            let position = [index % width, index / width];
            if depth > 0.0
                && self.nearer_quadrants(position, depth, occlusion) >= occlusion.quadrants
            {
                0.0
            } else {
                depth
            }
        });
        DepthImage {
            width: self.width,
            height: self.height,
            metres: metres.collect(),
        }
    }

    /// Number of quadrants around a pixel that contain a nearer pixel.
    fn nearer_quadrants(&self, [column, row]: [usize; 2], depth: f32, of: &Occlusion) -> u32 {
        let limit = depth * (1.0 - of.nearer);
        let width = (self.width as usize).max(1);
        let height = self.metres.len() / width;
        let window = |middle: usize, side: usize| {
            let end = middle.saturating_add(of.reach_px).saturating_add(1);
            middle.saturating_sub(of.reach_px)..side.min(end)
        };
        let [columns, rows] = [window(column, width), window(row, height)];
        let mut found = [false; 4];
        for y in rows {
            for x in columns.clone() {
                let near = self.metres[y * width + x];
                if near > 0.0 && near < limit {
                    // Each quadrant includes one of the two half axes that bound it.
                    let quadrant = match (x > column, x < column, y > row, y < row) {
                        (true, _, _, false) => 0,
                        (false, _, true, _) => 1,
                        (_, true, false, _) => 2,
                        _ => 3,
                    };
                    found[quadrant] = true;
                }
            }
            if found == [true; 4] {
                break;
            }
        }
        found.into_iter().map(u32::from).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AROUND: Occlusion = Occlusion {
        reach_px: 6,
        nearer: 0.05,
        quadrants: 4,
    };

    /// Depths of a sheet at 10 m with holes onto a background at 30 m in the right half of the
    /// image, and of the background alone in the left.
    fn sheet() -> DepthImage {
        let depth = |index: usize| match (index % 40 >= 20, index % 3) {
            (true, 0) => 10.0,
            _ => 30.0,
        };
        DepthImage {
            width: 40,
            height: 30,
            metres: (0..1200).map(depth).collect(),
        }
    }

    #[test]
    fn what_shines_through_a_sheet_is_dropped_and_what_stands_beside_it_stays() {
        let seen = sheet().without_occluded(&AROUND);
        for (index, (&before, &after)) in sheet().metres.iter().zip(&seen.metres).enumerate() {
            let [column, row] = [index % 40, index / 40];
            let is_inside = (22..38).contains(&column) && (2..28).contains(&row);
            if before == 10.0 || column < 19 {
                assert_eq!(after, before, "{column} {row}");
            } else if is_inside {
                assert_eq!(after, 0.0, "{column} {row}");
            }
        }
    }

    #[test]
    fn a_plane_that_recedes_is_not_hidden_by_its_own_near_part() {
        let metres = (0..1200).map(|index| 720.0 / (1.0 + (29 - index / 40) as f32));
        let plane = DepthImage {
            width: 40,
            height: 30,
            metres: metres.collect(),
        };
        assert_eq!(plane.without_occluded(&AROUND), plane);
    }
}
