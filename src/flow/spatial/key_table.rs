//! Hash table of integer keys by open addressing: the cells of a grid that hold points.
//!
//! Keys that are chosen to collide cost no more than others: after a long search the table takes
//! another hash function.

/// The key of a vacant slot.
const VACANT: u64 = u64::MAX;
/// The first multiplier of the hash function (Fibonacci hashing), and what gives the next one.
const FIRST_MULTIPLIER: u64 = 0x9E37_79B9_7F4A_7C15;
const NEXT_MULTIPLIER: u64 = 0xD134_2543_DE82_EF95;
/// Slots of a search after which a new key makes the table take another hash function. A table is
/// half full at most, and the cells of sweeps need far fewer.
const LONG_SEARCH: usize = 256;
/// Bound on the number of hash functions.
const FUNCTIONS: usize = 32;

/// Values by key. Keys are below `u64::MAX`.
#[derive(Debug)]
pub(super) struct KeyTable<V> {
    slots: Vec<(u64, V)>,
    used: usize,
    /// An odd number.
    multiplier: u64,
    functions: usize,
}

impl<V: Copy + Default> KeyTable<V> {
    /// A table without keys. It grows; room for `expected` keys is there from the start.
    pub(super) fn new(expected: usize) -> Self {
        let slots = (2 * expected).next_power_of_two().max(16);
        Self {
            slots: vec![(VACANT, V::default()); slots],
            used: 0,
            multiplier: FIRST_MULTIPLIER,
            functions: 1,
        }
    }

    /// The value of a key.
    #[inline(always)]
    pub(super) fn get(&self, key: u64) -> Option<&V> {
        let (found, value) = &self.slots[self.slot(key)];
        (*found == key).then_some(value)
    }

    /// The value of a key, which is the default one where the key is new.
    #[inline]
    pub(super) fn entry(&mut self, key: u64) -> &mut V {
        let (mut slot, mut steps) = self.search(key);
        if self.slots[slot].0 == VACANT {
            while steps > LONG_SEARCH && self.functions < FUNCTIONS {
                self.multiplier = self.multiplier.wrapping_mul(NEXT_MULTIPLIER);
                self.functions += 1;
                self.move_to(self.slots.len());
                (slot, steps) = self.search(key);
            }
            if 2 * (self.used + 1) > self.slots.len() {
                self.move_to(2 * self.slots.len());
                slot = self.slot(key);
            }
            self.slots[slot].0 = key;
            self.used += 1;
        }
        &mut self.slots[slot].1
    }

    /// Adds a key, and returns whether it was new.
    #[inline]
    pub(super) fn insert(&mut self, key: u64) -> bool {
        let before = self.used;
        self.entry(key);
        self.used > before
    }

    /// Number of keys.
    pub(super) fn len(&self) -> usize {
        self.used
    }

    /// The keys and their values, in no order.
    pub(super) fn all(&self) -> impl Iterator<Item = (u64, V)> {
        let slots = self.slots.iter().copied();
        slots.filter(|&(key, _)| key != VACANT)
    }

    /// The keys in ascending order.
    pub(super) fn sorted(&self) -> Vec<u64> {
        let mut keys: Vec<u64> = self.all().map(|(key, _)| key).collect();
        keys.sort_unstable();
        keys
    }

    /// Moves all keys to `slots` new slots.
    fn move_to(&mut self, slots: usize) {
        let vacant = vec![(VACANT, V::default()); slots];
        for (key, value) in core::mem::replace(&mut self.slots, vacant) {
            if key != VACANT {
                let slot = self.slot(key);
                self.slots[slot] = (key, value);
            }
        }
    }

    /// The slot of the key, or the vacant one for it.
    #[inline(always)]
    fn slot(&self, key: u64) -> usize {
        self.search(key).0
    }

    /// The slot, and the number of slots before it that other keys take.
    #[inline(always)]
    fn search(&self, key: u64) -> (usize, usize) {
        // The high bits are mixed best.
        let hash = key.wrapping_mul(self.multiplier) >> 29;
        let mut slot = hash as usize & (self.slots.len() - 1);
        let mut steps = 0;
        while self.slots[slot].0 != key && self.slots[slot].0 != VACANT {
            slot = (slot + 1) & (self.slots.len() - 1);
            steps += 1;
        }
        (slot, steps)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;
    use crate::flow::data::Random;

    #[test]
    fn every_key_keeps_its_value_while_the_table_grows() {
        let mut random = Random::new(7);
        let mut table = KeyTable::<u32>::new(0);
        let mut expected = HashMap::new();
        for round in 0..5000 {
            // A few keys many times, and neighboring keys as grids have them.
            let key = random.uniform(0.0, 2000.0) as u64 * (1 << 21);
            *table.entry(key) += round;
            *expected.entry(key).or_insert(0) += round;
        }
        assert!(
            expected
                .iter()
                .all(|(&key, value)| table.get(key) == Some(value))
        );
        assert_eq!(table.get(5), None);
        let mut keys: Vec<u64> = expected.into_keys().collect();
        keys.sort_unstable();
        assert_eq!(table.sorted(), keys);
    }

    #[test]
    fn keys_that_are_chosen_to_collide_are_found_after_few_steps() {
        // Newton's iteration for the inverse modulo 2^64.
        let inverse = (0..6).fold(1_u64, |inverse, _| {
            inverse.wrapping_mul(2_u64.wrapping_sub(FIRST_MULTIPLIER.wrapping_mul(inverse)))
        });
        assert_eq!(inverse.wrapping_mul(FIRST_MULTIPLIER), 1);
        let keys = (0..20_000_u64).map(|number| inverse.wrapping_mul(number));
        let mut table = KeyTable::<bool>::new(0);
        for key in keys.clone() {
            *table.entry(key) = true;
        }
        let longest = keys.clone().map(|key| table.search(key).1).max();
        assert!(longest <= Some(LONG_SEARCH), "{longest:?}");
        assert!(keys.clone().all(|key| table.get(key) == Some(&true)));
        assert_eq!(table.sorted().len(), 20_000);
    }
}
