//! Tracks that the tests of the layouts share.

use crate::flow::OrientedBox;
use crate::flow::tracks::{Track, TrackState};

/// Two tracks: one in sweeps 0 to 2, which is hidden in sweep 1, and one in sweep 2.
pub(super) fn tracks() -> Vec<Track> {
    let state = |sweep: u32, points: u32| TrackState {
        sweep,
        bounds: OrientedBox {
            center: [1.0 + sweep as f32, -2.0, 0.5],
            size: [4.5, 1.75, 1.5],
            yaw: 0.25,
        },
        velocity: [8.0, 0.5, 0.0],
        yaw_rate: 0.1,
        points,
        confidence: if points > 0 { 0.75 } else { 0.0 },
    };
    let track = |id: u32, states: Vec<TrackState>| Track { id, states };
    vec![
        track(1, vec![state(0, 120), state(1, 0), state(2, 90)]),
        track(4, vec![state(2, 30)]),
    ]
}

pub(super) fn names() -> Vec<String> {
    ["a", "b", "c"].map(str::to_owned).to_vec()
}
