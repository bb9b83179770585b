//! The order of the sweeps of a sequence, by the numbers in their names.

use super::error::ApiError;
use crate::formats::turning_sweep;

/// The names of the latest sweeps of a sequence.
#[derive(Debug, Default)]
pub(super) struct SweepOrder {
    latest: Vec<String>,
}

impl SweepOrder {
    /// Adds the name of the next sweep.
    ///
    /// # Errors
    /// [`ApiError::BadInput`] if the numbers of the names turn back, as of files in the order 1, 10,
    /// 2. Not with `force`.
    pub(super) fn push(&mut self, name: &str, force: bool) -> Result<(), ApiError> {
        self.latest.push(name.to_owned());
        let names: Vec<&str> = self.latest.iter().map(String::as_str).collect();
        if let Some(at) = turning_sweep(&names)
            && !force
        {
            return Err(ApiError::BadInput(format!(
                "{:?} is followed by {:?}, against the order of the sweeps before: send sweeps in the \
                 order in which they were recorded, or set force",
                names[at],
                names[at + 1]
            )));
        }
        // A turn shows in three names.
        self.latest.drain(..self.latest.len().saturating_sub(2));
        Ok(())
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
    }
}
