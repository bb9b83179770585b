//! KITTI's depth images: 16-bit gray PNG, 1/256 m per step, 0 where the depth is unknown.

use std::io::{Cursor, Write};

use super::error::{FileKind, FormatError};
use super::limits::unfold_limit;
use super::pair::check_count;
use crate::flow::depth::{DepthImage, MAX_SIDE_PX};

const KIND: FileKind = FileKind::Png;

/// Steps per metre.
const STEPS_PER_M: f32 = 256.0;

/// Memory per pixel while a file is read, bytes: two of the PNG and four of the depth.
const PIXEL_BYTES: u64 = 6;

/// Writes a depth image as KITTI's PNG: 16-bit gray, 1/256 m per step, 0 where the depth is
/// unknown.
///
/// Returns the number of known depths that the format cannot represent: less than 1/512 m, or at
/// least 255.998 m. Such pixels are written as unknown.
///
/// # Errors
/// `RowCount` where the number of depths does not match the image's size. `Encode` for an image
/// without pixels, and where encoding or writing fails.
pub fn write_depth_png(image: &DepthImage, out: &mut dyn Write) -> Result<usize, FormatError> {
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

/// Reads a depth image in KITTI's format: 16-bit gray PNG, 1/256 m per step, 0 where the depth is
/// unknown.
///
/// # Errors
/// - `Malformed` for bytes that are not a complete PNG.
/// - `Unsupported` for a PNG other than 16-bit gray.
/// - `TooLarge` for sides over 16,384 pixels. Also for an image that needs, at 6 bytes per pixel,
///   more than 32 MiB plus 32 times the file's size, or more than 4 GiB.
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
