//! Sweeps that callers name by URI instead of sending them.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use futures_util::stream::{self, BoxStream};
use futures_util::{StreamExt, TryStreamExt};
use percent_encoding::percent_decode_str;
use tokio::io::AsyncReadExt;
use url::Url;

use super::allowed::{Allowed, NotAllowed};
use super::client::{client, literal_is_reachable};
use super::places::Places;
use crate::storage::{BlobError, BucketError};

/// The schemes of URIs that can be read.
pub const SOURCE_SCHEMES: [&str; 6] = ["https", "http", "s3", "gs", "az", "file"];

/// Bytes that are read from a file at a time.
const PIECE_BYTES: usize = 1 << 20;

/// What a URI may be followed by: the hash of the file.
const HASH: &str = "#blake3=";

/// Why a sweep cannot be fetched.
#[derive(Debug, thiserror::Error)]
pub enum NotFetched {
    /// The configuration allows no sweeps by URI.
    #[error("this server fetches no sweeps; its operator names places in remote.sweeps")]
    Off,
    /// The configuration does not allow the URI.
    #[error("the URI {0}")]
    NotAllowed(#[from] NotAllowed),
    /// The URI has an address that is not public, or leads out of the folder that is allowed.
    #[error("the URI leads to a place that is not allowed")]
    Private,
    /// `#blake3=` is not followed by 64 hexadecimal digits.
    #[error("the URI ends with #blake3= and 64 hexadecimal digits, or has no fragment")]
    Hash,
    /// There is no such file, or its server refuses it.
    #[error("the file is not there: {0}")]
    Missing(String),
    /// Its server does not answer, or fails.
    #[error("the file cannot be fetched: {0}")]
    Failed(String),
}

impl From<BlobError> for NotFetched {
    fn from(error: BlobError) -> Self {
        match error.is_missing() {
            true => Self::Missing("no object has this name".to_owned()),
            // It may tell of addresses and answers that are not the caller's.
            false => {
                tracing::warn!(%error, "a sweep cannot be fetched from its bucket");
                Self::Failed("its bucket cannot be read".to_owned())
            }
        }
    }
}

impl From<io::Error> for NotFetched {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::NotFound => Self::Missing(error.to_string()),
            _ => Self::Failed(error.to_string()),
        }
    }
}

impl From<reqwest::Error> for NotFetched {
    fn from(error: reqwest::Error) -> Self {
        Self::Failed(super::client::chain(&error))
    }
}

/// A file that is being fetched.
pub struct Download {
    /// The last part of its path.
    pub name: String,
    /// The hash that it is to have.
    pub blake3: Option<blake3::Hash>,
    /// Its bytes, piece by piece.
    pub pieces: BoxStream<'static, Result<Bytes, NotFetched>>,
}

/// The places that sweeps may be fetched from. Clones share the connections.
#[derive(Clone, Default)]
pub struct Sources(Option<Arc<Parts>>);

struct Parts {
    allowed: Allowed,
    places: Places,
    allows_private: bool,
    client: reqwest::Client,
}

impl Sources {
    /// Places below the `allowed` URIs.
    ///
    /// # Errors
    /// [`BucketError`] of a bucket that cannot be used.
    ///
    /// # Panics
    /// If no TLS provider was installed for the process.
    pub fn new(allowed: Allowed, allows_private: bool) -> Result<Self, BucketError> {
        if allowed.is_empty() {
            return Ok(Self::default());
        }
        Ok(Self(Some(Arc::new(Parts {
            places: Places::open(allowed.prefixes())?,
            allowed,
            allows_private,
            client: client(allows_private),
        }))))
    }

    /// Begins to fetch a file. The URI may end with `#blake3=` and the hash of the file.
    ///
    /// # Errors
    /// [`NotFetched`].
    pub async fn open(&self, uri: &str) -> Result<Download, NotFetched> {
        let parts = self.0.as_deref().ok_or(NotFetched::Off)?;
        let (uri, hash) = match uri.split_once(HASH) {
            None => (uri, None),
            Some((uri, hash)) => (uri, Some(hash)),
        };
        let blake3 = hash.map(blake3::Hash::from_hex).transpose();
        let blake3 = blake3.map_err(|_| NotFetched::Hash)?;
        let url = parts.allowed.check(uri)?;
        let pieces = match url.scheme() {
            "file" => parts.read_file(&url).await?,
            "http" | "https" => parts.read_http(&url).await?,
            _ => parts.read_object(&url).await?,
        };
        let name = url.path_segments().and_then(Iterator::last);
        let name = percent_decode_str(name.unwrap_or_default()).decode_utf8_lossy();
        Ok(Download {
            name: name.into_owned(),
            blake3,
            pieces,
        })
    }
}

impl Parts {
    async fn read_http(
        &self,
        url: &Url,
    ) -> Result<BoxStream<'static, Result<Bytes, NotFetched>>, NotFetched> {
        if !literal_is_reachable(url, self.allows_private) {
            return Err(NotFetched::Private);
        }
        let answer = self.client.get(url.clone()).send().await?;
        let status = answer.status();
        if status.is_success() {
            return Ok(answer.bytes_stream().map_err(NotFetched::from).boxed());
        }
        let said = format!("its server answered {}", status.as_u16());
        match status.is_server_error() || status.as_u16() == 429 {
            true => Err(NotFetched::Failed(said)),
            false => Err(NotFetched::Missing(said)),
        }
    }

    async fn read_object(
        &self,
        url: &Url,
    ) -> Result<BoxStream<'static, Result<Bytes, NotFetched>>, NotFetched> {
        let (objects, path) = self.places.find(url).ok_or(NotAllowed::Elsewhere)?;
        let pieces = objects.read(&path).await?;
        Ok(pieces.map_err(NotFetched::from).boxed())
    }

    async fn read_file(
        &self,
        url: &Url,
    ) -> Result<BoxStream<'static, Result<Bytes, NotFetched>>, NotFetched> {
        let path = |url: &Url| url.to_file_path().map_err(|()| NotFetched::Private);
        let asked = tokio::fs::canonicalize(path(url)?).await?;
        // A link must not lead out of the folder.
        let folders = self.allowed.prefixes().iter();
        let folders = folders.filter(|prefix| prefix.scheme() == "file");
        let folders: Vec<PathBuf> = folders.map(path).collect::<Result<_, _>>()?;
        let mut is_inside = false;
        for folder in folders {
            is_inside |= is_below(&asked, &folder).await;
        }
        if !is_inside || !tokio::fs::metadata(&asked).await?.is_file() {
            return Err(NotFetched::Private);
        }
        let file = tokio::fs::File::open(asked).await?;
        let pieces = stream::try_unfold(file, |mut file| async move {
            let mut piece = Vec::with_capacity(PIECE_BYTES);
            let mut part = (&mut file).take(PIECE_BYTES as u64);
            let read = part.read_to_end(&mut piece).await?;
            Ok((read > 0).then(|| (Bytes::from(piece), file)))
        });
        Ok(pieces.boxed())
    }
}

async fn is_below(path: &Path, folder: &Path) -> bool {
    let folder = tokio::fs::canonicalize(folder).await;
    folder.is_ok_and(|folder| path.starts_with(folder))
}
