//! Thrift's compact protocol, as far as the limits of Parquet files need it.

/// Most structs within each other.
const MAX_DEPTH: usize = 12;
/// Least bytes of a struct in a list: in Parquet's metadata it has a field with a value, or a struct.
const STRUCT_BYTES: usize = 3;

/// The types of values. True and false are types of fields; a reader takes either for a truth value.
pub(super) const TRUE: u8 = 1;
pub(super) const FALSE: u8 = 2;
pub(super) const I8: u8 = 3;
pub(super) const I16: u8 = 4;
pub(super) const I32: u8 = 5;
pub(super) const I64: u8 = 6;
pub(super) const DOUBLE: u8 = 7;
pub(super) const BINARY: u8 = 8;
pub(super) const LIST: u8 = 9;
pub(super) const STRUCT: u8 = 12;

/// What a struct holds, as [`Input::walk`] finds it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Found {
    /// A field of this type.
    Field(u8),
    /// An integer.
    Number(i64),
    /// A list with this many elements of this type.
    List(usize, u8),
}

/// What is left of the bytes of a value.
pub(super) struct Input<'a>(pub(super) &'a [u8]);

impl Input<'_> {
    /// Walks a struct to its end. `see` is told what is in it, each with the ids of its field and of the fields
    /// around it. Elements of a list have the ids of the list. The walk ends where `see` refuses.
    ///
    /// `None` for a struct that is refused, cut, too deep, not in the order of its ids, with a number beyond its
    /// type, or with a list of more elements than bytes follow.
    pub(super) fn walk(
        &mut self,
        path: &mut Vec<i64>,
        see: &mut impl FnMut(&[i64], Found) -> bool,
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
            let next = match field >> 4 {
                // The long form, for a step of more than 15.
                0 => zigzag(self.varint()?),
                step => id + i64::from(step),
            };
            id = (next > id && next <= i64::from(i16::MAX)).then_some(next)?;
            path.push(id);
            see(path, Found::Field(field & 15)).then_some(())?;
            // The type of a field that is true or false is its value.
            if field & 15 > FALSE {
                self.value(field & 15, path, see)?;
            }
            path.pop();
        }
    }

    fn value(
        &mut self,
        kind: u8,
        path: &mut Vec<i64>,
        see: &mut impl FnMut(&[i64], Found) -> bool,
    ) -> Option<()> {
        match kind {
            // As an element of a list true and false take a byte.
            TRUE | FALSE | I8 => drop(self.byte()?),
            I16 | I32 | I64 => {
                let number = zigzag(self.varint()?);
                let fits = match kind {
                    I16 => i16::try_from(number).is_ok(),
                    I32 => i32::try_from(number).is_ok(),
                    _ => true,
                };
                (fits && see(path, Found::Number(number))).then_some(())?;
            }
            DOUBLE => self.skip(8)?,
            BINARY => {
                let length = self.varint()?;
                self.skip(usize::try_from(length).ok()?)?;
            }
            LIST => {
                let head = self.byte()?;
                let count = match head >> 4 {
                    15 => usize::try_from(self.varint()?).ok()?,
                    count => usize::from(count),
                };
                let kind = head & 15;
                let least = if kind == STRUCT { STRUCT_BYTES } else { 1 };
                // Parquet's metadata have no lists of lists.
                if kind == LIST || count > self.0.len() / least {
                    return None;
                }
                see(path, Found::List(count, kind)).then_some(())?;
                for _ in 0..count {
                    self.value(kind, path, see)?;
                }
            }
            STRUCT => self.walk(path, see)?,
            // Parquet's metadata have no sets and no maps.
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
