//! Webhooks: signed notices of the end of jobs, in the form of
//! [Standard Webhooks](https://www.standardwebhooks.com).

use std::sync::Arc;
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;
use url::Url;

use super::allowed::{Allowed, NotAllowed};
use super::client::{chain, client, literal_is_reachable};

/// Time of one notice, from the connection to the end of the answer's headers.
const TIMEOUT: Duration = Duration::from_secs(15);

/// Minimum length of a secret, bytes.
const MIN_SECRET: usize = 24;

/// A secret that cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a webhook secret is whsec_ and then at least {MIN_SECRET} random bytes in base64: make one with \
     echo whsec_$(openssl rand -base64 32)"
)]
pub struct InvalidSecret;

/// The key of the signatures.
#[derive(Clone)]
pub struct SigningSecret(Hmac<Sha256>);

impl SigningSecret {
    /// Reads `whsec_` and a key of at least 24 bytes in base64.
    ///
    /// # Errors
    /// [`InvalidSecret`].
    pub fn parse(text: &str) -> Result<Self, InvalidSecret> {
        let key = text.strip_prefix("whsec_").ok_or(InvalidSecret)?;
        let key = STANDARD.decode(key).map_err(|_| InvalidSecret)?;
        if key.len() < MIN_SECRET {
            return Err(InvalidSecret);
        }
        Hmac::new_from_slice(&key)
            .map(Self)
            .map_err(|_| InvalidSecret)
    }

    /// The value of the header `webhook-signature`.
    fn sign(&self, id: &str, seconds: i64, body: &str) -> String {
        let mut mac = self.0.clone();
        mac.update(format!("{id}.{seconds}.{body}").as_bytes());
        format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()))
    }
}

/// Why a webhook was not told.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotTold {
    /// The configuration does not allow its URL (any more).
    #[error("its URL {0}")]
    NotAllowed(#[from] NotAllowed),
    /// Its URL has an address that is not public.
    #[error("its URL has a private address")]
    Private,
    /// It answered with another status than 2xx.
    #[error("it answered {0}")]
    Status(u16),
    /// It did not answer.
    #[error("{0}")]
    Failed(String),
}

impl NotTold {
    /// Whether a later attempt may succeed. Status 410 (Gone) means that the receiver was removed, so it
    /// is not retried. A URL that was allowed when the job came may be unknown to another node, or to
    /// this one until its settings are those of the others.
    pub fn is_worth_a_retry(&self) -> bool {
        match self {
            Self::Failed(_) | Self::NotAllowed(_) => true,
            Self::Status(status) => *status != 410,
            Self::Private => false,
        }
    }
}

/// Tells webhooks; by default none is allowed. Clones share the connections.
#[derive(Clone, Default)]
pub struct Webhooks(Option<Arc<Parts>>);

struct Parts {
    allowed: Allowed,
    secret: SigningSecret,
    allows_private: bool,
    client: reqwest::Client,
}

impl Webhooks {
    /// Webhooks below the `allowed` URLs, signed with `secret`.
    ///
    /// # Panics
    /// If no TLS provider was installed for the process.
    pub fn new(allowed: Allowed, secret: SigningSecret, allows_private: bool) -> Self {
        Self(Some(Arc::new(Parts {
            allowed,
            secret,
            allows_private,
            client: client(allows_private),
        })))
    }

    /// Whether no webhook is allowed.
    pub fn are_off(&self) -> bool {
        self.0.is_none()
    }

    /// Checks a URL that a caller names.
    ///
    /// # Errors
    /// [`NotTold::NotAllowed`] or [`NotTold::Private`].
    pub fn check(&self, url: &str) -> Result<(), NotTold> {
        self.reachable(url).map(drop)
    }

    fn reachable(&self, url: &str) -> Result<(&Parts, Url), NotTold> {
        let parts = self.0.as_deref().ok_or(NotAllowed::Elsewhere)?;
        let url = parts.allowed.check(url)?;
        match literal_is_reachable(&url, parts.allows_private) {
            true => Ok((parts, url)),
            false => Err(NotTold::Private),
        }
    }

    /// Posts a JSON body. `id` names the notice and stays the same when it is repeated, so that the
    /// receiver can drop repetitions; `seconds` is the time, seconds since 1970.
    ///
    /// # Errors
    /// [`NotTold`].
    pub async fn tell(
        &self,
        url: &str,
        id: &str,
        seconds: i64,
        body: String,
    ) -> Result<(), NotTold> {
        let (parts, url) = self.reachable(url)?;
        let signature = parts.secret.sign(id, seconds, &body);
        let request = parts.client.post(url).timeout(TIMEOUT);
        let request = request
            .header("content-type", "application/json")
            .header("webhook-id", id)
            .header("webhook-timestamp", seconds)
            .header("webhook-signature", signature);
        let answer = request.body(body).send().await;
        match answer {
            Ok(answer) if answer.status().is_success() => Ok(()),
            Ok(answer) => Err(NotTold::Status(answer.status().as_u16())),
            Err(error) => Err(NotTold::Failed(chain(&error))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signatures_are_those_of_standard_webhooks() {
        // The example of the specification's reference implementations.
        let secret = SigningSecret::parse("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw");
        let secret = secret.expect("a good secret");
        let signature = secret.sign(
            "msg_p5jXN8AQM9LWM0D4loKWxJek",
            1_614_265_330,
            r#"{"test": 2432232314}"#,
        );
        assert_eq!(signature, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
        for wrong in [
            "",
            "whsec_",
            "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw",
            "whsec_AAAA",
            "whsec_?",
        ] {
            assert!(SigningSecret::parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn only_failures_that_may_pass_are_repeated() {
        assert!(NotTold::Failed(String::new()).is_worth_a_retry());
        assert!(NotTold::Status(500).is_worth_a_retry());
        assert!(NotTold::Status(404).is_worth_a_retry());
        assert!(!NotTold::Status(410).is_worth_a_retry());
        assert!(!NotTold::Private.is_worth_a_retry());
        assert!(NotTold::NotAllowed(NotAllowed::Elsewhere).is_worth_a_retry());
    }
}
