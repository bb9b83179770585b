//! Authentication and authorization: API keys, tenants and roles, for both protocols.
//!
//! Keys are stored as hashes and compared in constant time. Without any keys every caller is the
//! default tenant with full rights, so such a server should listen on loopback only.

use constant_time_eq::constant_time_eq_32;
use serde::{Deserialize, Serialize};

use super::error::ApiError;
use super::share::{self, ShareToken};
use crate::clock::Timestamp;
use crate::job::{Job, JobId, Priority, Tenant};

/// What a caller may do. Each role includes the rights of those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Read jobs and fetch results.
    Read,
    /// Also submit, cancel and requeue jobs.
    Write,
    /// Also see the queued work of all tenants, the devices and the nodes.
    Operate,
}

/// An authenticated caller, or any caller of a server without keys.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    /// The tenant. A caller has access to this tenant's jobs only.
    pub tenant: Tenant,
    /// The rights of the caller.
    pub role: Role,
    /// The highest priority that the caller's jobs may have.
    pub max_priority: Priority,
    /// The only job that the caller may read, with its pairs, if it has a share link.
    pub shared_job: Option<JobId>,
}

impl Caller {
    /// Refuses a priority above the maximum of this caller.
    ///
    /// # Errors
    /// [`ApiError::Priority`], with the maximum.
    pub fn may_ask_for(&self, priority: Priority) -> Result<(), ApiError> {
        if priority <= self.max_priority {
            Ok(())
        } else {
            Err(ApiError::Priority(self.max_priority))
        }
    }

    /// Refuses callers with a share link.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`].
    pub(super) fn has_key(&self) -> Result<(), ApiError> {
        match self.shared_job {
            None => Ok(()),
            Some(_) => Err(ApiError::Forbidden),
        }
    }

    /// Whether the caller may read this job of its tenant.
    pub(super) fn may_read(&self, job: &Job) -> bool {
        self.shared_job
            .is_none_or(|shared| shared == job.id || Some(shared) == job.parent)
    }

    /// Refuses callers with read access only.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`] for [`Role::Read`].
    pub fn may_write(&self) -> Result<(), ApiError> {
        if self.role >= Role::Write {
            Ok(())
        } else {
            Err(ApiError::Forbidden)
        }
    }
}

/// The minimum length of a key, characters.
pub const MIN_KEY: usize = 16;

/// Why a key cannot be used, with the tenant of the key.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidKey {
    /// It is too short, so it could be guessed.
    #[error("the key of tenant {0} is shorter than {MIN_KEY} characters")]
    Short(Tenant),
    /// It starts or ends with white space, or has characters other than printable ASCII, so no
    /// header can carry it unchanged.
    #[error(
        "the key of tenant {0} has white space around it, or characters other than printable ASCII: \
         no header carries it"
    )]
    Unsendable(Tenant),
    /// The same key was given twice.
    #[error("the key of tenant {0} is given twice")]
    Twice(Tenant),
}

/// All keys of a server. Only hashes of the keys are stored.
#[derive(Clone, Debug, Default)]
pub struct Keys {
    known: Vec<Known>,
}

#[derive(Clone, Debug)]
struct Known {
    hash: [u8; 32],
    /// The key that signs share links. It is slow to derive, because a link can be tried with guessed keys.
    signer: [u8; 32],
    caller: Caller,
}

/// The key of a bearer token.
fn bearer(authorization: Option<&str>) -> Option<&str> {
    let (scheme, key) = authorization?.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then_some(key.trim())
}

fn hash_of(key: &str) -> [u8; 32] {
    *blake3::hash(key.as_bytes()).as_bytes()
}

impl Keys {
    /// Adds a key that identifies `caller`.
    ///
    /// # Errors
    /// - [`InvalidKey::Short`] if the key is shorter than [`MIN_KEY`].
    /// - [`InvalidKey::Unsendable`] if it has white space at an end, or characters other than
    ///   printable ASCII.
    /// - [`InvalidKey::Twice`] if it is already present, for any tenant.
    pub fn add(&mut self, key: &str, caller: Caller) -> Result<(), InvalidKey> {
        if key.len() < MIN_KEY {
            return Err(InvalidKey::Short(caller.tenant));
        }
        // HTTP strips white space around a header value.
        if key.trim() != key || !key.bytes().all(|byte| matches!(byte, b' '..=b'~')) {
            return Err(InvalidKey::Unsendable(caller.tenant));
        }
        let hash = hash_of(key);
        if self.known.iter().any(|known| known.hash == hash) {
            return Err(InvalidKey::Twice(caller.tenant));
        }
        self.known.push(Known {
            hash,
            signer: share::signer(&hash),
            caller,
        });
        Ok(())
    }

    /// Whether there are keys of more than one tenant.
    pub fn has_several_tenants(&self) -> bool {
        let mut tenants = self.known.iter().map(|known| &known.caller.tenant);
        let first = tenants.next();
        tenants.any(|tenant| Some(tenant) != first)
    }

    /// Whether the server has no keys, so that requests need none.
    pub fn is_open(&self) -> bool {
        self.known.is_empty()
    }

    /// The caller that a request identifies.
    ///
    /// `authorization` is the value of its `Authorization` header: `Bearer KEY`, where the case of
    /// `Bearer` does not matter. A server without keys ignores it. Every caller is then the default
    /// tenant with [`Role::Operate`] and priorities up to [`Priority::High`]. Instead of a key, the
    /// token of a share link identifies a caller who may read one job.
    ///
    /// # Errors
    /// - [`ApiError::Unauthenticated`] if the server has keys and the value is missing, has another
    ///   form, or has an unknown key.
    /// - [`ApiError::LinkExpired`] if the token of a share link has expired.
    pub fn caller(&self, authorization: Option<&str>) -> Result<Caller, ApiError> {
        if self.is_open() {
            return Ok(Caller {
                tenant: Tenant::default(),
                role: Role::Operate,
                max_priority: Priority::High,
                shared_job: None,
            });
        }
        let shown = bearer(authorization);
        let hash = hash_of(shown.unwrap_or_default());
        // All keys are compared, so the response time does not depend on the key that matches.
        let mut found = None;
        for known in &self.known {
            if constant_time_eq_32(&known.hash, &hash) {
                found = Some(&known.caller);
            }
        }
        match found {
            Some(caller) => Ok(caller.clone()),
            None => self.guest(shown.unwrap_or_default()),
        }
    }

    /// The caller that the token of a share link identifies.
    fn guest(&self, shown: &str) -> Result<Caller, ApiError> {
        let token = ShareToken::parse(shown).ok_or(ApiError::Unauthenticated)?;
        let mut known = self.known.iter();
        let signer = known.find(|known| token.is_signed_by(&known.signer));
        let signer = &signer.ok_or(ApiError::Unauthenticated)?.caller;
        token.check_expiry(Timestamp::now())?;
        Ok(Caller {
            tenant: signer.tenant.clone(),
            role: Role::Read,
            max_priority: Priority::Low,
            shared_job: Some(token.job),
        })
    }

    /// The token of a share link to a job, signed by the key in the value of the header `authorization`:
    /// without this key in the configuration it is void. `None` on a server without keys, where a reader
    /// needs no token.
    pub(super) fn share(
        &self,
        authorization: Option<&str>,
        job: JobId,
        expires: Timestamp,
    ) -> Option<String> {
        let hash = hash_of(bearer(authorization).unwrap_or_default());
        let mut known = self.known.iter();
        let key = known.find(|known| constant_time_eq_32(&known.hash, &hash))?;
        Some(ShareToken::sign(&key.signer, job, expires).to_string())
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
            shared_job: None,
        }
    }

    #[test]
    fn a_share_link_identifies_a_reader_of_one_job_until_it_expires() {
        let mut keys = Keys::default();
        let job = JobId::fresh();
        let now = Timestamp::now();
        let soon = now.after(std::time::Duration::from_secs(60));
        let tenant: Tenant = "a".parse().expect("a name");
        assert_eq!(keys.share(None, job, soon), None);
        for key in ["of another user", "0123456789abcdef"] {
            let padded = format!("{key:_<16}");
            keys.add(&padded, caller("a", Role::Write)).expect("a key");
        }
        let own = Some("Bearer 0123456789abcdef");
        let link = |expires| keys.share(own, job, expires).expect("a key");
        let guest = keys.caller(Some(&format!("Bearer {}", link(soon))));
        let guest = guest.expect("a good link");
        assert_eq!(
            (guest.tenant.clone(), guest.role),
            (tenant.clone(), Role::Read)
        );
        assert_eq!(guest.shared_job, Some(job));
        assert_eq!(guest.has_key(), Err(ApiError::Forbidden));
        let expired = keys.caller(Some(&format!("Bearer {}", link(now))));
        assert_eq!(expired, Err(ApiError::LinkExpired));
        let mut others = Keys::default();
        // The key that signed it is gone; another one of the tenant is not.
        others
            .add("of another user_", caller("a", Role::Write))
            .expect("a key");
        let foreign = others.caller(Some(&format!("Bearer {}", link(soon))));
        assert_eq!(foreign, Err(ApiError::Unauthenticated));
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
