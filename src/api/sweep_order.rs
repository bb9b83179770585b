//! The order of the sweeps of a sequence, by the numbers in their names.

use super::error::ApiError;
use crate::formats;

/// The order of the sweeps so far.
#[derive(Debug, Default)]
pub(super) struct SweepOrder(formats::SweepOrder);

impl SweepOrder {
    /// Adds the name of the next sweep. One without a name counts for nothing.
    ///
    /// # Errors
    /// [`ApiError::BadInput`] if the numbers of the names turn back, as of files in the order 1, 10,
    /// 2. Not with `force`.
    pub(super) fn push(&mut self, name: &str, force: bool) -> Result<(), ApiError> {
        let turned = (!name.is_empty()).then(|| self.0.push(name)).flatten();
        match turned {
            Some(before) if !force => Err(ApiError::BadInput(format!(
                "{before:?} is followed by {name:?}, against the order of the sweeps before: send sweeps in the \
                 order in which they were recorded, or set force"
            ))),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pushed(names: &[&str], force: bool) -> Result<(), ApiError> {
        let mut order = SweepOrder::default();
        names.iter().try_for_each(|name| order.push(name, force))
    }

    #[test]
    fn numbers_that_turn_back_are_refused_unless_forced() {
        let names: Vec<String> = (1..30).map(|number| format!("{number}.pcd")).collect();
        let mut names: Vec<&str> = names.iter().map(String::as_str).collect();
        assert_eq!(pushed(&names, false), Ok(()));
        names.sort_unstable();
        let refused = pushed(&names, false)
            .expect_err("1, 10, ... 19, 2")
            .to_string();
        assert!(
            refused.contains("\"19.pcd\" is followed by \"2.pcd\""),
            "{refused}"
        );
        assert_eq!(pushed(&names, true), Ok(()));
        assert_eq!(pushed(&["", "", ""], false), Ok(()));
        assert!(pushed(&["1.pcd", "10.pcd", "", "2.pcd"], false).is_err());
    }
}
