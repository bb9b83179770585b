//! Objects of other people's buckets, for reading.

use std::sync::Arc;

use bytes::Bytes;
use futures_util::stream::BoxStream;
use futures_util::{StreamExt, TryStreamExt};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use super::blob::BlobError;
use super::bucket::{self, BucketError};

/// The objects below a prefix of a bucket.
#[derive(Clone, Debug)]
pub struct Objects(Arc<dyn ObjectStore>);

impl Objects {
    /// Opens `s3://bucket/prefix/`, `gs://bucket/prefix/` or `az://container/prefix/`, with the
    /// variables of the environment.
    ///
    /// # Errors
    /// [`BucketError`].
    pub fn open(url: &str) -> Result<Self, BucketError> {
        bucket::open(url).map(Self)
    }

    /// Reads the object at a path below the prefix, piece by piece.
    ///
    /// # Errors
    /// [`BlobError`] if there is none or it cannot be read.
    pub async fn read(
        &self,
        path: &str,
    ) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, BlobError> {
        let path = Path::from_url_path(path).map_err(object_store::Error::from)?;
        let found = self.0.get(&path).await?;
        Ok(found.into_stream().map_err(BlobError::from).boxed())
    }
}
