//! The order of an iteration's phases, and its division among several submissions to the driver.

use super::layout::TILE;
use super::phase::Phase;
use super::request::{LossKind, Request};
use super::tiling::{Plan, Wave};

/// Distances that are computed in one submission to the driver. It takes 0.2 s at 1e11 a second,
/// and 17 s on a software device, so that no driver and no watchdog takes it for hung.
pub(super) const MOST_DISTANCES: usize = 1 << 34;
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
                let clouds = requests.iter().map(|request| request.cloud_sizes());
                let sizes = clouds.clone().flatten();
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

/// The phases of an iteration in order. Each group is one submission to the driver, as far as it is
/// not the last of its part.
pub(super) struct Program {
    pub(super) before_query: Vec<Vec<Item>>,
    pub(super) query: Vec<Vec<Item>>,
    pub(super) after_query: Vec<Vec<Item>>,
    /// Share of all tiles whose query is in `query`.
    pub(super) query_share: f64,
}

impl Program {
    /// The phases of an iteration of `plan`. A search of nearest neighbors needs the flow of all
    /// waves, so with more than one wave the forward pass is done twice.
    pub(super) fn new(plan: &Plan, loss: SubmittedLoss) -> Self {
        let (first, rest) = (plan.waves[0], &plan.waves[1..]);
        let of_a_wave = |wave: &Wave| Phase::OF_A_WAVE.map(|phase| (phase, *wave));
        let others = rest.iter().flat_map(of_a_wave);
        let end = Phase::OF_THE_END.map(|phase| (phase, Wave::default()));
        let [forward, loss_of_first, backward, gradients] = of_a_wave(&first);
        let before_query = vec![vec![(Phase::Halve, first), forward]];
        match loss {
            SubmittedLoss::Distance => {
                let after = [backward, gradients].into_iter();
                Self {
                    before_query,
                    query: vec![vec![loss_of_first]],
                    after_query: vec![after.chain(others).chain(end).collect()],
                    query_share: first.tiles as f64 / plan.tiles.len() as f64,
                }
            }
            SubmittedLoss::Chamfer { queries, sites } => {
                let displaced = rest
                    .iter()
                    .flat_map(|&wave| [(Phase::Forward, wave), (Phase::Deform, wave)]);
                let displaced = [(Phase::Deform, first)].into_iter().chain(displaced);
                let again = (!rest.is_empty()).then_some(forward);
                let after = again.into_iter();
                let after = after.chain([loss_of_first, backward, gradients]);
                Self {
                    before_query,
                    query: grouped(displaced.chain(searches(queries, sites)), sites),
                    after_query: grouped(after.chain(others).chain(end), sites),
                    query_share: 1.0,
                }
            }
        }
    }

    /// Whether all phases go into one submission to the driver.
    pub(super) fn is_whole(&self) -> bool {
        self.parts().iter().all(|part| part.len() == 1)
    }

    /// What comes before the query, the query, and what comes after it.
    pub(super) fn parts(&self) -> [&[Vec<Item>]; 3] {
        [&self.before_query, &self.query, &self.after_query]
    }
}

/// The search of nearest neighbors in pieces.
fn searches(queries: usize, sites: usize) -> impl Iterator<Item = Item> {
    let all = queries.div_ceil(TILE).max(1);
    let tiles = (MOST_DISTANCES / (TILE * sites.max(1))).clamp(1, all);
    (0..all).step_by(tiles).map(move |first_tile| {
        let wave = Wave {
            first_tile,
            tiles,
            ..Wave::default()
        };
        (Phase::Nearest, wave)
    })
}

/// Cuts `items` into groups of bounded work, in order. `sites` are the points that each point of a
/// wave meets.
fn grouped(items: impl Iterator<Item = Item>, sites: usize) -> Vec<Vec<Item>> {
    let mut groups = vec![Vec::new()];
    let mut work = 0;
    for (phase, wave) in items {
        let own = match phase {
            Phase::Nearest => wave.tiles * TILE * sites,
            Phase::Loss => wave.tiles * TILE * sites / COMPARISONS,
            _ => 0,
        };
        if work > 0 && work + own > MOST_DISTANCES {
            groups.push(Vec::new());
            work = 0;
        }
        work += own;
        if let Some(group) = groups.last_mut() {
            group.push((phase, wave));
        }
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::gpu::tiling::Cut;

    fn program(points: usize, targets: usize, rows: usize) -> Program {
        let loss = SubmittedLoss::Chamfer {
            queries: points.max(targets),
            sites: points + targets,
        };
        Program::new(&Plan::new(&[Cut::new(points)], rows), loss)
    }

    #[test]
    fn usual_clouds_are_one_submission_and_compute_each_flow_once() {
        let program = program(8192, 9000, 8192);
        assert!(program.is_whole());
        let items = program.parts().into_iter().flatten().flatten();
        let forward = items.filter(|(phase, _)| *phase == Phase::Forward);
        assert_eq!(forward.count(), 1);
    }

    #[test]
    fn a_long_search_is_cut_into_pieces_that_cover_every_query_once() {
        let (points, targets) = (2_000_000, 1_900_000);
        let program = program(points, targets, 1 << 19);
        assert!(!program.is_whole());
        let mut next = 0;
        for (phase, wave) in program.query.iter().flatten() {
            if *phase == Phase::Nearest {
                assert_eq!(wave.first_tile, next);
                assert!(wave.tiles * TILE * (points + targets) <= MOST_DISTANCES);
                next += wave.tiles;
            }
        }
        assert!(next * TILE >= points);
        let losses = program.after_query.iter().flatten();
        let losses = losses.filter(|(phase, _)| *phase == Phase::Loss);
        assert_eq!(losses.count(), points.div_ceil(1 << 19));
    }
}
