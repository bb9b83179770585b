//! Recordings for viewers: the clouds of a sequence, the boxes of its tracks and the motion of the sensor as
//! MCAP with the messages of Foxglove's schemas, in protocol buffers.

mod messages;
mod protobuf;
mod recording;
mod schema;

pub use recording::SceneRecording;
