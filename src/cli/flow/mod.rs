//! `fnsf flow`: scene flow of one pair, or of the consecutive pairs of a sequence.

mod arguments;
mod follow;
mod output;
mod pairs;
mod print;

use std::path::Path;
use std::sync::Arc;

pub(super) use self::arguments::Flow;
use self::follow::{Arrivals, Latencies};
use self::output::Arrival;
use self::pairs::{Pairs, Taken, warn};
pub(super) use self::print::print_report;
use super::estimation::check_sequence;
use super::failure::Failure;
use super::files;
use super::output::complain;
use crate::flow::{Control, Sweep};
use crate::job::JobOptions;

impl Flow {
    pub(super) fn run(&self) -> Result<(), Failure> {
        self.check_outputs()?;
        let options = self.estimation.options()?;
        self.follow.check(&self.tracks, &self.estimation)?;
        if let Some(folder) = &self.follow.follow {
            return self.run_folder(folder, options);
        }
        let mut given = None;
        match self.sweeps.as_slice() {
            [pair] => given = Some(files::read_pair(pair)?),
            files => check_sequence(&options, files.len())?,
        }
        let count = given.as_ref().map_or(self.sweeps.len(), |_| 2);
        let tracking = self.tracks.start(count, &options)?;
        let surroundings = self.estimation.surroundings(&self.sweeps)?;
        self.check_deskew(&surroundings, &options)?;
        let mut pairs = Pairs::new(self, options, surroundings, tracking, count - 1)?;
        let done = match given {
            Some(pair) => {
                let (source, target) = match pair.ground {
                    Some(ground) => (Some(ground.source), Some(ground.target)),
                    None => (None, None),
                };
                let mut given = [(pair.source, source), (pair.target, target)].into_iter();
                given.try_for_each(|(points, ground)| {
                    let sweep = Sweep {
                        points,
                        ground,
                        ..Sweep::default()
                    };
                    pairs.push(&Arc::new(sweep), Taken::default())
                })
            }
            None => self.sweeps.iter().try_for_each(|path| {
                let (sweep, taken) = match pairs.read(path) {
                    Ok(read) => read,
                    Err(failure) => return pairs.flush().and(Err(failure)),
                };
                pairs.push(&Arc::new(sweep), taken)
            }),
        };
        pairs.finish(done)
    }

    /// Estimates the pairs of a folder's sweeps as they are written.
    fn run_folder(&self, folder: &Path, options: JobOptions) -> Result<(), Failure> {
        check_sequence(&options, usize::MAX)?;
        let surroundings = self.estimation.surroundings(&[])?;
        self.check_deskew(&surroundings, &options)?;
        let mut arrivals = Arrivals::watch(folder, &self.follow)?;
        let mut pairs = Pairs::new(self, options, surroundings, None, usize::MAX)?;
        let mut latencies = Latencies::default();
        while let Some(arrived) = arrivals.next()? {
            let waiting = arrivals.waiting();
            pairs.surroundings.add(&arrived.path);
            // One bad sweep is no reason to miss all later ones.
            match pairs.read(&arrived.path) {
                Ok((sweep, taken)) => {
                    let taken = Taken {
                        arrived: Some(Arrival {
                            due_s: self.follow.due_s(&arrived, pairs.terminal.seconds()),
                            written: arrived.written,
                            waiting,
                        }),
                        ..taken
                    };
                    pairs.push_or_warn(&Arc::new(sweep), taken)?;
                }
                Err(failure) if failure.is_of_input() => {
                    pairs.flush_or_warn()?;
                    warn(&failure);
                    pairs.restart();
                }
                Err(failure) => return Err(failure),
            }
            latencies.add(&pairs.take_latencies());
        }
        pairs.flush_or_warn()?;
        latencies.add(&pairs.take_latencies());
        complain(format_args!("{latencies}"));
        Ok(())
    }
}
