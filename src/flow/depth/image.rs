//! Depth images, and the projection of a cloud into one.

use super::camera::Camera;
use crate::flow::data::Point;

/// A depth image of `width` x `height` pixels. Depths are measured along the optical axis, not
/// along the pixels' rays.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// `width * height` depths, metres, row by row from the top, each row from the left; 0 if
    /// unknown.
    pub metres: Vec<f32>,
}

impl DepthImage {
    /// An image of `width` x `height` pixels whose depths are all unknown.
    pub fn empty(width: u32, height: u32) -> Self {
        Self {
            width,
            height,
            metres: vec![0.0; width as usize * height as usize],
        }
    }

    /// Number of pixels with a depth.
    pub fn known(&self) -> usize {
        self.metres.iter().filter(|&&metres| metres > 0.0).count()
    }

    /// Share of all pixels that have a depth, 0 to 1; 0 for an image without pixels.
    pub fn density(&self) -> f64 {
        self.known() as f64 / self.metres.len().max(1) as f64
    }
}

/// Projects points of the lidar's frame (N x 3, metres) into the camera. Each pixel keeps the
/// smallest depth of the points that fall on it, and is 0 where none does. A point is left out if
/// it is not finite, outside the image, behind the camera, or less than 0.1 m in front of it.
pub fn project(points: &[Point], camera: &Camera) -> DepthImage {
    let mut image = DepthImage::empty(camera.width(), camera.height());
    let width = camera.width() as usize;
    for &point in points {
        let Some((column, row, depth)) = camera.pixel(point) else {
            continue;
        };
        let nearest = &mut image.metres[row * width + column];
        if *nearest == 0.0 || depth < *nearest {
            *nearest = depth;
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::RigidTransform;
    use crate::flow::depth::camera::Intrinsics;

    fn camera() -> Camera {
        let intrinsics = Intrinsics {
            fx: 10.0,
            fy: 10.0,
            cx: 2.0,
            cy: 1.0,
        };
        Camera::new(intrinsics, RigidTransform::identity(), [5, 3]).unwrap()
    }

    #[test]
    fn the_nearest_point_of_a_pixel_wins_in_any_order() {
        let points = [[0.0, 0.0, 9.0], [0.0, 0.0, 4.0], [0.0, 0.0, 6.0]];
        let image = project(&points, &camera());
        assert_eq!(image.metres[5 + 2], 4.0);
        assert_eq!((image.known(), image.density()), (1, 1.0 / 15.0));
        let turned = points.iter().rev().copied().collect::<Vec<_>>();
        assert_eq!(project(&turned, &camera()), image);
    }

    #[test]
    fn what_is_not_in_view_leaves_no_depth() {
        let points = [[0.0, 0.0, -4.0], [f32::NAN; 3], [90.0, 0.0, 4.0]];
        assert_eq!(project(&points, &camera()), DepthImage::empty(5, 3));
    }
}
