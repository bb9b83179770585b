//! Exact distance to the nearest target point, not to its cell, at the vertices of one brick.
//!
//! Rasterizing moves points by up to 0.87 cells; this undoes it at the vertices. For each 4x4x4
//! sub-brick only points can matter that are at most its diagonal farther from its center than the
//! nearest one; among those the minimum is taken vertex by vertex.

use super::activate::VOLUME;

/// Vertices along a sub-brick's edge.
const SUB: usize = 4;
/// The diagonal of a sub-brick, cells, rounded up.
const DIAGONAL: f32 = 5.2;

/// Points near one brick, in cells from the brick's first vertex.
#[derive(Default)]
pub(super) struct NearPoints {
    all: [Vec<f32>; 3],
    close: [Vec<f32>; 3],
    squares: Vec<f32>,
}

impl NearPoints {
    /// Takes the points that lie within `reach` cells of the brick at `first`, from `points` in
    /// cells.
    pub(super) fn collect<'a>(
        &mut self,
        points: impl Iterator<Item = &'a [[f32; 3]]>,
        first: [f32; 3],
        reach: f32,
    ) {
        self.all.iter_mut().for_each(Vec::clear);
        for run in points {
            for point in run {
                let z = point[2] - first[2];
                if (-reach..=reach + 7.0).contains(&z) {
                    self.all[0].push(point[0] - first[0]);
                    self.all[1].push(point[1] - first[1]);
                    self.all[2].push(z);
                }
            }
        }
    }

    /// Squared distances, in cells, from the brick's 512 vertices; infinite without points.
    pub(super) fn squares(&mut self) -> [f32; VOLUME] {
        let mut out = [f32::INFINITY; VOLUME];
        for sub in 0..8usize {
            let first = [sub >> 2, sub >> 1 & 1, sub & 1].map(|bit| bit * SUB);
            self.keep_close(first.map(|f| f as f32 + 1.5));
            for x in first[0]..first[0] + SUB {
                for y in first[1]..first[1] + SUB {
                    for z in first[2]..first[2] + SUB {
                        let vertex = [x as f32, y as f32, z as f32];
                        out[(x * 8 + y) * 8 + z] = least_square(&self.close, vertex);
                    }
                }
            }
        }
        out
    }

    /// Keeps the points that can be nearest to some vertex of the sub-brick around `center`.
    fn keep_close(&mut self, center: [f32; 3]) {
        let [xs, ys, zs] = &self.all;
        self.squares.clear();
        self.squares
            .extend(xs.iter().zip(ys).zip(zs).map(|((x, y), z)| {
                (x - center[0]).powi(2) + (y - center[1]).powi(2) + (z - center[2]).powi(2)
            }));
        let nearest = self
            .squares
            .iter()
            .fold(f32::INFINITY, |a, &b| if b < a { b } else { a });
        let limit = (nearest.sqrt() + DIAGONAL).powi(2);
        self.close.iter_mut().for_each(Vec::clear);
        for (i, &square) in self.squares.iter().enumerate() {
            if square <= limit {
                for axis in 0..3 {
                    self.close[axis].push(self.all[axis][i]);
                }
            }
        }
    }
}

/// The least squared distance from `vertex` to any of the points.
fn least_square(points: &[Vec<f32>; 3], vertex: [f32; 3]) -> f32 {
    let [xs, ys, zs] = points;
    let mut least = [f32::INFINITY; 8];
    let (xs, x_rest) = xs.as_chunks::<8>();
    let (ys, y_rest) = ys.as_chunks::<8>();
    let (zs, z_rest) = zs.as_chunks::<8>();
    let square = |x: f32, y: f32, z: f32| {
        let [dx, dy, dz] = [x - vertex[0], y - vertex[1], z - vertex[2]];
        dx * dx + dy * dy + dz * dz
    };
    for ((x, y), z) in xs.iter().zip(ys).zip(zs) {
        for lane in 0..8 {
            let d = square(x[lane], y[lane], z[lane]);
            least[lane] = if d < least[lane] { d } else { least[lane] };
        }
    }
    for ((&x, &y), &z) in x_rest.iter().zip(y_rest).zip(z_rest) {
        least[0] = least[0].min(square(x, y, z));
    }
    least.into_iter().fold(f32::INFINITY, f32::min)
}
