//! The smallest upright bounding box of a set of points.
//!
//! One side of the rectangle of least area around a set of points lies on an edge of its convex
//! hull (Freeman and Shapira 1975).

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::point::Point;

/// Most edges of a hull that are tried.
const MOST_EDGES: usize = 256;

/// The upright bounding box of a set of points, rotated about the z axis only.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OrientedBox {
    /// Center of the box, metres.
    pub center: Point,
    /// Length along `yaw`, width across it, and height along z, metres. The length is the longer
    /// side, except in a box that is aligned with a motion. Zero along an axis without extent.
    pub size: Point,
    /// Angle from the x axis to the direction of the length, radians, counterclockwise, in (-pi,
    /// pi]. It is between -pi/2 and pi/2 in a box that is not aligned with a motion.
    pub yaw: f32,
}

impl OrientedBox {
    /// The box around `points` (at least one), metres. If the points move by `way` (x, y), the
    /// length is along the side whose direction is nearest to it. Otherwise the length is the
    /// longer side, in the direction nearest to +x.
    pub(crate) fn enclosing(points: &[Point], way: Option<[f32; 2]>) -> Self {
        let level: Vec<[f64; 2]> = points.iter().map(|p| [p[0], p[1]].map(f64::from)).collect();
        let hull = hull(level);
        // A hull with more corners is nearly round, so every n-th edge suffices.
        let apart = hull.len().div_ceil(MOST_EDGES).max(1);
        let edges = (0..hull.len()).step_by(apart).map(|i| {
            let ([a, b], [c, d]) = (hull[i], hull[(i + 1) % hull.len()]);
            (d - b).atan2(c - a)
        });
        let rectangles = edges.map(|yaw| Rectangle::along(yaw, &hull));
        let least = rectangles.min_by(|a, b| a.area().total_cmp(&b.area()));
        let mut found = least.unwrap_or_else(|| Rectangle::along(0.0, &hull));
        let wanted = way.map_or(0.0, |[x, y]| y.atan2(x));
        if way.is_none() && found.size[1] > found.size[0] {
            found = Rectangle::along(found.yaw + std::f64::consts::FRAC_PI_2, &hull);
        }
        // The allowed direction nearest to the wanted one.
        let step = if way.is_some() { FRAC_PI_2 } else { PI };
        let yaw = found.yaw as f32;
        let yaw = yaw + ((wanted - yaw) / step).round() * step;
        let yaw = if yaw > PI {
            yaw - TAU
        } else if yaw <= -PI {
            yaw + TAU
        } else {
            yaw
        };
        let found = Rectangle::along(f64::from(yaw), &hull);
        let heights = || points.iter().map(|point| point[2]);
        let (low, high) = (
            heights().fold(f32::INFINITY, f32::min),
            heights().fold(f32::NEG_INFINITY, f32::max),
        );
        let [x, y] = found.center.map(|c| c as f32);
        let [length, width] = found.size.map(|c| c as f32);
        Self {
            center: [x, y, low.midpoint(high)],
            size: [length, width, high - low],
            yaw,
        }
    }
}

/// A rectangle with the direction of its length.
struct Rectangle {
    yaw: f64,
    center: [f64; 2],
    size: [f64; 2],
}

impl Rectangle {
    /// The smallest rectangle of direction `yaw` around `points`.
    fn along(yaw: f64, points: &[[f64; 2]]) -> Self {
        let (sin, cos) = yaw.sin_cos();
        let mut ends = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for &[x, y] in points {
            let turned = [x * cos + y * sin, y * cos - x * sin];
            for ([low, high], value) in ends.iter_mut().zip(turned) {
                (*low, *high) = (low.min(value), high.max(value));
            }
        }
        let [a, b] = ends.map(|[low, high]| low.midpoint(high));
        Self {
            yaw,
            center: [a * cos - b * sin, a * sin + b * cos],
            size: ends.map(|[low, high]| high - low),
        }
    }

    fn area(&self) -> f64 {
        self.size[0] * self.size[1]
    }
}

/// The points that may be corners of the convex hull: without those inside the octagon of the
/// outermost points along both axes and both diagonals (Akl and Toussaint 1978).
fn outer(points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    /// Up to this many points, sorting all of them costs less.
    const FEW: usize = 64;
    /// A point is inside if it is at least this share of the extent from every edge: far above the
    /// rounding of a cross product.
    const INSIDE: f64 = 1e-9;
    if points.len() <= FEW {
        return points;
    }
    let directions: [[f64; 2]; 8] = [
        [1.0, 0.0],
        [1.0, 1.0],
        [0.0, 1.0],
        [-1.0, 1.0],
        [-1.0, 0.0],
        [-1.0, -1.0],
        [0.0, -1.0],
        [1.0, -1.0],
    ];
    let mut corners = [points[0]; 8];
    let mut farthest = [f64::NEG_INFINITY; 8];
    for &point in &points {
        for (axis, [x, y]) in directions.into_iter().enumerate() {
            let along = x * point[0] + y * point[1];
            if along > farthest[axis] {
                (farthest[axis], corners[axis]) = (along, point);
            }
        }
    }
    let edges: [[[f64; 2]; 2]; 8] = core::array::from_fn(|i| [corners[i], corners[(i + 1) % 8]]);
    let extent = (farthest[0] + farthest[4]).max(farthest[2] + farthest[6]);
    if extent == 0.0 {
        return points;
    }
    let margin = INSIDE * extent * extent;
    let is_outer = |&point: &[f64; 2]| {
        let is_beyond = |&[a, b]: &[[f64; 2]; 2]| a != b && cross(a, b, point) <= margin;
        edges.iter().any(is_beyond)
    };
    points.into_iter().filter(is_outer).collect()
}

/// Twice the area of a triangle, positive if it is counterclockwise.
fn cross(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// The corners of the convex hull, counterclockwise (Andrew 1979). Fewer than three distinct points
/// are returned as they are.
fn hull(points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    let mut points = outer(points);
    points.sort_unstable_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = Vec::new();
        for point in points {
            while let [.., a, b] = chain[..]
                && cross(a, b, point) <= 0.0
            {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut corners = chain(&mut points.iter().copied());
    corners.extend(chain(&mut points.iter().rev().copied()));
    corners
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::rng::Random;

    /// Points of a car at (20, -5), 4 m long and 1.8 m wide, rotated by `yaw`.
    fn car(yaw: f64) -> Vec<Point> {
        let mut random = Random::new(6);
        let mut point = || {
            let [a, b, z] = [4.0, 1.8, 1.5].map(|side| random.uniform(-0.5, 0.5) * side);
            let (sin, cos) = yaw.sin_cos();
            [20.0 + a * cos - b * sin, -5.0 + a * sin + b * cos, z].map(|c| c as f32)
        };
        (0..4000).map(|_| point()).collect()
    }

    fn close(a: f32, b: f32, tolerance: f32) -> bool {
        (a - b).abs() < tolerance
    }

    #[test]
    fn a_box_is_the_car_that_it_is_around() {
        // 4,000 random points leave a margin of a few centimetres along every side.
        const FREE_M: f32 = 0.1;
        const TURN: f32 = 0.03;
        for yaw in [0.0, 0.4, -1.2] {
            let bounds = OrientedBox::enclosing(&car(yaw), None);
            for (found, true_) in bounds.center.iter().zip([20.0, -5.0, 0.0]) {
                assert!(close(*found, true_, FREE_M), "{bounds:?}");
            }
            for (found, true_) in bounds.size.iter().zip([4.0, 1.8, 1.5]) {
                assert!(close(*found, true_, FREE_M), "{bounds:?}");
            }
            assert!(close(bounds.yaw, yaw as f32, TURN), "{bounds:?}");
        }
    }

    #[test]
    fn a_box_of_what_moves_points_where_it_goes() {
        const TURN: f32 = 0.03;
        let backward = OrientedBox::enclosing(&car(0.4), Some([-1.0, -0.35]));
        assert!(close(backward.yaw, 0.4 - PI, TURN), "{backward:?}");
        assert!(backward.size[0] > backward.size[1]);
        for yaw in [0.15, -0.15] {
            let bounds = OrientedBox::enclosing(&car(yaw), Some([-1.0, 0.0]));
            let expected = yaw as f32 - PI * (yaw as f32).signum();
            assert!(close(bounds.yaw, expected, TURN), "{bounds:?}");
        }
        let sideways = OrientedBox::enclosing(&car(0.4), Some([-0.35, 1.0]));
        assert!(close(sideways.yaw, 0.4 + FRAC_PI_2, TURN), "{sideways:?}");
        assert!(sideways.size[0] < sideways.size[1]);
    }

    #[test]
    fn a_ring_of_any_number_of_points_has_the_box_of_a_circle() {
        const ROUND: f32 = 1e-3;
        let point = |i: u32| {
            let (sin, cos) = (f64::from(i) * 1e-5 * std::f64::consts::TAU).sin_cos();
            [3.0 * cos, 3.0 * sin, 0.0].map(|c| c as f32)
        };
        let ring: Vec<Point> = (0..100_000).map(point).collect();
        let [length, width, _] = OrientedBox::enclosing(&ring, None).size;
        assert!(close(length, 6.0, ROUND) && close(width, 6.0, ROUND));
    }

    #[test]
    fn few_points_and_points_on_a_line_have_boxes_too() {
        let one = OrientedBox::enclosing(&[[1.0, 2.0, 3.0]], None);
        assert_eq!((one.center, one.size), ([1.0, 2.0, 3.0], [0.0; 3]));
        for count in [5, 500] {
            let same = OrientedBox::enclosing(&vec![[1.0, 2.0, 3.0]; count], None);
            assert_eq!(same, one);
            let along = |i: usize| i as f32 * 4.0 / (count - 1) as f32;
            let line: Vec<Point> = (0..count).map(|i| [along(i), along(i), 0.0]).collect();
            let line = OrientedBox::enclosing(&line, None);
            assert!(close(line.size[0], 4.0 * 2.0_f32.sqrt(), 1e-5), "{line:?}");
            assert!(close(line.size[1], 0.0, 1e-5), "{line:?}");
            assert!(close(line.yaw, PI / 4.0, 1e-5), "{line:?}");
        }
    }

    #[test]
    fn points_within_the_octagon_are_no_corners_and_no_corner_is_left_out() {
        let mut random = Random::new(8);
        for count in [3, 65, 400, 5000] {
            let mut coordinate = || random.uniform(-50.0, 50.0);
            let points: Vec<[f64; 2]> = (0..count).map(|_| [coordinate(), coordinate()]).collect();
            let corners = hull(points.clone());
            // All points lie to the left of every edge.
            for (i, &a) in corners.iter().enumerate() {
                let b = corners[(i + 1) % corners.len()];
                assert!(points.iter().all(|&point| cross(a, b, point) >= 0.0));
            }
            let left = outer(points).len();
            assert!(left >= corners.len() && (count < 400 || left < count / 2));
        }
    }
}
