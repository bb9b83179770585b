//! Points seen through a nearer surface: behind a car, between the points that were measured on it.
//!
//! A pixel is hidden where nearer ones stand all around it. One side alone does not count: the
//! road rises to the horizon, and the house beside the car begins at its edge.

use super::camera::Camera;
use super::image::DepthImage;
use rayon::prelude::*;

/// When a pixel counts as hidden.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Occlusion {
    /// How far around a pixel is looked, pixels.
    pub reach_px: usize,
    /// A neighbor hides a pixel only where it is nearer by this part of the pixel's depth.
    pub nearer: f32,
    /// Of the four quadrants around a pixel, how many must hold one that is nearer, 1 to 4.
    pub quadrants: u32,
}

/// Angle that the gaps of an accumulated cloud stay below, radians: two lasers of an HDL-64E.
const REACH_RAD: f64 = 1.0 / 60.0;

/// Farthest that is looked around a pixel: time grows with its square.
const MAX_REACH_PX: usize = 16;

impl Occlusion {
    /// What suits clouds of a spinning lidar seen through this camera: all around, one degree far.
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
    /// The image without the pixels that are hidden.
    pub fn without_hidden(&self, occlusion: &Occlusion) -> DepthImage {
        let width = (self.width as usize).max(1);
        let metres = (0..self.metres.len()).into_par_iter().map(|index| {
            let depth = self.metres[index];
            let place = [index % width, index / width];
            if depth > 0.0 && self.nearer_quadrants(place, depth, occlusion) >= occlusion.quadrants
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

    /// Number of quadrants around a pixel with a depth that is nearer than its own.
    fn nearer_quadrants(&self, [column, row]: [usize; 2], depth: f32, of: &Occlusion) -> u32 {
        let limit = depth * (1.0 - of.nearer);
        let width = (self.width as usize).max(1);
        let height = self.metres.len() / width;
        let around = |middle: usize, side: usize| {
            let end = middle.saturating_add(of.reach_px).saturating_add(1);
            middle.saturating_sub(of.reach_px)..side.min(end)
        };
        let [columns, rows] = [around(column, width), around(row, height)];
        let mut found = [false; 4];
        for y in rows {
            for x in columns.clone() {
                let near = self.metres[y * width + x];
                if near > 0.0 && near < limit {
                    // Each quadrant has one of the four half axes that bound it.
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

    /// Depths of a checkered sheet of `near` with `far` in its gaps on the right half, `far` alone
    /// on the left.
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
        let seen = sheet().without_hidden(&AROUND);
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
        assert_eq!(plane.without_hidden(&AROUND), plane);
    }
}
