//! Thrift's compact protocol, as far as the limits of Parquet files need it.

/// Most structs and lists within each other.
const MAX_DEPTH: usize = 12;
/// Least bytes of an element of a list: a struct in Parquet's metadata has a field with a value, or a struct.
const STRUCT_BYTES: usize = 3;

/// The types of values.
const LIST: u8 = 9;
const SET: u8 = 10;
const STRUCT: u8 = 12;

/// What a struct holds, as [`Input::walk`] finds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Found {
    /// An integer.
    Number(i64),
    /// A list or a set with this many elements.
    List(usize),
}

/// What is left of the bytes of a value.
pub(super) struct Input<'a>(pub(super) &'a [u8]);

impl Input<'_> {
    /// Walks a struct to its end. `see` is told the numbers and lists in it, each with the ids of its field
    /// and of the fields around it. Elements of a list have the ids of the list.
    ///
    /// `None` for a struct that is cut, too deep, or has a list with more elements than bytes follow.
    pub(super) fn walk(
        &mut self,
        path: &mut Vec<i64>,
        see: &mut impl FnMut(&[i64], Found),
    ) -> Option<()> {
        if path.len() > MAX_DEPTH {
            return None;
        }
        let mut id = 0;
        loop {
            let field = self.byte()?;
            if field == 0 {
                return Some(());
            }
            id = match field >> 4 {
                0 => zigzag(self.varint()?),
                step => id.wrapping_add(i64::from(step)),
            };
            path.push(id);
            // The type of a field that is true or false is its value.
            if field & 15 > 2 {
                self.value(field & 15, path, see)?;
            }
            path.pop();
        }
    }

    fn value(
        &mut self,
        kind: u8,
        path: &mut Vec<i64>,
        see: &mut impl FnMut(&[i64], Found),
    ) -> Option<()> {
        match kind {
            // As an element of a list true and false take a byte.
            1..=3 => drop(self.byte()?),
            4..=6 => see(path, Found::Number(zigzag(self.varint()?))),
            7 => self.skip(8)?,
            8 => {
                let length = self.varint()?;
                self.skip(usize::try_from(length).ok()?)?;
            }
            LIST | SET => {
                let head = self.byte()?;
                let count = match head >> 4 {
                    15 => usize::try_from(self.varint()?).ok()?,
                    count => usize::from(count),
                };
                let kind = head & 15;
                let least = if kind == STRUCT { STRUCT_BYTES } else { 1 };
                // Parquet's metadata have no lists of lists.
                if kind == LIST || kind == SET || count > self.0.len() / least {
                    return None;
                }
                see(path, Found::List(count));
                for _ in 0..count {
                    self.value(kind, path, see)?;
                }
            }
            STRUCT => self.walk(path, see)?,
            // Parquet's metadata have no maps.
            _ => return None,
        }
        Some(())
    }

    /// The next byte.
    pub(super) fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    /// Leaves out bytes.
    pub(super) fn skip(&mut self, count: usize) -> Option<()> {
        self.0 = self.0.get(count..)?;
        Some(())
    }

    /// A number of at most 64 bits, seven a byte, the lowest first.
    pub(super) fn varint(&mut self) -> Option<u64> {
        let mut number = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            number |= u64::from(byte & 127) << shift;
            if byte & 128 == 0 {
                return Some(number);
            }
        }
        None
    }
}

/// A signed number from its zigzag form.
fn zigzag(number: u64) -> i64 {
    (number >> 1) as i64 ^ -((number & 1) as i64)
}
