//! Height field: nodes on a square grid, bilinear between them.
//!
//! The height field is pulled toward samples and stays smooth where there are none. The correction
//! solves a screened Poisson equation by Gauss-Seidel relaxation.

use crate::flow::data::Point;

/// Weight of each of a node's four neighbors in its correction, relative to a full pull of 1.
const STIFFNESS: f32 = 0.3;
/// Gauss-Seidel iterations per correction. Coarser levels spread corrections over long distances;
/// these iterations spread them over the next few nodes.
const ROUNDS: usize = 6;

/// Heights over a square area centered on the origin.
pub(super) struct HeightField {
    half_m: f32,
    /// Distance between nodes, metres.
    step_m: f32,
    /// Nodes per metre.
    nodes_per_m: f32,
    /// Nodes along a side, at least 2.
    side: usize,
    /// Heights, metres, row by row; a row runs along x.
    heights: Vec<f32>,
}

impl HeightField {
    /// A level surface over |x|, |y| <= `half_m` metres. `half_m` is a multiple of `step_m`, and
    /// `step_m` is a power of two.
    pub(super) fn level(half_m: f32, step_m: f32, height_m: f32) -> Self {
        let side = (2.0 * half_m / step_m) as usize + 1;
        Self {
            half_m,
            step_m,
            nodes_per_m: 1.0 / step_m,
            side,
            heights: vec![height_m; side * side],
        }
    }

    /// The same surface with half the distance between nodes.
    pub(super) fn refined(&self) -> Self {
        let mut fine = Self::level(self.half_m, self.step_m / 2.0, 0.0);
        debug_assert_eq!(fine.side, 2 * self.side - 1);
        let middle = |a: f32, b: f32| 0.5 * a + 0.5 * b;
        let (coarse_side, side) = (self.side, fine.side);
        let rows = fine.heights.chunks_exact_mut(side).step_by(2);
        for (row, coarse) in rows.zip(self.heights.chunks_exact(coarse_side)) {
            for (node, &height) in row.iter_mut().step_by(2).zip(coarse) {
                *node = height;
            }
            for (node, ends) in row.iter_mut().skip(1).step_by(2).zip(coarse.windows(2)) {
                *node = middle(ends[0], ends[1]);
            }
        }
        for row in (1..side).step_by(2) {
            let (before, rest) = fine.heights.split_at_mut(row * side);
            let (nodes, after) = rest.split_at_mut(side);
            let around = before[(row - 1) * side..].iter().zip(after.iter());
            for (node, (&above, &below)) in nodes.iter_mut().zip(around) {
                *node = middle(above, below);
            }
        }
        fine
    }

    /// Distance between nodes, metres.
    pub(super) fn step_m(&self) -> f32 {
        self.step_m
    }

    /// Height at (x, y), metres; outside the area, the height at the nearest border point.
    #[inline]
    pub(super) fn height_at(&self, x: f32, y: f32) -> f32 {
        let [u, v] = self.position(x, y);
        let before = |position: f32| (position as u32 as usize).min(self.side - 2);
        let (column, row) = (before(u), before(v));
        let [along, across] = [u - column as f32, v - row as f32];
        let node = row * self.side + column;
        let between =
            |node: usize| self.heights[node] * (1.0 - along) + self.heights[node + 1] * along;
        between(node) * (1.0 - across) + between(node + self.side) * across
    }

    /// Height of a point above the surface, metres.
    #[inline]
    pub(super) fn above(&self, point: &Point) -> f32 {
        point[2] - self.height_at(point[0], point[1])
    }

    /// Moves the surface toward weighted samples, metres. `trust` maps a sample's height above the
    /// surface to a factor on its weight, 0 or more. Samples of a total weight of `full` or more
    /// pull a node fully.
    pub(super) fn pull<'a>(
        &mut self,
        samples: impl Iterator<Item = (&'a Point, f32)>,
        trust: impl Fn(f32) -> f32,
        full: f32,
    ) {
        // Per node: the sum of weights, and the weighted sum of heights above the surface.
        let mut pulls = vec![[0.0_f32; 2]; self.heights.len()];
        for (point, weight) in samples {
            let above = self.above(point);
            let weight = weight * trust(above);
            if weight > 0.0 {
                let pull = &mut pulls[self.nearest(point)];
                pull[0] += weight;
                pull[1] += weight * above;
            }
        }
        for pull in &mut pulls {
            let [weight, sum] = *pull;
            if weight > 0.0 {
                let share = (weight / full).min(1.0);
                *pull = [share, share * sum / weight];
            }
        }
        for (height, correction) in self.heights.iter_mut().zip(relaxed(&pulls, self.side)) {
            *height += correction;
        }
    }

    fn nearest(&self, point: &Point) -> usize {
        let [u, v] = self.position(point[0], point[1]);
        let rounded = |position: f32| {
            let whole = position as u32;
            whole as usize + usize::from(position - whole as f32 >= 0.5)
        };
        rounded(v) * self.side + rounded(u)
    }

    /// Position in node distances from the first node along x and y, clamped to the area. It is never
    /// negative, and a conversion to 32 bits takes one instruction.
    fn position(&self, x: f32, y: f32) -> [f32; 2] {
        let last = (self.side - 1) as f32;
        let position = |c: f32| ((c + self.half_m) * self.nodes_per_m).clamp(0.0, last);
        [position(x), position(y)]
    }
}

/// Corrections that approximately balance the pulls against smoothness.
fn relaxed(pulls: &[[f32; 2]], side: usize) -> Vec<f32> {
    // Mirror boundary: a border of padding nodes that copy the nearest node.
    let padded = side + 2;
    let mut corrections = vec![0.0_f32; padded * padded];
    // The factor of the four neighbors' sum, and what is added to it.
    let factors: Vec<[f32; 2]> = pulls
        .iter()
        .map(|[weight, pull]| [STIFFNESS, *pull].map(|value| value / (weight + 4.0 * STIFFNESS)))
        .collect();
    let mut known = vec![0.0_f32; side];
    for _ in 0..ROUNDS {
        for row in 0..side {
            let first = (row + 1) * padded + 1;
            let factors = &factors[row * side..(row + 1) * side];
            // All but the neighbor before is known, and the sums do not wait for each other.
            let above = &corrections[first - padded..first - padded + side];
            let below = &corrections[first + padded..first + padded + side];
            let after = &corrections[first + 1..first + 1 + side];
            for (column, known) in known.iter_mut().enumerate() {
                let around = after[column] + above[column] + below[column];
                let [factor, pull] = factors[column];
                *known = pull + factor * around;
            }
            let mut before = corrections[first - 1];
            let nodes = corrections[first..first + side].iter_mut();
            for ((node, known), [factor, _]) in nodes.zip(&known).zip(factors) {
                before = known + factor * before;
                *node = before;
            }
            corrections[first - 1] = corrections[first];
            corrections[first + side] = corrections[first + side - 1];
        }
        let rows = padded * padded - padded;
        corrections.copy_within(padded..2 * padded, 0);
        corrections.copy_within(rows - padded..rows, rows);
    }
    let inner = |row: usize| (row + 1) * padded + 1..(row + 1) * padded + 1 + side;
    (0..side)
        .flat_map(|row| corrections[inner(row)].iter().copied())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: fn(f32) -> f32 = |_| 1.0;

    #[test]
    fn a_refined_surface_has_the_same_heights() {
        let mut surface = HeightField::level(32.0, 16.0, -1.0);
        for (node, height) in surface.heights.iter_mut().enumerate() {
            *height = (node * 7 % 5) as f32;
        }
        let fine = surface.refined().refined();
        for (x, y) in [(0.0, 0.0), (-31.0, 3.5), (13.2, 29.9), (32.0, -32.0)] {
            assert!((fine.height_at(x, y) - surface.height_at(x, y)).abs() < 1e-5);
        }
        let fine = surface.refined();
        for (node, &height) in fine.heights.iter().enumerate() {
            let [x, y] = [node % fine.side, node / fine.side].map(|n| n as f32 * 8.0 - 32.0);
            assert_eq!(height, surface.height_at(x, y));
        }
    }

    #[test]
    fn outside_the_area_the_height_is_the_borders() {
        let surface = HeightField::level(32.0, 8.0, 0.7);
        assert_eq!(surface.height_at(1e9, -40.0), 0.7);
        assert_eq!(surface.above(&[0.0, 900.0, 1.7]), 1.0);
    }

    #[test]
    fn samples_everywhere_are_met_and_holes_are_filled_from_around() {
        let plane = |x: f32, y: f32| 0.05 * x - 0.02 * y + 1.0;
        let grid = || (-32..=32).flat_map(|x| (-32..=32).map(move |y| (x as f32, y as f32)));
        let samples: Vec<Point> = grid()
            .filter(|(x, y)| x.hypot(*y) > 3.0)
            .map(|(x, y)| [x, y, plane(x, y)])
            .collect();
        let mut surface = HeightField::level(32.0, 4.0, 0.0);
        for _ in 0..20 {
            surface.pull(samples.iter().map(|point| (point, 1.0)), ALL, 8.0);
        }
        for (x, y) in [(0.0, 0.0), (10.0, -20.0), (-17.0, 4.0)] {
            let error = surface.height_at(x, y) - plane(x, y);
            assert!(error.abs() < 0.03, "{error} at {x}, {y}");
        }
    }

    #[test]
    fn samples_without_trust_pull_nothing() {
        let mut surface = HeightField::level(32.0, 32.0, 0.0);
        let samples = [[0.0, 0.0, 5.0]];
        surface.pull(samples.iter().map(|point| (point, 1.0)), |_| 0.0, 1.0);
        assert!(surface.heights.iter().all(|&height| height == 0.0));
    }
}
