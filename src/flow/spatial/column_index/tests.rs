//! Tests of the column index against searches of all points, on every instruction set.

use super::*;
use crate::flow::data::{Random, square_distance};

/// A random cloud in a cube, and random positions in it.
fn scattered(points: usize, positions: usize, half_m: f64) -> (Vec<Point>, Vec<Point>) {
    let mut random = Random::new(2);
    let mut point = || [0; 3].map(|_| random.uniform(-half_m, half_m) as f32);
    let cloud = (0..points).map(|_| point()).collect();
    (cloud, (0..positions).map(|_| point()).collect())
}

fn on_all_sets(cloud: &[Point], column_m: f32) -> impl Iterator<Item = ColumnIndex> {
    let sets = Isa::available().into_iter();
    sets.map(move |isa| ColumnIndex::with(isa, cloud, column_m))
}

/// The squared distances and the rows of the points that are less than `within_m` from `center`,
/// the nearest first.
fn by_definition(cloud: &[Point], center: Point, within_m: f32) -> Vec<(f32, u32)> {
    let all = cloud.iter().zip(0..);
    let all = all.map(|(&point, row)| (square_distance(center, point), row));
    let mut near: Vec<(f32, u32)> = all
        .filter(|&(square, _)| square < within_m * within_m)
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near
}

#[test]
fn the_nearest_point_is_the_one_that_a_search_of_all_finds() {
    let (cloud, positions) = scattered(700, 500, 3.0);
    for (column_m, within_m) in [(0.7, 0.7), (0.35, 0.7), (2.0, 0.7), (0.5, 0.2)] {
        for index in on_all_sets(&cloud, column_m) {
            for &center in &positions {
                let expected = by_definition(&cloud, center, within_m);
                let found = index.nearest(center, within_m);
                let first = expected.first().map(|&(square, row)| (row, square));
                assert_eq!(found, first, "{index:?}");
            }
        }
    }
}

#[test]
fn the_nearest_point_of_a_label_is_the_one_that_a_search_of_all_finds() {
    let (cloud, positions) = scattered(700, 300, 3.0);
    let of_row = |row: u32| match row % 4 {
        3 => u32::MAX,
        label => label,
    };
    let labels: Vec<u32> = (0..700).map(of_row).collect();
    for index in on_all_sets(&cloud, 0.35) {
        let of_slots = index.labels(&labels);
        for &center in &positions {
            for wanted in [0, 2, 7, u32::MAX] {
                let expected = by_definition(&cloud, center, 0.7);
                let is_wanted =
                    |&&(_, row): &&(f32, u32)| wanted != u32::MAX && of_row(row) == wanted;
                let expected = expected.iter().find(is_wanted);
                let found = index.nearest_labelled(center, 0.7, &of_slots, wanted);
                let found = found.map(|(slot, square)| (square, index.rows()[slot]));
                assert_eq!(found, expected.copied());
                if let Some((slot, _)) = index.nearest_slot(center, 0.7) {
                    let label = of_row(index.rows()[slot]);
                    assert_eq!(
                        of_slots.is(slot as u32, wanted),
                        label == wanted && wanted < 4
                    );
                }
            }
        }
    }
}

#[test]
fn on_a_lattice_far_out_nothing_near_is_left_out_and_all_sets_find_the_same_of_equals() {
    // Column borders pass through the points, and single precision resolves a quarter of a
    // millimetre.
    let lattice = |i: u16| {
        let [x, y, z] = [i % 12, i / 12 % 12, i / 144].map(f32::from);
        [4000.0 + x * 0.25, -4000.0 + y * 0.25, z * 0.25]
    };
    let cloud: Vec<Point> = (0..720).map(lattice).collect();
    let sets: Vec<ColumnIndex> = on_all_sets(&cloud, 0.5).collect();
    let mut random = Random::new(5);
    for _ in 0..500 {
        let mut side = |low: f64, high: f64| (random.uniform(low, high) * 8.0).round() / 8.0;
        let center = [
            side(3999.5, 4003.5),
            side(-4000.5, -3996.5),
            side(-0.5, 1.5),
        ];
        let center = center.map(|c| c as f32);
        for within_m in [0.2, 0.5, 0.9_f32] {
            let expected = by_definition(&cloud, center, within_m);
            let mut rows: Vec<u32> = expected.iter().map(|&(_, row)| row).collect();
            rows.sort_unstable();
            let first = sets[0].nearest(center, within_m);
            for index in &sets {
                let mut within = Vec::new();
                index.within(center, within_m, |row| within.push(row));
                within.sort_unstable();
                assert_eq!(within, rows);
                assert_eq!(index.nearest(center, within_m), first);
            }
            assert_eq!(
                first.map(|(_, square)| square),
                expected.first().map(|&(square, _)| square)
            );
        }
    }
}

#[test]
fn what_lies_near_several_places_is_found_once_and_nothing_of_it_is_left_out() {
    let (cloud, places) = scattered(3000, 20, 3.0);
    // Some follow others that lie near them.
    let beside = |&[x, y, z]: &Point| [[x, y, z], [x + 0.4, y, z], [x, y - 0.9, z + 0.2]];
    let places: Vec<Point> = places.iter().flat_map(beside).collect();
    for index in on_all_sets(&cloud, 0.35) {
        let slots = index.slots_near(&places, 0.7);
        assert!(slots.is_sorted());
        let rows = slots.iter().map(|&slot| index.rows()[slot as usize]);
        let mut rows: Vec<u32> = rows.collect();
        rows.sort_unstable();
        let is_near = |point: &Point| places.iter().any(|&p| square_distance(p, *point) < 0.49);
        let expected = cloud.iter().zip(0..).filter(|(point, _)| is_near(point));
        let expected: Vec<u32> = expected.map(|(_, row)| row).collect();
        assert!(expected.len() > 500);
        assert_eq!(rows, expected);
    }
}

#[test]
fn a_square_holds_what_a_search_of_all_finds_in_it() {
    let (cloud, positions) = scattered(700, 1, 3.0);
    let center = positions[0];
    let inside = |other: &Point, half_m: f32| {
        (0..2).all(|a| (other[a] - center[a]).abs() <= half_m) && (other[2] - center[2]).abs() < 0.5
    };
    for index in on_all_sets(&cloud, 0.4) {
        let mut seen = 0;
        index.within_square(center, 1.5, 0.5, |other| {
            assert!(inside(&other, 1.5 + 0.4), "{other:?}");
            seen += usize::from(inside(&other, 1.5));
        });
        let expected = cloud.iter().filter(|other| inside(other, 1.5)).count();
        assert_eq!(seen, expected);
    }
}

#[test]
fn points_are_sorted_and_given_back_in_their_order() {
    let (cloud, _) = scattered(300, 0, 30.0);
    let index = ColumnIndex::new(&cloud, 0.5);
    assert_eq!(index.in_order(), cloud);
    let mut sorted = cloud.clone();
    let of_sorted = ColumnIndex::sorted(&mut sorted, 0.5);
    let expected: Vec<Point> = index
        .rows()
        .iter()
        .map(|&row| cloud[row as usize])
        .collect();
    assert_eq!(sorted, expected);
    assert!(of_sorted.rows().iter().copied().eq(0..300));
    assert_eq!(of_sorted.nearest(sorted[7], 0.1), Some((7, 0.0)));
}

#[test]
fn nothing_is_near_in_an_empty_cloud_and_far_from_every_point() {
    assert_eq!(ColumnIndex::new(&[], 0.5).nearest([0.0; 3], 0.5), None);
    let index = ColumnIndex::new(&[[1e30, -1e30, 0.0], [f32::NAN; 3], [f32::MAX; 3]], 0.5);
    assert_eq!(index.nearest([0.0; 3], 0.5), None);
    assert_eq!(index.nearest([f32::NAN; 3], 0.5), None);
    assert_eq!(index.nearest([f32::INFINITY, 0.0, 0.0], 0.5), None);
    assert_eq!(index.nearest([1e30, -1e30, 0.25], 0.5), Some((0, 0.0625)));
}

#[test]
fn the_sums_around_a_point_are_those_of_a_search_of_all_with_the_same_bits_on_all_sets() {
    let (cloud, positions) = scattered(900, 60, 2.0);
    let sets: Vec<ColumnIndex> = on_all_sets(&cloud, 0.35).collect();
    let sums = |index: &ColumnIndex, center: Point| {
        let found = Neighborhood::of(index.isa, &index.slots, center, 0.7);
        [&[found.count], &found.sum[..], &found.products].concat()
    };
    for &center in &positions {
        let mut expected = [0.0; 10];
        for (_, row) in by_definition(&cloud, center, 0.7) {
            let point = cloud[row as usize];
            let [x, y, z] = [0, 1, 2].map(|axis: usize| f64::from(center[axis] - point[axis]));
            let terms = [1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z];
            for (sum, term) in expected.iter_mut().zip(terms) {
                *sum += term;
            }
        }
        let first = sums(&sets[0], center);
        for (sum, expected) in first.iter().zip(expected) {
            assert!((sum - expected).abs() < 1e-12, "{sum}, not {expected}");
        }
        for index in &sets {
            assert_eq!(sums(index, center), first);
        }
    }
}
