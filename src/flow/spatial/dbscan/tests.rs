//! Tests of the clustering against its definition, and of its time on hostile clouds.

use super::*;
use crate::flow::data::Random;

/// DBSCAN by its definition: the core flags, and the labels of the core points. All other
/// points are labelled noise.
fn by_definition(points: &[Point], radius_m: f32, least: usize) -> (Vec<bool>, Vec<u32>) {
    let near = |a: usize, b: usize| square_distance(points[a], points[b]) <= radius_m * radius_m;
    let count = |a: usize| (0..points.len()).filter(|&b| near(a, b)).count();
    let core: Vec<bool> = (0..points.len()).map(|a| count(a) >= least).collect();
    let mut labels = vec![NOISE; points.len()];
    let mut clusters = 0;
    for seed in 0..points.len() {
        if !core[seed] || labels[seed] != NOISE {
            continue;
        }
        let mut open = vec![seed];
        labels[seed] = clusters;
        while let Some(a) = open.pop() {
            for b in 0..points.len() {
                if core[b] && labels[b] == NOISE && near(a, b) {
                    labels[b] = clusters;
                    open.push(b);
                }
            }
        }
        clusters += 1;
    }
    (core, labels)
}

#[test]
fn cores_are_clustered_as_defined_and_others_join_a_core_within_the_radius() {
    for (seed, side) in [(1, 3.0), (2, 5.0), (3, 8.0)] {
        let mut random = Random::new(seed);
        let mut point = || [0; 3].map(|_| random.uniform(0.0, side) as f32);
        let points: Vec<Point> = (0..400).map(|_| point()).collect();
        let (core, expected) = by_definition(&points, 0.5, 4);
        let found = clusters(&points, 0.5, 4);
        let cores: Vec<usize> = (0..points.len()).filter(|&i| core[i]).collect();
        for &a in &cores {
            for &b in &cores {
                assert_eq!(found[a] == found[b], expected[a] == expected[b]);
            }
        }
        for i in (0..points.len()).filter(|&i| !core[i]) {
            let beside = cores
                .iter()
                .filter(|&&c| square_distance(points[i], points[c]) <= 0.25);
            let beside: Vec<u32> = beside.map(|&c| found[c]).collect();
            assert_eq!(found[i] == NOISE, beside.is_empty(), "{i}");
            assert!(found[i] == NOISE || beside.contains(&found[i]), "{i}");
        }
    }
}

#[test]
fn a_pole_of_many_cells_and_points_out_of_reach_take_no_longer_than_others() {
    // A column of 200,000 cells: scanning the column for each of them would take 4e10 steps.
    let mut points: Vec<Point> = (0..200_000).map(|i| [1.0, 2.0, i as f32 * 0.3]).collect();
    // Also 200,000 points out of range, which all belong to the outermost cell if clamped.
    points.extend((0..200_000).map(|i| [9e5, 9e5, i as f32 * 0.5]));
    let found = clusters(&points, 0.5, 2);
    assert!(found[..200_000].iter().all(|&label| label == 0));
    assert!(found[200_000..].iter().all(|&label| label == NOISE));
}

#[test]
fn clusters_are_numbered_in_the_order_of_their_first_point() {
    let mut points = vec![[9.0, 0.0, 0.0]];
    points.extend(vec![[5.0, 0.0, 0.0]; 4]);
    points.extend(vec![[-5.0, 0.0, 0.0]; 4]);
    let expected = [NOISE, 0, 0, 0, 0, 1, 1, 1, 1];
    assert_eq!(clusters(&points, 0.5, 4), expected);
    assert_eq!(clusters(&[], 0.5, 4), [0; 0]);
}

#[test]
fn full_cells_that_do_not_touch_are_told_apart_in_time() {
    // Comparing all pairs of core points of neighboring full cells would take billions of
    // distances.
    let mut random = Random::new(5);
    let mut clump = |x: f64| -> Vec<Point> {
        let mut side = || random.uniform(0.0, 0.25) as f32;
        let clump = (0..40_000).map(|_| [side() + x as f32, side(), side()]);
        clump.collect()
    };
    let points = [clump(0.0), clump(0.8)].concat();
    let labels = clusters(&points, 0.5, 4);
    assert!(labels[..40_000].iter().all(|&label| label == 0));
    assert!(labels[40_000..].iter().all(|&label| label == 1));
}

#[test]
fn many_points_in_one_place_are_one_cluster() {
    let points = vec![[1.0, 2.0, 3.0]; 130_000];
    assert!(clusters(&points, 0.5, 4).iter().all(|&label| label == 0));
}
