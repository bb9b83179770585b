//! Manifests: tables of sweeps or of pairs, as CSV or Parquet.
//!
//! ```text
//! drive,sweep                 one row for each sweep, in order; consecutive rows of a drive are pairs
//! source,target[,drive,id]    one row for each pair
//! ```
//!
//! Further columns of sweeps: `time_s` (seconds) or `timestamp_ns`, and `pose`, 12 or 16 numbers of
//! world_from_sensor. Other columns are ignored.

mod footer;
mod pages;
mod parquet;
mod table;
mod thrift;

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

use bytes::Bytes;

pub use table::ManifestError;
use table::{MAX_BYTES, MAX_ROWS, Table, known};

use super::plan::{Drive, DriveSweep, drive_name, key_of, stem};
use crate::flow::RigidTransform;
use crate::formats::rigid_motion;

/// Reads the drives of a manifest. Relative paths are below `folder`, where one is given.
///
/// # Errors
/// [`ManifestError`].
pub fn read_manifest(bytes: Bytes, folder: Option<&str>) -> Result<Vec<Drive>, ManifestError> {
    if bytes.len() > MAX_BYTES {
        return Err(ManifestError::TooLarge);
    }
    let table = match bytes.starts_with(b"PAR1") {
        true => {
            // The reader of Parquet panics at some damaged files.
            let read = catch_unwind(AssertUnwindSafe(|| parquet::read(bytes)));
            let damaged = |_| ManifestError::Unreadable("the Parquet file is damaged".to_owned());
            read.map_err(damaged)??
        }
        false => read_csv(&bytes)?,
    };
    let has = |name: &str| table.names.iter().any(|known| known == name);
    if has("sweep") {
        sweeps(&table, folder)
    } else if has("source") && has("target") {
        pairs(&table, folder)
    } else {
        Err(ManifestError::Columns(table.names.join(", ")))
    }
}

fn read_csv(bytes: &[u8]) -> Result<Table, ManifestError> {
    let unreadable = |error: csv::Error| ManifestError::Unreadable(error.to_string());
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_reader(bytes);
    let names: Vec<String> = reader
        .headers()
        .map_err(unreadable)?
        .iter()
        .map(str::to_owned)
        .collect();
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.map_err(unreadable)?;
        if rows.len() == MAX_ROWS {
            return Err(ManifestError::TooLarge);
        }
        let values = names
            .iter()
            .zip(&record)
            .filter(|(_, value)| !value.is_empty());
        let values = values.filter_map(|(name, value)| Some((known(name)?, value.to_owned())));
        rows.push(values.collect());
    }
    Ok(Table { names, rows })
}

/// A path or URI of the manifest; relative paths are below its folder.
fn located(uri: &str, folder: Option<&str>) -> String {
    match folder {
        Some(folder) if !uri.contains("://") && !uri.starts_with('/') => {
            format!("{}/{uri}", folder.trim_end_matches('/'))
        }
        _ => uri.to_owned(),
    }
}

fn sweeps(table: &Table, folder: Option<&str>) -> Result<Vec<Drive>, ManifestError> {
    let mut places: HashMap<String, usize> = HashMap::new();
    let mut drives: Vec<Drive> = Vec::new();
    for (index, values) in table.rows.iter().enumerate() {
        let wrong = |what: String| ManifestError::Row {
            row: index + 1,
            what,
        };
        let uri = values.get("sweep");
        let uri = uri.ok_or_else(|| wrong("it has no sweep".to_owned()))?;
        let number = |name: &'static str| {
            let read = |text: &String| {
                let number: Result<f64, _> = text.parse();
                let number = number.ok().filter(|number| number.is_finite());
                number.ok_or_else(|| wrong(format!("{name} is {text}, not a number")))
            };
            values.get(name).map(read).transpose()
        };
        let time_s = number("time_s")?.or(number("timestamp_ns")?.map(|time| time * 1e-9));
        let pose = values.get("pose").map(|text| pose(text).map_err(&wrong));
        let name = drive_name(values.get("drive").map_or("", String::as_str));
        let place = *places.entry(name.clone()).or_insert_with(|| {
            drives.push(Drive::new(name, Vec::new()));
            drives.len() - 1
        });
        drives[place].sweeps.push(DriveSweep {
            key: key_of(stem(uri)),
            uri: located(uri, folder),
            pose: pose.transpose()?,
            time_s,
        });
    }
    Ok(drives)
}

fn pairs(table: &Table, folder: Option<&str>) -> Result<Vec<Drive>, ManifestError> {
    let pair = |(index, values): (usize, &HashMap<&'static str, String>)| {
        let needed = |name: &'static str| {
            values.get(name).ok_or_else(|| ManifestError::Row {
                row: index + 1,
                what: format!("it has no {name}"),
            })
        };
        let sweep = |uri: &str, key: &str| DriveSweep {
            uri: located(uri, folder),
            key: key_of(key),
            pose: None,
            time_s: None,
        };
        let (source, target) = (needed("source")?, needed("target")?);
        let id = values
            .get("id")
            .map_or_else(|| stem(source), String::as_str);
        Ok(Drive::new(
            drive_name(values.get("drive").map_or("", String::as_str)),
            vec![sweep(source, id), sweep(target, stem(target))],
        ))
    };
    table.rows.iter().enumerate().map(pair).collect()
}

/// A pose of 12 or 16 numbers, row by row, as a JSON list or separated by spaces.
fn pose(text: &str) -> Result<RigidTransform, String> {
    let plain = text.replace(['[', ']', ','], " ");
    let numbers: Result<Vec<f64>, _> = plain.split_whitespace().map(str::parse).collect();
    let mut numbers = numbers.map_err(|_| "pose holds something that is no number".to_owned())?;
    if numbers.len() == 12 {
        numbers.extend([0.0, 0.0, 0.0, 1.0]);
    }
    let count = numbers.len();
    let rows: [f64; 16] = numbers
        .try_into()
        .map_err(|_| format!("pose has {count} numbers: 12 or 16 are needed"))?;
    let rows = core::array::from_fn(|row| core::array::from_fn(|column| rows[4 * row + column]));
    rigid_motion(&rows).map_err(|error| format!("pose: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn csv(text: &str) -> Result<Vec<Drive>, ManifestError> {
        read_manifest(Bytes::from(text.to_owned()), Some("/data"))
    }

    #[test]
    fn sweeps_of_a_drive_follow_each_other() {
        let text = "drive,sweep,timestamp_ns,pose\n\
            a,x/0.pcd,100000000,\"[1,0,0,5, 0,1,0,0, 0,0,1,0]\"\n\
            b,s3://lake/b/7.pcd,,\na,x/1.pcd,200000000,\n";
        let drives = csv(text).expect("drives");
        let found: Vec<_> = drives
            .iter()
            .map(|d| (d.name.as_str(), d.sweeps.len()))
            .collect();
        assert_eq!(found, [("a", 2), ("b", 1)]);
        let sweep = &drives[0].sweeps[0];
        assert_eq!(
            (sweep.uri.as_str(), sweep.key.as_str()),
            ("/data/x/0.pcd", "0")
        );
        assert_eq!(sweep.time_s, Some(0.1));
        assert_eq!(sweep.pose.map(|pose| pose.translation.x), Some(5.0));
        assert_eq!(drives[1].sweeps[0].uri, "s3://lake/b/7.pcd");
    }

    #[test]
    fn a_pair_is_a_drive_of_two_sweeps() {
        let text = "id,source,target,drive\npair 7,/a/0.pcd,/a/1.pcd,d/e\n,/a/1.pcd,/a/2.pcd,d/e\n";
        let drives = csv(text).expect("drives");
        let keys: Vec<String> = drives.iter().map(|drive| drive.key(0)).collect();
        assert_eq!(keys, ["d/e/pair_7", "d/e/1"]);
    }

    #[test]
    fn wrong_rows_are_named() {
        for (text, said) in [
            ("a,b\n1,2\n", "drive and sweep are needed"),
            ("drive,sweep\na,\n", "row 1: it has no sweep"),
            ("source,target\na,\n", "row 1: it has no target"),
            (
                "sweep,time_s\na.pcd,0\nb.pcd,soon\n",
                "row 2: time_s is soon",
            ),
            ("sweep,pose\na.pcd,1 2 3\n", "pose has 3 numbers"),
            ("sweep,pose\na.pcd,1 0 0 0 0 2 0 0 0 0 1 0\n", "not a rigid"),
            ("drive,sweep\na\n", "found record with 1 fields"),
        ] {
            let error = csv(text).expect_err(text).to_string();
            assert!(error.contains(said), "{text}: {error}");
        }
        let cut = read_manifest(Bytes::from_static(b"PAR1 and then nothing"), None);
        assert!(matches!(cut, Err(ManifestError::Unreadable(_))));
    }
}
