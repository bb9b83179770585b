//! What a configuration holds and nobody may see: keys, and errors in their place.

use std::fmt;

use figment::error::Kind;
use serde::de::Visitor;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Text that is never shown.
#[derive(Clone)]
pub struct Secret(String);

impl Secret {
    /// The text itself.
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

/// Reads text, and says of anything else no more than that it is none.
struct SecretVisitor;

/// A value that is no text, without saying it.
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

/// What is wrong, key by key. What was found in a key's place is never said: it may be the key.
pub(super) fn wrong_values(error: figment::Error) -> String {
    const SECRET: [&str; 3] = ["api_key", "keys", "tls"];
    let said = error.into_iter().map(|mut error| {
        let is_secret = error.path.first();
        if !is_secret.is_some_and(|first| SECRET.contains(&first.as_str())) {
            return error.to_string();
        }
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
