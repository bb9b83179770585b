//! Exact distance to the nearest target point itself, instead of its nearest vertex.
//!
//! Rounding a point to its vertex moves it by up to 0.87 cells; this variant avoids that error. A
//! point can be nearest to a vertex of a cube only if its distance from the cube's center exceeds
//! that of the nearest point by at most the cube's diagonal. A brick is halved to cubes of 4 and of
//! 2 vertices along an edge, and each passes on only the points that can be nearest within it.

use core::ops::Range;

use super::brick_index::{EDGE, within};
use super::fill::{Gather, Rows, codes_per_cell};
use super::grid::Grid;
use crate::flow::data::Point;

/// Vertices along a brick's edge.
const SIDE: i32 = EDGE as i32;
/// Added to every bound, cells: more than the single-precision rounding error at 100 cells.
const SLACK: f32 = 1e-3;

/// The target's points, sorted by their nearest vertices.
#[derive(Debug)]
pub(super) struct PointSites {
    band: i32,
    rows: Rows,
    points: Vec<Site>,
}

/// A target point: its nearest vertex, and its offset from that vertex, cells.
#[derive(Debug, Clone, Copy)]
struct Site {
    vertex: [u32; 3],
    offset: [f32; 3],
}

impl PointSites {
    pub(super) fn new(grid: &Grid, target: &[Point], band: i32) -> Self {
        let site = |&point: &Point| {
            let vertex = grid.nearest_vertex(point);
            let at = grid.in_cells(point);
            let offset = core::array::from_fn(|a| (at[a] - f64::from(vertex[a])) as f32);
            Site { vertex, offset }
        };
        let mut points: Vec<_> = target.iter().map(site).collect();
        points.sort_unstable_by_key(|site| site.vertex);
        Self {
            band,
            rows: Rows::new(points.iter().map(|site| [site.vertex[0], site.vertex[1]])),
            points,
        }
    }

    /// An upper bound on the bytes of [`Self::new`] for `points` points.
    pub(super) fn bytes(points: usize) -> usize {
        points * (size_of::<Site>() + size_of::<i32>())
    }
}

/// One thread's working set.
pub(super) struct PointGather<'a> {
    sites: &'a PointSites,
    /// First vertex of the open strip along x.
    x: i32,
    /// The rows within the band of the strip, by x: the row's x, and the index of its first point
    /// in `strip`.
    rows: Vec<(i32, usize)>,
    strip: Points,
    /// The points that can be nearest within a brick, and within cubes of half and a quarter of its
    /// edge.
    brick: Points,
    half: Points,
    quarter: Points,
    /// Scratch buffer of [`Points::keep_close`].
    squares: Vec<f32>,
}

impl<'a> PointGather<'a> {
    pub(super) fn new(sites: &'a PointSites) -> Self {
        Self {
            sites,
            x: 0,
            rows: Vec::new(),
            strip: Points::default(),
            brick: Points::default(),
            half: Points::default(),
            quarter: Points::default(),
            squares: Vec::new(),
        }
    }
}

impl Gather for PointGather<'_> {
    fn open_strip(&mut self, x: Range<i32>, y: i32, z: i32) {
        let (sites, band) = (self.sites, self.sites.band);
        let near_z = z - band..z + SIDE + band;
        self.x = x.start;
        self.rows.clear();
        self.strip.clear();
        let window = sites
            .rows
            .window(x.start - band..x.end + band, y - band..y + SIDE + band);
        for (row, range) in window {
            self.rows.push((row, self.strip.len));
            for site in &sites.points[range] {
                let at = site.vertex.map(|v| v as i32);
                if near_z.contains(&at[2]) {
                    let from_strip = [at[0] - x.start, at[1] - y, at[2] - z].map(|c| c as f32);
                    self.strip.push(add(from_strip, site.offset));
                }
            }
        }
        self.rows.push((i32::MAX, self.strip.len));
    }

    fn fill(&mut self, x: i32, codes: &mut [u16]) {
        let band = self.sites.band;
        let begin = |x: i32| self.rows[self.rows.partition_point(|row| row.0 < x)].1;
        let near_x = begin(x - band)..begin(x + SIDE + band);
        let per_cell = codes_per_cell(band) as f32;
        let first = [(x - self.x) as f32, 0.0, 0.0];
        let Self {
            strip,
            brick,
            half,
            quarter,
            squares,
            ..
        } = self;

        let cube = |first, edge| Cube::new(first, edge, band);
        strip.keep_close(near_x, &cube(first, 8), brick, squares);
        for to_half in corners(4) {
            let first = add(first, to_half);
            brick.keep_close(0..brick.len, &cube(first, 4), half, squares);
            for to_quarter in corners(2) {
                let first = add(first, to_quarter);
                half.keep_close(0..half.len, &cube(first, 2), quarter, squares);
                let least = quarter.least_squares(first);
                for (to_vertex, square) in corners(1).into_iter().zip(least) {
                    let at = add(add(to_half, to_quarter), to_vertex).map(|c| c as u32);
                    // Rounded. The cast saturates, so distances beyond the band become BEYOND.
                    codes[within(at)] = (square.sqrt() * per_cell + 0.5) as u16;
                }
            }
        }
    }
}

/// A cube of vertices, and the bounds on the distance of its relevant points.
struct Cube {
    center: [f32; 3],
    diagonal: f32,
    /// A point farther from the center is beyond the band of every vertex, cells.
    reach: f32,
}

impl Cube {
    fn new(first: [f32; 3], edge: u32, band: i32) -> Self {
        let side = (edge - 1) as f32;
        let diagonal = side * 3f32.sqrt() + SLACK;
        Self {
            center: first.map(|c| c + side / 2.0),
            diagonal,
            reach: band as f32 + diagonal / 2.0 + SLACK,
        }
    }
}

/// Points in cells from a strip's first vertex, one list per axis. The lists may be longer than
/// `len`.
#[derive(Default)]
struct Points {
    axes: [Vec<f32>; 3],
    len: usize,
}

impl Points {
    fn clear(&mut self) {
        self.len = 0;
        self.axes.iter_mut().for_each(Vec::clear);
    }

    fn push(&mut self, point: [f32; 3]) {
        for (axis, coordinate) in self.axes.iter_mut().zip(point) {
            axis.push(coordinate);
        }
        self.len += 1;
    }

    /// Copies to `kept` the points of `range` that can be nearest to some vertex of the cube.
    fn keep_close(
        &self,
        range: Range<usize>,
        cube: &Cube,
        kept: &mut Self,
        squares: &mut Vec<f32>,
    ) {
        let [xs, ys, zs] = self.axes.each_ref().map(|axis| &axis[range.clone()]);
        let [x, y, z] = cube.center;
        squares.clear();
        squares.extend(
            xs.iter().zip(ys).zip(zs).map(|((px, py), pz)| {
                (px - x) * (px - x) + (py - y) * (py - y) + (pz - z) * (pz - z)
            }),
        );
        let nearest = least(squares).sqrt();
        let limit = (nearest + cube.diagonal).min(cube.reach).powi(2);
        for axis in &mut kept.axes {
            axis.resize(axis.len().max(xs.len()), 0.0);
        }
        let [kept_x, kept_y, kept_z] = kept.axes.each_mut().map(|axis| &mut axis[..xs.len()]);
        let mut len = 0;
        // Each point is written but counted only if it is close: a branch would be mispredicted
        // half of the time.
        for (((&px, &py), &pz), &square) in xs.iter().zip(ys).zip(zs).zip(squares.iter()) {
            (kept_x[len], kept_y[len], kept_z[len]) = (px, py, pz);
            len += usize::from(square <= limit);
        }
        kept.len = len;
    }

    /// The least squared distances to the 2x2x2 vertices from `first` on; infinite without points.
    fn least_squares(&self, first: [f32; 3]) -> [f32; 8] {
        let vertices = corners(1).map(|corner| add(first, corner));
        let [vx, vy, vz]: [[f32; 8]; 3] =
            core::array::from_fn(|axis| vertices.map(|vertex| vertex[axis]));
        let [xs, ys, zs] = self.axes.each_ref().map(|axis| &axis[..self.len]);
        let mut least = [f32::INFINITY; 8];
        for ((x, y), z) in xs.iter().zip(ys).zip(zs) {
            for lane in 0..8 {
                let [dx, dy, dz] = [x - vx[lane], y - vy[lane], z - vz[lane]];
                let square = dx * dx + dy * dy + dz * dz;
                least[lane] = if square < least[lane] {
                    square
                } else {
                    least[lane]
                };
            }
        }
        least
    }
}

/// The minimum of the values, computed eight at a time; infinite if there are none.
fn least(values: &[f32]) -> f32 {
    let lower = |a: f32, b: f32| if b < a { b } else { a };
    let (chunks, rest) = values.as_chunks::<8>();
    let mut lanes = [f32::INFINITY; 8];
    for chunk in chunks {
        for (lane, &value) in lanes.iter_mut().zip(chunk) {
            *lane = lower(*lane, value);
        }
    }
    lanes.iter().chain(rest).copied().fold(f32::INFINITY, lower)
}

/// The corners of a cube with edge `step`, in the order of [`within`].
fn corners(step: u8) -> [[f32; 3]; 8] {
    core::array::from_fn(|i| [i >> 2, i >> 1 & 1, i & 1].map(|bit| bit as f32 * f32::from(step)))
}

fn add(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    core::array::from_fn(|axis| a[axis] + b[axis])
}
