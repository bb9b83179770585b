//! A recording: its channels, and the messages with point clouds.

use std::collections::HashMap;
use std::io::Read;
use std::ops::ControlFlow;

use super::chunk;
use super::point_cloud::{PointCloud, RecordedSweep};
use super::records::{self, Record, Records};
use super::wire::{Alignment, KIND, Wire};
use crate::formats::error::{FormatError, shorten};

/// Schemas of point clouds: ROS 2's and ROS 1's name.
const SCHEMAS: [&str; 2] = ["sensor_msgs/msg/PointCloud2", "sensor_msgs/PointCloud2"];

/// The most channels and schemas of a recording.
const MAX_NAMES: usize = 65_536;

/// The most bytes of the name of a schema, a topic or an encoding.
const MAX_NAME: usize = 4 << 10;

/// A message with a point cloud.
#[derive(Clone, Copy, Debug)]
pub struct CloudMessage<'a> {
    /// The topic that it was published on.
    pub topic: &'a str,
    /// When it was recorded, nanoseconds.
    pub logged_ns: u64,
    data: &'a [u8],
    alignment: Alignment,
}

impl CloudMessage<'_> {
    /// Decodes the points.
    ///
    /// # Errors
    /// - `Malformed` for a message that contradicts itself or is cut off.
    /// - `Missing` without fields x, y and z.
    /// - `OutOfRange` for a coordinate over 1e6 m in magnitude.
    /// - `TooLarge` for more than [`MAX_POINTS`](crate::formats::MAX_POINTS) points.
    pub fn sweep(&self) -> Result<RecordedSweep, FormatError> {
        PointCloud::read(self.data, self.alignment)?.sweep()
    }
}

/// A channel whose messages are point clouds.
struct Channel {
    topic: String,
    alignment: Alignment,
}

/// Reads a recording, and gives its point clouds to `take`, in the order of the file, until that breaks.
///
/// # Errors
/// - `Malformed` for a file that is no recording, violates the format, or ends before its end record.
///   The messages before that were taken.
/// - `Unsupported` for a compression that is not known.
/// - `TooLarge` for a record or a chunk over 1 GiB, for a name over 4 KiB, and for chunks that unfold to more
///   than 32 MiB plus 32 times their sizes.
pub fn read_recording<R: Read>(
    recording: R,
    mut take: impl FnMut(&CloudMessage<'_>) -> ControlFlow<()>,
) -> Result<(), FormatError> {
    let mut records = Records::open(recording)?;
    let mut known = Known::default();
    let mut so_far = chunk::Unfolded::default();
    while let Some(record) = records.read_next()? {
        let taken = match record {
            Record::Chunk(chunk) => {
                let unfolded = chunk::unfold(chunk, &mut so_far)?;
                let mut inner = unfolded.as_ref();
                let mut taken = ControlFlow::Continue(());
                while taken.is_continue()
                    && let Some(record) = records::split(&mut inner)?
                {
                    taken = known.meet(record, &mut take)?;
                }
                taken
            }
            record => known.meet(record, &mut take)?,
        };
        if taken.is_break() {
            break;
        }
    }
    Ok(())
}

/// The name of a schema, a topic or an encoding.
fn name<'a>(wire: &mut Wire<'a>) -> Result<&'a str, FormatError> {
    let name = wire.text()?;
    if name.len() > MAX_NAME {
        let length = name.len();
        return Err(KIND.too_large(format!("a name of {length} bytes, {MAX_NAME} are the most")));
    }
    Ok(name)
}

/// The schemas and channels so far.
#[derive(Default)]
struct Known {
    /// Names of schemas by their number.
    schemas: HashMap<u16, String>,
    /// None for channels of other messages.
    channels: HashMap<u16, Option<Channel>>,
}

impl Known {
    fn meet(
        &mut self,
        record: Record<'_>,
        take: &mut impl FnMut(&CloudMessage<'_>) -> ControlFlow<()>,
    ) -> Result<ControlFlow<()>, FormatError> {
        if self.schemas.len() + self.channels.len() > MAX_NAMES {
            return Err(KIND.too_large(format!("it has more than {MAX_NAMES} channels")));
        }
        match record {
            Record::Schema(body) => {
                let mut wire = Wire::packed(body);
                let id = wire.u16()?;
                let name = name(&mut wire)?;
                self.schemas.insert(id, name.to_owned());
            }
            Record::Channel(body) => {
                let mut wire = Wire::packed(body);
                let (id, schema) = (wire.u16()?, wire.u16()?);
                let (topic, encoding) = (name(&mut wire)?, name(&mut wire)?);
                let is_cloud = self
                    .schemas
                    .get(&schema)
                    .is_some_and(|schema| SCHEMAS.contains(&schema.as_str()));
                let alignment = match encoding {
                    "cdr" => Some(Alignment::Cdr),
                    "ros1" => Some(Alignment::Packed),
                    _ => None,
                };
                if is_cloud && alignment.is_none() {
                    let (topic, encoding) = (shorten(topic), shorten(encoding));
                    return Err(KIND
                        .unsupported(format!("the clouds of {topic} are encoded as {encoding}")));
                }
                let channel = alignment.filter(|_| is_cloud).map(|alignment| Channel {
                    topic: topic.to_owned(),
                    alignment,
                });
                self.channels.insert(id, channel);
            }
            Record::Message(body) => {
                let mut wire = Wire::packed(body);
                let channel = wire.u16()?;
                let _sequence = wire.u32()?;
                let logged_ns = wire.u64()?;
                let _published = wire.u64()?;
                let channel = self.channels.get(&channel).ok_or_else(|| {
                    KIND.malformed(format!(
                        "a message is of channel {channel}, which is not declared"
                    ))
                })?;
                if let Some(channel) = channel {
                    return Ok(take(&CloudMessage {
                        topic: &channel.topic,
                        logged_ns,
                        data: wire.rest(),
                        alignment: channel.alignment,
                    }));
                }
            }
            Record::Chunk(_) => return Err(KIND.malformed("a chunk lies in a chunk")),
        }
        Ok(ControlFlow::Continue(()))
    }
}
