//! Errors of a depth image against ground truth.

use super::image::DepthImage;

/// Relative error up to which a depth counts as close.
const CLOSE: f64 = 0.05;

/// Two depth images have different sizes and cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "a depth image of {} x {} pixels cannot be compared with one of {} x {}",
    found[0], found[1], expected[0], expected[1]
)]
pub struct SizeMismatch {
    /// Width and height of the evaluated image, pixels.
    pub found: [u32; 2],
    /// Width and height of the ground truth, pixels.
    pub expected: [u32; 2],
}

/// Errors of a depth image against the ground truth, over the pixels with a depth in both images.
/// Without such pixels all means, the median and `within_5_percent` are NaN.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthErrors {
    /// Number of pixels with a depth in both images.
    pub pixels: usize,
    /// Share of the pixels with a true depth that have a depth in the evaluated image, 0 to 1. NaN
    /// if no pixel has a true depth.
    pub coverage: f64,
    /// Mean absolute error, metres.
    pub mean_m: f64,
    /// Median absolute error, metres; of an even number of values, the upper of the two middle
    /// ones.
    pub median_m: f64,
    /// Root mean squared error, metres.
    pub rmse_m: f64,
    /// Mean relative error: absolute error divided by true depth.
    pub relative: f64,
    /// Share of the pixels whose error is at most 5 % of the true depth, 0 to 1.
    pub within_5_percent: f64,
}

impl DepthImage {
    /// The errors of this image against the ground truth `truth`, an image of the same size.
    ///
    /// # Errors
    /// [`SizeMismatch`] if the widths or the heights differ.
    pub fn errors(&self, truth: &DepthImage) -> Result<DepthErrors, SizeMismatch> {
        let size = |image: &DepthImage| [image.width, image.height];
        if size(self) != size(truth) {
            return Err(SizeMismatch {
                found: size(self),
                expected: size(truth),
            });
        }
        let pairs = self.metres.iter().zip(&truth.metres);
        let both: Vec<(f64, f64)> = pairs
            .filter(|&(&found, &truth)| found > 0.0 && truth > 0.0)
            .map(|(&found, &truth)| (f64::from((found - truth).abs()), f64::from(truth)))
            .collect();
        let mean = |value: &dyn Fn(&(f64, f64)) -> f64| {
            both.iter().map(value).sum::<f64>() / both.len() as f64
        };
        Ok(DepthErrors {
            pixels: both.len(),
            coverage: both.len() as f64 / truth.known() as f64,
            mean_m: mean(&|(error, _)| *error),
            median_m: median(both.iter().map(|(error, _)| *error).collect()),
            rmse_m: mean(&|(error, _)| error * error).sqrt(),
            relative: mean(&|(error, truth)| error / truth),
            within_5_percent: mean(&|(error, truth)| f64::from(*error <= CLOSE * truth)),
        })
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(metres: [f32; 4]) -> DepthImage {
        DepthImage {
            width: 2,
            height: 2,
            metres: metres.to_vec(),
        }
    }

    #[test]
    fn only_pixels_that_both_know_are_compared() {
        let errors = image([10.0, 21.0, 0.0, 5.0])
            .errors(&image([10.0, 20.0, 7.0, 0.0]))
            .unwrap();
        assert_eq!(errors.pixels, 2);
        assert!((errors.coverage - 2.0 / 3.0).abs() < 1e-12);
        assert_eq!((errors.mean_m, errors.median_m), (0.5, 1.0));
        assert!((errors.rmse_m - 0.5_f64.sqrt()).abs() < 1e-12);
        assert_eq!((errors.relative, errors.within_5_percent), (0.025, 1.0));
    }

    #[test]
    fn images_of_different_sizes_are_not_compared() {
        let error = image([1.0; 4]).errors(&DepthImage::empty(3, 2));
        assert_eq!(
            error.unwrap_err().to_string(),
            "a depth image of 2 x 2 pixels cannot be compared with one of 3 x 2"
        );
    }

    #[test]
    fn nothing_in_common_has_no_error_to_speak_of() {
        let errors = image([0.0; 4]).errors(&image([1.0; 4])).unwrap();
        assert_eq!((errors.pixels, errors.coverage), (0, 0.0));
        assert!(errors.mean_m.is_nan() && errors.median_m.is_nan());
    }
}
