//! Who calls: keys, tenants and roles. One check for every door.
//!
//! Keys are kept hashed and compared in constant time. Without keys everybody is the default
//! tenant and may do everything, which is why such a server listens on loopback alone.

use constant_time_eq::constant_time_eq_32;
use serde::{Deserialize, Serialize};

use super::error::ApiError;
use crate::job::{Priority, Tenant};

/// What a key may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Look at jobs and fetch results.
    Read,
    /// Submit, cancel and requeue too.
    Write,
}

/// Somebody who has shown a key, or needs none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    /// Whose jobs are seen.
    pub tenant: Tenant,
    /// What may be done.
    pub role: Role,
    /// How urgent its jobs may be.
    pub max_priority: Priority,
}

impl Caller {
    /// Refuses jobs that are more urgent than this key's may be.
    ///
    /// # Errors
    /// [`ApiError::Priority`].
    pub fn may_ask_for(&self, priority: Priority) -> Result<(), ApiError> {
        if priority <= self.max_priority {
            Ok(())
        } else {
            Err(ApiError::Priority(self.max_priority))
        }
    }

    /// Refuses callers that may only read.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`].
    pub fn may_write(&self) -> Result<(), ApiError> {
        if self.role >= Role::Write {
            Ok(())
        } else {
            Err(ApiError::Forbidden)
        }
    }
}

/// The shortest key that is taken, characters.
pub const MIN_KEY: usize = 16;

/// A key that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidKey {
    /// It could be guessed.
    #[error("the key of tenant {0} is shorter than {MIN_KEY} characters")]
    Short(Tenant),
    /// No header could carry it as it is.
    #[error(
        "the key of tenant {0} has white space around it, or characters other than printable ASCII: \
         no header carries it"
    )]
    Unsendable(Tenant),
    /// Two tenants cannot share one.
    #[error("the key of tenant {0} is given twice")]
    Twice(Tenant),
}

/// All keys of a server.
#[derive(Clone, Debug, Default)]
pub struct Keys {
    known: Vec<([u8; 32], Caller)>,
}

impl Keys {
    /// Takes one more key.
    ///
    /// # Errors
    /// [`InvalidKey`] where it is too short, cannot be sent or is known already.
    pub fn add(&mut self, key: &str, caller: Caller) -> Result<(), InvalidKey> {
        if key.len() < MIN_KEY {
            return Err(InvalidKey::Short(caller.tenant));
        }
        // What a header carries as it is: white space around a value is no part of it.
        if key.trim() != key || !key.bytes().all(|byte| matches!(byte, b' '..=b'~')) {
            return Err(InvalidKey::Unsendable(caller.tenant));
        }
        let hash = *blake3::hash(key.as_bytes()).as_bytes();
        if self.known.iter().any(|(known, _)| *known == hash) {
            return Err(InvalidKey::Twice(caller.tenant));
        }
        self.known.push((hash, caller));
        Ok(())
    }

    /// Whether there are keys of more than one tenant.
    pub fn has_several_tenants(&self) -> bool {
        let mut tenants = self.known.iter().map(|(_, caller)| &caller.tenant);
        let first = tenants.next();
        tenants.any(|tenant| Some(tenant) != first)
    }

    /// Whether anybody may do anything.
    pub fn is_open(&self) -> bool {
        self.known.is_empty()
    }

    /// The caller whose key a request shows: `authorization` is that header's value, if any.
    ///
    /// # Errors
    /// [`ApiError::Unauthenticated`] where keys are needed and this is none of them.
    pub fn caller(&self, authorization: Option<&str>) -> Result<Caller, ApiError> {
        if self.is_open() {
            return Ok(Caller {
                tenant: Tenant::default(),
                role: Role::Write,
                max_priority: Priority::High,
            });
        }
        let shown = authorization.and_then(|value| {
            let (scheme, key) = value.split_once(' ')?;
            scheme.eq_ignore_ascii_case("bearer").then_some(key.trim())
        });
        let hash = *blake3::hash(shown.unwrap_or_default().as_bytes()).as_bytes();
        // All keys are compared, so that the time tells nothing of which one matched.
        let mut found = None;
        for (known, caller) in &self.known {
            if constant_time_eq_32(known, &hash) {
                found = Some(caller);
            }
        }
        found.cloned().ok_or(ApiError::Unauthenticated)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn caller(tenant: &str, role: Role) -> Caller {
        Caller {
            tenant: tenant.parse().expect("a good name"),
            role,
            max_priority: Priority::Normal,
        }
    }

    #[test]
    fn only_known_keys_open_a_server_that_has_keys() {
        let mut keys = Keys::default();
        assert!(keys.caller(None).is_ok());
        let short = keys.add("", caller("a", Role::Write));
        assert!(matches!(short, Err(InvalidKey::Short(_))));
        for unsendable in ["0123456789abcdef ", "                ", "0123456789abcdeé"] {
            let refused = keys.add(unsendable, caller("a", Role::Write));
            assert!(matches!(refused, Err(InvalidKey::Unsendable(_))));
        }
        keys.add("0123456789abcdef", caller("a", Role::Write))
            .expect("a key");
        keys.add("fedcba9876543210", caller("b", Role::Read))
            .expect("a key");
        let twice = keys.add("fedcba9876543210", caller("c", Role::Read));
        assert!(matches!(twice, Err(InvalidKey::Twice(_))));
        let found = keys.caller(Some("Bearer fedcba9876543210")).expect("known");
        assert_eq!(found, caller("b", Role::Read));
        assert_eq!(found.may_write(), Err(ApiError::Forbidden));
        assert_eq!(found.may_ask_for(Priority::Normal), Ok(()));
        let refused = Err(ApiError::Priority(Priority::Normal));
        assert_eq!(found.may_ask_for(Priority::High), refused);
        for wrong in [
            None,
            Some(""),
            Some("Bearer "),
            Some("Basic 0123456789abcdef"),
            Some("Bearer x"),
        ] {
            assert_eq!(keys.caller(wrong), Err(ApiError::Unauthenticated));
        }
    }
}
