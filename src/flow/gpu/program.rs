//! The order of an iteration's phases. A long search of nearest neighbors is divided, so that no
//! driver and no watchdog takes the GPU for hung.

use super::layout::TILE;
use super::phase::Phase;
use super::request::{LossKind, Request};
use super::tiling::{Plan, Wave};

/// Comparisons of the Chamfer loss that take as long as a distance.
const COMPARISONS: usize = 8;

/// The loss of all lanes of a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SubmittedLoss {
    Distance,
    Chamfer {
        /// Queries of the largest search.
        queries: usize,
        /// Points of both clouds of all lanes.
        sites: usize,
    },
}

impl SubmittedLoss {
    /// The loss of `requests`, which have one kind.
    pub(super) fn of(requests: &[&Request]) -> Self {
        match requests.first().map(|request| request.loss) {
            Some(LossKind::Chamfer) => {
                let sizes = requests.iter().flat_map(|request| request.cloud_sizes());
                Self::Chamfer {
                    queries: sizes.clone().max().unwrap_or_default(),
                    sites: sizes.sum(),
                }
            }
            _ => Self::Distance,
        }
    }
}

/// A phase with its wave: tiles of points, or tiles of queries for [`Phase::Nearest`].
pub(super) type Item = (Phase, Wave);

/// The phases of an iteration in order, in groups of bounded work.
pub(super) struct Program {
    before_query: Vec<Vec<Item>>,
    query: Vec<Vec<Item>>,
    after_query: Vec<Vec<Item>>,
    /// Share of all tiles whose query is in `query`.
    pub(super) query_share: f64,
    /// Whether all groups together have the work of one.
    pub(super) is_whole: bool,
}

impl Program {
    /// The phases of an iteration of `plan`. A search of nearest neighbors needs the flow of all
    /// waves, so with more than one wave the forward pass is done twice. A group has up to
    /// `most_distances` distances.
    pub(super) fn new(plan: &Plan, loss: SubmittedLoss, most_distances: usize) -> Self {
        let (first, rest) = (plan.waves[0], &plan.waves[1..]);
        let of_a_wave = |wave: &Wave| Phase::OF_A_WAVE.map(|phase| (phase, *wave));
        let others = rest.iter().flat_map(of_a_wave);
        let end = Phase::OF_THE_END.map(|phase| (phase, Wave::default()));
        let [forward, loss_of_first, backward, gradients] = of_a_wave(&first);
        let halve = (Phase::Halve, first);
        match loss {
            SubmittedLoss::Distance => {
                let after = [backward, gradients].into_iter();
                Self {
                    before_query: vec![vec![halve, forward]],
                    query: vec![vec![loss_of_first]],
                    after_query: vec![after.chain(others).chain(end).collect()],
                    query_share: first.tiles as f64 / plan.tiles.len() as f64,
                    is_whole: true,
                }
            }
            SubmittedLoss::Chamfer { queries, sites } => {
                let limit = Limit {
                    sites,
                    most_distances,
                };
                let waves = plan.waves.iter();
                let displaced =
                    waves.flat_map(|&wave| [(Phase::Forward, wave), (Phase::Deform, wave)]);
                let again = (!rest.is_empty()).then_some(forward);
                let after = again.into_iter();
                let after = after.chain([loss_of_first, backward, gradients]);
                let search = Wave {
                    tiles: queries.div_ceil(TILE).max(1),
                    ..Wave::default()
                };
                let mut program = Self {
                    before_query: vec![[halve].into_iter().chain(displaced).collect()],
                    query: limit.grouped([(Phase::Nearest, search)].into_iter()),
                    after_query: limit.grouped(after.chain(others).chain(end)),
                    query_share: 1.0,
                    is_whole: false,
                };
                let items = program.parts().into_iter().flatten().flatten();
                let work: usize = items.map(|item| limit.work(item)).sum();
                program.is_whole = work <= most_distances;
                program
            }
        }
    }

    /// What comes before the query, the query, and what comes after it.
    pub(super) fn parts(&self) -> [&[Vec<Item>]; 3] {
        [&self.before_query, &self.query, &self.after_query]
    }
}

/// The limit of a group's work.
struct Limit {
    /// Points that each point of a wave meets.
    sites: usize,
    most_distances: usize,
}

impl Limit {
    /// Distances of one tile of a phase. Zero for phases that are short.
    fn work_of_a_tile(&self, phase: Phase) -> usize {
        match phase {
            Phase::Nearest => TILE * self.sites,
            Phase::Loss => TILE * self.sites / COMPARISONS,
            _ => 0,
        }
    }

    fn work(&self, (phase, wave): &Item) -> usize {
        wave.tiles * self.work_of_a_tile(*phase)
    }

    /// Cuts the waves of `items` into pieces, and these into groups, in order.
    fn grouped(&self, items: impl Iterator<Item = Item>) -> Vec<Vec<Item>> {
        let mut groups = vec![Vec::new()];
        let mut work = 0;
        for item in items.flat_map(|item| self.pieces(item)) {
            let own = self.work(&item);
            if work > 0 && work + own > self.most_distances {
                groups.push(Vec::new());
                work = 0;
            }
            work += own;
            if let Some(group) = groups.last_mut() {
                group.push(item);
            }
        }
        groups
    }

    /// The pieces of a wave. Those of a short phase are the wave itself.
    fn pieces(&self, (phase, wave): Item) -> Vec<Item> {
        let tiles = match self.work_of_a_tile(phase) {
            0 => return vec![(phase, wave)],
            work => (self.most_distances / work).max(1),
        };
        let firsts = (0..wave.tiles).step_by(tiles);
        let piece = |first: usize| Wave {
            first_tile: wave.first_tile + first,
            first_row: wave.first_row + first * TILE,
            tiles: tiles.min(wave.tiles - first),
            ..wave
        };
        firsts.map(|first| (phase, piece(first))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::gpu::tiling::Cut;

    const MOST: usize = 1 << 34;

    fn program(points: usize, targets: usize, rows: usize) -> Program {
        let loss = SubmittedLoss::Chamfer {
            queries: points.max(targets),
            sites: points + targets,
        };
        Program::new(&Plan::new(&[Cut::new(points)], rows), loss, MOST)
    }

    #[test]
    fn usual_clouds_are_one_submission_and_compute_each_flow_once() {
        let program = program(8192, 9000, 8192);
        assert!(program.is_whole);
        let items = program.parts().into_iter().flatten().flatten();
        let forward = items.filter(|(phase, _)| *phase == Phase::Forward);
        assert_eq!(forward.count(), 1);
    }

    #[test]
    fn long_phases_are_cut_into_pieces_that_cover_every_tile_once() {
        let (points, targets) = (2_000_000, 1_900_000);
        let program = program(points, targets, 1 << 19);
        assert!(!program.is_whole);
        let limit = Limit {
            sites: points + targets,
            most_distances: MOST,
        };
        for (long, tiles) in [
            (Phase::Nearest, points.div_ceil(TILE)),
            (Phase::Loss, Cut::new(points).tiles),
        ] {
            let mut next = 0;
            for group in program.parts().into_iter().flatten() {
                let work: usize = group.iter().map(|item| limit.work(item)).sum();
                assert!(work <= MOST, "{work}");
                for (_, wave) in group.iter().filter(|(phase, _)| *phase == long) {
                    assert_eq!(wave.first_tile, next, "{long:?}");
                    next += wave.tiles;
                }
            }
            assert_eq!(next, tiles, "{long:?}");
        }
    }
}
