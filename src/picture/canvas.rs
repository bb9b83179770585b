//! A canvas of pixels: blending, smooth circles and lines, text, and PNG output.

use std::io::Write;

use super::font::{GLYPH, glyph};

/// Red, green, blue, 8 bits each.
pub(super) type Rgb = [u8; 3];

/// An 8-bit RGB picture in memory, rows from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    width: u32,
    height: u32,
    pixels: Vec<Rgb>,
}

/// The encoding of a picture as PNG failed, or the writing of the file.
#[derive(Debug, thiserror::Error)]
#[error("failed to write the picture")]
pub struct PictureError(#[from] png::EncodingError);

/// The style of a text.
#[derive(Clone, Copy)]
pub(super) struct TextStyle {
    /// Pixels per dot of the font.
    pub(super) dot: i32,
    pub(super) color: Rgb,
    pub(super) align: Align,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Align {
    Left,
    Center,
}

impl Image {
    /// An image of one color.
    pub(super) fn filled(width: u32, height: u32, color: Rgb) -> Self {
        Self {
            width,
            height,
            pixels: vec![color; width as usize * height as usize],
        }
    }

    /// Pixels per row.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Number of rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// All pixels (red, green, blue), row by row from the top.
    pub fn pixels(&self) -> &[Rgb] {
        &self.pixels
    }

    /// Blends a color over a pixel, opacity 0 to 1; does nothing outside the image.
    pub(super) fn blend(&mut self, x: i32, y: i32, color: Rgb, opacity: f32) {
        let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y)) else {
            return;
        };
        if x >= self.width || y >= self.height {
            return;
        }
        let index = y as usize * self.width as usize + x as usize;
        let opacity = opacity.clamp(0.0, 1.0);
        if let Some(pixel) = self.pixels.get_mut(index) {
            for (under, over) in pixel.iter_mut().zip(color) {
                let mixed = f32::from(*under) * (1.0 - opacity) + f32::from(over) * opacity;
                *under = mixed.round() as u8;
            }
        }
    }

    /// Calls `shade` for every pixel of a square, with the offset of the pixel's center from
    /// `center`, and blends the color and opacity that it returns.
    pub(super) fn shade_square(
        &mut self,
        center: [f32; 2],
        half_side: f32,
        shade: impl Fn(f32, f32) -> (Rgb, f32),
    ) {
        let from = |axis: usize| (center[axis] - half_side).floor() as i32;
        let to = |axis: usize| (center[axis] + half_side).ceil() as i32;
        for y in from(1).max(0)..=to(1).min(self.height as i32 - 1) {
            for x in from(0).max(0)..=to(0).min(self.width as i32 - 1) {
                let (color, opacity) =
                    shade(x as f32 + 0.5 - center[0], y as f32 + 0.5 - center[1]);
                if opacity > 0.0 {
                    self.blend(x, y, color, opacity);
                }
            }
        }
    }

    /// A filled circle with a smooth edge; lengths in pixels.
    pub(super) fn disk(&mut self, center: [f32; 2], radius: f32, color: Rgb, opacity: f32) {
        self.shade_square(center, radius + 1.0, |x, y| {
            (color, opacity * (radius + 0.5 - x.hypot(y)).clamp(0.0, 1.0))
        });
    }

    /// The outline of a circle, smooth and one pixel wide.
    pub(super) fn ring(&mut self, center: [f32; 2], radius: f32, color: Rgb, opacity: f32) {
        self.shade_square(center, radius + 1.0, |x, y| {
            (
                color,
                opacity * (1.0 - (x.hypot(y) - radius).abs()).clamp(0.0, 1.0),
            )
        });
    }

    /// A rectangle with edges at whole pixels.
    pub(super) fn bar(&mut self, corner: [i32; 2], size: [i32; 2], color: Rgb, opacity: f32) {
        for y in corner[1]..corner[1] + size[1] {
            for x in corner[0]..corner[0] + size[0] {
                self.blend(x, y, color, opacity);
            }
        }
    }

    /// One line of text, its top at `at`.
    pub(super) fn text(&mut self, at: [i32; 2], text: &str, style: TextStyle) {
        let advance = (GLYPH.0 as i32 + 1) * style.dot;
        let width = text.chars().count() as i32 * advance - style.dot;
        let left = if style.align == Align::Center {
            at[0] - width / 2
        } else {
            at[0]
        };
        for (index, letter) in text.chars().enumerate() {
            let left = left + index as i32 * advance;
            for (row, bits) in glyph(letter).into_iter().enumerate() {
                for column in (0..GLYPH.0).filter(|column| bits >> (GLYPH.0 - 1 - column) & 1 == 1)
                {
                    let corner = [
                        left + column as i32 * style.dot,
                        at[1] + row as i32 * style.dot,
                    ];
                    self.bar(corner, [style.dot; 2], style.color, 1.0);
                }
            }
        }
    }
}

/// Writes an image as an 8-bit RGB PNG.
///
/// # Errors
/// [`PictureError`] where encoding or writing to `out` fails.
pub fn write_png(image: &Image, out: &mut dyn Write) -> Result<(), PictureError> {
    let mut encoder = png::Encoder::new(out, image.width, image.height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(image.pixels.as_flattened())?;
    Ok(writer.finish()?)
}
