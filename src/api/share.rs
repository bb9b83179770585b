//! Share links: tokens that give read access to one job until they expire.
//!
//! A token is sent like a key: `Authorization: Bearer share.JOB.EXPIRY.CODE`. `EXPIRY` is in
//! milliseconds since 1970, UTC. `CODE` is a keyed hash of job and expiry. Its key is derived from the API key of
//! the caller who shares, so every node with this API key accepts the token, and nothing is stored. Without the API key in the
//! configuration the token is void.

use constant_time_eq::constant_time_eq_32;

use super::error::ApiError;
use crate::clock::Timestamp;
use crate::job::JobId;

/// The first part of a token.
const PREFIX: &str = "share";

/// Context of the key derivation.
const CONTEXT: &str = "fnsf share links of jobs, version 2";

/// Rounds of the key derivation: some ten milliseconds, so that who has a link tries a hundred API keys
/// a second and not millions.
const ROUNDS: u32 = 1 << 16;

/// The content of a token, not yet verified.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ShareToken {
    /// The job that may be read.
    pub(super) job: JobId,
    /// The time from which the token is void.
    expires: Timestamp,
    code: [u8; 32],
}

impl ShareToken {
    /// A token for `job`, signed by the [`signer`] of an API key.
    pub(super) fn sign(signer: &[u8; 32], job: JobId, expires: Timestamp) -> Self {
        Self {
            job,
            expires,
            code: code(signer, job, expires),
        }
    }

    /// Parses a bearer token. `None` if it is not of this form.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let mut parts = text.split('.');
        let mut next = || parts.next();
        let (prefix, job, expires, code) = (next()?, next()?, next()?, next()?);
        if prefix != PREFIX || next().is_some() {
            return None;
        }
        Some(Self {
            job: job.parse().ok()?,
            expires: Timestamp::from_millis(expires.parse().ok()?),
            code: *blake3::Hash::from_hex(code).ok()?.as_bytes(),
        })
    }

    /// Whether this [`signer`] has signed the token. The comparison takes constant time.
    pub(super) fn is_signed_by(&self, signer: &[u8; 32]) -> bool {
        constant_time_eq_32(&self.code, &code(signer, self.job, self.expires))
    }

    /// Refuses a token after its expiry.
    ///
    /// # Errors
    /// [`ApiError::LinkExpired`].
    pub(super) fn check_expiry(&self, now: Timestamp) -> Result<(), ApiError> {
        if now < self.expires {
            Ok(())
        } else {
            Err(ApiError::LinkExpired)
        }
    }
}

impl std::fmt::Display for ShareToken {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let code = blake3::Hash::from_bytes(self.code).to_hex();
        let expires = self.expires.as_millis();
        write!(formatter, "{PREFIX}.{}.{expires}.{code}", self.job)
    }
}

/// The key that signs tokens, from the hash of an API key.
pub(super) fn signer(key_hash: &[u8; 32]) -> [u8; 32] {
    let mut key = blake3::derive_key(CONTEXT, key_hash);
    for _ in 0..ROUNDS {
        key = *blake3::hash(&key).as_bytes();
    }
    key
}

fn code(signer: &[u8; 32], job: JobId, expires: Timestamp) -> [u8; 32] {
    let text = format!("{job}.{}", expires.as_millis());
    *blake3::keyed_hash(signer, text.as_bytes()).as_bytes()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_token_is_void_when_altered_or_expired() {
        let (hash, job, now) = ([7; 32], JobId::fresh(), Timestamp::now());
        let token = ShareToken::sign(&hash, job, now.after(Duration::from_secs(60)));
        let text = token.to_string();
        assert_eq!(ShareToken::parse(&text), Some(token));
        assert!(token.is_signed_by(&hash) && !token.is_signed_by(&[8; 32]));
        assert_eq!(token.check_expiry(now), Ok(()));
        let late = now.after(Duration::from_secs(61));
        assert_eq!(token.check_expiry(late), Err(ApiError::LinkExpired));
        let later = ShareToken {
            expires: late,
            ..token
        };
        let other = ShareToken {
            job: JobId::fresh(),
            ..token
        };
        assert!(!later.is_signed_by(&hash) && !other.is_signed_by(&hash));
        for wrong in ["share", "share...", &format!("{text}.x"), &text[1..]] {
            assert_eq!(ShareToken::parse(wrong), None, "{wrong}");
        }
    }
}
