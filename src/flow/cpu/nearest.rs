//! Searches for nearest neighbors between the target and a deformed source, on a pool of threads.

use std::sync::Arc;

use rayon::prelude::*;

use super::nearest_kernels::{NearestKernel, QUERIES, Sites};
use crate::flow::data::{Control, Interrupt, Point, control};
use crate::flow::field::NearestSearcher;
use crate::flow::simd::Isa;

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
    fn target(&self) -> &[Point] {
        &self.target
    }

    fn over(&self, target: &[Point]) -> Self {
        Self {
            kernel: self.kernel,
            threads: Arc::clone(&self.threads),
            target: target.to_vec(),
            sites: Sites::new(target),
        }
    }

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
    fn target(&self) -> &[Point] {
        &self.target
    }

    fn over(&self, target: &[Point]) -> Self {
        Self::new(Arc::clone(&self.threads), target)
    }

    fn in_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt> {
        self.search(points, &self.tree, control)
    }

    fn of_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt> {
        self.search(&self.target, &KdTree::new(points), control)
    }
}

/// A k-d tree of a cloud with at least one point. All coordinates must be finite.
struct KdTree(nabo::KDTree<f32, Site>);

/// A point in the form of the library.
#[derive(Clone, Copy, Debug, Default)]
struct Site(Point);

impl nabo::Point<f32> for Site {
    const DIM: u32 = 3;

    fn set(&mut self, axis: u32, value: nabo::NotNan<f32>) {
        self.0[axis as usize] = value.into_inner();
    }

    fn get(&self, axis: u32) -> nabo::NotNan<f32> {
        nabo::NotNan::new(self.0[axis as usize]).expect("the coordinates are finite")
    }
}

impl KdTree {
    fn new(points: &[Point]) -> Self {
        let sites: Vec<Site> = points.iter().map(|&point| Site(point)).collect();
        Self(nabo::KDTree::new(&sites))
    }

    fn nearest(&self, point: Point) -> u32 {
        let nearest = self.0.knn(1, &Site(point));
        nearest.first().map_or(0, |found| found.index)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::{Random, Uncontrolled};

    fn squared(a: Point, b: Point) -> f32 {
        a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
    }

    #[test]
    fn both_searches_find_equally_near_points_in_both_directions() {
        // Rounding of fused and of separate products and sums.
        const TOLERANCE: f32 = 1e-6;
        let mut random = Random::new(11);
        let mut cloud = |count: usize| -> Vec<Point> {
            let mut axis = || random.uniform(-40.0, 40.0) as f32;
            (0..count).map(|_| [axis(), axis(), axis()]).collect()
        };
        let same = vec![[3.0, -1.0, 2.0]; 1000];
        for (target, points) in [
            (cloud(1), cloud(1)),
            (cloud(2000), cloud(700)),
            (same.clone(), cloud(40)),
            (cloud(40), same),
        ] {
            let threads = rayon::ThreadPoolBuilder::new().num_threads(2).build();
            let threads = Arc::new(threads.expect("threads"));
            let isa = Isa::available()[0];
            let brute_force = BruteForce::new(isa, Arc::clone(&threads), &target);
            let trees = KdTrees::new(threads, &target);
            let found = |search: &dyn NearestSearcher| {
                let into = search.in_target(&points, &Uncontrolled);
                let of = search.of_target(&points, &Uncontrolled);
                (into.expect("no interrupt"), of.expect("no interrupt"))
            };
            let (all, tree) = (found(&brute_force), found(&trees));
            let near = |from: &[Point], to: &[Point], a: &[u32], b: &[u32]| {
                for (&from, (&a, &b)) in from.iter().zip(a.iter().zip(b)) {
                    let [a, b] = [a, b].map(|index| squared(from, to[index as usize]));
                    assert!((a - b).abs() <= TOLERANCE * a, "{a} {b}");
                }
            };
            near(&points, &target, &all.0, &tree.0);
            near(&target, &points, &all.1, &tree.1);
        }
    }
}
