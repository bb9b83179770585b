//! A dense cloud from above: static points by their height, moving ones in a color of their own.

use super::canvas::{Image, Rgb};
use super::top_down::{BACKGROUND, View, draw_heading, draw_rings, draw_scale_bar, range_m};
use crate::flow::{DenseCloud, Point};
use crate::text::grouped;

/// Width and height, pixels.
const SIDE_PX: u32 = 1400;
/// The colors of the lowest and the highest static points.
const HEIGHTS: [Rgb; 2] = [[38, 54, 92], [236, 241, 250]];
const MOVING: Rgb = [255, 146, 43];
/// Shares of the points below the lowest and the highest height that have colors of their own.
const SHARES: [f64; 2] = [0.02, 0.98];
/// Share of the points within the picture's range.
const COVERED: f64 = 0.95;

/// Draws a dense cloud from above, in the frame of its reference time: the sensor is in the middle, forward
/// (+x) is up and left (+y) is left. Higher points lie on lower ones, and moving ones on all. Points whose
/// position is unreliable are left out.
pub fn dense_from_above(cloud: &DenseCloud) -> Image {
    let is_shown = |&row: &usize| {
        let is_finite = cloud.points[row].iter().all(|value| value.is_finite());
        cloud.converged[row] && is_finite
    };
    let mut rows: Vec<usize> = (0..cloud.points.len()).filter(is_shown).collect();
    let point = |row: usize| cloud.points[row];
    rows.sort_unstable_by(|&a, &b| {
        let by_height = point(a)[2].total_cmp(&point(b)[2]);
        cloud.dynamic[a].cmp(&cloud.dynamic[b]).then(by_height)
    });
    let moving = rows.iter().filter(|&&row| cloud.dynamic[row]).count();
    // The static ones come first, in the order of their heights.
    let still = &rows[..rows.len() - moving];
    let [low, high] = SHARES.map(|share| {
        let index = (still.len().saturating_sub(1) as f64 * share) as usize;
        still.get(index).map_or(0.0, |&row| point(row)[2])
    });
    let reach = rows.iter().map(|&row| point(row));
    let view = View {
        side: SIDE_PX as f32,
        range_m: range_m(reach, COVERED),
    };

    let mut image = Image::filled(SIDE_PX, SIDE_PX, BACKGROUND);
    for &row in &rows {
        let at = view.pixel(point(row));
        match cloud.dynamic[row] {
            true => image.disk(at, 1.0, MOVING, 0.8),
            false => image.disk(at, 0.6, shade(point(row), low, high), 0.7),
        }
    }
    draw_rings(&mut image, view);
    let sweeps = cloud.sweep.iter().max().map_or(0, |last| last + 1);
    let notes = [
        format!(
            "{} points of {sweeps} sweeps, {} moving in orange",
            grouped(cloud.points.len()),
            grouped(moving)
        ),
        format!("static points from {low:.1} m, dark, to {high:.1} m, bright"),
    ];
    draw_heading(&mut image, view, "Dense cloud", &notes);
    draw_scale_bar(&mut image, view);
    image
}

/// The color of a static point by its height.
fn shade(point: Point, low: f32, high: f32) -> Rgb {
    let share = ((point[2] - low) / (high - low).max(0.01)).clamp(0.0, 1.0);
    let [dark, bright] = HEIGHTS.map(|color| color.map(f32::from));
    core::array::from_fn(|part| (dark[part] + share * (bright[part] - dark[part])) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(points: &[(Point, bool, bool)]) -> DenseCloud {
        DenseCloud {
            points: points.iter().map(|(point, ..)| *point).collect(),
            sweep: vec![0; points.len()],
            age: vec![0.0; points.len()],
            dynamic: points.iter().map(|(_, dynamic, _)| *dynamic).collect(),
            converged: points.iter().map(|(.., converged)| *converged).collect(),
        }
    }

    #[test]
    fn the_moving_and_the_high_lie_on_the_others_and_the_unreliable_is_left_out() {
        // In the middle of a pixel each, where 10 m are 700 pixels.
        let [ahead, left] = [349.5 / 70.0, 139.5 / 70.0];
        let image = dense_from_above(&cloud(&[
            ([ahead, left, 9.0], true, true),
            ([ahead, left, 1.0], false, true),
            ([-ahead, left, 3.0], false, true),
            ([-ahead, left, -2.0], false, true),
            ([ahead, -left, 1.0], false, false),
            ([f32::NAN, 0.0, 0.0], false, true),
        ]));
        let view = View {
            side: SIDE_PX as f32,
            range_m: 10.0,
        };
        let pixel = |x: f32, y: f32| {
            let [column, row] = view.pixel([x, y, 0.0]).map(|at| at as usize);
            image.pixels()[row * SIDE_PX as usize + column]
        };
        let near = |found: Rgb, wanted: Rgb| {
            let mut pairs = found.into_iter().zip(wanted);
            pairs.all(|(a, b)| a.abs_diff(b) < 80)
        };
        assert!(near(pixel(ahead, left), MOVING));
        assert!(near(pixel(-ahead, left), HEIGHTS[1]));
        assert_eq!(pixel(ahead, -left), BACKGROUND);
    }

    #[test]
    fn nothing_makes_an_empty_picture() {
        assert_eq!(dense_from_above(&cloud(&[])).width(), SIDE_PX);
    }
}
