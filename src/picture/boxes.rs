//! The boxes of moving clusters, as outlines. A line from each center shows the cluster's velocity.

use super::canvas::{Image, Rgb};
use crate::flow::{Cluster, OrientedBox, Point};

const OUTLINE: Rgb = [255, 214, 102];
/// The time in which a cluster moves along its line, seconds.
const LINE_S: f32 = 1.0;
/// Margin around a cluster's box on each side, metres.
const MARGIN_M: f32 = 0.15;

/// Draws the boxes of the dynamic clusters. `pixel` maps a point, metres, to pixels; lines are
/// `width` pixels wide.
pub(super) fn draw(
    image: &mut Image,
    clusters: &[Cluster],
    pixel: impl Fn(Point) -> [f32; 2],
    width: f32,
) {
    for cluster in clusters.iter().filter(|cluster| cluster.dynamic) {
        let corners = corners(&cluster.bounds).map(&pixel);
        outline(image, corners, width, OUTLINE);
        let center = cluster.bounds.center;
        let velocity = cluster.velocity;
        let there = core::array::from_fn(|a| center[a] + LINE_S * velocity[a]);
        line(image, [pixel(center), pixel(there)], width, OUTLINE);
    }
}

/// Draws the lines between `corners`, pixels, `width` pixels wide.
pub(super) fn outline(image: &mut Image, corners: [[f32; 2]; 4], width: f32, color: Rgb) {
    for (index, &corner) in corners.iter().enumerate() {
        let next = corners[(index + 1) % corners.len()];
        line(image, [corner, next], width, color);
    }
}

/// The corners of a box, with its margin, as seen from above, metres.
pub(super) fn corners(bounds: &OrientedBox) -> [Point; 4] {
    let [x, y, z] = bounds.center;
    let [length, width, _] = bounds.size.map(|side| side / 2.0 + MARGIN_M);
    let (sin, cos) = bounds.yaw.sin_cos();
    [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]].map(|[along, across]| {
        let [a, b] = [along * length, across * width];
        [x + a * cos - b * sin, y + a * sin + b * cos, z]
    })
}

/// A straight line; nothing where an end is not finite or far outside the image.
pub(super) fn line(image: &mut Image, [[x0, y0], [x1, y1]]: [[f32; 2]; 2], width: f32, color: Rgb) {
    /// Longest line that is drawn, pixels: more than the width of any image.
    const LONGEST: f32 = 1e4;
    let length = (x1 - x0).hypot(y1 - y0);
    if !length.is_finite() || length > LONGEST {
        return;
    }
    let steps = length.ceil().max(1.0);
    for step in 0..=steps as u32 {
        let share = step as f32 / steps;
        let at = [x0 + share * (x1 - x0), y0 + share * (y1 - y0)];
        image.disk(at, width / 2.0, color, 0.9);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(dynamic: bool, velocity: Point) -> Image {
        let cluster = Cluster {
            dynamic,
            bounds: OrientedBox {
                center: [50.0, 50.0, 0.0],
                size: [20.0, 10.0, 1.0],
                yaw: std::f32::consts::FRAC_PI_2,
            },
            velocity,
            ..Cluster::default()
        };
        let mut image = Image::filled(100, 100, [0; 3]);
        draw(&mut image, &[cluster], |[x, y, _]| [x, y], 2.0);
        image
    }

    fn is_drawn(image: &Image, x: usize, y: usize) -> bool {
        image.pixels()[y * 100 + x] != [0; 3]
    }

    #[test]
    fn what_moves_has_an_outline_and_a_line_ahead_and_what_stands_has_none() {
        let image = drawn(true, [0.0, 30.0, 0.0]);
        assert!(is_drawn(&image, 55, 50) && is_drawn(&image, 50, 60));
        assert!(is_drawn(&image, 50, 78) && !is_drawn(&image, 50, 84));
        assert!(!is_drawn(&image, 53, 45));
        let still = drawn(false, [0.0, 3.0, 0.0]);
        assert!(still.pixels().iter().all(|pixel| *pixel == [0; 3]));
    }

    #[test]
    fn motions_out_of_this_world_draw_no_line() {
        let image = drawn(true, [f32::MAX, f32::NAN, 0.0]);
        assert!(is_drawn(&image, 55, 50) && !is_drawn(&image, 70, 50));
    }
}
