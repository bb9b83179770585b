//! Searches for nearest neighbors between the target and a deformed source, on a pool of threads.

use std::sync::Arc;

use rayon::prelude::*;

use super::isa::Isa;
use super::nearest_kernels::{NearestKernel, QUERIES, Sites};
use crate::flow::data::{Control, Interrupt, Point, control};
use crate::flow::field::NearestSearcher;

/// Queries between two checks of the control.
const GROUP: usize = 4 * QUERIES;

/// Searches all distances.
pub(super) struct BruteForce {
    kernel: NearestKernel,
    threads: Arc<rayon::ThreadPool>,
    target: Vec<Point>,
    sites: Sites,
}

impl BruteForce {
    /// A search in `target`, which has at least one point.
    pub(super) fn new(isa: Isa, threads: Arc<rayon::ThreadPool>, target: &[Point]) -> Self {
        Self {
            kernel: NearestKernel::new(isa),
            threads,
            target: target.to_vec(),
            sites: Sites::new(target),
        }
    }

    fn search(
        &self,
        queries: &[Point],
        sites: &Sites,
        control: &dyn Control,
    ) -> Result<Vec<u32>, Interrupt> {
        in_groups(&self.threads, queries, control, |queries, nearest| {
            let groups = queries.chunks(QUERIES).zip(nearest.chunks_mut(QUERIES));
            groups.for_each(|(queries, nearest)| self.kernel.search(queries, sites, nearest));
        })
    }
}

impl NearestSearcher for BruteForce {
    fn in_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt> {
        self.search(points, &self.sites, control)
    }

    fn of_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt> {
        self.search(&self.target, &Sites::new(points), control)
    }
}

/// Searches k-d trees: one of the target, and one of the other cloud that is built for every search.
pub(super) struct KdTrees {
    threads: Arc<rayon::ThreadPool>,
    target: Vec<Point>,
    tree: KdTree,
}

impl KdTrees {
    /// A search in `target`, which has at least one point.
    pub(super) fn new(threads: Arc<rayon::ThreadPool>, target: &[Point]) -> Self {
        Self {
            threads,
            target: target.to_vec(),
            tree: KdTree::new(target),
        }
    }

    fn search(
        &self,
        queries: &[Point],
        tree: &KdTree,
        control: &dyn Control,
    ) -> Result<Vec<u32>, Interrupt> {
        in_groups(&self.threads, queries, control, |queries, nearest| {
            for (&query, nearest) in queries.iter().zip(nearest) {
                *nearest = tree.nearest(query);
            }
        })
    }
}

impl NearestSearcher for KdTrees {
    fn in_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt> {
        self.search(points, &self.tree, control)
    }

    fn of_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt> {
        self.search(&self.target, &KdTree::new(points), control)
    }
}

/// A k-d tree of a cloud with at least one point. All coordinates must be finite.
struct KdTree(nabo::KDTree<f32, Site>);

/// A point with its index in the cloud.
#[derive(Clone, Copy, Debug, Default)]
struct Site {
    point: Point,
    index: u32,
}

impl nabo::Point<f32> for Site {
    const DIM: u32 = 3;

    fn set(&mut self, axis: u32, value: nabo::NotNan<f32>) {
        self.point[axis as usize] = value.into_inner();
    }

    fn get(&self, axis: u32) -> nabo::NotNan<f32> {
        nabo::NotNan::new(self.point[axis as usize]).expect("the coordinates are finite")
    }
}

impl KdTree {
    fn new(points: &[Point]) -> Self {
        let sites = points.iter().enumerate().map(|(index, &point)| Site {
            point,
            index: index as u32,
        });
        Self(nabo::KDTree::new(&sites.collect::<Vec<_>>()))
    }

    fn nearest(&self, point: Point) -> u32 {
        let query = Site { point, index: 0 };
        let nearest = self.0.knn(1, &query);
        nearest.first().map_or(0, |found| found.point.index)
    }
}

/// Searches groups of queries in parallel, and checks the control before each.
fn in_groups(
    threads: &rayon::ThreadPool,
    queries: &[Point],
    control: &dyn Control,
    search: impl Fn(&[Point], &mut [u32]) + Sync,
) -> Result<Vec<u32>, Interrupt> {
    let mut nearest = vec![0; queries.len()];
    let groups = queries.par_chunks(GROUP).zip(nearest.par_chunks_mut(GROUP));
    threads.install(|| {
        groups.try_for_each(|(queries, nearest)| {
            control::check(control)?;
            search(queries, nearest);
            Ok(())
        })
    })?;
    Ok(nearest)
}
