//! The plan: the drives, their sweeps, and the names of the outputs.

use std::collections::HashMap;

use crate::flow::RigidTransform;
use crate::formats::turning_sweep;

/// One sweep of a drive.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveSweep {
    /// The path of its file or the URI of its object.
    pub uri: String,
    /// Its part of the names of outputs.
    pub key: String,
    /// Pose of the sensor, world_from_sensor, where it is known.
    pub pose: Option<RigidTransform>,
    /// Seconds of its time, on any clock of the drive, where they are known.
    pub time_s: Option<f64>,
}

/// Consecutive sweeps of one sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// Its part of the names of outputs; it may have several parts, separated by `/`.
    pub name: String,
    /// Two sweeps or more, in the order in which they were recorded.
    pub sweeps: Vec<DriveSweep>,
    /// Why the poses of the drive cannot be read, where they are there.
    pub bad_poses: Option<String>,
}

impl Drive {
    /// A drive whose poses, where it has any, are with its sweeps.
    pub fn new(name: String, sweeps: Vec<DriveSweep>) -> Self {
        Self {
            name,
            sweeps,
            bad_poses: None,
        }
    }

    /// Number of pairs.
    pub fn pairs(&self) -> usize {
        self.sweeps.len().saturating_sub(1)
    }

    /// The name of the output of a pair, without its ending.
    pub fn key(&self, pair: usize) -> String {
        below(&self.name, &self.sweeps[pair].key)
    }
}

/// The path of a file or folder in a folder. An empty folder, and a drive without a name, is the place itself.
pub(super) fn below(folder: &str, name: &str) -> String {
    match folder.is_empty() {
        true => name.to_owned(),
        false => format!("{folder}/{name}"),
    }
}

/// Why drives are no plan.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// There is no drive of two sweeps.
    #[error("there is no pair: a drive has two sweeps or more")]
    Empty,
    /// Two pairs have one output.
    #[error("{first} and {second} would both be written as {key}: give them other names or drives")]
    SameKey {
        /// The sweep of the first pair.
        first: String,
        /// The sweep of the second pair.
        second: String,
        /// The name of the output.
        key: String,
    },
    /// The sweeps of a drive go back in time.
    #[error(
        "{sweep} is followed by an earlier sweep, against the order of drive {drive:?}: sort the rows of the \
         manifest, or label them as they are with --force"
    )]
    Order {
        /// The name of the drive.
        drive: String,
        /// The sweep before the turn.
        sweep: String,
    },
    /// The output of one pair is the folder of another one's.
    #[error(
        "{key} would be the output of {first} and the folder of that of {second}: give them other names"
    )]
    FileAndFolder {
        /// The sweep of the first pair.
        first: String,
        /// The sweep of the second pair.
        second: String,
        /// The name.
        key: String,
    },
}

/// All drives, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    drives: Vec<Drive>,
}

impl Plan {
    /// A plan of drives. Drives of one sweep are left out.
    ///
    /// # Errors
    /// [`PlanError`].
    pub fn new(mut drives: Vec<Drive>) -> Result<Self, PlanError> {
        drives.retain(|drive| drive.pairs() > 0);
        if drives.is_empty() {
            return Err(PlanError::Empty);
        }
        let mut known: HashMap<String, &str> = HashMap::new();
        for drive in &drives {
            for pair in 0..drive.pairs() {
                let uri = &drive.sweeps[pair].uri;
                if let Some(first) = known.insert(drive.key(pair), uri) {
                    return Err(PlanError::SameKey {
                        first: first.to_owned(),
                        second: uri.clone(),
                        key: drive.key(pair),
                    });
                }
            }
        }
        Ok(Self { drives })
    }

    /// Checks that the times of the sweeps of each drive, or the numbers in their names, go one way.
    ///
    /// # Errors
    /// [`PlanError::Order`].
    pub(super) fn check_order(&self) -> Result<(), PlanError> {
        for drive in &self.drives {
            let times: Option<Vec<f64>> = drive.sweeps.iter().map(|sweep| sweep.time_s).collect();
            let turn = match times {
                Some(times) => {
                    let ways = times.windows(2).map(|pair| pair[1].total_cmp(&pair[0]));
                    let mut ways = ways.enumerate().filter(|(_, way)| way.is_ne());
                    let first = ways.next().map(|(_, way)| way);
                    ways.find(|&(_, way)| Some(way) != first).map(|(at, _)| at)
                }
                None => {
                    let names: Vec<&str> = drive.sweeps.iter().map(|s| s.uri.as_str()).collect();
                    turning_sweep(&names)
                }
            };
            if let Some(turn) = turn {
                return Err(PlanError::Order {
                    drive: drive.name.clone(),
                    sweep: drive.sweeps[turn].uri.clone(),
                });
            }
        }
        Ok(())
    }

    /// The drives.
    pub fn drives(&self) -> &[Drive] {
        &self.drives
    }

    /// Number of pairs.
    pub fn pairs(&self) -> usize {
        self.drives.iter().map(Drive::pairs).sum()
    }

    /// All pairs in order: the index of the drive, and of the pair in the drive.
    pub fn all_pairs(&self) -> impl Iterator<Item = (usize, usize)> {
        let drives = self.drives.iter().enumerate();
        drives.flat_map(|(drive, of)| (0..of.pairs()).map(move |pair| (drive, pair)))
    }

    /// The number of pairs before each drive.
    pub(super) fn pairs_before(&self) -> Vec<usize> {
        let sums = self.drives.iter().scan(0, |sum, drive| {
            let before = *sum;
            *sum += drive.pairs();
            Some(before)
        });
        sums.collect()
    }

    /// A hash of all that outputs depend on: their names, the sweeps in order, the times, and with
    /// `poses` the poses.
    pub fn hash(&self, poses: bool) -> String {
        let mut hasher = blake3::Hasher::new();
        for drive in &self.drives {
            for sweep in &drive.sweeps {
                for part in [&drive.name, &sweep.key, &sweep.uri] {
                    hasher.update(part.as_bytes());
                    hasher.update(&[0]);
                }
                let pose = sweep
                    .pose
                    .filter(|_| poses)
                    .map(|pose| pose.to_homogeneous());
                let numbers = pose.iter().flatten().chain(&sweep.time_s);
                for number in numbers {
                    hasher.update(&number.to_le_bytes());
                }
                // What is there is told from what is not.
                hasher.update(&[u8::from(pose.is_some()), u8::from(sweep.time_s.is_some())]);
            }
        }
        hasher.finalize().to_hex().to_string()
    }
}

/// A part of a name of outputs: letters, digits, `.`, `-` and `_` of the text, the others as `_`.
pub(super) fn key_of(text: &str) -> String {
    let plain = |letter: char| match letter {
        'a'..='z' | 'A'..='Z' | '0'..='9' | '.' | '-' | '_' => letter,
        _ => '_',
    };
    let key: String = text.chars().map(plain).collect();
    // Outputs that begin so are the run's own, and a part of dots alone is a folder.
    match key.starts_with('_') || key.chars().all(|letter| letter == '.') {
        true => format!("x{key}"),
        false => key,
    }
}

/// The name of a drive: each part of a path by itself, as [`key_of`] gives it.
pub(super) fn drive_name(path: &str) -> String {
    let parts = path.split('/').filter(|part| !part.is_empty());
    parts.map(key_of).collect::<Vec<_>>().join("/")
}

/// The name of a file without its folder and its ending. nuScenes has two endings, `.pcd.bin`.
pub(super) fn stem(name: &str) -> &str {
    let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let bare = file.strip_suffix(".pcd.bin");
    bare.or(file.rsplit_once('.').map(|(bare, _)| bare))
        .unwrap_or(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(name: &str, keys: &[&str]) -> Drive {
        let sweep = |key: &&str| DriveSweep {
            uri: format!("{key}.pcd"),
            key: key_of(key),
            pose: None,
            time_s: None,
        };
        Drive::new(name.to_owned(), keys.iter().map(sweep).collect())
    }

    #[test]
    fn every_pair_has_a_name_of_its_own() {
        let plan = Plan::new(vec![
            drive("a", &["0", "1", "2"]),
            drive("one", &["0"]),
            drive("b/c", &["0", "1"]),
        ]);
        let plan = plan.expect("a plan");
        let keys: Vec<String> = plan
            .all_pairs()
            .map(|(drive, pair)| plan.drives()[drive].key(pair))
            .collect();
        assert_eq!(keys, ["a/0", "a/1", "b/c/0"]);
        assert_eq!(plan.pairs(), 3);
        let twice = Plan::new(vec![drive("a", &["0", "1"]), drive("a", &["0", "2"])]);
        assert!(matches!(twice, Err(PlanError::SameKey { .. })));
        assert_eq!(Plan::new(vec![drive("a", &["0"])]), Err(PlanError::Empty));
    }

    #[test]
    fn sweeps_that_go_back_in_time_are_no_plan() {
        let check = |keys: &[&str], times: &[f64]| {
            let mut drive = drive("a", keys);
            for (sweep, &time) in drive.sweeps.iter_mut().zip(times) {
                sweep.time_s = Some(time);
            }
            Plan::new(vec![drive]).expect("a plan").check_order()
        };
        for (keys, times) in [
            (&["1", "2", "10"], &[][..]),
            (&["10", "2", "1"], &[]),
            (&["a", "c", "b"], &[]),
            (&["3", "1", "2"], &[0.0, 0.0, 0.1]),
        ] {
            assert_eq!(check(keys, times), Ok(()), "{keys:?} {times:?}");
        }
        for (keys, times) in [
            (&["1", "10", "2"], &[][..]),
            (&["1", "2", "3"], &[0.0, 0.2, 0.1]),
        ] {
            let turned = check(keys, times).expect_err("a turn").to_string();
            assert!(turned.contains(keys[1]), "{turned}");
        }
    }

    #[test]
    fn names_lead_nowhere_else() {
        let names = ["a b", "../x", "..", "_SUCCESS", "Übung", "7.pcd.bin"].map(key_of);
        assert_eq!(
            names,
            ["a_b", ".._x", "x..", "x_SUCCESS", "x_bung", "7.pcd.bin"]
        );
        let names = [
            "a/b/0012.pcd.bin",
            "1617179420.100000000.pcd",
            "scan.0001.ply",
            "7",
        ]
        .map(stem);
        assert_eq!(names, ["0012", "1617179420.100000000", "scan.0001", "7"]);
    }
}
