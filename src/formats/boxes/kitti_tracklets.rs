//! KITTI's raw data: `tracklet_labels.xml`, an object with its pose in each of its sweeps.
//!
//! A place is the center of the box's lower face in the frame of the lidar, metres. `rz` is the yaw,
//! radians. Whether something is occluded or truncated is not known: -1.

use std::fmt::{self, Write};

use super::layout_file::LayoutFile;
use super::sequence::BoxSequence;
use crate::flow::tracks::{Track, TrackState};
use crate::formats::error::{FileKind, FormatError};

/// What the data set says of a pose: hidden objects are interpolated, the others labelled.
const INTERPOLATED: u8 = 1;
const LABELLED: u8 = 2;

/// The number of an element's class, which only the first element of a class states.
struct Class {
    id: u8,
    version: u8,
    is_stated: bool,
}

impl Class {
    const fn new(id: u8, version: u8) -> Self {
        Self {
            id,
            version,
            is_stated: false,
        }
    }

    /// The attributes of the next element.
    fn attributes(&mut self) -> String {
        let Self { id, version, .. } = *self;
        match std::mem::replace(&mut self.is_stated, true) {
            true => String::new(),
            false => format!(" class_id=\"{id}\" tracking_level=\"0\" version=\"{version}\""),
        }
    }
}

/// The tracklets of a sequence. Sweeps are numbered from 0.
///
/// # Errors
/// `Unsupported` for a track that has no state in a sweep between its first and its last: a tracklet
/// has the number of its first sweep alone.
pub(super) fn file(sequence: &BoxSequence<'_>) -> Result<LayoutFile, FormatError> {
    for track in sequence.tracks {
        let has_gap = |pair: &[TrackState]| pair[0].sweep + 1 != pair[1].sweep;
        if let Some(pair) = track.states.windows(2).find(|pair| has_gap(pair)) {
            return Err(FileKind::Json.unsupported(format!(
                "track {} has no box between the sweeps {} and {}, and a tracklet has one in each",
                track.id, pair[0].sweep, pair[1].sweep
            )));
        }
    }
    let mut text = String::new();
    write(&mut text, sequence).expect("a string takes all text");
    Ok(LayoutFile {
        path: "tracklet_labels.xml".to_owned(),
        bytes: text.into_bytes(),
    })
}

fn write(out: &mut String, sequence: &BoxSequence<'_>) -> fmt::Result {
    let tracks = || {
        sequence
            .tracks
            .iter()
            .filter(|track| !track.states.is_empty())
    };
    let [mut list, mut item] = [Class::new(0, 0), Class::new(1, 1)];
    let [mut poses, mut pose] = [Class::new(2, 0), Class::new(3, 2)];
    writeln!(
        out,
        "<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\" ?>"
    )?;
    writeln!(out, "<!DOCTYPE boost_serialization>")?;
    writeln!(
        out,
        "<boost_serialization signature=\"serialization::archive\" version=\"9\">"
    )?;
    writeln!(out, "<tracklets{}>", list.attributes())?;
    writeln!(out, "<count>{}</count>", tracks().count())?;
    writeln!(out, "<item_version>1</item_version>")?;
    let class = escaped(sequence.class);
    for track in tracks() {
        writeln!(out, "<item{}>", item.attributes())?;
        writeln!(out, "<objectType>{class}</objectType>")?;
        let [length, width, height] = track.states[0].bounds.size;
        writeln!(out, "<h>{height}</h><w>{width}</w><l>{length}</l>")?;
        writeln!(out, "<first_frame>{}</first_frame>", track.states[0].sweep)?;
        writeln!(out, "<poses{}>", poses.attributes())?;
        write_poses(out, track, &mut pose)?;
        writeln!(out, "</poses>\n<finished>1</finished>\n</item>")?;
    }
    writeln!(out, "</tracklets>\n</boost_serialization>")
}

fn write_poses(out: &mut String, track: &Track, class: &mut Class) -> fmt::Result {
    writeln!(out, "<count>{}</count>", track.states.len())?;
    writeln!(out, "<item_version>2</item_version>")?;
    for state in &track.states {
        let [x, y, z] = state.bounds.center;
        let z = z - state.bounds.size[2] / 2.0;
        let yaw = state.bounds.yaw;
        let known = if state.points > 0 {
            LABELLED
        } else {
            INTERPOLATED
        };
        writeln!(
            out,
            "<item{}><tx>{x}</tx><ty>{y}</ty><tz>{z}</tz><rx>0</rx><ry>0</ry><rz>{yaw}</rz>\
             <state>{known}</state>\
             <occlusion>-1</occlusion><occlusion_kf>0</occlusion_kf>\
             <truncation>-1</truncation>\
             <amt_occlusion>-1</amt_occlusion><amt_occlusion_kf>0</amt_occlusion_kf>\
             <amt_border_l>-1</amt_border_l><amt_border_r>-1</amt_border_r>\
             <amt_border_kf>0</amt_border_kf></item>",
            class.attributes()
        )?;
    }
    Ok(())
}

/// Text as XML has it.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::super::samples::{names, tracks};
    use super::*;

    #[test]
    fn a_track_is_an_item_with_a_pose_in_each_sweep_on_its_lower_face() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "Van & <trailer>").expect("a sequence");
        let file = file(&sequence).expect("a file");
        assert_eq!(file.path, "tracklet_labels.xml");
        let text = String::from_utf8(file.bytes).expect("text");
        assert!(text.contains("<count>2</count>\n<item_version>1</item_version>"));
        assert!(text.contains("<objectType>Van &amp; &lt;trailer&gt;</objectType>"));
        assert!(text.contains("<h>1.5</h><w>1.75</w><l>4.5</l>\n<first_frame>0</first_frame>"));
        assert!(text.contains("<first_frame>2</first_frame>"));
        assert_eq!(text.matches("<tx>").count(), 4);
        assert!(
            text.contains("<tx>1</tx><ty>-2</ty><tz>-0.25</tz><rx>0</rx><ry>0</ry><rz>0.25</rz>")
        );
        // Hidden in sweep 1.
        assert_eq!(text.matches("<state>1</state>").count(), 1);
        // The number of a class is stated once.
        for class in 0..4 {
            assert_eq!(text.matches(&format!("class_id=\"{class}\"")).count(), 1);
        }
    }

    #[test]
    fn a_track_with_a_gap_is_refused() {
        let (mut tracks, names) = (tracks(), names());
        tracks[0].states.remove(1);
        let sequence = BoxSequence::new(&tracks, &names, "Van").expect("a sequence");
        let refused = file(&sequence).expect_err("a gap").to_string();
        assert!(
            refused.contains("track 1 has no box between the sweeps 0 and 2"),
            "{refused}"
        );
    }
}
