//! A dense cloud from above: static points by their height, moving ones in a color of their own.

use super::canvas::{Image, Rgb};
use super::top_down::{BACKGROUND, View, draw_heading, draw_rings, draw_scale_bar, range_m};
use super::wheel::INVALID_COLOR;
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

/// The colors of a dense cloud's points: static ones by their height, moving ones in a color of their own.
#[derive(Clone, Copy, Debug)]
pub struct DenseColors<'a> {
    cloud: &'a DenseCloud,
    /// Heights of the darkest and the brightest static points, metres.
    heights_m: [f32; 2],
}

impl<'a> DenseColors<'a> {
    /// The colors of a cloud. The darkest and the brightest color are those of the 2nd and 98th
    /// percentile of the static points' heights.
    pub fn of(cloud: &'a DenseCloud) -> Self {
        let is_still = |row: &usize| {
            let is_finite = cloud.points[*row].iter().all(|value| value.is_finite());
            is_finite && cloud.converged[*row] && !cloud.dynamic[*row]
        };
        let still = (0..cloud.points.len()).filter(is_still);
        let mut heights: Vec<f32> = still.map(|row| cloud.points[row][2]).collect();
        let heights_m = SHARES.map(|share| {
            let index = (heights.len().saturating_sub(1) as f64 * share) as usize;
            match heights.is_empty() {
                true => 0.0,
                false => *heights.select_nth_unstable_by(index, f32::total_cmp).1,
            }
        });
        Self { cloud, heights_m }
    }

    /// Red, green and blue of a point; gray where its position is unreliable.
    ///
    /// # Panics
    /// There is no point of this row.
    pub fn color(&self, row: usize) -> Rgb {
        match (self.cloud.converged[row], self.cloud.dynamic[row]) {
            (false, _) => INVALID_COLOR,
            (true, true) => MOVING,
            (true, false) => shade(self.cloud.points[row], self.heights_m),
        }
    }
}

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
    let colors = DenseColors::of(cloud);
    let reach = rows.iter().map(|&row| point(row));
    let view = View {
        side: SIDE_PX as f32,
        range_m: range_m(reach, COVERED),
    };

    let mut image = Image::filled(SIDE_PX, SIDE_PX, BACKGROUND);
    for &row in &rows {
        let at = view.pixel(point(row));
        let (radius, opacity) = match cloud.dynamic[row] {
            true => (1.0, 0.8),
            false => (0.6, 0.7),
        };
        image.disk(at, radius, colors.color(row), opacity);
    }
    draw_rings(&mut image, view);
    let sweeps = cloud.sweep.iter().max().map_or(0, |last| last + 1);
    let [low, high] = colors.heights_m;
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
fn shade(point: Point, [low, high]: [f32; 2]) -> Rgb {
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
    fn colors_span_the_heights_of_the_static_points() {
        let mut points: Vec<(Point, bool, bool)> = (0..101)
            .map(|step| ([0.0, 0.0, step as f32], false, true))
            .collect();
        points.push(([0.0, 0.0, 500.0], true, true));
        points.push(([0.0, 0.0, -500.0], false, false));
        let cloud = cloud(&points);
        let colors = DenseColors::of(&cloud);
        assert_eq!(colors.heights_m, [2.0, 98.0]);
        assert_eq!(
            (colors.color(2), colors.color(99)),
            (HEIGHTS[0], HEIGHTS[1])
        );
        assert_eq!(
            (colors.color(101), colors.color(102)),
            (MOVING, INVALID_COLOR)
        );
    }

    #[test]
    fn nothing_makes_an_empty_picture() {
        assert_eq!(dense_from_above(&cloud(&[])).width(), SIDE_PX);
    }
}
