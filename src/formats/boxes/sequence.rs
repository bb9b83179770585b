//! A sequence of sweeps with the boxes of its tracks.

use std::collections::HashSet;

use uuid::Uuid;

use crate::flow::tracks::{Track, TrackState};
use crate::formats::error::{FileKind, FormatError};

const KIND: FileKind = FileKind::Json;

/// The boxes of a sequence, by sweep.
pub struct BoxSequence<'a> {
    pub(super) tracks: &'a [Track],
    /// Name of each sweep: its file name without folder and ending.
    pub(super) sweeps: &'a [String],
    /// The class of all boxes. Tracks have none of their own.
    pub(super) class: &'a str,
    /// Tracks and states of each sweep.
    boxes: Vec<Vec<(&'a Track, &'a TrackState)>>,
    /// A hash of the sweeps and their boxes.
    digest: u64,
}

/// FNV-1a of 64 bits, from `start` on.
fn hashed(start: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(start, |hash, &byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

impl<'a> BoxSequence<'a> {
    /// Sorts the boxes of `tracks` into the `sweeps` of their sequence, which are names without folder
    /// and ending.
    ///
    /// # Errors
    /// `Malformed` for a state in a sweep that is not among them, and for two sweeps of one name.
    pub fn new(
        tracks: &'a [Track],
        sweeps: &'a [String],
        class: &'a str,
    ) -> Result<Self, FormatError> {
        let mut names = HashSet::new();
        if let Some(twice) = sweeps.iter().find(|name| !names.insert(*name)) {
            return Err(KIND.malformed(format!("two sweeps have the name {twice}")));
        }
        let mut boxes: Vec<Vec<_>> = vec![Vec::new(); sweeps.len()];
        let mut digest = hashed(0xcbf2_9ce4_8422_2325, class.as_bytes());
        for name in sweeps {
            digest = hashed(digest, name.as_bytes());
        }
        for track in tracks {
            for state in &track.states {
                let index = state.sweep as usize;
                let in_sweep = boxes.get_mut(index).ok_or_else(|| {
                    KIND.malformed(format!(
                        "track {} is in sweep {index}, and of {} given sweeps the last is sweep {}: give all sweeps of \
                         the tracks",
                        track.id,
                        sweeps.len(),
                        sweeps.len().saturating_sub(1)
                    ))
                })?;
                in_sweep.push((track, state));
                for value in state.bounds.center {
                    digest = hashed(digest, &value.to_le_bytes());
                }
            }
        }
        Ok(Self {
            tracks,
            sweeps,
            class,
            boxes,
            digest,
        })
    }

    /// Name, tracks and states of each sweep, in order.
    pub(super) fn by_sweep(
        &self,
    ) -> impl Iterator<Item = (&'a str, &[(&'a Track, &'a TrackState)])> {
        let names = self.sweeps.iter().map(String::as_str);
        names.zip(self.boxes.iter().map(Vec::as_slice))
    }

    /// Tracks and states of the sweep `index`.
    pub(super) fn boxes(&self, index: usize) -> &[(&'a Track, &'a TrackState)] {
        &self.boxes[index]
    }

    /// The identity of something in this sequence: the same in every run, and another in another
    /// sequence.
    pub(super) fn key(&self, of: &str) -> Uuid {
        Uuid::from_u64_pair(self.digest, hashed(self.digest, of.as_bytes()))
    }
}

/// Mean confidence of the sweeps in which a track is seen, 0 to 1.
pub(super) fn confidence(track: &Track) -> f64 {
    let seen = track.states.iter().filter(|state| state.points > 0);
    let (sum, count) = seen.fold((0.0, 0), |(sum, count), state| {
        (sum + f64::from(state.confidence), count + 1)
    });
    sum / f64::from(count.max(1))
}

#[cfg(test)]
mod tests {
    use super::super::samples::{names, tracks};
    use super::*;

    #[test]
    fn boxes_are_found_by_sweep_and_hidden_ones_do_not_count_for_the_confidence() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "mover").expect("a sequence");
        let counts: Vec<_> = sequence
            .by_sweep()
            .map(|(name, boxes)| (name, boxes.len()))
            .collect();
        assert_eq!(counts, [("a", 1), ("b", 1), ("c", 2)]);
        assert!((confidence(&tracks[0]) - 0.75).abs() < 1e-9);
    }

    #[test]
    fn keys_are_the_same_in_every_run_and_others_in_another_sequence() {
        let (tracks, names) = (tracks(), names());
        let key = |names: &[String]| {
            let sequence = BoxSequence::new(&tracks, names, "mover").expect("a sequence");
            [sequence.key("object 1"), sequence.key("object 4")]
        };
        let [one, other] = key(&names);
        assert_ne!(one, other);
        assert_eq!(key(&names), [one, other]);
        let others = ["a", "b", "d"].map(str::to_owned);
        assert!(!key(&others).contains(&one));
    }

    #[test]
    fn tracks_of_more_sweeps_and_sweeps_of_one_name_are_refused() {
        let tracks = tracks();
        let refused = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
            let refused = BoxSequence::new(&tracks, &names, "mover").err();
            refused.expect("a refusal").to_string()
        };
        assert!(refused(&["a", "b"]).contains("track 1 is in sweep 2"));
        assert!(refused(&["a", "b", "a"]).contains("two sweeps have the name a"));
    }
}
