//! The part of the store that only a bucket of an object store has.

use std::ffi::OsString;
use std::io;
use std::sync::Arc;

use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt};
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::{ObjectStore, ObjectStoreExt, WriteMultipart, parse_url_opts};
use url::Url;

use super::blob::{BlobError, folder};
use crate::job::JobId;

/// Larger blobs are written in parts, each of which is retried by itself.
const WHOLE_BYTES: usize = 64 << 20;

/// Bytes of a part.
const PART_BYTES: usize = 16 << 20;

/// Why a bucket cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BucketError {
    /// The text is no URL of a bucket.
    #[error("{0:?} is no s3://bucket, gs://bucket or az://container")]
    Url(String),
    /// A variable of the environment has a value that cannot be used.
    #[error("the settings of the bucket cannot be used")]
    Settings(#[source] object_store::Error),
}

/// Opens a bucket by its URL, with the variables of the environment.
pub(super) fn open(url: &str) -> Result<Arc<dyn ObjectStore>, BucketError> {
    let is_known = |parsed: &Url| ["s3", "gs", "az"].contains(&parsed.scheme());
    let parsed = Url::parse(url).ok().filter(is_known);
    let parsed = parsed.ok_or_else(|| BucketError::Url(url.to_owned()))?;
    // The client of the bucket needs one.
    let _named_already = rustls::crypto::ring::default_provider().install_default();
    let opened = parse_url_opts(&parsed, settings(std::env::vars_os()));
    let (store, prefix) = opened.map_err(BucketError::Settings)?;
    Ok(Arc::new(PrefixStore::new(store, prefix)))
}

/// The variables of the environment that are meant for buckets: those of the vendors, the last two of
/// Azure's managed identities. The client would take others, too: a program's own `ENDPOINT` or `TOKEN`.
fn settings(
    variables: impl Iterator<Item = (OsString, OsString)>,
) -> impl Iterator<Item = (String, String)> {
    const PREFIXES: [&str; 5] = ["AWS_", "GOOGLE_", "AZURE_", "IDENTITY_", "MSI_"];
    variables.filter_map(|(name, value)| {
        let name = name.into_string().ok()?;
        let is_meant = PREFIXES.iter().any(|prefix| name.starts_with(prefix));
        Some((name, value.into_string().ok()?)).filter(|_| is_meant)
    })
}

/// Writes, reads back and removes 64 KiB.
pub(super) async fn probe(store: &dyn ObjectStore) -> Result<(), BlobError> {
    const BYTES: usize = 64 << 10;
    // Several nodes may test the bucket at once.
    let path = Path::from(format!("probe/{}", JobId::fresh()));
    let bytes = Bytes::from(vec![7; BYTES]);
    store.put(&path, bytes.clone().into()).await?;
    let read = async { store.get(&path).await?.bytes().await }.await;
    // Whether or not it could be read.
    store.delete(&path).await?;
    if read? != bytes {
        return Err(io::Error::from(io::ErrorKind::InvalidData).into());
    }
    Ok(())
}

/// Writes a blob, a large one in parts.
pub(super) async fn put(
    store: &dyn ObjectStore,
    path: &Path,
    bytes: Bytes,
) -> Result<(), BlobError> {
    const PARTS_AT_ONCE: usize = 4;
    if bytes.len() <= WHOLE_BYTES {
        store.put(path, bytes.into()).await?;
        return Ok(());
    }
    let upload = store.put_multipart(path).await?;
    let mut writer = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
    let mut rest = bytes;
    while !rest.is_empty() {
        writer.wait_for_capacity(PARTS_AT_ONCE).await?;
        writer.put(rest.split_to(PART_BYTES.min(rest.len())));
    }
    writer.finish().await?;
    Ok(())
}

/// Removes all blobs of a job.
pub(super) async fn remove_job(store: &dyn ObjectStore, id: JobId) -> Result<(), BlobError> {
    let prefix = Path::from(folder(id));
    let paths = store.list(Some(&prefix)).map_ok(|found| found.location);
    let mut removed = store.delete_stream(paths.boxed());
    while let Some(removed) = removed.next().await {
        match removed {
            Ok(_) | Err(object_store::Error::NotFound { .. }) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(())
}

/// Whether there are no blobs of any job.
pub(super) async fn is_empty(store: &dyn ObjectStore) -> Result<bool, BlobError> {
    let first = store.list(Some(&Path::from("jobs"))).try_next().await?;
    Ok(first.is_none())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_variables_of_the_vendors_set_a_bucket() {
        let variables = [
            ("AWS_REGION", "eu-central-1"),
            ("TOKEN", "of another program"),
            ("ENDPOINT", "https://elsewhere.example"),
            ("ALLOW_INVALID_CERTIFICATES", "true"),
            ("GOOGLE_SERVICE_ACCOUNT", "/key.json"),
            ("AZURE_STORAGE_ACCOUNT_NAME", "labels"),
        ];
        let variables =
            variables.map(|(name, value)| (OsString::from(name), OsString::from(value)));
        let taken: Vec<String> = settings(variables.into_iter())
            .map(|(name, _)| name)
            .collect();
        let expected = [
            "AWS_REGION",
            "GOOGLE_SERVICE_ACCOUNT",
            "AZURE_STORAGE_ACCOUNT_NAME",
        ];
        assert_eq!(taken, expected);
    }
}
