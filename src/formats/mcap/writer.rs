//! Writing of recordings: a chunk for each call, not compressed, with the index of all.
//!
//! ```text
//! MAGIC  HEADER  SCHEMA CHANNEL ...  CHUNK MESSAGE_INDEX ...  DATA_END
//! SCHEMA ...  CHANNEL ...  STATISTICS  CHUNK_INDEX ...  FOOTER  MAGIC
//! ```

use std::collections::BTreeMap;
use std::io::{self, Write};

use super::records::{
    CHANNEL, CHUNK, CHUNK_INDEX, DATA_END, FOOTER, HEADER, MAGIC, MESSAGE, MESSAGE_INDEX, SCHEMA,
    STATISTICS,
};

/// What a channel carries.
pub(in crate::formats) struct Topic<'a> {
    pub(in crate::formats) name: &'a str,
    /// Encoding of its messages.
    pub(in crate::formats) encoding: &'a str,
    /// Name of the type of its messages.
    pub(in crate::formats) schema_name: &'a str,
    pub(in crate::formats) schema_encoding: &'a str,
    /// The definition of the type.
    pub(in crate::formats) schema: &'a [u8],
}

/// A recording that is written.
pub(in crate::formats) struct RecordingWriter<W> {
    out: W,
    /// Bytes written.
    at: u64,
    /// Records for the index at the end, as bytes.
    schemas: Vec<u8>,
    channels: Vec<u8>,
    chunks: Vec<u8>,
    chunk_count: u32,
    /// Messages of each channel.
    counts: Vec<u64>,
    /// Times of the first message and the last, nanoseconds.
    span_ns: Option<(u64, u64)>,
}

/// The content of a record, to which values are appended.
#[derive(Default)]
struct Content(Vec<u8>);

impl Content {
    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Bytes with their number before them: a text, a list or a map.
    fn counted(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }
}

/// Appends a record.
fn append(records: &mut Vec<u8>, code: u8, content: &Content) {
    records.push(code);
    records.extend((content.0.len() as u64).to_le_bytes());
    records.extend_from_slice(&content.0);
}

impl<W: Write> RecordingWriter<W> {
    /// # Errors
    /// Those of the writer, as for all functions.
    pub(in crate::formats) fn start(out: W) -> io::Result<Self> {
        let mut writer = Self {
            out,
            at: 0,
            schemas: Vec::new(),
            channels: Vec::new(),
            chunks: Vec::new(),
            chunk_count: 0,
            counts: Vec::new(),
            span_ns: None,
        };
        writer.write(MAGIC)?;
        let library = concat!("fnsf ", env!("CARGO_PKG_VERSION"));
        let header = Content::default().counted(b"").counted(library.as_bytes());
        writer.record(HEADER, &header)?;
        Ok(writer)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.at += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    fn record(&mut self, code: u8, content: &Content) -> io::Result<()> {
        self.write(&[code])?;
        self.write(&(content.0.len() as u64).to_le_bytes())?;
        self.write(&content.0)
    }

    /// Adds a channel. Returns its number.
    pub(in crate::formats) fn channel(&mut self, topic: &Topic<'_>) -> io::Result<u16> {
        let number = self.counts.len() as u16;
        // A schema of number 0 is none.
        let schema_number = number + 1;
        let schema = Content::default()
            .u16(schema_number)
            .counted(topic.schema_name.as_bytes())
            .counted(topic.schema_encoding.as_bytes())
            .counted(topic.schema);
        let channel = Content::default()
            .u16(number)
            .u16(schema_number)
            .counted(topic.name.as_bytes())
            .counted(topic.encoding.as_bytes())
            .counted(b"");
        self.record(SCHEMA, &schema)?;
        self.record(CHANNEL, &channel)?;
        append(&mut self.schemas, SCHEMA, &schema);
        append(&mut self.channels, CHANNEL, &channel);
        self.counts.push(0);
        Ok(number)
    }

    /// Writes messages of one time, each with the number of its channel, as a chunk. The times of chunks
    /// must not turn back.
    pub(in crate::formats) fn chunk(
        &mut self,
        time_ns: u64,
        messages: &[(u16, Vec<u8>)],
    ) -> io::Result<()> {
        let mut records = Vec::new();
        // The places of each channel's messages in the chunk.
        let mut places: BTreeMap<u16, Content> = BTreeMap::new();
        for (channel, data) in messages {
            let place = places.entry(*channel).or_default();
            *place = std::mem::take(place).u64(time_ns).u64(records.len() as u64);
            let count = &mut self.counts[usize::from(*channel)];
            let message = Content::default()
                .u16(*channel)
                .u32(*count as u32)
                .u64(time_ns)
                .u64(time_ns)
                .raw(data);
            *count += 1;
            append(&mut records, MESSAGE, &message);
        }
        let (begin, size) = (self.at, records.len() as u64);
        // Without a checksum and a compression.
        let chunk = Content::default()
            .u64(time_ns)
            .u64(time_ns)
            .u64(size)
            .u32(0)
            .counted(b"")
            .u64(size)
            .raw(&records);
        self.record(CHUNK, &chunk)?;
        let end = self.at;
        let mut indices = Content::default();
        for (channel, places) in &places {
            indices = indices.u16(*channel).u64(self.at);
            let index = Content::default().u16(*channel).counted(&places.0);
            self.record(MESSAGE_INDEX, &index)?;
        }
        let index = Content::default()
            .u64(time_ns)
            .u64(time_ns)
            .u64(begin)
            .u64(end - begin)
            .counted(&indices.0)
            .u64(self.at - end)
            .counted(b"")
            .u64(size)
            .u64(size);
        append(&mut self.chunks, CHUNK_INDEX, &index);
        self.chunk_count += 1;
        let first = self.span_ns.map_or(time_ns, |(first, _)| first);
        self.span_ns = Some((first, time_ns));
        Ok(())
    }

    /// Writes the index and the end.
    pub(in crate::formats) fn finish(mut self) -> io::Result<()> {
        self.record(DATA_END, &Content::default().u32(0))?;
        let summary = self.at;
        let (first, last) = self.span_ns.unwrap_or_default();
        let channels = self.counts.len() as u16;
        let counts = (0..).zip(&self.counts);
        let counts = counts.fold(Content::default(), |counts, (channel, &count)| {
            counts.u16(channel).u64(count)
        });
        let statistics = Content::default()
            .u64(self.counts.iter().sum())
            .u16(channels)
            .u32(u32::from(channels))
            // Attachments and metadata.
            .u32(0)
            .u32(0)
            .u32(self.chunk_count)
            .u64(first)
            .u64(last)
            .counted(&counts.0);
        let mut index = std::mem::take(&mut self.schemas);
        index.append(&mut self.channels);
        append(&mut index, STATISTICS, &statistics);
        index.append(&mut self.chunks);
        self.write(&index)?;
        let footer = Content::default().u64(summary).u64(0).u32(0);
        self.record(FOOTER, &footer)?;
        self.write(MAGIC)?;
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::super::chunk::{Unfolded, unfold};
    use super::super::records::{Record, Records, split};
    use super::*;

    #[test]
    fn what_is_written_is_read_and_its_index_leads_to_it() {
        let mut bytes = Vec::new();
        let mut writer = RecordingWriter::start(&mut bytes).expect("memory");
        let topic = |name| Topic {
            name,
            encoding: "json",
            schema_name: "a",
            schema_encoding: "jsonschema",
            schema: b"{}",
        };
        assert_eq!(writer.channel(&topic("/a")).expect("memory"), 0);
        assert_eq!(writer.channel(&topic("/b")).expect("memory"), 1);
        for time_ns in [5, 9] {
            let messages = [(1, vec![1, 2]), (0, vec![3]), (1, vec![time_ns as u8])];
            writer.chunk(time_ns, &messages).expect("memory");
        }
        writer.finish().expect("memory");

        let mut records = Records::open(bytes.as_slice()).expect("a recording");
        let (mut described, mut messages) = (0, Vec::new());
        while let Some(record) = records.read_next().expect("whole records") {
            match record {
                Record::Schema(_) | Record::Channel(_) => described += 1,
                Record::Message(_) => panic!("a message outside of a chunk"),
                Record::Chunk(chunk) => {
                    let chunk = unfold(chunk, &mut Unfolded::default()).expect("records");
                    let mut rest = chunk.as_ref();
                    while let Some(record) = split(&mut rest).expect("whole records") {
                        if let Record::Message(message) = record {
                            messages.push(message.to_vec());
                        }
                    }
                }
            }
        }
        assert_eq!((described, messages.len()), (4, 6));
        // Channel, number in it, time twice, data.
        let last = Content::default().u16(1).u32(3).u64(9).u64(9).raw(&[9]);
        assert_eq!(messages[5], last.0);
        // The footer names the place of the index, which begins with the first schema.
        let footer = &bytes[bytes.len() - MAGIC.len() - 20..];
        let summary = u64::from_le_bytes(footer[..8].try_into().expect("eight bytes"));
        assert_eq!(bytes[summary as usize], SCHEMA);
        assert!(bytes.ends_with(MAGIC));
    }
}
