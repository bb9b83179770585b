//! API keys in a configuration, and error messages that do not reveal them.

use std::fmt;

use figment::error::Kind;
use serde::de::Visitor;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Secret text. `Debug` and `Serialize` give `***` in its place. It is deserialized from a string.
#[derive(Clone)]
pub struct Secret(String);

impl Secret {
    /// The secret text.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("***")
    }
}

impl Serialize for Secret {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str("***")
    }
}

impl<'de> Deserialize<'de> for Secret {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(SecretVisitor)
    }
}

/// Accepts strings and single characters. The error for any other type does not contain the value.
struct SecretVisitor;

/// The error for a value that is not a string. It does not contain the value.
fn no_text<E: serde::de::Error>() -> E {
    E::custom("a key is text: put it in quotes")
}

impl<'de> Visitor<'de> for SecretVisitor {
    type Value = Secret;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("text")
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Secret, E> {
        Ok(Secret(text.to_owned()))
    }

    fn visit_bool<E: serde::de::Error>(self, _: bool) -> Result<Secret, E> {
        Err(no_text())
    }

    fn visit_i64<E: serde::de::Error>(self, _: i64) -> Result<Secret, E> {
        Err(no_text())
    }

    fn visit_u64<E: serde::de::Error>(self, _: u64) -> Result<Secret, E> {
        Err(no_text())
    }

    fn visit_i128<E: serde::de::Error>(self, _: i128) -> Result<Secret, E> {
        Err(no_text())
    }

    fn visit_u128<E: serde::de::Error>(self, _: u128) -> Result<Secret, E> {
        Err(no_text())
    }

    fn visit_f64<E: serde::de::Error>(self, _: f64) -> Result<Secret, E> {
        Err(no_text())
    }

    fn visit_char<E: serde::de::Error>(self, one: char) -> Result<Secret, E> {
        Ok(Secret(one.into()))
    }

    fn visit_some<D: Deserializer<'de>>(self, inner: D) -> Result<Secret, D::Error> {
        inner.deserialize_any(self)
    }
}

/// The errors of figment as one line, key by key. Values are left out: a key that stands at a wrong place
/// may have a secret as its value.
pub(super) fn wrong_values(error: figment::Error) -> String {
    let said = error.into_iter().map(|mut error| {
        let needed = match &error.kind {
            Kind::InvalidType(_, needed) | Kind::InvalidValue(_, needed) => needed.clone(),
            Kind::UnknownVariant(_, known) => format!("one of {}", known.join(", ")),
            _ => return error.to_string(),
        };
        let path = error.path.join(".");
        let source = error.metadata.take();
        let source = source.map_or(String::new(), |source| format!(", in {}", source.name));
        format!("{path} is something else than {needed}{source}")
    });
    said.collect::<Vec<_>>().join("; ")
}
