//! Buckets and folders below the prefixes that the operator allows.

use url::Url;

use crate::storage::{BucketError, Objects};

/// The schemes of buckets.
const BUCKETS: [&str; 3] = ["s3", "gs", "az"];

/// Opened buckets, each with the prefix that it was opened by.
pub(super) struct Places(Vec<(Url, Objects)>);

impl Places {
    /// Opens the buckets among the prefixes.
    ///
    /// # Errors
    /// [`BucketError`] of one that cannot be used.
    pub(super) fn open(prefixes: &[Url]) -> Result<Self, BucketError> {
        let buckets = prefixes
            .iter()
            .filter(|url| BUCKETS.contains(&url.scheme()));
        let opened = buckets.map(|url| Ok((url.clone(), Objects::open(url.as_str())?)));
        opened.collect::<Result<_, BucketError>>().map(Self)
    }

    /// The bucket that an object is in, and the object's path there, encoded as in the URL.
    pub(super) fn find(&self, url: &Url) -> Option<(&Objects, String)> {
        self.0.iter().find_map(|(prefix, objects)| {
            let is_same = prefix.scheme() == url.scheme() && prefix.host() == url.host();
            let rest = url.path().strip_prefix(prefix.path()).filter(|_| is_same)?;
            Some((objects, rest.to_owned()))
        })
    }
}
