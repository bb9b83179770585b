//! What manifests in both forms are read into.

use std::collections::HashMap;

/// Most bytes of a manifest.
pub(super) const MAX_BYTES: usize = 1 << 30;
/// Most rows of a manifest.
pub(super) const MAX_ROWS: usize = 50_000_000;
/// The columns that are read.
pub(super) const COLUMNS: [&str; 8] = [
    "drive",
    "sweep",
    "source",
    "target",
    "id",
    "time_s",
    "timestamp_ns",
    "pose",
];

/// Why a manifest cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// It is no table.
    #[error("the manifest is no CSV and no Parquet table: {0}")]
    Unreadable(String),
    /// It is too large.
    #[error("the manifest is too large: at most 1 GiB and 50,000,000 rows are read")]
    TooLarge,
    /// A column is missing.
    #[error("the manifest has the columns {0}: drive and sweep are needed, or source and target")]
    Columns(String),
    /// A row has a wrong value.
    #[error("the manifest, row {row}: {what}")]
    Row {
        /// Number of the row, from 1, without the heading.
        row: usize,
        /// What is wrong.
        what: String,
    },
}

/// The values of the known columns, as text, one row after the other.
#[derive(Debug, Default)]
pub(super) struct Table {
    pub(super) names: Vec<String>,
    pub(super) rows: Vec<HashMap<&'static str, String>>,
}

/// The name of a column, if it is read.
pub(super) fn known(name: &str) -> Option<&'static str> {
    COLUMNS.into_iter().find(|known| *known == name)
}
