//! Objects of a folder or a bucket that belongs to other people, by name: sweeps and labels.

use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::stream::BoxStream;
use futures_util::{StreamExt, TryStreamExt};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt, PutMode};

use super::blob::BlobError;
use super::bucket::{self, BucketError};
use super::folder::remove_staged_below;

/// The objects below a prefix of a bucket, or the files below a folder. Clones share the connections.
#[derive(Clone, Debug)]
pub struct Objects {
    store: Arc<dyn ObjectStore>,
    /// The folder; none for a bucket.
    folder: Option<Arc<FilePath>>,
}

impl Objects {
    /// Opens `s3://bucket/prefix/`, `gs://bucket/prefix/` or `az://container/prefix/`, with the
    /// variables of the environment.
    ///
    /// # Errors
    /// [`BucketError`].
    pub fn open(url: &str) -> Result<Self, BucketError> {
        Ok(Self {
            store: bucket::open(url)?,
            folder: None,
        })
    }

    /// Opens a folder, which must exist. New files are on disk before a write returns.
    ///
    /// # Errors
    /// [`BlobError`] if it cannot be opened.
    pub fn open_folder(root: &FilePath) -> Result<Self, BlobError> {
        let folder = LocalFileSystem::new_with_prefix(root)?;
        Ok(Self {
            store: Arc::new(folder.with_fsync(true)),
            folder: Some(Arc::from(root)),
        })
    }

    /// Removes the remains of writes of objects with one of these endings that were cut off more than
    /// `age` ago, and counts them. A bucket has none.
    ///
    /// # Errors
    /// If a folder cannot be listed, or a file cannot be removed.
    pub fn remove_cut_off(&self, endings: &[&str], age: Duration) -> Result<usize, BlobError> {
        let folder = self.folder.as_deref();
        let removed = folder.map_or(Ok(0), |folder| remove_staged_below(folder, endings, age));
        Ok(removed?)
    }

    /// Reads the object at a path below the prefix, piece by piece. The path may be encoded as in a
    /// URL.
    ///
    /// # Errors
    /// [`BlobError`] if there is none or it cannot be read.
    pub async fn read(
        &self,
        path: &str,
    ) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, BlobError> {
        let path = Path::from_url_path(path).map_err(object_store::Error::from)?;
        let found = self.store.get(&path).await?;
        Ok(found.into_stream().map_err(BlobError::from).boxed())
    }

    /// Reads a whole object of at most `most` bytes.
    ///
    /// # Errors
    /// [`BlobError`] if there is none, it is larger, or it cannot be read.
    pub async fn read_whole(&self, path: &str, most: u64) -> Result<Bytes, BlobError> {
        let path = Path::parse(path).map_err(object_store::Error::from)?;
        let found = self.store.get(&path).await?;
        if found.meta.size > most {
            return Err(std::io::Error::from(std::io::ErrorKind::FileTooLarge).into());
        }
        Ok(found.bytes().await?)
    }

    /// The paths of all objects below a path, in no order.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn all(&self, below: &str) -> Result<Vec<String>, BlobError> {
        let below = Path::parse(below).map_err(object_store::Error::from)?;
        let found = self.store.list(Some(&below));
        let paths = found.map_ok(|found| found.location.to_string());
        Ok(paths.try_collect().await?)
    }

    /// The names of the folders and of the objects directly below a path, each in order.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn entries(&self, below: &str) -> Result<[Vec<String>; 2], BlobError> {
        let below = Path::parse(below).map_err(object_store::Error::from)?;
        let found = self.store.list_with_delimiter(Some(&below)).await?;
        let name = |path: &Path| path.filename().unwrap_or_default().to_owned();
        let mut folders: Vec<String> = found.common_prefixes.iter().map(name).collect();
        let objects = found.objects.iter().map(|object| name(&object.location));
        let mut objects: Vec<String> = objects.collect();
        folders.sort();
        objects.sort();
        Ok([folders, objects])
    }

    /// Writes an object unless there is one. Returns whether it was written. Of several writers one
    /// alone writes it.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn put_new(&self, path: &str, bytes: Bytes) -> Result<bool, BlobError> {
        let path = Path::parse(path).map_err(object_store::Error::from)?;
        let written = self
            .store
            .put_opts(&path, bytes.into(), PutMode::Create.into());
        match written.await {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes an object, replacing an earlier one; a large one in parts. The path may be encoded as in a
    /// URL.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn write(&self, path: &str, bytes: Bytes) -> Result<(), BlobError> {
        let path = Path::from_url_path(path).map_err(object_store::Error::from)?;
        bucket::put(&*self.store, &path, bytes).await
    }

    /// Writes an object, replacing an earlier one.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn put(&self, path: &str, bytes: Bytes) -> Result<(), BlobError> {
        let path = Path::parse(path).map_err(object_store::Error::from)?;
        self.store.put(&path, bytes.into()).await?;
        Ok(())
    }

    /// Removes an object.
    ///
    /// # Errors
    /// [`BlobError`].
    pub async fn remove(&self, path: &str) -> Result<(), BlobError> {
        let path = Path::parse(path).map_err(object_store::Error::from)?;
        Ok(self.store.delete(&path).await?)
    }
}
