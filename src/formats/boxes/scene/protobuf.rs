//! Messages of protocol buffers as bytes.

const VARINT: u32 = 0;
const FIXED_64: u32 = 1;
const LENGTH: u32 = 2;
const FIXED_32: u32 = 5;

/// A message, to which fields are appended.
#[derive(Debug, Default)]
pub(super) struct Message(Vec<u8>);

impl Message {
    fn raw_varint(mut self, mut value: u64) -> Self {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
        self
    }

    fn key(self, field: u32, kind: u32) -> Self {
        self.raw_varint(u64::from((field << 3) | kind))
    }

    /// An integer, a flag or a value of an enumeration.
    pub(super) fn varint(self, field: u32, value: u64) -> Self {
        self.key(field, VARINT).raw_varint(value)
    }

    pub(super) fn double(self, field: u32, value: f64) -> Self {
        let mut message = self.key(field, FIXED_64);
        message.0.extend(value.to_le_bytes());
        message
    }

    pub(super) fn fixed32(self, field: u32, value: u32) -> Self {
        let mut message = self.key(field, FIXED_32);
        message.0.extend(value.to_le_bytes());
        message
    }

    pub(super) fn bytes(self, field: u32, bytes: &[u8]) -> Self {
        let mut message = self.key(field, LENGTH).raw_varint(bytes.len() as u64);
        message.0.extend_from_slice(bytes);
        message
    }

    pub(super) fn text(self, field: u32, text: &str) -> Self {
        self.bytes(field, text.as_bytes())
    }

    pub(super) fn message(self, field: u32, inner: &Self) -> Self {
        self.bytes(field, &inner.0)
    }

    pub(super) fn into_bytes(self) -> Vec<u8> {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_have_the_bytes_of_the_encoding() {
        let inner = Message::default().varint(1, 300);
        let message = Message::default()
            .text(2, "ab")
            .fixed32(3, 1)
            .message(16, &inner);
        let text = [0x12, 2, b'a', b'b'];
        let number = [0x1d, 1, 0, 0, 0];
        let nested = [0x82, 0x01, 3, 0x08, 0xac, 0x02];
        let expected = [&text[..], &number, &nested].concat();
        assert_eq!(message.into_bytes(), expected);
        let double = Message::default().double(1, 1.0).into_bytes();
        assert_eq!(double, [0x09, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f]);
    }
}
