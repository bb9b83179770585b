//! Shards: the part of a plan that one process does.

use std::env;
use std::fmt;
use std::str::FromStr;

use super::plan::Plan;

/// Shard `index` of `count`, counted from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// Its index.
    pub index: usize,
    /// Number of shards.
    pub count: usize,
}

/// Why a shard cannot be known.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ShardError {
    /// The text is no shard.
    #[error("{0:?} is no shard: it is I/N, with I from 0 to N - 1")]
    Text(String),
    /// No variable of the environment names one.
    #[error(
        "the environment names no shard: FNSF_SHARD=I/N, SLURM_ARRAY_TASK_ID, or JOB_COMPLETION_INDEX are read"
    )]
    NotInEnvironment,
    /// The environment does not say how many there are.
    #[error("JOB_COMPLETION_INDEX is {0}, and nothing says of how many: give --shards N")]
    NoCount(usize),
}

impl Default for Shard {
    fn default() -> Self {
        Self { index: 0, count: 1 }
    }
}

impl FromStr for Shard {
    type Err = ShardError;

    fn from_str(text: &str) -> Result<Self, ShardError> {
        let parsed = || {
            let (index, count) = text.split_once('/')?;
            let (index, count) = (index.trim().parse().ok()?, count.trim().parse().ok()?);
            (index < count).then_some(Self { index, count })
        };
        parsed().ok_or_else(|| ShardError::Text(text.to_owned()))
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

impl Shard {
    /// The shard that the environment names: `FNSF_SHARD`, a task of a Slurm array, or a pod of an
    /// Indexed Job of Kubernetes. `count` is the number of shards where the environment does not say
    /// it.
    ///
    /// # Errors
    /// [`ShardError`].
    pub fn from_environment(count: Option<usize>) -> Result<Self, ShardError> {
        Self::from_variables(count, |name| env::var(name).ok())
    }

    fn from_variables(
        count: Option<usize>,
        variable: impl Fn(&str) -> Option<String>,
    ) -> Result<Self, ShardError> {
        if let Some(text) = variable("FNSF_SHARD") {
            return text.parse();
        }
        let number = |name: &str| {
            let text = variable(name)?;
            Some(text.parse::<usize>().map_err(|_| ShardError::Text(text)))
        };
        let number = |name: &str| number(name).transpose();
        if let Some(task) = number("SLURM_ARRAY_TASK_ID")? {
            let first = number("SLURM_ARRAY_TASK_MIN")?.unwrap_or(0);
            let step = number("SLURM_ARRAY_TASK_STEP")?.unwrap_or(1).max(1);
            let tasks = number("SLURM_ARRAY_TASK_COUNT")?;
            // A later part of a long list may be submitted as an array of its own.
            let (index, count) = match count {
                Some(count) => (task, count),
                None => (task.saturating_sub(first) / step, tasks.unwrap_or(0)),
            };
            return format!("{index}/{count}").parse();
        }
        if let Some(index) = number("JOB_COMPLETION_INDEX")? {
            let count = count.ok_or(ShardError::NoCount(index))?;
            return format!("{index}/{count}").parse();
        }
        Err(ShardError::NotInEnvironment)
    }

    /// The index of the shard of `count` that holds a pair. `number` is the number of the plan's `all`
    /// pairs before it, or with whole drives before its drive.
    pub(super) fn of(number: usize, all: usize, count: usize) -> usize {
        (number as u128 * count as u128 / all as u128) as usize
    }

    /// Its pairs, in order: the indices of the drive and of the pair. Consecutive pairs stay
    /// together, so that a sweep is read once. With `whole_drives` a drive is in one shard.
    pub fn pairs(&self, plan: &Plan, whole_drives: bool) -> Vec<(usize, usize)> {
        let (all, before) = (plan.pairs(), plan.pairs_before());
        let is_own = |&(drive, pair): &(usize, usize)| {
            let number = before[drive] + if whole_drives { 0 } else { pair };
            Self::of(number, all, self.count) == self.index
        };
        plan.all_pairs().filter(is_own).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::label::plan::{Drive, DriveSweep};

    fn plan(sizes: &[usize]) -> Plan {
        let sweep = |sweep: usize| DriveSweep {
            uri: String::new(),
            key: sweep.to_string(),
            pose: None,
            time_s: None,
        };
        let drive = |(index, &size): (usize, &usize)| {
            Drive::new(index.to_string(), (0..size).map(sweep).collect())
        };
        Plan::new(sizes.iter().enumerate().map(drive).collect()).expect("a plan")
    }

    #[test]
    fn every_pair_is_in_one_shard() {
        let plan = plan(&[2, 30, 5, 5, 17, 2]);
        for count in [1, 2, 3, 7, 55, 56, 200] {
            for whole in [false, true] {
                let shards = (0..count).map(|index| Shard { index, count });
                let pairs: Vec<_> = shards.flat_map(|shard| shard.pairs(&plan, whole)).collect();
                assert_eq!(
                    pairs,
                    plan.all_pairs().collect::<Vec<_>>(),
                    "{count} {whole}"
                );
            }
        }
        let shards = (0..4).map(|index| Shard { index, count: 4 }.pairs(&plan, false).len());
        assert_eq!(shards.collect::<Vec<_>>(), [14, 14, 14, 13]);
    }

    #[test]
    fn the_environments_of_farms_name_a_shard() {
        let of = |count: Option<usize>, known: &[(&str, &str)]| {
            let variable = |name: &str| {
                let found = known.iter().find(|(known, _)| *known == name);
                found.map(|(_, value)| (*value).to_owned())
            };
            Shard::from_variables(count, variable)
        };
        let shard = |index, count| Ok(Shard { index, count });
        assert_eq!(of(None, &[("FNSF_SHARD", "3/8")]), shard(3, 8));
        let array = [
            ("SLURM_ARRAY_TASK_ID", "7"),
            ("SLURM_ARRAY_TASK_MIN", "1"),
            ("SLURM_ARRAY_TASK_STEP", "2"),
            ("SLURM_ARRAY_TASK_COUNT", "5"),
        ];
        assert_eq!(of(None, &array), shard(3, 5));
        assert_eq!(of(Some(2000), &array), shard(7, 2000));
        let pod = [("JOB_COMPLETION_INDEX", "4")];
        assert_eq!(of(Some(5), &pod), shard(4, 5));
        assert_eq!(of(None, &pod), Err(ShardError::NoCount(4)));
        assert_eq!(of(None, &[]), Err(ShardError::NotInEnvironment));
        for wrong in ["8/8", "1", "-1/2", "a/b", ""] {
            let read = of(None, &[("FNSF_SHARD", wrong)]);
            assert_eq!(read, Err(ShardError::Text(wrong.to_owned())));
        }
    }
}
