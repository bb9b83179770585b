//! Computes the distances of the active bricks, block by block and strip by strip.
//!
//! A strip is the bricks of a block that share y and z. They depend on nearly the same sites, which
//! are gathered once per strip. Distances are exact up to the rounding to 16 bits, and every brick
//! is written by one thread, so the number of threads does not change the result. Independent of
//! the kind of site: see [`Gather`].

use core::ops::Range;

use rayon::prelude::*;

use super::brick_index::{ABSENT, EDGE, Index, VOLUME};
use crate::flow::data::{Control, Interrupt, control};

/// Marks a vertex of an active brick that lies beyond the band.
pub(super) const BEYOND: u16 = u16::MAX;

/// Bricks along a block's edge, equal to the vertices along a brick's edge.
const STRIP: usize = EDGE as usize;

/// One thread's state for computing the codes of bricks from the sites.
pub(super) trait Gather {
    /// Gathers the sites that the bricks of one strip share. The strip's vertices are `x` along x,
    /// and eight from `y` and from `z` on.
    fn open_strip(&mut self, x: Range<i32>, y: i32, z: i32);

    /// Writes the codes of the strip's brick that begins at `x`: the distance from each vertex to
    /// the nearest site, or [`BEYOND`] if that is farther than the band.
    fn fill(&mut self, x: i32, codes: &mut [u16]);
}

/// Codes per cell of distance. The band's radius maps to the largest code below [`BEYOND`].
pub(crate) fn codes_per_cell(band: i32) -> f64 {
    f64::from(BEYOND - 1) / f64::from(band)
}

/// The codes of all active bricks, 512 per brick, with one gather per thread. Checks the control
/// before every block.
///
/// # Errors
/// [`Interrupt`] if the control interrupts.
pub(super) fn band_codes<G: Gather>(
    index: &Index,
    gather: impl Fn() -> G + Send + Sync,
    control: &dyn Control,
) -> Result<Vec<u16>, Interrupt> {
    let mut codes = vec![0u16; index.active * VOLUME];
    let mut rest = codes.as_mut_slice();
    let mut blocks = Vec::new();
    for (block, table) in index.tabled_blocks() {
        let bricks = &index.bricks[table * VOLUME..(table + 1) * VOLUME];
        let active = bricks.iter().filter(|&&b| b != ABSENT).count();
        let (own, others) = rest.split_at_mut(active * VOLUME);
        rest = others;
        blocks.push((block, bricks, own));
    }
    blocks
        .into_par_iter()
        .try_for_each_init(gather, |gather, (block, bricks, own)| {
            control::check(control)?;
            fill_block(gather, block, bricks, own);
            Ok(())
        })?;
    Ok(codes)
}

/// Computes the active bricks of one block. `own` are their codes, in the order of their storage
/// numbers.
fn fill_block(gather: &mut impl Gather, block: [usize; 3], bricks: &[u32], own: &mut [u16]) {
    // Storage numbers ascend along the table, and ABSENT exceeds all of them.
    let Some(&first) = bricks.iter().min() else {
        return;
    };
    let vertex = |axis: usize, brick: usize| ((block[axis] * STRIP + brick) * STRIP) as i32;
    for y in 0..STRIP {
        for z in 0..STRIP {
            let number = |x: usize| bricks[(x * STRIP + y) * STRIP + z];
            let mut active = (0..STRIP).filter(|&x| number(x) != ABSENT);
            let Some(low) = active.next() else {
                continue;
            };
            let high = active.next_back().unwrap_or(low);
            gather.open_strip(
                vertex(0, low)..vertex(0, high + 1),
                vertex(1, y),
                vertex(2, z),
            );
            for x in (low..=high).filter(|&x| number(x) != ABSENT) {
                let start = (number(x) - first) as usize * VOLUME;
                gather.fill(vertex(0, x), &mut own[start..start + VOLUME]);
            }
        }
    }
}

/// Items with integer x and y, sorted by both and indexed by x.
#[derive(Debug)]
pub(crate) struct Rows {
    /// First item of each x, and the number of items at the end.
    starts: Vec<u32>,
    y: Vec<i32>,
}

impl Rows {
    /// The index of `(x, y)` items, which are sorted.
    pub(super) fn new(items: impl Iterator<Item = [u32; 2]>) -> Self {
        let mut rows = Self {
            starts: vec![],
            y: vec![],
        };
        for [x, y] in items {
            rows.starts.resize(x as usize + 1, rows.y.len() as u32);
            rows.y.push(y as i32);
        }
        rows.starts.push(rows.y.len() as u32);
        rows
    }

    /// The items with x and y in the given ranges: for each x with items, x and the range of item
    /// indices.
    pub(super) fn window(
        &self,
        x: Range<i32>,
        y: Range<i32>,
    ) -> impl Iterator<Item = (i32, Range<usize>)> {
        let rows = self.starts.len() as i32 - 1;
        (x.start.max(0)..x.end.min(rows)).filter_map(move |row| {
            let start = self.starts[row as usize] as usize;
            let all = &self.y[start..self.starts[row as usize + 1] as usize];
            let low = all.partition_point(|&at| at < y.start);
            let count = all[low..].partition_point(|&at| at < y.end);
            (count > 0).then_some((row, start + low..start + low + count))
        })
    }

    /// First item of each x, and the number of items at the end.
    #[cfg(feature = "gpu")]
    pub(crate) fn starts(&self) -> &[u32] {
        &self.starts
    }

    /// The y of every item.
    #[cfg(feature = "gpu")]
    pub(crate) fn all_y(&self) -> &[i32] {
        &self.y
    }

    /// The y of item `item`.
    pub(super) fn y(&self, item: usize) -> i32 {
        self.y[item]
    }
}
