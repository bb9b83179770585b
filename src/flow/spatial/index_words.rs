//! A column index as 32-bit words, for the kernels of a GPU.

use bytemuck::{Pod, Zeroable};

use super::column_index::ColumnIndex;
use super::tiles::Tiles;

/// Marks a vacant slot of the table, where its first column stands.
const VACANT: u32 = u32::MAX;
/// Words of a slot of the table: x and y of the tile, its occupied columns, and its first column.
const SLOT_WORDS: usize = 5;
/// Slots of a search after which the table takes another salt, and the number of salts.
const LONG_SEARCH: usize = 64;
const SALTS: u32 = 32;

/// Where the parts of an index lie among the words, in words, and its geometry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct IndexRecord {
    /// The hash table of the tiles.
    pub(crate) table: u32,
    /// Slots of the table less one.
    pub(crate) mask: u32,
    /// Mixed into the keys.
    pub(crate) salt: u32,
    /// The first point of each column, and the number of points at the end.
    pub(crate) begins: u32,
    /// The first of its points, which are in the order of the slots.
    pub(crate) points: u32,
    /// Number of points.
    pub(crate) count: u32,
    /// Side of a column, metres, and its inverse.
    pub(crate) column_m: f32,
    pub(crate) columns_per_m: f32,
}

impl ColumnIndex {
    /// Appends the tiles and columns to `words`, and the points to `points`: coordinates, and the
    /// bits of their labels. There is a label for each slot.
    pub(crate) fn write_words(
        &self,
        labels: impl Iterator<Item = u32>,
        words: &mut Vec<u32>,
        points: &mut Vec<[f32; 4]>,
    ) -> IndexRecord {
        let tiles = self.tiles();
        let (slots, salt) = table(tiles);
        let [column_m, columns_per_m] = tiles.sides();
        let mut record = IndexRecord {
            table: words.len() as u32,
            mask: (slots.len() - 1) as u32,
            salt,
            count: self.len() as u32,
            column_m,
            columns_per_m,
            ..IndexRecord::default()
        };
        words.extend_from_slice(slots.as_flattened());
        record.begins = words.len() as u32;
        words.extend_from_slice(tiles.begins());
        record.points = points.len() as u32;
        let slots = (0..self.len()).zip(labels);
        points.extend(slots.map(|(slot, label)| {
            let [x, y, z] = self.point(slot);
            [x, y, z, f32::from_bits(label)]
        }));
        record
    }
}

/// The hash table of the tiles by open addressing, at most half full, and its salt. Tiles that are
/// chosen to collide make it take another salt, and then more slots.
fn table(tiles: &Tiles) -> (Vec<[u32; SLOT_WORDS]>, u32) {
    let mut slots = (2 * tiles.count()).next_power_of_two().max(2);
    loop {
        for salt in 0..SALTS {
            if let Some(table) = filled(tiles, slots, salt) {
                return (table, salt);
            }
        }
        slots *= 2;
    }
}

/// The table with this number of slots and this salt; none where a search would be long.
fn filled(tiles: &Tiles, slots: usize, salt: u32) -> Option<Vec<[u32; SLOT_WORDS]>> {
    let mut table = vec![[0, 0, 0, 0, VACANT]; slots];
    for (tile, occupied, first) in tiles.all() {
        let mut slot = hash(tile, salt) as usize & (slots - 1);
        let mut steps = 0;
        while table[slot][SLOT_WORDS - 1] != VACANT {
            slot = (slot + 1) & (slots - 1);
            steps += 1;
        }
        if steps > LONG_SEARCH {
            return None;
        }
        let [x, y] = tile.map(i32::cast_unsigned);
        table[slot] = [x, y, occupied as u32, (occupied >> 32) as u32, first];
    }
    Some(table)
}

/// The hash of a tile, as the kernels compute it.
fn hash(tile: [i32; 2], salt: u32) -> u32 {
    let [x, y] = tile.map(i32::cast_unsigned);
    let keys = (x ^ salt.wrapping_mul(0x9E37_79B9)).wrapping_mul(0x9E37_79B1);
    let mixed = keys.wrapping_add(y.wrapping_mul(0x85EB_CA77));
    let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(0xC2B2_AE35);
    mixed ^ (mixed >> 13)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Point;

    #[test]
    fn every_tile_is_found_at_its_hash_or_soon_after() {
        let points: Vec<Point> = (0..4000_u16)
            .map(|i| {
                [
                    f32::from(i % 67) * 3.1 - 100.0,
                    f32::from(i / 67) * 2.9 - 80.0,
                    0.0,
                ]
            })
            .collect();
        let index = ColumnIndex::new(&points, 0.35);
        let mut words = vec![7; 3];
        let mut placed = vec![[0.0; 4]; 5];
        let record = index.write_words(0..4000, &mut words, &mut placed);
        assert_eq!(record.count, 4000);
        assert_eq!((record.points, placed.len()), (5, 4005));
        let [x, y, z, label] = placed[12];
        assert_eq!(([x, y, z], label.to_bits()), (index.point(7), 7));
        let mut tiles = 0;
        for (tile, occupied, first) in index.tiles().all() {
            let mut slot = hash(tile, record.salt) & record.mask;
            let at = loop {
                let at = (record.table + slot * SLOT_WORDS as u32) as usize;
                assert_ne!(words[at + 4], VACANT, "{tile:?}");
                if words[at..at + 2] == tile.map(i32::cast_unsigned) {
                    break at;
                }
                slot = (slot + 1) & record.mask;
            };
            assert_eq!(
                words[at + 2..at + 5],
                [occupied as u32, (occupied >> 32) as u32, first]
            );
            tiles += 1;
        }
        assert!(tiles > 100);
        assert_eq!(words.last(), Some(&4000));
    }
}
