//! Tests of the transforms: against brute force in double precision, and properties of any scene.

use proptest::prelude::*;

use super::*;
use crate::flow::data::Point;
use crate::flow::data::Random;
use crate::flow::data::Uncontrolled;
use crate::flow::field::reference;

/// Rounding error of single-precision sums of a few terms of at most 100 m.
const SINGLE: f64 = 1e-4;
/// Rounding error of single-precision values of at most 20 m, divided by a cell of 0.1 m.
const SLOPE: f64 = 1e-3;
/// Fine cells between the far field's vertices, on grids as small as these.
const PITCH: f64 = 8.0;
/// Half the diagonal of a coarse cell, cells. Distance changes by no more than the position does.
const HALF: f64 = PITCH * 0.866_026;
/// Largest underestimate of the far field, cells. Its vertices never underestimate, and
/// interpolation averages over corners up to half a diagonal away.
const FAR_BELOW: f64 = HALF;
/// Largest overestimate of the far field, cells. In addition to the interpolation, the vertex found
/// as the nearest and the true nearest one were each rounded by up to half a diagonal.
const FAR_ABOVE: f64 = 3.0 * HALF;
/// Rasterizing moves a point by at most half a cell along each axis; the norm of that, cells.
const RASTER: f64 = 0.866_026;
/// Number of random positions of a check.
const PLACES: usize = 2000;

fn options(cell_m: f64, band_cells: f64, sites: Sites) -> DistanceOptions {
    DistanceOptions {
        sites,
        cell_m,
        band_m: band_cells * cell_m,
        ..DistanceOptions::default()
    }
}

fn bricks(source: &[Point], target: &[Point], options: &DistanceOptions) -> Bricks {
    Bricks::build(source, target, options, &Uncontrolled).expect("small scenes fit")
}

/// `count` random points of the box between `low` and `high`, metres.
fn boxed(seed: u64, count: usize, low: [f64; 3], high: [f64; 3]) -> Vec<Point> {
    let mut random = Random::new(seed);
    let mut point = || core::array::from_fn(|a| random.uniform(low[a], high[a]) as f32);
    (0..count).map(|_| point()).collect()
}

/// Small scenes for cells of 1 m: names, sources and targets.
fn scenes() -> Vec<(&'static str, Vec<Point>, Vec<Point>)> {
    let corners = |low: [f32; 3], high: [f32; 3]| vec![low, high];
    let at = |d: [f32; 3], points: Vec<Point>| -> Vec<Point> {
        let moved = points.iter().map(|p| [0, 1, 2].map(|a| p[a] + d[a]));
        moved.collect()
    };
    let wall = boxed(1, 60, [5.0, -9.0, -4.0], [5.0, 9.0, 4.0]);
    let ground = boxed(2, 60, [-15.0, -15.0, -1.0], [15.0, 15.0, -1.0]);
    let scattered = boxed(3, 25, [-20.0, -12.0, -8.0], [20.0, 12.0, 8.0]);
    let column = vec![[0.0, 0.0, -60.0], [0.3, 0.0, 0.0], [0.0, 0.4, 58.0]];
    // The grid's first vertex is one cell below: these points lie on both sides of brick and block
    // edges.
    let edges = [0.0, 5.0, 6.0, 7.0, 8.0, 61.0, 62.0, 63.0, 64.0];
    let edges = edges.map(|x: f32| [x, x / 4.0, x / 8.0]).to_vec();
    let box_m = || corners([-30.0, -17.0, -11.0], [25.0, 20.0, 13.0]);
    vec![
        ("wall", box_m(), wall),
        ("ground", box_m(), ground),
        ("scattered", vec![], scattered.clone()),
        ("one point", box_m(), vec![[0.25, -0.5, 0.5]]),
        ("one point alone", vec![], vec![[7.5, -0.5, 1e-3]]),
        (
            "one column",
            corners([-9.0, -9.0, -75.0], [9.0, 9.0, 75.0]),
            column,
        ),
        ("block borders", vec![], edges),
        (
            "negative",
            at([-137.3, -12.1, -45.7], box_m()),
            at([-137.3, -12.1, -45.7], scattered.clone()),
        ),
        (
            "far away",
            at([10_000.0, -10_000.0, 100.0], box_m()),
            at([10_000.0, -10_000.0, 100.0], scattered),
        ),
    ]
}

fn scaled(points: &[Point], scale: f64) -> Vec<Point> {
    let scale_point = |p: &Point| p.map(|c| (f64::from(c) * scale) as f32);
    points.iter().map(scale_point).collect()
}

fn every_vertex(grid: &Grid) -> impl Iterator<Item = [u32; 3]> {
    let [nx, ny, nz] = grid.vertices.map(|n| n as u32);
    (0..nx).flat_map(move |x| (0..ny).flat_map(move |y| (0..nz).map(move |z| [x, y, z])))
}

/// The target in cells from the grid's origin, and the vertices that it rasterizes to.
fn in_cells(grid: &Grid, target: &[Point]) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
    let cells = |p: &Point| [0, 1, 2].map(|a| (f64::from(p[a]) - grid.origin[a]) / grid.cell);
    let points: Vec<_> = target.iter().map(cells).collect();
    let rounded = points.iter().map(|p| p.map(f64::round_ties_even)).collect();
    (points, rounded)
}

/// Compares every vertex with brute force: exact within the band, and bounded beyond it.
fn check_every_vertex(name: &str, bricks: &Bricks, target: &[Point], band: f64, sites: Sites) {
    let grid = bricks.grid();
    let cell = grid.cell;
    let (points, vertices) = in_cells(grid, target);
    let (sites, moved) = match sites {
        Sites::Cells => (&vertices, 0.0),
        Sites::Points => (&points, RASTER),
    };
    // Half a code, and single-precision rounding, in cells.
    let tolerance = band / 65534.0 / 2.0 + 1e-6 * (band + 1.0);
    for vertex in every_vertex(grid) {
        let at = vertex.map(f64::from);
        let exact = reference::nearest_distance(at, sites);
        let value = f64::from(bricks.at_vertex(vertex)) / cell;
        let position = format!("{name}, band {band}, {vertex:?}: {value} for {exact}");
        if bricks.code(vertex) != fill::BEYOND {
            assert!(exact <= band + tolerance, "{position}");
            assert!((value - exact).abs() <= tolerance, "{position}");
        } else {
            // Bricks are active if an occupied vertex is within the band.
            let active = reference::nearest_distance(at, &vertices) <= band;
            assert!(!active || exact > band - tolerance, "{position}");
            assert!(value >= band - tolerance, "{position}");
            assert!(value >= exact - FAR_BELOW - moved, "{position}");
            assert!(value <= exact.max(band) + FAR_ABOVE + moved, "{position}");
        }
    }
}

fn check_scenes(sites: Sites) {
    for (name, source, target) in scenes() {
        for (cell, band) in [(1.0, 1.0), (0.1, 2.0), (0.25, 20.0), (1.0, 64.0)] {
            let (source, target) = (scaled(&source, cell), scaled(&target, cell));
            let bricks = bricks(&source, &target, &options(cell, band, sites));
            check_every_vertex(name, &bricks, &target, band, sites);
        }
    }
}

#[test]
fn distances_to_cells_are_those_of_brute_force() {
    check_scenes(Sites::Cells);
}

#[test]
fn distances_to_points_are_those_of_brute_force() {
    check_scenes(Sites::Points);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn random_scenes_are_those_of_brute_force(
        seed: u64,
        count in 1usize..40,
        size in prop::array::uniform3(0.0..40.0),
        offset in prop::array::uniform3(-300.0..300.0),
        cell in 0.05..2.0,
        band in 1u32..=64,
    ) {
        let low = [0, 1, 2].map(|a| offset[a] * cell);
        let high = [0, 1, 2].map(|a| (offset[a] + size[a]) * cell);
        let target = boxed(seed, count, low, high);
        for sites in [Sites::Cells, Sites::Points] {
            let bricks = bricks(&[], &target, &options(cell, f64::from(band), sites));
            check_every_vertex("random", &bricks, &target, f64::from(band), sites);
        }
    }
}

/// A scene that lies partly far beyond the band: its source and target.
fn street() -> (Vec<Point>, Vec<Point>) {
    let mut target = boxed(5, 300, [-4.0, -3.0, -1.5], [4.0, 3.0, -1.5]);
    target.extend(boxed(6, 300, [-4.0, 3.0, -1.5], [4.0, 3.0, 1.5]));
    (vec![[-20.0, -16.0, -4.0], [18.0, 14.0, 9.0]], target)
}

#[test]
fn a_query_is_the_trilinear_value_of_the_vertices() {
    // Slopes are at most 14 at the edge of the band; a fraction in single precision resolves 1e-7.
    const TOLERANCE: f64 = 1e-4;
    let (source, target) = street();
    for sites in [Sites::Cells, Sites::Points] {
        let bricks = bricks(&source, &target, &options(0.1, 20.0, sites));
        let grid = bricks.grid();
        let (points, vertices) = in_cells(grid, &target);
        let sites = if sites == Sites::Cells {
            vertices
        } else {
            points
        };
        let near = boxed(7, PLACES, [-5.0, -4.0, -3.0], [5.0, 4.0, 3.0]);
        let far = boxed(8, PLACES, [-19.9, -15.9, -3.9], [17.9, 13.9, 8.9]);
        for position in near.into_iter().chain(far) {
            let at = grid.in_cells(position);
            let stored = |v: [u32; 3]| f64::from(bricks.at_vertex(v));
            let (value, gradient) = reference::trilinear(at, stored);
            let sample = bricks.sample(position);
            assert!(
                (f64::from(sample.distance) - value).abs() < TOLERANCE,
                "{position:?}"
            );
            for (slope, exact) in sample.gradient.into_iter().zip(gradient) {
                let error = (f64::from(slope) - exact / grid.cell).abs();
                assert!(error < SLOPE, "{position:?}");
            }
            if value < 1.7 {
                let oracle = |v: [u32; 3]| reference::nearest_distance(v.map(f64::from), &sites);
                let exact = reference::trilinear(at, oracle).0 * grid.cell;
                assert!((value - exact).abs() < TOLERANCE, "{position:?}");
            }
        }
    }
}

#[test]
fn the_gradient_is_the_finite_difference_of_the_value() {
    // Values of up to 20 m resolve 2e-6 m, and a central difference spans 1e-2 m.
    const TOLERANCE: f64 = 2e-3;
    const STEP: f32 = 5e-3;
    let (source, target) = street();
    let bricks = bricks(&source, &target, &options(0.1, 20.0, Sites::Cells));
    let mut checked = 0;
    for position in boxed(9, PLACES, [-9.0, -8.0, -3.5], [9.0, 8.0, 5.0]) {
        let inside = |c: f64| (0.1..0.9).contains(&(c - c.floor()));
        if !bricks.grid().in_cells(position).into_iter().all(inside) {
            continue;
        }
        checked += 1;
        let gradient = bricks.sample(position).gradient;
        for axis in 0..3 {
            let (mut ahead, mut behind) = (position, position);
            ahead[axis] += STEP;
            behind[axis] -= STEP;
            let rise = bricks.sample(ahead).distance - bricks.sample(behind).distance;
            let slope = f64::from(rise) / f64::from(ahead[axis] - behind[axis]);
            let error = (slope - f64::from(gradient[axis])).abs();
            assert!(error < TOLERANCE, "{position:?}: {slope} {gradient:?}");
        }
    }
    assert!(checked > PLACES / 4);
}

#[test]
fn grids_too_large_for_the_finest_far_field_take_a_coarser_one() {
    // 8,000 x 8,000 x 800 cells: with vertices every 16th cell there would be 12 M.
    const COARSER: f64 = 32.0 / PITCH;
    let (low, high) = ([-400.0, -400.0, -40.0], [400.0, 400.0, 40.0]);
    let target = boxed(15, 300, low, high);
    let source = [low, high].map(|corner| corner.map(|c| c as f32));
    let bricks = bricks(&source, &target, &options(0.1, 20.0, Sites::Cells));
    let (_, vertices) = in_cells(bricks.grid(), &target);
    for position in boxed(16, PLACES, low, high) {
        let at = bricks.grid().in_cells(position);
        let exact = reference::nearest_distance(at, &vertices);
        let value = f64::from(bricks.sample(position).distance) / bricks.grid().cell;
        assert!(value >= exact - FAR_BELOW * COARSER, "{value} for {exact}");
        assert!(
            value <= exact.max(20.0) + FAR_ABOVE * COARSER,
            "{value} for {exact}"
        );
    }
}

#[test]
fn distance_has_no_jump_from_near_to_far_and_out_of_the_grid() {
    const STEP_M: f64 = 1e-3;
    // Neighboring vertices differ by a cell and the far field's error. The slope along a line is at
    // most that of three axes.
    let jump = STEP_M * (1.0 + FAR_ABOVE) * 1.733 + SINGLE;
    let (source, target) = street();
    let mut random = Random::new(10);
    for sites in [Sites::Cells, Sites::Points] {
        let bricks = bricks(&source, &target, &options(0.1, 20.0, sites));
        for _ in 0..10 {
            let direction: [f64; 3] = core::array::from_fn(|_| random.normal());
            let length = direction.iter().map(|d| d * d).sum::<f64>().sqrt();
            let at = |step: i32| {
                let reach = f64::from(step) * STEP_M / length;
                let point = [0, 1, 2].map(|a| (direction[a] * reach) as f32);
                f64::from(bricks.sample(point).distance)
            };
            for step in 0..25_000 {
                let change = (at(step + 1) - at(step)).abs();
                assert!(change <= jump, "{direction:?} step {step}: {change}");
            }
        }
    }
}

#[test]
fn outside_the_grid_the_border_goes_on_and_pulls_only_along_it() {
    let (source, target) = street();
    let chamfer = DistanceOptions {
        metric: Metric::Chamfer,
        ..options(0.2, 10.0, Sites::Cells)
    };
    for options in [options(0.2, 10.0, Sites::Cells), chamfer] {
        let transform =
            DistanceTransform::build(&source, &target, &options, &Uncontrolled).unwrap();
        let on_border = [1.0, 2.0, 9.4];
        let outside = [1.0, 2.0, 5e4];
        let (border, sample) = (transform.sample(on_border), transform.sample(outside));
        assert!((border.distance - sample.distance).abs() < 0.05);
        assert_eq!(sample.gradient[2], 0.0);
        assert!(
            sample.gradient[1].abs() > 0.05 && border.gradient[2] > 0.1,
            "{border:?} {sample:?}"
        );
        let corner = transform.sample([-1e6, f32::INFINITY, f32::MIN]);
        assert!(corner.distance.is_finite());
        assert_eq!(corner.gradient, [0.0; 3]);
    }
}

#[test]
fn a_point_thirty_metres_away_is_pulled_home() {
    const STEP_M: f32 = 0.1;
    let target = boxed(11, 200, [-2.0, -2.0, -1.0], [2.0, 2.0, 1.0]);
    let source = [[-35.0; 3], [35.0; 3]];
    let bricks = bricks(&source, &target, &options(0.1, 20.0, Sites::Cells));
    for start in boxed(12, 50, [-1.0; 3], [1.0; 3]) {
        let length = start.iter().map(|c| c * c).sum::<f32>().sqrt();
        let mut point = start.map(|c| c / length * 30.0);
        // Gradients of the coarse field are off by a few per cent.
        for _ in 0..400 {
            let gradient = bricks.sample(point).gradient;
            let slope = gradient.iter().map(|g| g * g).sum::<f32>().sqrt();
            point = core::array::from_fn(|a| point[a] - STEP_M * gradient[a] / slope.max(1e-6));
        }
        assert!(
            bricks.sample(point).distance < 2.0,
            "{start:?} ends at {point:?}"
        );
    }
}

/// The root of `1 + (sqrt 2 - 1)^2 + (sqrt 3 - sqrt 2)^2`, rounded up: the largest ratio of a
/// chamfer path to the straight line.
const LONGEST: f64 = 1.1281;

#[test]
fn chamfer_distances_are_the_closed_form() {
    for (name, source, target) in scenes() {
        let options = DistanceOptions {
            metric: Metric::Chamfer,
            ..options(1.0, 1.0, Sites::Cells)
        };
        let dense = DenseChamfer::build(&source, &target, &options, &Uncontrolled).unwrap();
        let (_, vertices) = in_cells(dense.grid(), &target);
        for vertex in every_vertex(dense.grid()) {
            let at = vertex.map(f64::from);
            let value = f64::from(dense.at(vertex));
            let exact = reference::nearest_chamfer(at, &vertices);
            assert!(
                (value - exact).abs() < SINGLE,
                "{name}, {vertex:?}: {value} for {exact}"
            );
            let euclid = reference::nearest_distance(at, &vertices);
            assert!(
                value >= euclid - SINGLE && value <= euclid * LONGEST + SINGLE,
                "{name}"
            );
        }
    }
}

#[test]
fn a_chamfer_query_is_the_trilinear_value_of_the_vertices() {
    let (source, target) = street();
    let options = DistanceOptions {
        metric: Metric::Chamfer,
        ..options(0.2, 10.0, Sites::Cells)
    };
    let dense = DenseChamfer::build(&source, &target, &options, &Uncontrolled).unwrap();
    for position in boxed(13, PLACES, [-19.9, -15.9, -3.9], [17.9, 13.9, 8.9]) {
        let at = dense.grid().in_cells(position);
        let (value, gradient) = reference::trilinear(at, |v| f64::from(dense.at(v)));
        let sample = dense.sample(position);
        assert!((f64::from(sample.distance) - value).abs() < SINGLE);
        for (slope, exact) in sample.gradient.into_iter().zip(gradient) {
            assert!(
                (f64::from(slope) - exact / 0.2).abs() < SLOPE,
                "{position:?}"
            );
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let (source, target) = street();
    for sites in [Sites::Cells, Sites::Points] {
        let values = |threads: usize| -> Vec<u32> {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let options = options(0.1, 20.0, sites);
            let bricks = pool.unwrap().install(|| bricks(&source, &target, &options));
            let positions = every_vertex(bricks.grid()).step_by(7);
            positions.map(|v| bricks.at_vertex(v).to_bits()).collect()
        };
        let one = values(1);
        assert!(one == values(2) && one == values(5));
    }
}

#[test]
fn the_order_of_the_points_changes_no_bit() {
    let (source, mut target) = street();
    for sites in [Sites::Cells, Sites::Points] {
        let options = options(0.1, 20.0, sites);
        let first = bricks(&source, &target, &options);
        target.reverse();
        let second = bricks(&source, &target, &options);
        let same = |v| first.at_vertex(v).to_bits() == second.at_vertex(v).to_bits();
        assert!(every_vertex(first.grid()).step_by(7).all(same));
    }
}

#[test]
fn what_is_not_a_number_neither_hangs_nor_panics() {
    let (mut source, mut target) = street();
    for (i, point) in target.iter_mut().enumerate() {
        if i % 3 == 0 {
            point[i % 9 / 3] = f32::NAN;
        }
    }
    source.push([f32::NAN, 0.0, f32::NAN]);
    for sites in [Sites::Cells, Sites::Points] {
        let bricks = bricks(&source, &target, &options(0.1, 20.0, sites));
        let sample = bricks.sample([f32::NAN, 1.0, 2.0]);
        assert_eq!(sample.gradient.len(), 3);
    }
}
