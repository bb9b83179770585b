//! Labels of jobs: pairs of a name and a value by which clients find their jobs.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::error::InvalidOptions;

/// Maximum number of labels of one job.
const MAX_LABELS: usize = 16;
/// Maximum length of a name, characters.
const MAX_NAME: usize = 63;
/// Maximum length of a value, bytes.
const MAX_VALUE: usize = 255;

/// The labels of a job: values by name.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(transparent)]
pub struct Labels(pub BTreeMap<String, String>);

impl Labels {
    /// Checks the number of labels, their names and their values: at most 16; names of 1 to 63
    /// letters, digits, `-`, `_`, `.` or `/`; values of at most 255 bytes without control
    /// characters.
    ///
    /// # Errors
    /// [`InvalidOptions::Labels`] or [`InvalidOptions::Label`].
    pub fn check(&self) -> Result<(), InvalidOptions> {
        if self.0.len() > MAX_LABELS {
            return Err(InvalidOptions::Labels(self.0.len()));
        }
        match self.0.iter().find(|label| !is_valid(*label)) {
            None => Ok(()),
            Some((name, _)) => Err(InvalidOptions::Label(name.chars().take(MAX_NAME).collect())),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The labels in the JSON form of a [`super::JobOptions`]. None if it cannot be read.
    pub fn of_options(json: &str) -> Self {
        #[derive(Deserialize)]
        struct Labelled {
            #[serde(default)]
            labels: Labels,
        }
        serde_json::from_str::<Labelled>(json)
            .map(|options| options.labels)
            .unwrap_or_default()
    }

    /// The labels as `name=value`. A name contains no `=`, so each text belongs to one label.
    pub fn texts(&self) -> Vec<String> {
        let text = |(name, value): (&String, &String)| format!("{name}={value}");
        self.0.iter().map(text).collect()
    }
}

fn is_valid((name, value): (&String, &String)) -> bool {
    let is_letter = |byte: u8| byte.is_ascii_alphanumeric() || b"-_./".contains(&byte);
    let is_name = (1..=MAX_NAME).contains(&name.len()) && name.bytes().all(is_letter);
    is_name && value.len() <= MAX_VALUE && !value.chars().any(char::is_control)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(pairs: &[(&str, &str)]) -> Labels {
        let pairs = pairs.iter();
        Labels(
            pairs
                .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
                .collect(),
        )
    }

    #[test]
    fn names_values_and_their_number_are_checked() {
        let good = labels(&[("drive", "2011_09_26 <0001>"), ("team/split", "")]);
        assert_eq!(good.check(), Ok(()));
        assert_eq!(good.texts(), ["drive=2011_09_26 <0001>", "team/split="]);
        for wrong in [("", "x"), ("a=b", "x"), ("a b", "x"), ("a", "x\ny")] {
            let refused = labels(&[wrong]).check();
            assert_eq!(refused, Err(InvalidOptions::Label(wrong.0.to_owned())));
        }
        let long = labels(&[("a", &"x".repeat(256))]).check();
        assert_eq!(long, Err(InvalidOptions::Label("a".to_owned())));
        let names: Vec<String> = (0..17).map(|at| format!("l{at}")).collect();
        let many: Vec<_> = names.iter().map(|name| (name.as_str(), "x")).collect();
        assert_eq!(labels(&many).check(), Err(InvalidOptions::Labels(17)));
    }
}
