//! Column index: radius and nearest-neighbor queries on a point cloud.
//!
//! Points are sorted into square vertical columns. A query visits the columns that its radius
//! touches, a vector register of points at a time.

use std::ops::Range;

use super::column_kernels::{Wanted, each_level, each_near, nearest};
use super::neighborhood::Neighborhood;
use super::plane::PlaneFit;
use super::slots::{MOST_LANES, Slots, padded};
use super::tiles::Tiles;
use crate::flow::data::{Point, stride_sample};
use crate::flow::simd::Isa;

/// Most points of a column after [`ColumnIndex::uncrowded_rows`]. Real sweeps have up to 180 in a column
/// of 0.35 m, one a voxel of 0.1 m.
const MOST_IN_A_COLUMN: usize = 512;
/// Side of a square, in columns. Its centers share one search.
const TOGETHER: f32 = 5.0;

/// A point cloud indexed by vertical columns. A slot is a point's place in the order of the columns.
#[derive(Debug)]
pub(crate) struct ColumnIndex {
    isa: Isa,
    slots: Slots,
    /// The input row of each slot.
    rows: Vec<u32>,
}

impl ColumnIndex {
    /// Indexes `points`, metres, in columns with a side of `column_m` metres. The cost of a query
    /// grows with the square of its radius over that side.
    pub(crate) fn new(points: &[Point], column_m: f32) -> Self {
        Self::with(Isa::fastest(), points, column_m)
    }

    fn with(isa: Isa, points: &[Point], column_m: f32) -> Self {
        let (slots, rows) = Slots::new(points, column_m);
        Self { isa, slots, rows }
    }

    /// Sorts `points` into the order of the columns and indexes them: a slot is then a row.
    pub(crate) fn sorted(points: &mut Vec<Point>, column_m: f32) -> Self {
        let mut index = Self::new(points, column_m);
        *points = (0..points.len()).map(|slot| index.point(slot)).collect();
        index.rows = (0..points.len() as u32).collect();
        index
    }

    /// [`Self::sorted`] without the points that crowd a column, see [`Self::uncrowded_rows`].
    pub(crate) fn sorted_uncrowded(points: &mut Vec<Point>, column_m: f32) -> Self {
        let index = Self::sorted(points, column_m);
        let Some(rows) = index.uncrowded_rows() else {
            return index;
        };
        *points = rows.iter().map(|&row| points[row as usize]).collect();
        Self::sorted(points, column_m)
    }

    /// The input rows, in ascending order, without those that crowd a column: of a column with more
    /// than 512 points, 512 are left, evenly chosen. None where no column has more.
    ///
    /// A query looks at all points of a column, however high they lie. A tower of points, which no
    /// sensor sees, would make the cost of all queries quadratic.
    pub(crate) fn uncrowded_rows(&self) -> Option<Vec<u32>> {
        let columns = self.slots.tiles.begins().windows(2);
        let columns = columns.map(|ends| &self.rows[ends[0] as usize..ends[1] as usize]);
        if columns.clone().all(|rows| rows.len() <= MOST_IN_A_COLUMN) {
            return None;
        }
        let uncrowded = columns.flat_map(|rows| stride_sample(rows, MOST_IN_A_COLUMN));
        let mut rows: Vec<u32> = uncrowded.collect();
        rows.sort_unstable();
        Some(rows)
    }

    /// Number of points.
    pub(crate) fn len(&self) -> usize {
        self.rows.len()
    }

    /// The input rows in the order of the slots.
    pub(crate) fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// The columns.
    pub(super) fn tiles(&self) -> &Tiles {
        &self.slots.tiles
    }

    /// All points in their input order.
    pub(crate) fn in_order(&self) -> Vec<Point> {
        let mut points = vec![[0.0; 3]; self.len()];
        for (slot, &row) in self.rows.iter().enumerate() {
            points[row as usize] = self.point(slot);
        }
        points
    }

    /// Labels for [`Self::nearest_labelled`], from one label for each input row. `u32::MAX` is no
    /// label.
    pub(crate) fn labels(&self, of_rows: &[u32]) -> SlotLabels {
        let of_slots = self.rows.iter().map(|&row| of_rows[row as usize]);
        self.slot_labels(&of_slots.collect::<Vec<u32>>())
    }

    /// The same from one label for each slot.
    pub(crate) fn slot_labels(&self, of_slots: &[u32]) -> SlotLabels {
        let labels = of_slots.iter().map(|&value| label(value));
        SlotLabels(padded(labels, self.len(), f32::NAN))
    }

    /// Calls `see` with the input row of every point less than `within_m` metres from `center`.
    #[inline]
    pub(crate) fn within(&self, center: Point, within_m: f32, mut see: impl FnMut(u32)) {
        each_near(self.isa, &self.slots, &[center], within_m, |first, bits| {
            for bit in ones(bits.into()) {
                see(self.rows[first + bit as usize]);
            }
        });
    }

    /// The plane of the points less than `within_m` metres from `center`. None where there are too
    /// few, or where they do not lie on a plane.
    pub(crate) fn plane_at(&self, center: Point, within_m: f32) -> Option<PlaneFit> {
        Neighborhood::of(self.isa, &self.slots, center, within_m).flat()
    }

    /// The slots of all points less than `within_m` metres from one of `centers`, in ascending order.
    /// It is fast where centers that follow each other lie near each other.
    pub(crate) fn slots_near(&self, centers: &[Point], within_m: f32) -> Vec<u32> {
        let mut marks = Marks::of(self);
        let side_m = TOGETHER * self.slots.tiles.column_m();
        for together in within_squares(centers, side_m) {
            each_near(self.isa, &self.slots, together, within_m, |first, bits| {
                marks.add(first, bits);
            });
        }
        marks.slots().collect()
    }

    /// Calls `see` with every point of the columns that touch the square of half side `half_m`
    /// around `center`, less than `height_m` higher or lower. Metres.
    pub(crate) fn within_square(
        &self,
        center: Point,
        half_m: f32,
        height_m: f32,
        mut see: impl FnMut(Point),
    ) {
        let extent_m = [half_m, height_m];
        each_level(self.isa, &self.slots, center, extent_m, |first, bits| {
            for bit in ones(bits.into()) {
                see(self.point(first + bit as usize));
            }
        });
    }

    /// The input row and the squared distance of the nearest point, less than `within_m` metres
    /// from `center`. Of equally near points, it is the one of the lowest slot.
    #[inline]
    pub(crate) fn nearest(&self, center: Point, within_m: f32) -> Option<(u32, f32)> {
        let (slot, square) = self.nearest_slot(center, within_m)?;
        Some((self.rows[slot], square))
    }

    /// [`Self::nearest`] with the slot of the point.
    #[inline]
    pub(crate) fn nearest_slot(&self, center: Point, within_m: f32) -> Option<(usize, f32)> {
        self.search(center, within_m, None)
    }

    /// [`Self::nearest_slot`] among the points with the given label.
    #[inline]
    pub(crate) fn nearest_labelled(
        &self,
        center: Point,
        within_m: f32,
        labels: &SlotLabels,
        wanted: u32,
    ) -> Option<(usize, f32)> {
        self.search(center, within_m, Some((&labels.0, label(wanted))))
    }

    #[inline]
    fn search(
        &self,
        center: Point,
        within_m: f32,
        label: Option<(&[f32], f32)>,
    ) -> Option<(usize, f32)> {
        let wanted = Wanted {
            center,
            within_m,
            label,
        };
        nearest(self.isa, &self.slots, wanted)
    }

    #[inline]
    pub(super) fn point(&self, slot: usize) -> Point {
        [0, 1, 2].map(|axis: usize| self.slots.axes[axis][slot])
    }
}

/// The `points` in parts: consecutive ones that lie within a square of side `side_m`, metres.
fn within_squares(points: &[Point], side_m: f32) -> impl Iterator<Item = &[Point]> {
    let mut rest = points;
    std::iter::from_fn(move || {
        let &[x, y, _] = rest.first()?;
        let [mut low, mut high] = [[x, y]; 2];
        let fits = |&&[x, y, _]: &&Point| {
            low = [low[0].min(x), low[1].min(y)];
            high = [high[0].max(x), high[1].max(y)];
            high[0] - low[0] <= side_m && high[1] - low[1] <= side_m
        };
        // A first point that is not finite does not even fit alone.
        let count = rest.iter().take_while(fits).count().max(1);
        let (part, others) = rest.split_at(count);
        rest = others;
        Some(part)
    })
}

/// One label a slot, for [`ColumnIndex::nearest_labelled`].
#[derive(Debug)]
pub(crate) struct SlotLabels(Vec<f32>);

impl SlotLabels {
    /// The label of each slot; `u32::MAX` is no label.
    pub(crate) fn all(&self, slots: usize) -> impl Iterator<Item = u32> {
        let labels = self.0[..slots].iter();
        labels.map(|&label| {
            if label.is_nan() {
                u32::MAX
            } else {
                label as u32
            }
        })
    }

    /// Whether the slot has this label.
    pub(crate) fn is(&self, slot: u32, wanted: u32) -> bool {
        self.0[slot as usize] == label(wanted)
    }
}

/// A label as a float, which is exact: there are fewer labels than 2^24. No label equals nothing.
fn label(label: u32) -> f32 {
    if label == u32::MAX {
        f32::NAN
    } else {
        label as f32
    }
}

/// A set of slots of a [`ColumnIndex`], one bit each.
struct Marks {
    words: Vec<u64>,
    /// The words outside this range are zero.
    used: Range<usize>,
}

impl Marks {
    /// The empty set of slots of an index.
    fn of(index: &ColumnIndex) -> Self {
        let words = vec![0; index.slots.padded().div_ceil(64)];
        // The first slot sets both ends.
        let used = words.len()..0;
        Self { words, used }
    }

    #[inline(always)]
    fn add(&mut self, first: usize, bits: u32) {
        let Self { words, used } = self;
        let (word, shift) = (first / 64, first % 64);
        words[word] |= u64::from(bits) << shift;
        let mut last = word;
        if shift > 64 - MOST_LANES {
            last += 1;
            words[last] |= u64::from(bits) >> (64 - shift);
        }
        *used = used.start.min(word)..used.end.max(last + 1);
    }

    /// The slots in ascending order.
    fn slots(&self) -> impl Iterator<Item = u32> {
        let Range { start, end } = self.used;
        let words = self.words.get(start..end).unwrap_or_default().iter();
        let words = words.zip((64 * start as u32..).step_by(64));
        words.flat_map(|(&word, first)| ones(word).map(move |bit| first + bit))
    }
}

/// The indices of the set bits of a word, in ascending order.
#[inline(always)]
fn ones(word: u64) -> impl Iterator<Item = u32> {
    let without_lowest = |&left: &u64| Some(left & left.wrapping_sub(1));
    std::iter::successors(Some(word), without_lowest)
        .take_while(|&left| left != 0)
        .map(u64::trailing_zeros)
}

#[cfg(test)]
mod tests;
