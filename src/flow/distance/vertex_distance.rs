//! Exact distance to the nearest occupied vertex, by a separable transform within the band.
//!
//! Each occupied column is transformed along z once. A strip takes the minimum over the columns
//! along y, and a brick the minimum over those rows along x, 64 values at a time in 16-bit
//! integers.

use core::ops::Range;

use super::brick_index::EDGE;
use super::fill::{BEYOND, Gather, Rows, codes_per_cell};

/// Exceeds every squared distance within the band, square cells. Adding a squared offset to it does
/// not overflow 16 bits.
const FAR: i16 = 0x3FFF;
/// Vertices along a brick's edge.
const SIDE: i32 = EDGE as i32;

/// Occupied columns, each with its squared distances along z.
#[derive(Debug)]
pub(crate) struct VertexSites {
    band: i32,
    /// Columns by x and y. A column is split where consecutive vertices are more than twice the
    /// band plus eight cells apart.
    pub(crate) columns: Rows,
    /// For each column, the brick layer at which its distances begin and the index of the first one
    /// in `squares`; one more entry at the end.
    pub(crate) layers: Vec<(u32, u32)>,
    /// Eight squared distances per layer, square cells; [`FAR`] beyond the band.
    pub(crate) squares: Vec<[i16; 8]>,
    /// The code of each squared distance up to the band's, then [`BEYOND`].
    pub(crate) codes: Vec<u16>,
}

impl VertexSites {
    /// Transforms `cells` (sorted, unique) along z, with a band of `band` cells.
    pub(crate) fn new(cells: &[[u32; 3]], band: i32) -> Self {
        let near =
            |a: &[u32; 3], b: &[u32; 3]| a[..2] == b[..2] && b[2] - a[2] <= 2 * band as u32 + EDGE;
        let columns = || cells.chunk_by(near);
        let mut layers = Vec::new();
        let mut squares = Vec::new();
        for column in columns() {
            let first = column[0][2].saturating_sub(band as u32) / EDGE;
            layers.push((first, squares.len() as u32));
            push_squares(&mut squares, column, first, band);
        }
        layers.push((0, squares.len() as u32));
        let per_cell = codes_per_cell(band);
        let code = |square: i32| (f64::from(square).sqrt() * per_cell).round() as u16;
        Self {
            band,
            columns: Rows::new(columns().map(|column| [column[0][0], column[0][1]])),
            layers,
            squares,
            codes: (0..=band * band).map(code).chain([BEYOND]).collect(),
        }
    }

    /// An upper bound on the bytes of [`Self::new`] for `cells` occupied vertices.
    pub(super) fn bytes(cells: usize, band: i32) -> usize {
        let layers = (2 * band + SIDE) / SIDE + 2;
        cells * (layers as usize * size_of::<[i16; 8]>() + size_of::<(u32, u32, i32)>())
    }

    /// The column's squared distances in brick layer `layer`; none if its band does not extend
    /// there.
    fn at(&self, column: usize, layer: u32) -> Option<&[i16; 8]> {
        let (first, start) = self.layers[column];
        let end = self.layers[column + 1].1;
        let index = start + layer.checked_sub(first)?;
        (index < end).then(|| &self.squares[index as usize])
    }
}

/// Appends the squared distances to a column's vertices along z, from brick layer `first` to the
/// last one within the band.
fn push_squares(squares: &mut Vec<[i16; 8]>, column: &[[u32; 3]], first: u32, band: i32) {
    let last = (column[column.len() - 1][2] + band as u32) / EDGE;
    let mut above = 0;
    for layer in first..=last {
        squares.push(core::array::from_fn(|lane| {
            let z = (layer * EDGE) as i32 + lane as i32;
            while above < column.len() && (column[above][2] as i32) < z {
                above += 1;
            }
            let up = column.get(above).map(|cell| cell[2] as i32 - z);
            let below = above.checked_sub(1).map(|below| column[below]);
            let down = below.map(|cell| z - cell[2] as i32);
            match up.into_iter().chain(down).min() {
                Some(nearest) if nearest <= band => (nearest * nearest) as i16,
                _ => FAR,
            }
        }));
    }
}

/// One row's squared distances to a strip: `[8 y + z]`.
struct Row {
    x: i32,
    squares: [i16; 64],
    least: i16,
}

/// One thread's working set.
pub(super) struct VertexGather<'a> {
    sites: &'a VertexSites,
    /// The rows within the band of the open strip, by x.
    rows: Vec<Row>,
}

impl<'a> VertexGather<'a> {
    pub(super) fn new(sites: &'a VertexSites) -> Self {
        Self {
            sites,
            rows: Vec::new(),
        }
    }
}

impl Gather for VertexGather<'_> {
    fn open_strip(&mut self, x: Range<i32>, y: i32, z: i32) {
        let (sites, band) = (self.sites, self.sites.band);
        let layer = z as u32 / EDGE;
        self.rows.clear();
        let window = sites
            .columns
            .window(x.start - band..x.end + band, y - band..y + SIDE + band);
        for (x, columns) in window {
            let mut squares = [FAR; 64];
            for column in columns {
                let Some(along_z) = sites.at(column, layer) else {
                    continue;
                };
                let gap = y - sites.columns.y(column);
                for (lane, out) in squares.as_chunks_mut::<8>().0.iter_mut().enumerate() {
                    let gap = gap + lane as i32;
                    lower(out, along_z, (gap * gap) as i16);
                }
            }
            let least = squares.iter().fold(FAR, |a, &b| a.min(b));
            if least < FAR {
                self.rows.push(Row { x, squares, least });
            }
        }
    }

    fn fill(&mut self, x: i32, codes: &mut [u16]) {
        let band = self.sites.band;
        let beyond = self.sites.codes.len() - 1;
        for (x, codes) in (x..).zip(codes.as_chunks_mut::<64>().0) {
            let first = self.rows.partition_point(|row| row.x < x - band);
            let rows = self.rows[first..].iter();
            let mut squares = [FAR; 64];
            for row in rows.take_while(|row| row.x <= x + band) {
                let gap = (x - row.x) * (x - row.x);
                if i32::from(row.least) + gap <= band * band {
                    lower(&mut squares, &row.squares, gap as i16);
                }
            }
            for (code, &square) in codes.iter_mut().zip(&squares) {
                *code = self.sites.codes[beyond.min(square as usize)];
            }
        }
    }
}

/// Lowers each element of `out` to that of `squares` plus `gap`.
#[inline(always)]
fn lower<const N: usize>(out: &mut [i16; N], squares: &[i16; N], gap: i16) {
    for (out, &square) in out.iter_mut().zip(squares) {
        *out = (*out).min(square + gap);
    }
}
