//! Depth images one above the other: near is red, far is violet, unknown is dark.
//!
//! All panels share one scale, so that a sparse one can be compared with a dense one.

use super::canvas::{Align, Image, Rgb, TextStyle};
use crate::flow::depth::DepthImage;
use crate::text::grouped;

const BACKGROUND: Rgb = [13, 16, 23];
const UNKNOWN: Rgb = [24, 28, 38];
const TITLE: Rgb = [222, 228, 240];
const LABELS: Rgb = [126, 140, 166];

/// Near end of the color scale, metres; smaller depths have the same red.
const NEAREST_M: f32 = 3.0;

/// Possible far ends of the color scale, and the labels of the scale, metres.
const STEPS_M: [f32; 6] = [5.0, 10.0, 20.0, 40.0, 80.0, 160.0];

/// Share of the known pixels whose depth is below the far end of the color scale.
const COVERED: f64 = 0.97;

/// Colors from near to far, evenly spaced.
const COLORS: [[f32; 3]; 7] = [
    [214.0, 52.0, 44.0],
    [246.0, 138.0, 36.0],
    [250.0, 214.0, 60.0],
    [124.0, 206.0, 92.0],
    [44.0, 172.0, 196.0],
    [58.0, 108.0, 222.0],
    [94.0, 62.0, 168.0],
];

/// One depth image and its title.
#[derive(Clone, Copy, Debug)]
pub struct DepthPanel<'a> {
    /// The title above the image. Drawn are A to Z, 0 to 9 and `. , / % -`. Lowercase letters are
    /// drawn as capitals, any other character as a blank.
    pub title: &'a str,
    /// Depths, metres; 0 where unknown.
    pub image: &'a DepthImage,
}

/// Draws depth images one above the other, above a color scale. Each keeps its own size, with its
/// title and density above it. The picture is as wide as the widest of them, and at least 256
/// pixels. Without images only the color scale is drawn.
///
/// Near is red, far is violet, unknown is dark. The scale is logarithmic and the same for all
/// images. It starts at 3 m, and smaller depths have the same red. It ends at the smallest of 5,
/// 10, 20, 40, 80 and 160 m that covers 97 % of the known pixels, and larger depths have the same
/// violet. The end is 160 m if none of these does, and 80 m without known pixels.
///
/// Each depth is a square of 3 x 3 pixels, with nearer depths on top, so that sparse depth is
/// visible.
pub fn depth_panels(panels: &[DepthPanel<'_>]) -> Image {
    let width = panels.iter().map(|panel| panel.image.width).max();
    let width = width.unwrap_or(0).max(256);
    let dot = (width as i32 / 620).max(1);
    let header = 12 * dot;
    let footer = 24 * dot;
    let panels_height: u32 = panels
        .iter()
        .map(|panel| panel.image.height + header as u32)
        .sum();
    let mut image = Image::filled(width, panels_height + footer as u32, BACKGROUND);
    let farthest_m = farthest(panels);
    let mut top = 0;
    for panel in panels {
        draw_title(&mut image, panel, top, dot);
        top += header;
        draw_panel(&mut image, panel.image, top, farthest_m);
        top += panel.image.height as i32;
    }
    draw_scale(&mut image, top, dot, farthest_m);
    image
}

/// The smallest step that is at least as large as nearly all known depths, metres.
fn farthest(panels: &[DepthPanel<'_>]) -> f32 {
    let depths = panels.iter().flat_map(|panel| &panel.image.metres);
    let mut known: Vec<f32> = depths.copied().filter(|metres| *metres > 0.0).collect();
    if known.is_empty() {
        return STEPS_M[4];
    }
    let index = ((known.len() - 1) as f64 * COVERED) as usize;
    let (_, wanted, _) = known.select_nth_unstable_by(index, f32::total_cmp);
    let step = STEPS_M.into_iter().find(|step| step >= wanted);
    step.unwrap_or(STEPS_M[5])
}

/// The color of a depth, metres: the position on the color scale is logarithmic.
fn depth_color(metres: f32, farthest_m: f32) -> Rgb {
    let part = (metres / NEAREST_M).ln() / (farthest_m / NEAREST_M).ln();
    let position = part.clamp(0.0, 1.0) * (COLORS.len() - 1) as f32;
    let index = (position as usize).min(COLORS.len() - 2);
    let rest = position - index as f32;
    std::array::from_fn(|channel| {
        let [from, to] = [COLORS[index][channel], COLORS[index + 1][channel]];
        (from + rest * (to - from)).round() as u8
    })
}

fn draw_title(image: &mut Image, panel: &DepthPanel<'_>, top: i32, dot: i32) {
    let style = |color, align| TextStyle { dot, color, align };
    let at = top + 3 * dot;
    image.text([4 * dot, at], panel.title, style(TITLE, Align::Left));
    let share = panel.image.density() * 100.0;
    let known = grouped(panel.image.known());
    let note = format!("{known} pixels, {share:.1} %");
    let middle = image.width() as i32 * 3 / 4;
    image.text([middle, at], &note, style(LABELS, Align::Center));
}

fn draw_panel(image: &mut Image, depth: &DepthImage, top: i32, farthest_m: f32) {
    let size = [depth.width as i32, depth.height as i32];
    image.bar([0, top], size, UNKNOWN, 1.0);
    let mut dots: Vec<(f32, usize)> = depth.metres.iter().copied().zip(0..).collect();
    dots.retain(|(metres, _)| *metres > 0.0 && depth.width > 0);
    dots.sort_by(|left, right| right.0.total_cmp(&left.0));
    for (metres, index) in dots {
        let [column, row] = [index as i32 % size[0], index as i32 / size[0]];
        let color = depth_color(metres, farthest_m);
        for y in (row - 1).max(0)..(row + 2).min(size[1]) {
            for x in (column - 1).max(0)..(column + 2).min(size[0]) {
                image.blend(x, top + y, color, 1.0);
            }
        }
    }
}

fn draw_scale(image: &mut Image, top: i32, dot: i32, farthest_m: f32) {
    let margin = 12 * dot;
    let length = image.width() as i32 - 2 * margin;
    let depth_at = |part: f32| NEAREST_M * (farthest_m / NEAREST_M).powf(part);
    for x in 0..length {
        let color = depth_color(depth_at(x as f32 / length as f32), farthest_m);
        image.bar([margin + x, top + 4 * dot], [1, 6 * dot], color, 1.0);
    }
    let style = TextStyle {
        dot,
        color: LABELS,
        align: Align::Center,
    };
    for step in STEPS_M.into_iter().filter(|step| *step <= farthest_m) {
        let part = (step / NEAREST_M).ln() / (farthest_m / NEAREST_M).ln();
        let x = margin + (part * length as f32) as i32;
        let text = format!("{step} m");
        // The last label ends with the bar.
        let half = text.len() as i32 * 3 * dot;
        let x = x.min(margin + length - half);
        image.text([x, top + 13 * dot], &text, style);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(metres: Vec<f32>) -> DepthImage {
        DepthImage {
            width: 300,
            height: 4,
            metres,
        }
    }

    #[test]
    fn near_is_red_and_far_is_blue() {
        let [near, middle, far] = [3.0, 15.0, 80.0].map(|metres| depth_color(metres, 80.0));
        assert_eq!(near, [214, 52, 44]);
        assert!(middle[1] > middle[0] && middle[1] > middle[2], "{middle:?}");
        assert_eq!(far, [94, 62, 168]);
        assert_eq!(depth_color(0.5, 80.0), near);
        assert_eq!(depth_color(900.0, 80.0), far);
    }

    #[test]
    fn panels_share_one_scale_and_the_nearest_dot_lies_on_top() {
        let mut metres = vec![0.0; 1200];
        (metres[100], metres[101]) = (30.0, 5.0);
        let sparse = image(metres);
        let dense = image(vec![30.0; 1200]);
        let panels = [("one", &sparse), ("ten", &dense)];
        let panels = panels.map(|(title, image)| DepthPanel { title, image });
        let drawn = depth_panels(&panels);
        assert_eq!((drawn.width(), drawn.height()), (300, 2 * (4 + 12) + 24));
        let pixel = |x: usize, y: usize| drawn.pixels()[y * 300 + x];
        assert_eq!(pixel(101, 12), depth_color(5.0, 40.0));
        assert_eq!(pixel(99, 12), pixel(150, 28 + 1));
        assert_eq!(pixel(10, 12), UNKNOWN);
    }

    #[test]
    fn nothing_known_draws_without_a_panic() {
        let nothing = image(vec![0.0; 1200]);
        let panel = DepthPanel {
            title: "",
            image: &nothing,
        };
        assert_eq!(depth_panels(&[panel]).width(), 300);
        assert_eq!(depth_panels(&[]).width(), 256);
    }
}
