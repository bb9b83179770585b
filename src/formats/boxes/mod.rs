//! Boxes of tracks in the layouts of labelling tools and data sets.

mod av2_annotations;
mod layout;
mod layout_file;
#[cfg(test)]
mod samples;
mod sequence;
mod supervisely;
mod sustechpoints;

pub use crate::formats::boxes::layout::BoxLayout;
pub use crate::formats::boxes::layout_file::LayoutFile;
pub use crate::formats::boxes::sequence::BoxSequence;
