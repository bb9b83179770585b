//! Identifiers of jobs and tenants. Neither can contain a path separator.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use serde::{Serialize, Serializer};
use uuid::Uuid;

/// The id of a job, a UUID. New ids are of version 7, so that they sort by creation time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct JobId(Uuid);

impl JobId {
    /// A new unique id: a UUID of version 7, with the current time in its first bytes.
    pub fn fresh() -> Self {
        Self(Uuid::now_v7())
    }

    /// The id with these 16 bytes, as [`JobId::as_bytes`] returns them. All values are accepted.
    pub fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(Uuid::from_bytes(bytes))
    }

    /// Its 16 bytes. Their lexicographic order is the order of the ids.
    pub fn as_bytes(&self) -> &[u8; 16] {
        self.0.as_bytes()
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.hyphenated().fmt(f)
    }
}

impl Serialize for JobId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Why a text is not a job id or a tenant name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidId {
    /// The text is not a UUID in the form of 8-4-4-4-12 hexadecimal digits.
    #[error("a job's name is a UUID, such as 0192f0c1-7b7a-7000-8000-000000000000")]
    Job,
    /// The text is not 1 to 64 ASCII letters, digits, `-`, `_` or `.`.
    #[error("a tenant's name has 1 to 64 letters, digits, '-', '_' or '.'")]
    Tenant,
}

impl FromStr for JobId {
    type Err = InvalidId;

    fn from_str(text: &str) -> Result<Self, InvalidId> {
        if text.len() != 36 {
            return Err(InvalidId::Job);
        }
        Uuid::parse_str(text).map(Self).map_err(|_| InvalidId::Job)
    }
}

/// The name of a tenant, the owner of jobs: 1 to 64 ASCII letters, digits, `-`, `_` or `.`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Tenant(Arc<str>);

impl Tenant {
    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Default for Tenant {
    /// The tenant of a server without keys.
    fn default() -> Self {
        Self(Arc::from("default"))
    }
}

impl FromStr for Tenant {
    type Err = InvalidId;

    fn from_str(text: &str) -> Result<Self, InvalidId> {
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        if text.is_empty() || text.len() > 64 || !text.chars().all(plain) {
            return Err(InvalidId::Tenant);
        }
        Ok(Self(Arc::from(text)))
    }
}

impl fmt::Display for Tenant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_come_back_from_their_text_and_paths_are_no_names() {
        let id = JobId::fresh();
        assert_eq!(id.to_string().parse(), Ok(id));
        for wrong in [
            "",
            "../../etc/passwd",
            "0192f0c17b7a70008000000000000000",
            "x",
        ] {
            assert_eq!(wrong.parse::<JobId>(), Err(InvalidId::Job));
        }
        for wrong in ["", "a/b", "a b", &"x".repeat(65)] {
            assert_eq!(wrong.parse::<Tenant>(), Err(InvalidId::Tenant));
        }
    }

    #[test]
    fn names_sort_by_time() {
        let names: Vec<JobId> = (0..1000).map(|_| JobId::fresh()).collect();
        assert!(names.is_sorted());
    }
}
