//! The assignment of found objects to true ones with the largest sum of weights.

use std::collections::{BTreeMap, BTreeSet};

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;
use pathfinding::undirected::connected_components::separate_components;

/// Integer scale of the weights of an assignment.
const SCALE: f64 = 1e6;

/// Two objects that may be the same one: a true one and a found one.
#[derive(Clone, Copy)]
pub(super) struct Edge {
    /// Numbers of the true and of the found object.
    pub(super) ends: [usize; 2],
    /// What the assignment of one to the other is worth, more than zero.
    pub(super) weight: f64,
}

/// The assignment of the largest sum of weights: pairs of indices with a positive weight.
pub(super) fn assign<T>(
    rows: &[T],
    columns: &[T],
    weight: impl Fn(&T, &T) -> f64,
) -> Vec<(usize, usize)> {
    let mut edges = Vec::new();
    for (row, a) in rows.iter().enumerate() {
        for (column, b) in columns.iter().enumerate() {
            let ends = [row, column];
            let weight = weight(a, b);
            if weight > 0.0 {
                edges.push(Edge { ends, weight });
            }
        }
    }
    let assigned = assignment(&edges).into_iter();
    assigned.map(|edge| edge.ends.into()).collect()
}

/// The edges of the largest sum of weights that have no end in common, in the order of their ends.
///
/// Each connected component is assigned by itself: objects that are far apart cost nothing together.
pub(super) fn assignment(edges: &[Edge]) -> Vec<Edge> {
    let nodes: Vec<_> = edges
        .iter()
        .map(|edge| vec![(0, edge.ends[0]), (1, edge.ends[1])])
        .collect();
    let (_, component_of) = separate_components(&nodes);
    let mut components: BTreeMap<usize, Vec<Edge>> = BTreeMap::new();
    for (edge, component) in edges.iter().zip(component_of) {
        components.entry(component).or_default().push(*edge);
    }
    let mut assigned: Vec<Edge> = components
        .into_values()
        .flat_map(assign_component)
        .collect();
    assigned.sort_by_key(|edge| edge.ends);
    assigned
}

/// The assignment of one connected component, by the algorithm of Kuhn and Munkres.
fn assign_component(edges: Vec<Edge>) -> Vec<Edge> {
    if edges.len() == 1 {
        return edges;
    }
    let numbers = |end: usize| -> Vec<usize> {
        let all: BTreeSet<usize> = edges.iter().map(|edge| edge.ends[end]).collect();
        all.into_iter().collect()
    };
    let mut sides = [numbers(0), numbers(1)];
    // The algorithm takes no more rows than columns.
    let rows_are = usize::from(sides[0].len() > sides[1].len());
    sides.rotate_left(rows_are);
    let [rows, columns] = sides;
    let mut weights = Matrix::new(rows.len(), columns.len(), 0_i64);
    let mut edge_of = BTreeMap::new();
    for edge in edges {
        let [row, column] = [(&rows, rows_are), (&columns, 1 - rows_are)]
            .map(|(numbers, end)| numbers.partition_point(|&number| number < edge.ends[end]));
        weights[(row, column)] = (edge.weight * SCALE).round() as i64;
        edge_of.insert((row, column), edge);
    }
    let (_, assigned) = kuhn_munkres(&weights);
    let assigned = assigned.into_iter().enumerate();
    assigned
        .filter_map(|place| edge_of.remove(&place))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_assignment_is_the_best_one_of_all_that_are_possible() {
        // The largest sum over all assignments of four rows to three columns. A weight of zero
        // forbids a pair.
        fn best(weights: &[[f64; 3]; 4], row: usize, taken: [bool; 3]) -> f64 {
            if row == weights.len() {
                return 0.0;
            }
            let mut most = best(weights, row + 1, taken);
            for column in (0..3).filter(|&column| !taken[column] && weights[row][column] > 0.0) {
                let mut taken = taken;
                taken[column] = true;
                most = most.max(weights[row][column] + best(weights, row + 1, taken));
            }
            most
        }
        let mut state = 7_u32;
        let mut draw = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 16) / 65_536.0
        };
        for _ in 0..500 {
            let weights = [[(); 3]; 4].map(|row| row.map(|()| (draw() - 0.5).max(0.0)));
            let rows: Vec<usize> = (0..4).collect();
            let found = assign(&rows, &[0, 1, 2], |&row, &column| weights[row][column]);
            let sum: f64 = found
                .iter()
                .map(|&(row, column)| weights[row][column])
                .sum();
            let wanted = best(&weights, 0, [false; 3]);
            assert!((sum - wanted).abs() < 1e-5, "{weights:?}: {found:?}");
            let columns: BTreeSet<usize> = found.iter().map(|&(_, column)| column).collect();
            assert_eq!(columns.len(), found.len());
        }
    }
}
