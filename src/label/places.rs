//! Places of files: paths of this machine, and URIs of object stores.

use std::collections::HashMap;
use std::fs::{self, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use rustix::fs::OFlags;
use url::Url;

use crate::storage::{BlobError, BucketError, Objects};
use crate::sync::locked;

/// Most bytes of a file that is read.
const MAX_FILE: u64 = 4 << 30;

/// Why a place cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The URI is none that can be read.
    #[error("{0:?} is no path and no file://, s3://, gs:// or az:// URI")]
    Uri(String),
    /// The bucket cannot be used.
    #[error(transparent)]
    Bucket(#[from] BucketError),
    /// It can never be read: it is no file, too large, or has an impossible name.
    #[error("{uri}: {source}")]
    Unusable {
        /// The place.
        uri: String,
        /// The reason.
        source: BlobError,
    },
    /// There is no such file.
    #[error("{0} is not there")]
    Missing(String),
    /// The file cannot be read or written now.
    #[error("{uri}: {source}")]
    Failed {
        /// The file.
        uri: String,
        /// The reason.
        source: BlobError,
    },
}

impl PlaceError {
    /// Whether trying again may help: the file is there, and its store failed.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::Failed { .. })
    }

    fn new(uri: &str, error: BlobError) -> Self {
        let uri = uri.to_owned();
        match error {
            error if error.is_missing() => Self::Missing(uri),
            error if error.is_unusable() => Self::Unusable { uri, source: error },
            error => Self::Failed { uri, source: error },
        }
    }
}

/// The buckets that are open. Clones share them.
#[derive(Clone, Debug, Default)]
pub(super) struct Places(Arc<Mutex<HashMap<String, Objects>>>);

/// A URI taken apart: the root of its store, and the path below it.
fn parts(uri: &str) -> Result<(Option<String>, String), PlaceError> {
    if !uri.contains("://") {
        return Ok((None, uri.to_owned()));
    }
    let unknown = || PlaceError::Uri(uri.to_owned());
    let url = Url::parse(uri).map_err(|_| unknown())?;
    if url.scheme() == "file" {
        let path = url.to_file_path().map_err(|()| unknown())?;
        return Ok((None, path.to_string_lossy().into_owned()));
    }
    let host = url
        .host_str()
        .filter(|_| ["s3", "gs", "az"].contains(&url.scheme()));
    let root = format!("{}://{}", url.scheme(), host.ok_or_else(unknown)?);
    // Not the path of the parsed URL, which is encoded.
    let path = uri
        .split_once("://")
        .and_then(|(_, rest)| rest.split_once('/'));
    Ok((Some(root), path.map_or("", |(_, path)| path).to_owned()))
}

/// The path of a URI, decoded as its store reads it.
pub(super) fn path_of(uri: &str) -> String {
    parts(uri).map_or_else(|_| uri.to_owned(), |(_, path)| path)
}

impl Places {
    fn bucket(&self, root: &str) -> Result<Objects, PlaceError> {
        let mut open = locked(&self.0);
        if let Some(known) = open.get(root) {
            return Ok(known.clone());
        }
        let objects = Objects::open(root)?;
        open.insert(root.to_owned(), objects.clone());
        Ok(objects)
    }

    /// Reads a whole file of at most 4 GiB.
    pub(super) async fn read(&self, uri: &str) -> Result<Bytes, PlaceError> {
        let failed = |error: BlobError| PlaceError::new(uri, error);
        match parts(uri)? {
            (Some(root), path) => {
                let bucket = self.bucket(&root)?;
                bucket.read_whole(&path, MAX_FILE).await.map_err(failed)
            }
            (None, path) => read_file(path).await.map_err(|error| failed(error.into())),
        }
    }

    /// Opens a folder or a prefix of a bucket.
    pub(super) fn open(&self, uri: &str) -> Result<Place, PlaceError> {
        match parts(uri)? {
            (Some(root), path) => Ok(Place {
                objects: self.bucket(&root)?,
                prefix: path.trim_matches('/').to_owned(),
                base: root,
            }),
            (None, path) => {
                let root = absolute(Path::new(&path));
                let opened = Objects::open_folder(&root);
                Ok(Place {
                    objects: opened.map_err(|error| PlaceError::new(uri, error))?,
                    prefix: String::new(),
                    base: root.to_string_lossy().into_owned(),
                })
            }
        }
    }
}

/// Reads a whole file of at most 4 GiB, and no more of it than it had when it was opened. What is no
/// regular file is refused: a pipe or a device may never end.
async fn read_file(path: String) -> io::Result<Bytes> {
    let read = move || {
        let mut options = OpenOptions::new();
        // Opening a pipe would wait for its writer.
        options.custom_flags(OFlags::NONBLOCK.bits() as i32);
        let file = options.read(true).open(path)?;
        let about = file.metadata()?;
        if !about.is_file() {
            return Err(io::Error::from(ErrorKind::InvalidInput));
        }
        if about.len() > MAX_FILE {
            return Err(io::Error::from(ErrorKind::FileTooLarge));
        }
        let mut bytes = Vec::new();
        file.take(about.len()).read_to_end(&mut bytes)?;
        Ok(bytes.into())
    };
    tokio::task::spawn_blocking(read).await?
}

fn absolute(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

/// The files below a folder or below a prefix of a bucket, by their relative paths.
#[derive(Clone, Debug)]
pub struct Place {
    objects: Objects,
    prefix: String,
    base: String,
}

impl Place {
    /// Opens a folder, or a prefix of a bucket such as `s3://bucket/prefix`. The folder must exist.
    ///
    /// # Errors
    /// [`PlaceError`].
    pub fn open(uri: &str) -> Result<Self, PlaceError> {
        Places::default().open(uri)
    }

    fn path(&self, below: &str) -> String {
        match (self.prefix.is_empty(), below.is_empty()) {
            (true, _) => below.to_owned(),
            (false, true) => self.prefix.clone(),
            (false, false) => format!("{}/{below}", self.prefix),
        }
    }

    /// The path or URI of a file below it.
    pub fn uri(&self, below: &str) -> String {
        format!("{}/{}", self.base.trim_end_matches('/'), self.path(below))
    }

    /// The folder or prefix that holds it, and its name there; none for the root of a store.
    pub(super) fn parent(&self) -> Result<Option<(Self, String)>, PlaceError> {
        if self.base.contains("://") {
            let (above, name) = self.prefix.rsplit_once('/').unwrap_or(("", &self.prefix));
            let parent = Self {
                prefix: above.to_owned(),
                ..self.clone()
            };
            return Ok((!name.is_empty()).then(|| (parent, name.to_owned())));
        }
        let path = Path::new(&self.base);
        let (Some(above), Some(name)) = (path.parent(), path.file_name()) else {
            return Ok(None);
        };
        let parent = Self::open(&above.to_string_lossy())?;
        Ok(Some((parent, name.to_string_lossy().into_owned())))
    }

    /// A folder below it without links; none in a bucket.
    pub(super) fn without_links(&self, below: &str) -> Option<PathBuf> {
        let is_folder = !self.base.contains("://");
        is_folder.then(|| Path::new(&self.uri(below)).canonicalize().ok())?
    }

    /// Reads a whole file of at most 4 GiB.
    pub(super) async fn read(&self, below: &str) -> Result<Bytes, PlaceError> {
        let read = match self.base.contains("://") {
            true => self.objects.read_whole(&self.path(below), MAX_FILE).await,
            false => read_file(self.uri(below)).await.map_err(BlobError::from),
        };
        read.map_err(|error| PlaceError::new(&self.uri(below), error))
    }

    /// The names of the folders and of the files directly below a path, each in order. A folder of this
    /// machine that must not be read is [`PlaceError::Unusable`].
    pub(super) async fn entries(&self, below: &str) -> Result<[Vec<String>; 2], PlaceError> {
        let uri = self.uri(below);
        if self.base.contains("://") {
            let found = self.objects.entries(&self.path(below)).await;
            return found.map_err(|error| PlaceError::new(&uri, error));
        }
        folder_entries(Path::new(&uri)).map_err(|error| match error.kind() {
            ErrorKind::PermissionDenied | ErrorKind::NotADirectory => PlaceError::Unusable {
                source: error.into(),
                uri,
            },
            _ => PlaceError::new(&uri, error.into()),
        })
    }

    /// The relative paths of all files below a path.
    pub(super) async fn all(&self, below: &str) -> Result<Vec<String>, PlaceError> {
        let found = self.objects.all(&self.path(below)).await;
        let found = found.map_err(|error| PlaceError::new(&self.uri(below), error))?;
        let skip = match self.prefix.is_empty() {
            true => 0,
            false => self.prefix.len() + 1,
        };
        Ok(found
            .into_iter()
            .map(|mut path| path.split_off(skip))
            .collect())
    }

    /// Writes a file unless there is one; whether it was written.
    pub(super) async fn put_new(&self, below: &str, bytes: Bytes) -> Result<bool, PlaceError> {
        let written = self.objects.put_new(&self.path(below), bytes).await;
        written.map_err(|error| PlaceError::new(&self.uri(below), error))
    }

    /// Writes a file, replacing an earlier one.
    pub(super) async fn put(&self, below: &str, bytes: Bytes) -> Result<(), PlaceError> {
        let written = self.objects.put(&self.path(below), bytes).await;
        written.map_err(|error| PlaceError::new(&self.uri(below), error))
    }

    /// Removes the remains of writes of a run's files that were cut off more than `age` ago.
    pub(super) fn remove_cut_off(&self, age: Duration) -> Result<usize, PlaceError> {
        const ENDINGS: [&str; 8] = [
            ".npz", ".feather", ".label", ".json", ".jsonl", ".csv", ".txt", "_SUCCESS",
        ];
        let removed = self.objects.remove_cut_off(&ENDINGS, age);
        removed.map_err(|error| PlaceError::new(&self.uri(""), error))
    }

    /// Removes a file.
    pub(super) async fn remove(&self, below: &str) -> Result<(), PlaceError> {
        let removed = self.objects.remove(&self.path(below)).await;
        removed.map_err(|error| PlaceError::new(&self.uri(below), error))
    }
}

/// Whether a link leads to nothing that exists, through a file, or in a circle.
fn leads_nowhere(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
        || rustix::io::Errno::from_io_error(error) == Some(rustix::io::Errno::LOOP)
}

/// The names of the folders and of the files in a folder of this machine, each in order; none if there
/// is no such folder. Links are what they lead to, and files where they lead nowhere or to themselves.
fn folder_entries(folder: &Path) -> io::Result<[Vec<String>; 2]> {
    let (mut folders, mut files) = (Vec::new(), Vec::new());
    let listed = match fs::read_dir(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok([folders, files]),
        listed => listed?,
    };
    for entry in listed {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let mut kind = entry.file_type()?;
        if kind.is_symlink() {
            match fs::metadata(entry.path()) {
                Ok(about) => kind = about.file_type(),
                Err(error) if leads_nowhere(&error) => {}
                Err(error) => {
                    let message = format!("{name}: {error}");
                    return Err(io::Error::new(error.kind(), message));
                }
            }
        }
        match (kind.is_dir(), entry.file_name().to_str()) {
            (true, Some(_)) => folders.push(name),
            (true, None) => {
                let message = format!("the name {name} is no UTF-8");
                return Err(io::Error::new(ErrorKind::InvalidFilename, message));
            }
            // A sweep whose name is no UTF-8 is refused later, as a file that is not there.
            (false, _) => files.push(name),
        }
    }
    folders.sort();
    files.sort();
    Ok([folders, files])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uris_are_taken_apart_and_unknown_ones_are_refused() {
        let taken = |uri: &str| parts(uri).map(|(root, path)| (root.unwrap_or_default(), path));
        let both = |root: &str, path: &str| (root.to_owned(), path.to_owned());
        for (uri, expected) in [
            ("a/b.pcd", both("", "a/b.pcd")),
            ("file:///a/b%20c.pcd", both("", "/a/b c.pcd")),
            ("s3://bucket/a b/c.pcd", both("s3://bucket", "a b/c.pcd")),
            ("gs://bucket", both("gs://bucket", "")),
        ] {
            assert_eq!(taken(uri).expect(uri), expected);
        }
        assert_eq!(path_of("file:///a/b%201.pcd"), "/a/b 1.pcd");
        for uri in ["ftp://a/b", "s3:///x", "://"] {
            assert!(matches!(parts(uri), Err(PlaceError::Uri(_))), "{uri}");
        }
    }
}
