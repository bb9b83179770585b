//! Tracks from above: the way of each moving object, with its last box and its id.

use super::boxes::{corners, line, outline};
use super::canvas::{Align, Image, Rgb, TextStyle};
use super::top_down::{
    BACKGROUND, RANGES_M, STATIC, TITLE, View, draw_heading, draw_rings, draw_scale_bar,
    draw_vehicle, range_m,
};
use super::wheel::color;
use crate::flow::tracks::{Track, TrackState};
use crate::flow::{Point, RigidTransform};
use crate::text::grouped;

/// Width and height, pixels.
const SIDE_PX: u32 = 1400;
/// Share of the states of all tracks within the picture's range.
const COVERED: f64 = 0.95;
/// Angle between the colors of consecutive ids, radians: the golden angle.
const BETWEEN_COLORS: f32 = 2.399_963;

/// Tracks to be drawn.
#[derive(Clone, Copy, Debug)]
pub struct TracksFromAbove<'a> {
    /// Tracks of a sequence.
    pub tracks: &'a [Track],
    /// Poses of the sensor in the sweeps, in a common frame. The picture is in the frame of the
    /// last one. States of sweeps without a pose are left out.
    pub poses: &'a [RigidTransform],
    /// Points of the last sweep but one, metres, drawn gray below the tracks.
    pub points: &'a [Point],
}

impl TracksFromAbove<'_> {
    /// `point` of a sweep in the frame of the picture, metres.
    fn shown(&self, sweep: usize, point: Point) -> Option<Point> {
        let shown_from_sweep = self.poses.last()?.inv_mul(self.poses.get(sweep)?);
        let shown = shown_from_sweep * nalgebra::Point3::from(point.map(f64::from));
        Some([shown.x, shown.y, shown.z].map(|c| c as f32))
    }

    fn center(&self, state: &TrackState) -> Option<Point> {
        self.shown(state.sweep as usize, state.bounds.center)
    }

    /// Half the width, metres, of the square that holds nearly all states.
    fn range_m(&self) -> f32 {
        let states = self.tracks.iter().flat_map(|track| &track.states);
        let centers = states.filter_map(|state| self.center(state));
        range_m(centers, COVERED).max(RANGES_M[1])
    }
}

/// Draws tracks from above, each with its own color. The sensor of the last sweep is in the middle,
/// forward is up. The line of a track leads through its centers, the box is its last.
pub fn tracks_from_above(scene: &TracksFromAbove<'_>) -> Image {
    let view = View {
        side: SIDE_PX as f32,
        range_m: scene.range_m(),
    };
    let mut image = Image::filled(SIDE_PX, SIDE_PX, BACKGROUND);
    draw_rings(&mut image, view);
    let last = scene.poses.len().saturating_sub(2);
    let points = scene.points.iter();
    for point in points.filter_map(|&point| scene.shown(last, point)) {
        image.disk(view.pixel(point), 0.6, STATIC, 0.45);
    }
    let way: Vec<Point> = (0..scene.poses.len())
        .filter_map(|sweep| scene.shown(sweep, [0.0; 3]))
        .collect();
    draw_way(&mut image, view, &way, TITLE);
    for track in scene.tracks {
        draw_track(&mut image, view, scene, track);
    }
    draw_vehicle(&mut image, view);
    let note = format!(
        "{} moving objects in {} sweeps",
        grouped(scene.tracks.len()),
        grouped(scene.poses.len())
    );
    draw_heading(&mut image, view, "Tracks", &[note]);
    draw_scale_bar(&mut image, view);
    image
}

fn draw_way(image: &mut Image, view: View, way: &[Point], color: Rgb) {
    for pair in way.windows(2) {
        line(
            image,
            [view.pixel(pair[0]), view.pixel(pair[1])],
            2.0,
            color,
        );
    }
}

fn draw_track(image: &mut Image, view: View, scene: &TracksFromAbove<'_>, track: &Track) {
    let angle = track.id as f32 * BETWEEN_COLORS;
    let color = color([angle.cos(), angle.sin(), 0.0], 1.0);
    let way: Vec<Point> = track
        .states
        .iter()
        .filter_map(|s| scene.center(s))
        .collect();
    draw_way(image, view, &way, color);
    let Some(state) = track.states.last() else {
        return;
    };
    let sweep = state.sweep as usize;
    let corners = corners(&state.bounds).map(|corner| scene.shown(sweep, corner));
    if let [Some(a), Some(b), Some(c), Some(d)] = corners {
        outline(
            image,
            [a, b, c, d].map(|corner| view.pixel(corner)),
            2.0,
            color,
        );
        let [x, y] = view.pixel(a);
        if ![x, y].iter().all(|at| (0.0..view.side).contains(at)) {
            return;
        }
        let dot = view.small_dot();
        let style = TextStyle {
            dot,
            color,
            align: Align::Left,
        };
        let at = [x as i32 + 2 * dot, y as i32 - 7 * dot];
        image.text(at, &track.id.to_string(), style);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;
    use crate::flow::OrientedBox;

    #[test]
    fn a_track_is_drawn_where_its_object_went_as_seen_from_the_last_sweep() {
        let state = |sweep: u32, x: f32| TrackState {
            sweep,
            bounds: OrientedBox {
                center: [x, 5.0, 0.0],
                size: [4.0, 2.0, 1.5],
                yaw: 0.0,
            },
            ..TrackState::default()
        };
        // The vehicle drives 10 m, the object stays 5 m to the left of its start.
        let track = Track {
            id: 1,
            states: vec![state(0, 0.0), state(1, -10.0)],
        };
        let poses = [
            Isometry3::identity(),
            Isometry3::translation(10.0, 0.0, 0.0),
        ];
        let scene = TracksFromAbove {
            tracks: &[track],
            poses: &poses,
            points: &[[3.0, 0.0, 0.0]],
        };
        let image = tracks_from_above(&scene);
        let view = View {
            side: SIDE_PX as f32,
            range_m: 20.0,
        };
        let pixel = |point: Point| {
            let [x, y] = view.pixel(point).map(|c| c as usize);
            image.pixels()[y * SIDE_PX as usize + x]
        };
        // The near left corner of the box about (-10, 5), with its margin.
        let corner = pixel([-10.0 + 2.15, 5.0 + 1.15, 0.0]);
        assert_ne!(corner, BACKGROUND);
        // The static point, 10 m nearer to the vehicle of the last sweep.
        assert_ne!(pixel([-7.0, 0.0, 0.0]), BACKGROUND);
        assert_eq!(pixel([6.0, -5.0, 0.0]), BACKGROUND);
    }

    #[test]
    fn nothing_makes_an_empty_picture() {
        let nothing = TracksFromAbove {
            tracks: &[],
            poses: &[],
            points: &[[1.0; 3]],
        };
        assert_eq!(tracks_from_above(&nothing).width(), SIDE_PX);
    }
}
