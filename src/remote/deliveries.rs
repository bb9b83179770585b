//! Results that are written to places that callers name by URI.

use std::sync::Arc;

use bytes::Bytes;
use url::Url;

use super::allowed::{Allowed, NotAllowed};
use super::places::Places;
use crate::storage::{BlobError, BucketError};

/// The schemes of URIs that results are written to.
pub const DELIVERY_SCHEMES: [&str; 3] = ["s3", "gs", "az"];

/// Why a result was not written.
#[derive(Debug, thiserror::Error)]
pub enum NotDelivered {
    /// The configuration allows no results by URI.
    #[error("this server delivers no results; its operator names places in remote.results")]
    Off,
    /// The configuration does not allow the URI (any more).
    #[error("the URI {0}")]
    NotAllowed(#[from] NotAllowed),
    /// The bucket refuses the object or does not answer.
    #[error("the bucket cannot be written: {0}")]
    Failed(#[from] BlobError),
}

/// The places that results may be written to. Clones share the connections.
#[derive(Clone, Default)]
pub struct Deliveries(Option<Arc<Parts>>);

struct Parts {
    allowed: Allowed,
    places: Places,
}

impl Deliveries {
    /// Places below the `allowed` URIs.
    ///
    /// # Errors
    /// [`BucketError`] of a bucket that cannot be used.
    pub fn new(allowed: Allowed) -> Result<Self, BucketError> {
        if allowed.is_empty() {
            return Ok(Self::default());
        }
        let places = Places::open(allowed.prefixes())?;
        Ok(Self(Some(Arc::new(Parts { allowed, places }))))
    }

    /// Checks a URI that a caller names.
    ///
    /// # Errors
    /// [`NotDelivered::Off`] or [`NotDelivered::NotAllowed`].
    pub fn check(&self, uri: &str) -> Result<(), NotDelivered> {
        self.reachable(uri).map(drop)
    }

    fn reachable(&self, uri: &str) -> Result<(&Parts, Url), NotDelivered> {
        let parts = self.0.as_deref().ok_or(NotDelivered::Off)?;
        let url = parts.allowed.check(uri)?;
        match url.query() {
            None => Ok((parts, url)),
            Some(_) => Err(NotAllowed::Malformed.into()),
        }
    }

    /// Writes an object, replacing an earlier one. Large ones are written in parts.
    ///
    /// # Errors
    /// [`NotDelivered`].
    pub async fn put(&self, uri: &str, bytes: Bytes) -> Result<(), NotDelivered> {
        let (parts, url) = self.reachable(uri)?;
        let (objects, path) = parts.places.find(&url).ok_or(NotAllowed::Elsewhere)?;
        Ok(objects.write(&path, bytes).await?)
    }
}
