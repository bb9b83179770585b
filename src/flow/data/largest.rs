//! The largest of some numbers.

/// The largest of `values`, at least zero. NaN counts as larger than any number.
pub(crate) fn largest(values: impl Iterator<Item = f32>) -> f32 {
    values.fold(0.0, |most: f32, value| {
        if value > most || value.is_nan() {
            value
        } else {
            most
        }
    })
}

#[cfg(test)]
mod tests {
    use super::largest;

    #[test]
    fn a_value_that_is_no_number_is_never_hidden_by_another() {
        assert_eq!(largest([1.0, 3.0, 2.0].into_iter()), 3.0);
        assert_eq!(largest(core::iter::empty()), 0.0);
        for values in [
            [f32::NAN, 5.0, 0.1],
            [5.0, f32::NAN, 0.1],
            [0.1, 5.0, f32::NAN],
        ] {
            assert!(largest(values.into_iter()).is_nan(), "{values:?}");
        }
    }
}
