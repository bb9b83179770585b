//! Flow from above: the vehicle in the middle, forward up, colored by direction of motion.
//!
//! Moving points are drawn on top of static ones.

use super::boxes;
use super::canvas::{Align, Image, Rgb, TextStyle};
use super::motion::{full_scale, shown_motion};
use super::wheel::color;
use crate::flow::{Cluster, Point, RigidTransform};
use crate::text::grouped;

pub(super) const BACKGROUND: Rgb = [13, 16, 23];
pub(super) const STATIC: Rgb = [128, 139, 160];
const INVALID: Rgb = [190, 190, 190];
const LINES: Rgb = [70, 82, 104];
const LABELS: Rgb = [126, 140, 166];
pub(super) const TITLE: Rgb = [222, 228, 240];
const VEHICLE: Rgb = [240, 244, 255];

/// Threshold between static and dynamic points that is common in scene flow, metres from the source
/// sweep's time to the target's.
const MOVING_M: f32 = 0.05;

/// Half ranges that a picture may have, metres.
pub(super) const RANGES_M: [f32; 10] = [
    10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 150.0, 200.0,
];

/// Share of the points inside an automatically chosen range. The farthest points of a sweep are
/// few, and would shrink all others.
const COVERED: f64 = 0.93;

/// A car, metres: length and width.
const VEHICLE_M: [f32; 2] = [4.6, 1.9];

/// The scene to be drawn: N points, each with its flow.
#[derive(Clone, Copy, Debug)]
pub struct TopDown<'a> {
    /// N source points, metres. Rows that are not finite, here or in the shown motion, are left
    /// out.
    pub source: &'a [Point],
    /// N displacements from the source sweep's time to the target's, metres, ego motion included.
    pub flow: &'a [Point],
    /// N flags: whether the row has a flow. Rows without one are drawn gray.
    pub valid: &'a [bool],
    /// The ego motion `target_from_source`, translation in metres. If it is given, motion relative
    /// to the world is shown, otherwise the flow itself. The title names which.
    pub ego: Option<&'a RigidTransform>,
    /// Clusters of the source points, or an empty slice. The dynamic ones get an outline of their
    /// box, and a line that shows their displacement in 1 s.
    pub clusters: &'a [Cluster],
}

/// Options of a picture from above.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TopDownOptions {
    /// Width and height, pixels, clamped to 256..=8192.
    pub side_px: u32,
    /// Half the width of the visible square, metres, clamped to 1..=10,000. A value that is not
    /// positive and finite counts as none.
    ///
    /// If none, it is the smallest of 10, 20, 30, 40, 50, 60, 80, 100, 150 and 200 m that holds
    /// 93 % of the points with a flow. It is 200 m if none of these does, and 50 m without such
    /// points.
    pub range_m: Option<f32>,
    /// The horizontal displacement at which colors saturate, metres. If none, or not positive and
    /// finite, it is the result of [`full_scale`].
    pub full_scale_m: Option<f32>,
    /// Time from the source sweep to the target sweep, seconds. With a positive value the legend is
    /// in m/s. Otherwise it is in metres per sweep.
    pub interval_s: Option<f32>,
}

impl Default for TopDownOptions {
    fn default() -> Self {
        Self {
            side_px: 1400,
            range_m: None,
            full_scale_m: None,
            interval_s: None,
        }
    }
}

/// The mapping from metres to pixels.
#[derive(Clone, Copy)]
pub(super) struct View {
    pub(super) side: f32,
    pub(super) range_m: f32,
}

impl View {
    fn pixels_per_metre(&self) -> f32 {
        self.side / (2.0 * self.range_m)
    }

    /// The pixel of a point: x, forward, is up; y, left, is left.
    pub(super) fn pixel(&self, point: Point) -> [f32; 2] {
        let scale = self.pixels_per_metre();
        [
            self.side / 2.0 - point[1] * scale,
            self.side / 2.0 - point[0] * scale,
        ]
    }

    /// Pixels per dot of the title's font.
    pub(super) fn dot(&self) -> i32 {
        ((self.side / 466.0).round() as i32).max(1)
    }

    /// Pixels per dot of the small labels' font.
    pub(super) fn small_dot(&self) -> i32 {
        (self.dot() * 2 / 3).max(1)
    }

    /// Pixels between the labels and the image's edge.
    pub(super) fn margin(&self) -> i32 {
        (self.side * 0.02) as i32
    }
}

/// Draws flow from above. The sensor is in the middle, forward (+x) is up and left (+y) is left.
/// Rows past the shortest of the three inputs are left out.
///
/// Points that move at least 0.05 m horizontally have the [`color`] of their motion, faster ones on
/// top. Slower points and points without a flow are gray. The picture has distance rings, a scale
/// bar and a legend of the colors.
pub fn top_down(scene: &TopDown<'_>, options: &TopDownOptions) -> Image {
    let side = options.side_px.clamp(256, 8192);
    let range_m = options
        .range_m
        .filter(|range| *range > 0.0 && range.is_finite());
    let range_m = range_m.map_or_else(|| choose_range(scene), |range| range.clamp(1.0, 10_000.0));
    let view = View {
        side: side as f32,
        range_m,
    };
    let motion = shown_motion(scene.source, scene.flow, scene.ego);
    let scale_m = options
        .full_scale_m
        .filter(|scale| *scale > 0.0 && scale.is_finite());
    let scale_m = scale_m.unwrap_or_else(|| full_scale(&motion, scene.valid));

    let mut image = Image::filled(side, side, BACKGROUND);
    draw_rings(&mut image, view);
    let moving = draw_points(&mut image, view, scene, &motion, scale_m);
    draw_vehicle(&mut image, view);
    boxes::draw(
        &mut image,
        scene.clusters,
        |point| view.pixel(point),
        view.side / 1000.0,
    );
    draw_title(&mut image, view, scene, moving);
    draw_legend(&mut image, view, scale_m, options.interval_s);
    draw_scale_bar(&mut image, view);
    image
}

/// Half the width, metres, of the square that holds nearly all points with a flow.
fn choose_range(scene: &TopDown) -> f32 {
    let rows = scene.source.iter().zip(scene.valid);
    let points = rows.filter(|(_, valid)| **valid);
    range_m(points.map(|(point, _)| *point), COVERED)
}

/// The smallest of [`RANGES_M`] whose square holds this share of the points, the largest if none does. 50 m
/// without points.
pub(super) fn range_m(points: impl Iterator<Item = Point>, share: f64) -> f32 {
    let reach = points.map(|point| point[0].abs().max(point[1].abs()));
    let mut reach: Vec<f32> = reach.filter(|m| m.is_finite()).collect();
    if reach.is_empty() {
        return RANGES_M[4];
    }
    let index = ((reach.len() - 1) as f64 * share) as usize;
    let (_, wanted, _) = reach.select_nth_unstable_by(index, f32::total_cmp);
    RANGES_M
        .into_iter()
        .find(|range| *range >= *wanted)
        .unwrap_or(RANGES_M[9])
}

/// Distance between rings, and length of the scale bar, metres: about a fifth of the range.
fn step_m(range_m: f32) -> f32 {
    [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
        .into_iter()
        .find(|step| range_m / step <= 5.0)
        .unwrap_or(100.0)
}

pub(super) fn draw_rings(image: &mut Image, view: View) {
    let center = [view.side / 2.0; 2];
    let step = step_m(view.range_m);
    let dot = view.small_dot();
    let style = TextStyle {
        dot,
        color: LABELS,
        align: Align::Center,
    };
    let mut radius_m = step;
    while radius_m < view.range_m {
        let radius = radius_m * view.pixels_per_metre();
        image.ring(center, radius, LINES, 0.55);
        let top = [center[0] as i32, (center[1] + radius) as i32 + 3 * dot];
        image.text(top, &format!("{radius_m} m"), style);
        radius_m += step;
    }
}

/// Draws the points, the fastest last. Returns the number of moving ones.
fn draw_points(
    image: &mut Image,
    view: View,
    scene: &TopDown<'_>,
    motion: &[Point],
    scale_m: f32,
) -> usize {
    let size = view.side / 1400.0;
    let mut moving = Vec::new();
    for ((point, motion), valid) in scene.source.iter().zip(motion).zip(scene.valid) {
        if !point.iter().chain(motion).all(|value| value.is_finite()) {
            continue;
        }
        let speed_m = motion[0].hypot(motion[1]);
        let at = view.pixel(*point);
        if !valid {
            image.disk(at, (0.6 * size).max(0.5), INVALID, 0.30);
        } else if speed_m < MOVING_M {
            image.disk(at, (0.6 * size).max(0.5), STATIC, 0.55);
        } else {
            moving.push((speed_m, at, *motion));
        }
    }
    moving.sort_by(|left, right| left.0.total_cmp(&right.0));
    for (_, at, motion) in &moving {
        image.disk(*at, (1.7 * size).max(1.0), color(*motion, scale_m), 0.9);
    }
    moving.len()
}

/// A car from above with a bright front, which marks the forward direction.
pub(super) fn draw_vehicle(image: &mut Image, view: View) {
    let scale = view.pixels_per_metre();
    let [length, width] = VEHICLE_M.map(|metres| metres * scale);
    let center = [view.side / 2.0; 2];
    let corner = width * 0.3;
    image.shade_square(center, length, |x, y| {
        let outside_x = (x.abs() - width / 2.0 + corner).max(0.0);
        let outside_y = (y.abs() - length / 2.0 + corner).max(0.0);
        let distance = outside_x.hypot(outside_y) - corner;
        let fill = (0.5 - distance).clamp(0.0, 1.0);
        let is_nose = y < -length * 0.22;
        (VEHICLE, fill * if is_nose { 0.95 } else { 0.35 })
    });
}

fn draw_title(image: &mut Image, view: View, scene: &TopDown<'_>, moving: usize) {
    let points = grouped(scene.source.len());
    let (title, note, counts) = match scene.ego {
        Some(_) => (
            "Motion in the world",
            "flow relative to the ego motion",
            format!("{points} points, {} moving", grouped(moving)),
        ),
        None => (
            "Total flow",
            "ego motion included",
            format!("{points} points"),
        ),
    };
    let mut notes = vec![note.to_owned(), counts];
    let is_shown = |point: Point| point[0].abs().max(point[1].abs()) <= view.range_m;
    let boxes = scene.clusters.iter();
    let boxes = boxes.filter(|cluster| cluster.dynamic && is_shown(cluster.bounds.center));
    if let boxes @ 1.. = boxes.count() {
        notes.push(format!(
            "{} moving boxes, and their displacement in 1 s",
            grouped(boxes)
        ));
    }
    draw_heading(image, view, title, &notes);
}

/// Draws a title at the top left, and small lines below it.
pub(super) fn draw_heading(image: &mut Image, view: View, title: &str, notes: &[String]) {
    let (dot, margin) = (view.dot(), view.margin());
    let style = TextStyle {
        dot,
        color: TITLE,
        align: Align::Left,
    };
    let small = TextStyle {
        dot: view.small_dot(),
        color: LABELS,
        align: Align::Left,
    };
    image.text([margin, margin], title, style);
    for (note, below) in notes.iter().zip((11..).step_by(7)) {
        image.text([margin, margin + below * dot], note, small);
    }
}

/// The color wheel, oriented as the picture: up is forward.
fn draw_legend(image: &mut Image, view: View, scale_m: f32, interval_s: Option<f32>) {
    let dot = view.dot();
    let radius = view.side * 0.055;
    let margin = view.margin() as f32;
    let center = [view.side - margin - radius, margin + radius];
    image.disk(center, radius + 4.0 * dot as f32, BACKGROUND, 0.8);
    image.shade_square(center, radius + 1.0, |x, y| {
        let inside = (radius + 0.5 - x.hypot(y)).clamp(0.0, 1.0);
        // Slightly inside the full scale, past which colors darken.
        (color([-y, -x, 0.0], radius * 1.01), inside)
    });
    image.disk(center, 1.5 * dot as f32, BACKGROUND, 0.7);
    let label = match interval_s.filter(|seconds| *seconds > 0.0) {
        Some(seconds) => format!("{} m/s", rounded(scale_m / seconds)),
        None => format!("{} m / sweep", rounded(scale_m)),
    };
    let style = TextStyle {
        dot: view.small_dot(),
        color: TITLE,
        align: Align::Center,
    };
    let (middle, below) = (center[0] as i32, (center[1] + radius) as i32 + 6 * dot);
    let small = TextStyle {
        color: LABELS,
        ..style
    };
    image.text([middle, below], &label, style);
    image.text([middle, below + 7 * dot], "at the rim", small);
    image.text([middle, below + 16 * dot], "static", small);
    let swatch = [center[0] - radius * 0.75, (below + 18 * dot) as f32];
    image.disk(swatch, 2.0 * dot as f32, STATIC, 0.9);
}

/// A number with at most two decimals, without trailing zeros.
fn rounded(value: f32) -> String {
    let text = format!("{value:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

pub(super) fn draw_scale_bar(image: &mut Image, view: View) {
    let thick = view.small_dot();
    let margin = view.margin();
    let step = step_m(view.range_m);
    let length = (step * view.pixels_per_metre()).round() as i32;
    let bottom = view.side as i32 - margin;
    image.bar([margin, bottom], [length, thick], TITLE, 0.9);
    for end in [margin, margin + length - thick] {
        image.bar([end, bottom - 3 * thick], [thick, 3 * thick], TITLE, 0.9);
    }
    let style = TextStyle {
        dot: thick,
        color: TITLE,
        align: Align::Center,
    };
    image.text(
        [margin + length / 2, bottom - 12 * thick],
        &format!("{step} m, x up, y left"),
        style,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: TopDownOptions = TopDownOptions {
        side_px: 256,
        range_m: Some(20.0),
        full_scale_m: Some(1.0),
        interval_s: None,
    };

    fn draw(points: &[Point], flow: &[Point], valid: &[bool]) -> Image {
        top_down(
            &TopDown {
                source: points,
                flow,
                valid,
                ego: None,
                clusters: &[],
            },
            &SMALL,
        )
    }

    fn pixel(image: &Image, x: usize, y: usize) -> Rgb {
        image.pixels()[y * image.width() as usize + x]
    }

    #[test]
    fn forward_is_up_and_left_is_left() {
        let none = draw(&[], &[], &[]);
        // 20 m are 128 pixels; 10 m forward and 5 m left.
        let one = draw(&[[10.0, 5.0, 0.0]], &[[1.0, 0.0, 0.0]], &[true]);
        let changed: Vec<usize> = (0..256 * 256)
            .filter(|&index| index / 256 > 60 && none.pixels()[index] != one.pixels()[index])
            .collect();
        assert!(!changed.is_empty());
        for index in changed {
            let (x, y) = (index % 256, index / 256);
            assert!(x.abs_diff(96) <= 1 && y.abs_diff(64) <= 1, "{x} {y}");
        }
        let [red, green, _] = pixel(&one, 96, 64);
        assert!(red > green, "forward is red");
    }

    #[test]
    fn a_mover_is_not_hidden_by_what_stands_still() {
        let points = [[10.0, 5.0, 0.0]; 50];
        let mut flow = [[0.0; 3]; 50];
        flow[0] = [0.0, 1.0, 0.0];
        let crowded = pixel(&draw(&points, &flow, &[true; 50]), 96, 64);
        let empty = pixel(&draw(&points[..1], &flow[..1], &[true]), 96, 64);
        assert!(crowded[2] < crowded[0] / 2, "left is yellow");
        assert!(
            crowded
                .iter()
                .zip(empty)
                .all(|(a, b)| *a >= b.saturating_sub(1))
        );
    }

    #[test]
    fn odd_input_draws_without_a_panic() {
        let nan = [[f32::NAN; 3], [f32::INFINITY, 0.0, 0.0], [1e30, -1e30, 0.0]];
        let image = draw(&nan, &[[f32::NAN; 3]; 3], &[true; 3]);
        assert_eq!((image.width(), image.height()), (256, 256));
        let options = TopDownOptions {
            side_px: 0,
            range_m: Some(f32::NAN),
            ..SMALL
        };
        let scene = TopDown {
            source: &nan,
            flow: &[[0.0; 3]; 2],
            valid: &[true],
            ego: None,
            clusters: &[],
        };
        assert_eq!(top_down(&scene, &options).width(), 256);
    }

    #[test]
    fn counts_are_grouped_and_scales_are_short() {
        assert_eq!(grouped(1_234_567), "1,234,567");
        assert_eq!(grouped(12), "12");
        assert_eq!(
            (rounded(2.0), rounded(0.25)),
            ("2".to_owned(), "0.25".to_owned())
        );
    }

    #[test]
    fn a_written_png_decodes_to_the_same_pixels() {
        let image = draw(&[[1.0, 2.0, 0.0]], &[[1.0, 0.0, 0.0]], &[true]);
        let mut bytes = Vec::new();
        super::super::write_png(&image, &mut bytes).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, image.pixels().as_flattened());
    }
}
