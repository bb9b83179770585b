//! Where payloads, snapshots and results lie: files below one folder, by job.
//!
//! Written whole or not at all. What a promise rests on is on disk before the call returns; what
//! dies with its caller does not wait for the disk. It must not know what the bytes mean.

use std::collections::BTreeMap;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use futures_util::TryStreamExt;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::job::JobId;

/// Payloads, snapshots and results.
#[derive(Clone, Debug)]
pub struct Blobs {
    folder: Arc<FilePath>,
    synced: Arc<LocalFileSystem>,
    quick: Arc<LocalFileSystem>,
}

/// Whether a write waits for the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sync {
    /// It does: somebody is promised something.
    Yes,
    /// It does not: it survives the process, but perhaps not the machine.
    No,
}

/// Something that lies under a job's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blob {
    /// One of its sweeps, from 0.
    Frame(u32),
    /// The latest snapshot of its optimization.
    Snapshot,
    /// The flow, or the cloud, that one attempt has found.
    Result(u32),
    /// The field that one attempt has fitted, for those who go on from it. By attempt, so that one
    /// that is late cannot change what others have read.
    Field(u32),
}

/// Why a blob could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("the blob store failed: {0}")]
pub struct BlobError(#[from] object_store::Error);

impl BlobError {
    /// Whether there is no such blob.
    pub fn is_missing(&self) -> bool {
        matches!(self.0, object_store::Error::NotFound { .. })
    }
}

/// A job's folder. Names begin with their time, so siblings are of about one minute.
fn folder(id: JobId) -> String {
    let name = id.to_string();
    format!("jobs/{}/{name}", &name[..8])
}

fn path(id: JobId, blob: Blob) -> Path {
    let folder = folder(id);
    Path::from(match blob {
        Blob::Frame(place) => format!("{folder}/frame-{place}"),
        Blob::Snapshot => format!("{folder}/snapshot"),
        Blob::Result(attempt) => format!("{folder}/result-{attempt}"),
        Blob::Field(attempt) => format!("{folder}/field-{attempt}"),
    })
}

impl Blobs {
    /// Opens or makes the store in `folder`.
    ///
    /// # Errors
    /// Where the folder cannot be used.
    pub fn open(folder: &FilePath) -> Result<Self, BlobError> {
        let made = std::fs::create_dir_all(folder);
        made.map_err(|source| object_store::Error::Generic {
            store: "files",
            source: Box::new(source),
        })?;
        let open = || -> Result<LocalFileSystem, BlobError> {
            Ok(LocalFileSystem::new_with_prefix(folder)?.with_automatic_cleanup(true))
        };
        Ok(Self {
            folder: Arc::from(folder),
            synced: Arc::new(open()?.with_fsync(true)),
            quick: Arc::new(open()?),
        })
    }

    /// Bytes that can still be written; none where the system does not say.
    pub fn free_bytes(&self) -> Option<u64> {
        let filesystem = rustix::fs::statvfs(&*self.folder).ok()?;
        Some(filesystem.f_bavail.saturating_mul(filesystem.f_frsize))
    }

    /// Writes a blob whole, over what was there.
    ///
    /// # Errors
    /// Where it cannot be written; then nothing is there under this name that was not before.
    pub async fn put(
        &self,
        id: JobId,
        blob: Blob,
        bytes: Bytes,
        sync: Sync,
    ) -> Result<(), BlobError> {
        let store = match sync {
            Sync::Yes => &self.synced,
            Sync::No => &self.quick,
        };
        store.put(&path(id, blob), bytes.into()).await?;
        Ok(())
    }

    /// Reads a blob whole.
    ///
    /// # Errors
    /// Where there is none ([`BlobError::is_missing`]) or it cannot be read.
    pub async fn get(&self, id: JobId, blob: Blob) -> Result<Bytes, BlobError> {
        Ok(self.quick.get(&path(id, blob)).await?.bytes().await?)
    }

    /// Makes a blob that was written without waiting for the disk safe.
    ///
    /// # Errors
    /// As for reading and writing.
    pub async fn sync(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        let bytes = self.get(id, blob).await?;
        self.put(id, blob, bytes, Sync::Yes).await
    }

    /// Removes a blob, if it is there.
    ///
    /// # Errors
    /// Where it cannot be removed.
    pub async fn remove(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        match self.quick.delete(&path(id, blob)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes all that lies under a job's name.
    ///
    /// # Errors
    /// Where something cannot be listed or removed.
    pub async fn remove_job(&self, id: JobId) -> Result<(), BlobError> {
        let prefix = Path::from(folder(id));
        let found: Vec<Path> = self
            .quick
            .list(Some(&prefix))
            .map_ok(|meta| meta.location)
            .try_collect()
            .await?;
        for location in found {
            match self.quick.delete(&location).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// The jobs under whose names nothing lies that is younger than `age`.
    ///
    /// # Errors
    /// Where the store cannot be listed.
    pub async fn jobs_older_than(&self, age: Duration) -> Result<Vec<JobId>, BlobError> {
        let limit = SystemTime::now().checked_sub(age);
        let mut all_old: BTreeMap<JobId, bool> = BTreeMap::new();
        let mut blobs = self.quick.list(Some(&Path::from("jobs")));
        while let Some(meta) = blobs.try_next().await? {
            let old = limit.is_some_and(|limit| SystemTime::from(meta.last_modified) < limit);
            let name = meta.location.parts().nth(2);
            if let Some(id) = name.and_then(|name| name.as_ref().parse().ok()) {
                *all_old.entry(id).or_insert(true) &= old;
            }
        }
        let found = all_old.into_iter().filter(|(_, old)| *old);
        Ok(found.map(|(id, _)| id).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn blobs_come_back_and_go_with_their_job() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        assert!(blobs.free_bytes().is_some_and(|bytes| bytes > 0));
        let (id, other) = (JobId::fresh(), JobId::fresh());
        let all = [
            Blob::Frame(0),
            Blob::Frame(1),
            Blob::Snapshot,
            Blob::Result(3),
            Blob::Field(3),
        ];
        for (sync, blob) in [Sync::Yes, Sync::No].into_iter().cycle().zip(all) {
            for id in [id, other] {
                let bytes = Bytes::from(format!("{blob:?}"));
                blobs.put(id, blob, bytes, sync).await.expect("written");
            }
        }
        blobs.sync(id, Blob::Frame(1)).await.expect("synced");
        let back = blobs.get(id, Blob::Frame(1)).await.expect("there");
        assert_eq!(back, "Frame(1)");
        let old = blobs.jobs_older_than(Duration::ZERO).await.expect("a list");
        assert_eq!(old.len(), 2);
        blobs.remove_job(id).await.expect("removed");
        let gone = blobs.get(id, Blob::Frame(0)).await.expect_err("gone");
        assert!(gone.is_missing());
        blobs.get(other, Blob::Frame(0)).await.expect("still there");
        let aged = blobs.jobs_older_than(Duration::from_secs(3600)).await;
        assert!(aged.expect("a list").is_empty());
    }
}
