//! Tracks of a sequence as JSON.
//!
//! ```text
//! {"tracks": [{"id": 1, "states": [{"sweep": 0, "center": [x, y, z], "size": [l, w, h], "yaw": 0.1,
//!   "velocity": [x, y, z], "yaw_rate": 0.0, "points": 120, "confidence": 0.9}, ...]}, ...]}
//! ```
//!
//! Units and frames are those of [`TrackState`]. Other keys are ignored when reading.

use std::collections::HashSet;
use std::io::Write;

use serde::{Deserialize, Serialize};

use super::error::{FileKind, FormatError};
use super::limits::{check_probability, check_value};
use crate::flow::OrientedBox;
use crate::flow::tracks::{Track, TrackState};

const KIND: FileKind = FileKind::Json;

/// The file.
#[derive(Serialize, Deserialize)]
struct Tracks {
    tracks: Vec<TrackJson>,
}

/// A track as a JSON object.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct TrackJson {
    id: u32,
    states: Vec<StateJson>,
}

/// A state of a track as a JSON object.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct StateJson {
    sweep: u32,
    center: [f32; 3],
    size: [f32; 3],
    yaw: f32,
    velocity: [f32; 3],
    yaw_rate: f32,
    points: u32,
    confidence: f32,
}

impl From<&TrackState> for StateJson {
    fn from(state: &TrackState) -> Self {
        Self {
            sweep: state.sweep,
            center: state.bounds.center,
            size: state.bounds.size,
            yaw: state.bounds.yaw,
            velocity: state.velocity,
            yaw_rate: state.yaw_rate,
            points: state.points,
            confidence: state.confidence,
        }
    }
}

impl StateJson {
    /// The state of row `row` of all states, with every number checked.
    fn checked(&self, row: usize) -> Result<TrackState, FormatError> {
        let value = |name: &str, value: f32| check_value(KIND, row, name, f64::from(value));
        let point = |name: &str, [x, y, z]: [f32; 3]| {
            Ok::<_, FormatError>([value(name, x)?, value(name, y)?, value(name, z)?])
        };
        Ok(TrackState {
            sweep: self.sweep,
            bounds: OrientedBox {
                center: point("center", self.center)?,
                size: point("size", self.size)?,
                yaw: value("yaw", self.yaw)?,
            },
            velocity: point("velocity", self.velocity)?,
            yaw_rate: value("yaw_rate", self.yaw_rate)?,
            points: self.points,
            confidence: check_probability(KIND, row, "confidence", f64::from(self.confidence))?,
        })
    }
}

/// Writes the tracks of a sequence.
///
/// # Errors
/// [`FormatError::Write`] if the writer fails.
pub fn write_tracks(tracks: &[Track], out: &mut dyn Write) -> Result<(), FormatError> {
    let tracks = tracks.iter().map(|track| TrackJson {
        id: track.id,
        states: track.states.iter().map(StateJson::from).collect(),
    });
    let tracks = Tracks {
        tracks: tracks.collect(),
    };
    serde_json::to_writer(&mut *out, &tracks).map_err(std::io::Error::from)?;
    out.write_all(b"\n")?;
    Ok(())
}

/// Reads the tracks of a sequence.
///
/// # Errors
/// - `Malformed` for JSON of another form, a confidence outside of 0 to 1, two tracks of one
///   identity, and states that are not in the order of their sweeps.
/// - `NotFinite` for a number that single precision does not hold.
pub fn read_tracks(bytes: &[u8]) -> Result<Vec<Track>, FormatError> {
    let read: Tracks =
        serde_json::from_slice(bytes).map_err(|error| KIND.malformed(error.to_string()))?;
    let mut ids = HashSet::new();
    let mut row = 0;
    let mut tracks = Vec::with_capacity(read.tracks.len());
    for TrackJson { id, states } in read.tracks {
        if !ids.insert(id) {
            return Err(KIND.malformed(format!("two tracks have the id {id}")));
        }
        if !states.is_sorted_by(|a, b| a.sweep < b.sweep) {
            return Err(KIND.malformed(format!(
                "the states of track {id} are not in the order of their sweeps"
            )));
        }
        let mut track = Track {
            id,
            states: Vec::with_capacity(states.len()),
        };
        for state in states {
            track.states.push(state.checked(row)?);
            row += 1;
        }
        tracks.push(track);
    }
    Ok(tracks)
}

/// Whether `bytes` are JSON with tracks rather than a flow.
pub fn is_tracks(bytes: &[u8]) -> bool {
    #[derive(Deserialize)]
    struct Probe {
        tracks: Option<serde::de::IgnoredAny>,
    }
    serde_json::from_slice::<Probe>(bytes).is_ok_and(|probe| probe.tracks.is_some())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tracks() -> Vec<Track> {
        let state = |sweep: u32| TrackState {
            sweep,
            bounds: OrientedBox {
                center: [1.0, -2.0, 0.5],
                size: [4.5, 1.8, 1.6],
                yaw: -0.25,
            },
            velocity: [8.0, 0.5, 0.0],
            yaw_rate: 0.1,
            points: 120,
            confidence: 0.75,
        };
        let track = |id: u32, sweeps: std::ops::Range<u32>| Track {
            id,
            states: sweeps.map(state).collect(),
        };
        vec![track(1, 0..3), track(4, 2..3)]
    }

    fn written() -> String {
        let mut bytes = Vec::new();
        write_tracks(&tracks(), &mut bytes).expect("a vector");
        String::from_utf8(bytes).expect("text")
    }

    #[test]
    fn tracks_are_read_as_they_were_written() {
        let text = written();
        assert!(is_tracks(text.as_bytes()));
        assert_eq!(read_tracks(text.as_bytes()).expect("tracks"), tracks());
        assert!(!is_tracks(b"{\"flow\": []}"));
        assert!(!is_tracks(b"PK\x03\x04"));
    }

    #[test]
    fn what_tracks_cannot_be_is_refused_by_name() {
        let refused = |from: &str, to: &str| {
            let text = written().replacen(from, to, 1);
            read_tracks(text.as_bytes())
                .expect_err("not tracks")
                .to_string()
        };
        assert!(refused("\"id\":4", "\"id\":1").contains("two tracks have the id 1"));
        assert!(refused("\"sweep\":1", "\"sweep\":0").contains("order of their sweeps"));
        assert!(refused("0.75", "1.75").contains("confidence"));
        assert!(refused("4.5", "1e39").contains("size"));
        assert!(refused("\"yaw\":-0.25,", "").contains("yaw"));
        assert!(refused("{\"tracks\"", "{\"track\"").contains("tracks"));
    }
}
