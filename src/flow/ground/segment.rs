//! Ground segmentation: columns, a height field fitted under them from coarse to fine, and the
//! points near it.
//!
//! Only x, y and z of the points are used.

use nalgebra::{Matrix3, Vector3};

use super::columns::{Column, Columns, TILE_M};
use super::options::GroundOptions;
use super::surface::HeightField;
use crate::flow::data::Point;

/// Distance between the nodes of the finest height field, metres.
const FINEST_M: f32 = 1.0;
/// Corrections of the height field per level.
const ROUNDS: usize = 3;
/// Tolerance at the coarsest level, metres per metre of node distance: how far columns may lie from
/// the ground's height around the vehicle. It allows for a tilted sweep.
const TILT: f32 = 0.2;
/// The same at a finer level, from the coarser level's surface. It allows for curved ground.
const BEND: f32 = 0.1;
/// Added to both tolerances, metres: the height of a kerb.
const STEP_M: f32 = 0.2;
/// A column this share of the tolerance above the surface weighs 1/e of a column on it: lower
/// points are more likely ground.
const FADING: f32 = 0.4;
/// Total weight of the columns at a node from which they pull it fully.
const FULL: f32 = 8.0;
/// The last correction uses all points within this distance of the surface, metres. Their mean is
/// the height of the ground, whereas the lowest points are biased by noise.
const MEAN_M: f32 = 0.15;
/// Total weight of the points at a node from which they pull it fully in the last correction.
const FULL_POINTS: f32 = 4.0;
/// Radius around the origin within which the initial height of the ground is estimated, metres.
const AROUND_M: f32 = 20.0;
/// Quantile of the columns' lowest points that is this height: below walls and cars, above
/// reflections.
const LOW_QUANTILE: f32 = 0.15;
/// Radius around the origin within which the plane under the vehicle is fitted, metres.
const STAND_M: f32 = 8.0;
/// Range up to which the tolerance of a point grows, metres.
const GROWTH_M: f32 = 40.0;
/// Radius around the origin within which flat columns are evidence of ground, metres.
const EVIDENCE_M: f32 = 40.0;
/// Least number of flat columns; each is 1 square metre.
const EVIDENCE_COLUMNS: usize = 16;
/// Flatness above which a column is flat: the share of its low points in its lowest layer.
const FLAT: f32 = 0.7;

/// The ground of one sweep.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GroundSegmentation {
    /// N flags: true for points on the ground.
    pub ground: Vec<bool>,
    /// Height of the frame's origin above the ground below it, metres. It is the lidar's height if
    /// the origin is at the lidar, and near zero if the origin is on the road. None if no ground
    /// was found.
    pub origin_height_m: Option<f32>,
}

/// Segments the ground of one sweep: N finite points, metres, x forward, y left, z up to within
/// some degrees, with the vehicle near the origin.
///
/// Points that are not finite must be removed first, because they can falsify the flags of others.
/// The flag of a point does not depend on the order of the points. Points at `|x|` or `|y|` of 128
/// m or more are never ground. Without sufficient evidence no point is ground: fewer than 16 flat
/// columns of 1 m x 1 m within 40 m, or a smaller share of them than [`GroundOptions::min_share`].
pub fn segment(points: &[Point], options: &GroundOptions) -> GroundSegmentation {
    let columns = Columns::new(points);
    let surface = fit(&columns);
    if !has_ground(&columns, &surface, options) {
        return GroundSegmentation {
            ground: vec![false; points.len()],
            origin_height_m: None,
        };
    }
    let is_ground = |point: &Point| {
        let above = surface.above(point);
        columns.contains(point) && -options.depth_m < above && {
            let range = point[0].hypot(point[1]).min(GROWTH_M);
            above < options.height_m + options.height_slope * range
        }
    };
    GroundSegmentation {
        ground: points.iter().map(is_ground).collect(),
        origin_height_m: Some(origin_height(&columns, &surface)),
    }
}

/// Fits the height field under the columns, coarse to fine. Each level uses only the columns near
/// the surface so far.
fn fit(columns: &Columns) -> HeightField {
    let mut surface = HeightField::level(columns.half_m, TILE_M, median_height(columns));
    let mut slope = TILT;
    loop {
        let step = surface.step_m();
        let tolerance = slope * step + STEP_M;
        let trust = |above: f32| {
            if above.abs() < tolerance {
                (-above.max(0.0) / (FADING * tolerance)).exp()
            } else {
                0.0
            }
        };
        let full = (step * step).min(FULL);
        for _ in 0..ROUNDS {
            let lowest = columns.columns.iter();
            let lowest = lowest.map(|column| (&column.low, column.weight()));
            surface.pull(lowest, trust, full);
        }
        if step <= FINEST_M {
            break;
        }
        surface = surface.refined();
        slope = BEND;
    }
    let all = columns.columns.iter().flat_map(|column| {
        let points = columns.points[column.rows.clone()].iter();
        points.map(|point| (point, column.weight()))
    });
    let near = |above: f32| f32::from(u8::from(above.abs() < MEAN_M));
    surface.pull(all, near, FULL_POINTS);
    surface
}

/// Approximate height of the ground around the vehicle, metres; 0 where no column is within 20 m.
fn median_height(columns: &Columns) -> f32 {
    let near = columns.columns.iter().map(|column| column.low);
    let near = near.filter(|low| low[0].hypot(low[1]) < AROUND_M);
    let mut heights: Vec<f32> = near.map(|low| low[2]).collect();
    let index = (heights.len() as f32 * LOW_QUANTILE) as usize;
    if index >= heights.len() {
        return 0.0;
    }
    *heights.select_nth_unstable_by(index, f32::total_cmp).1
}

/// Whether enough columns are flat and lie on the surface. Without ground the surface lies under
/// the lowest points present, such as walls and car bodies, which are not flat.
fn has_ground(columns: &Columns, surface: &HeightField, options: &GroundOptions) -> bool {
    let near = columns.columns.iter();
    let near = near.filter(|column| column.low[0].hypot(column.low[1]) < EVIDENCE_M);
    let mut seen = 0_usize;
    let mut flat = 0_usize;
    for column in near {
        seen += 1;
        flat += usize::from(lies_flat(column, surface));
    }
    flat >= EVIDENCE_COLUMNS && flat as f32 >= options.min_share * seen as f32
}

/// Height of the origin above the plane through the ground around it, metres. The height field is
/// only interpolated under the vehicle, where no ray falls.
fn origin_height(columns: &Columns, surface: &HeightField) -> f32 {
    let near = columns.columns.iter().filter(|column| {
        column.low[0].hypot(column.low[1]) < STAND_M && lies_flat(column, surface)
    });
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for column in near {
        for point in &columns.points[column.rows.clone()] {
            if surface.above(point).abs() < MEAN_M {
                let [x, y, z] = point.map(f64::from);
                let row = Vector3::new(x, y, 1.0);
                normal += row * row.transpose();
                right += row * z;
            }
        }
    }
    // Points on one side only do not determine the height at the origin better than the surface
    // does.
    let solved = normal
        .cholesky()
        .map(|factors| factors.solve(&right)[2] as f32);
    let height = solved.filter(|height| (height - surface.height_at(0.0, 0.0)).abs() < MEAN_M);
    -height.unwrap_or_else(|| surface.height_at(0.0, 0.0))
}

fn lies_flat(column: &Column, surface: &HeightField) -> bool {
    column.flatness() > FLAT && surface.above(&column.low).abs() < MEAN_M
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEIGHT_M: f32 = 1.8;

    /// 32 rings on level ground, from a sensor `HEIGHT_M` above it.
    fn plain() -> Vec<Point> {
        let ring = |beam: usize| HEIGHT_M / (2.0 + beam as f32 * 0.8).to_radians().tan();
        let shot = |range: f32, step: usize| {
            let (sin, cos) = (step as f32 * 0.5).to_radians().sin_cos();
            [range * cos, range * sin, -HEIGHT_M]
        };
        (0..32)
            .flat_map(|beam| (0..720).map(move |step| shot(ring(beam), step)))
            .collect()
    }

    fn wall() -> Vec<Point> {
        let at = |i: usize| {
            [
                8.0,
                (i % 100) as f32 * 0.2 - 10.0,
                (i / 100) as f32 * 0.1 - 1.7,
            ]
        };
        (0..3000).map(at).collect()
    }

    fn ground(points: &[Point]) -> Vec<bool> {
        let found = segment(points, &GroundOptions::default());
        assert_eq!(found.ground.len(), points.len());
        assert_eq!(
            found.ground.contains(&true),
            found.origin_height_m.is_some()
        );
        found.ground
    }

    #[test]
    fn level_ground_is_ground_and_tells_the_lidars_height() {
        let found = segment(&plain(), &GroundOptions::default());
        assert!(found.ground.iter().all(|&flag| flag));
        let height = found.origin_height_m.expect("there is ground");
        assert!((height - HEIGHT_M).abs() < 1e-3, "{height}");
    }

    #[test]
    fn things_on_the_ground_and_mirror_images_below_it_are_not_ground() {
        let mut points = plain();
        let first = points.len();
        points.extend(wall().iter().filter(|point| point[2] > -1.6));
        points.extend((0..40).map(|i| [5.0 + i as f32 * 0.4, -3.0, -HEIGHT_M - 1.5]));
        let found = ground(&points);
        assert!(found[..first].iter().all(|&flag| flag));
        assert!(!found[first..].contains(&true));
    }

    #[test]
    fn a_wall_alone_has_no_ground() {
        assert!(!ground(&wall()).contains(&true));
    }

    #[test]
    fn a_room_has_a_floor_and_its_walls_alone_have_none() {
        // A room of 8 m by 6 m by 2.6 m, from 1.1 m above the floor, with evenly spread rays.
        let shot = |i: usize| {
            let up = i as f32 / 10_000.0 - 1.0;
            let (sin, cos) = (i as f32 * 2.4).sin_cos();
            let level = (1.0 - up * up).max(0.0).sqrt();
            let ray = [level * cos, level * sin, up];
            let [low, high] = [[-3.0, -2.5, -1.1], [5.0, 3.5, 1.5]];
            let reach = |axis: usize| {
                let wall: f32 = if ray[axis] > 0.0 {
                    high[axis]
                } else {
                    low[axis]
                };
                if ray[axis] == 0.0 {
                    f32::INFINITY
                } else {
                    wall / ray[axis]
                }
            };
            let range = reach(0).min(reach(1)).min(reach(2));
            ray.map(|value| value * range)
        };
        let room: Vec<Point> = (0..20_000).map(shot).collect();
        let found = segment(&room, &GroundOptions::default());
        let height = found.origin_height_m.expect("there is a floor");
        assert!((height - 1.1).abs() < 0.02, "{height}");
        for (point, flag) in room.iter().zip(&found.ground) {
            let above = point[2] + 1.1;
            assert!(
                if above < 0.05 {
                    *flag
                } else {
                    above < 0.2 || !flag
                },
                "{point:?}"
            );
        }
        let is_wall = |point: &Point| point[2] > -0.9 && point[2] < 1.4;
        let walls: Vec<Point> = room.into_iter().filter(is_wall).collect();
        assert!(!ground(&walls).contains(&true));
    }

    #[test]
    fn few_points_and_duplicates_are_no_ground() {
        assert!(ground(&[]).is_empty());
        assert!(!ground(&[[1.0, 2.0, -1.7]]).contains(&true));
        assert!(!ground(&[[4.0, 0.0, -1.7], [0.0, 4.0, -1.7], [-4.0, 0.0, -1.7]]).contains(&true));
        assert!(!ground(&vec![[3.0, 3.0, 0.0]; 5000]).contains(&true));
    }

    #[test]
    fn every_point_twice_has_the_same_ground() {
        let once: Vec<Point> = [plain(), wall()].concat();
        let twice = once.repeat(2);
        assert_eq!(ground(&twice)[..once.len()], ground(&once));
    }

    #[test]
    fn the_order_of_the_points_does_not_matter() {
        let points: Vec<Point> = [plain(), wall()].concat();
        let backward: Vec<Point> = points.iter().rev().copied().collect();
        let mut found = ground(&backward);
        found.reverse();
        assert_eq!(found, ground(&points));
    }

    #[test]
    fn the_origin_may_lie_on_the_ground() {
        let mut points = plain();
        for point in &mut points {
            point[2] += HEIGHT_M + 0.3;
        }
        let found = segment(&points, &GroundOptions::default());
        let height = found.origin_height_m.expect("there is ground");
        assert!((height + 0.3).abs() < 1e-3, "{height}");
        assert!(found.ground.iter().all(|&flag| flag));
    }

    #[test]
    fn huge_coordinates_are_not_ground_and_harm_nothing() {
        let mut points = plain();
        let first = points.len();
        let huge = [f32::MAX, -f32::MAX, 1e30, -1e30];
        for value in huge {
            points.extend([[value, 0.0, -1.8], [0.0, value, -1.8], [6.0, 6.0, value]]);
            points.push([value, value, value]);
        }
        let found = ground(&points);
        assert!(found[..first].iter().all(|&flag| flag));
        assert!(!found[first..].contains(&true));
        for value in huge {
            ground(&vec![[1.0, 2.0, value]; 50]);
        }
    }
}
