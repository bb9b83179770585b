//! Depth as a 16-bit gray PNG, as KITTI has it: 1/256 m a step, 0 where nothing is known.
//!
//! It must not know cameras or colors.

use std::io::{Cursor, Write};

use crate::flow::depth::{DepthImage, MAX_SIDE_PX};

use super::error::{FileKind, FormatError};
use super::limits::unfold_limit;
use super::pair::check_count;

const KIND: FileKind = FileKind::Png;

/// Steps of a metre.
const STEPS_PER_M: f32 = 256.0;

/// Bytes that a pixel takes while it is read: its two, and four of its depth.
const PIXEL_BYTES: u64 = 6;

/// Writes a depth image, and says how many of its depths were dropped because the format ends at
/// 255.996 m: such pixels are written as unknown, never as nearer than they are.
///
/// # Errors
/// `RowCount` where the depths are not those of its size, `Encode` where writing fails.
pub fn write_depth_png<W: Write>(image: &DepthImage, out: W) -> Result<usize, FormatError> {
    let pixels = image.width as usize * image.height as usize;
    check_count("the depth image", image.metres.len(), pixels)?;
    let mut dropped = 0;
    let mut bytes = Vec::with_capacity(2 * pixels);
    for &metres in &image.metres {
        let steps = (metres * STEPS_PER_M).round();
        let is_held = (1.0..=f32::from(u16::MAX)).contains(&steps);
        let steps = if is_held { steps as u16 } else { 0 };
        dropped += usize::from(metres > 0.0 && !is_held);
        bytes.extend(steps.to_be_bytes());
    }
    let encode = |error| KIND.encode(error);
    let mut encoder = png::Encoder::new(out, image.width, image.height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let mut writer = encoder.write_header().map_err(encode)?;
    writer.write_image_data(&bytes).map_err(encode)?;
    writer.finish().map_err(encode)?;
    Ok(dropped)
}

/// Reads a depth image.
///
/// # Errors
/// `Malformed` for what is no PNG or breaks off, `Unsupported` for one of other than 16 bits of
/// gray, `TooLarge` for sides past 16,384 pixels or more pixels than a file of its length holds.
pub fn read_depth_png(bytes: &[u8]) -> Result<DepthImage, FormatError> {
    let broken = |error: png::DecodingError| KIND.malformed(error.to_string());
    let limits = png::Limits {
        bytes: usize::try_from(unfold_limit(bytes.len())).unwrap_or(usize::MAX),
    };
    let decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    let mut reader = decoder.read_info().map_err(broken)?;
    let info = reader.info();
    let (width, height) = (info.width, info.height);
    if reader.output_color_type() != (png::ColorType::Grayscale, png::BitDepth::Sixteen) {
        return Err(KIND.unsupported(
            "depth is read from 16 bits of gray a pixel, 256 steps a metre, as KITTI has it",
        ));
    }
    let pixels = u64::from(width) * u64::from(height);
    if width.max(height) > MAX_SIDE_PX || pixels * PIXEL_BYTES > unfold_limit(bytes.len()) {
        return Err(KIND.too_large(format!(
            "{width} x {height} pixels in {} bytes; {MAX_SIDE_PX} a side are the most",
            bytes.len()
        )));
    }
    let mut steps = vec![0; 2 * pixels as usize];
    reader.next_frame(&mut steps).map_err(broken)?;
    let (steps, _) = steps.as_chunks::<2>();
    let metres = |step: &[u8; 2]| f32::from(u16::from_be_bytes(*step)) / STEPS_PER_M;
    Ok(DepthImage {
        width,
        height,
        metres: steps.iter().map(metres).collect(),
    })
}
