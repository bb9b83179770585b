//! The message `sensor_msgs/PointCloud2`: rows of bytes, and fields that say what lies where in a row.

use super::wire::{Alignment, KIND, Wire};
use crate::flow::Point;
use crate::formats::error::FormatError;
use crate::formats::limits::{check_rows, check_value};
use crate::formats::point_times::{PointTimes, TimesColumn};
use crate::formats::scalar::{ByteOrder, Scalar};

/// The most fields of a cloud.
const MAX_FIELDS: u32 = 1024;

const AXES: [&str; 3] = ["x", "y", "z"];

/// The points of one message.
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedSweep {
    /// The time in the message's header, nanoseconds. 0 if the driver sets none.
    pub stamp_ns: u64,
    /// N x 3: x, y, z in metres, finite, in the order of the message.
    pub points: Vec<Point>,
    /// The time of each point. None if the message has none, or the same for all points.
    pub times: Option<PointTimes>,
    /// Why the message's field of times is not used, if it is not that of one sweep.
    pub refused_times: Option<String>,
    /// Number of points that were left out, because a coordinate is NaN or infinite.
    pub dropped: usize,
}

struct Field<'a> {
    name: &'a str,
    offset: usize,
    scalar: Option<Scalar>,
}

/// A cloud whose sizes agree.
pub(super) struct PointCloud<'a> {
    stamp_ns: u64,
    /// Number of lines, and of points in a line.
    height: usize,
    width: usize,
    fields: Vec<Field<'a>>,
    order: ByteOrder,
    /// Bytes from one point to the next, and from one line to the next.
    point_step: usize,
    row_step: usize,
    data: &'a [u8],
}

impl<'a> PointCloud<'a> {
    /// Reads the head of a message, and checks the sizes against the bytes that are there.
    ///
    /// # Errors
    /// `Malformed`, `Unsupported` or `TooLarge`.
    pub(super) fn read(message: &'a [u8], alignment: Alignment) -> Result<Self, FormatError> {
        let mut wire = Wire::message(message, alignment)?;
        if alignment == Alignment::Packed {
            let _sequence = wire.u32()?;
        }
        let (seconds, nanoseconds) = (wire.u32()?, wire.u32()?);
        let _frame = wire.text()?;
        let (height, width) = (wire.u32()? as usize, wire.u32()? as usize);
        let height = if width == 0 { 0 } else { height };
        let count = wire.u32()?;
        if count > MAX_FIELDS {
            return Err(KIND.too_large(format!(
                "a cloud has {count} fields, {MAX_FIELDS} are the most"
            )));
        }
        let mut fields = Vec::new();
        for _ in 0..count {
            let name = wire.text()?;
            let offset = wire.u32()? as usize;
            let scalar = scalar(wire.u8()?);
            let _count = wire.u32()?;
            fields.push(Field {
                name,
                offset,
                scalar,
            });
        }
        let order = match wire.u8()? {
            0 => ByteOrder::Little,
            _ => ByteOrder::Big,
        };
        let (point_step, row_step) = (wire.u32()? as usize, wire.u32()? as usize);
        let data = wire.bytes()?;
        check_rows(KIND, (height as u64).saturating_mul(width as u64))?;
        // Each value is below 2^32, so that none of these overflows.
        let line = width * point_step;
        let needed = (height.saturating_sub(1))
            .saturating_mul(row_step)
            .saturating_add(line);
        if height > 0 && (data.len() < needed || (height > 1 && row_step < line)) {
            return Err(KIND.malformed(format!(
                "a cloud of {height} x {width} points of {point_step} bytes has {} bytes",
                data.len()
            )));
        }
        Ok(Self {
            stamp_ns: u64::from(seconds) * 1_000_000_000 + u64::from(nanoseconds),
            height,
            width,
            fields,
            order,
            point_step,
            row_step,
            data,
        })
    }

    /// Where a field lies in a point, and its type.
    fn field(&self, name: &str) -> Result<(usize, Scalar), FormatError> {
        let found = self.fields.iter().find(|field| field.name == name);
        let present = || {
            let names = self.fields.iter().map(|field| field.name.to_owned());
            names.collect::<Vec<String>>()
        };
        let field = found.ok_or_else(|| KIND.missing(format!("the field {name}"), &present()))?;
        let scalar = field
            .scalar
            .ok_or_else(|| KIND.malformed(format!("the field {name} has an unknown type")))?;
        if field.offset.saturating_add(scalar.size()) > self.point_step {
            return Err(KIND.malformed(format!("the field {name} lies beyond its point")));
        }
        Ok((field.offset, scalar))
    }

    /// Decodes the points. Those with a coordinate that is not finite are counted and left out.
    ///
    /// # Errors
    /// As for `CloudMessage::sweep`.
    pub(super) fn sweep(&self) -> Result<RecordedSweep, FormatError> {
        let [x, y, z] = AXES.map(|axis| self.field(axis));
        let axes = [x?, y?, z?];
        let mut column =
            TimesColumn::find(|name| self.fields.iter().any(|field| field.name == name));
        let time = column
            .as_ref()
            .map(|column| self.field(column.name()))
            .transpose()?;
        let mut points = Vec::new();
        let mut dropped = 0;
        for line in 0..self.height {
            for place in 0..self.width {
                let point = &self.data[line * self.row_step + place * self.point_step..];
                let value = |(offset, scalar): (usize, Scalar)| {
                    let value = point
                        .get(offset..)
                        .and_then(|bytes| scalar.decode(bytes, self.order));
                    value.unwrap_or(f64::NAN)
                };
                let found = axes.map(value);
                if !found.iter().all(|value| value.is_finite()) {
                    dropped += 1;
                    continue;
                }
                let row = points.len();
                let mut checked = [0.0; 3];
                for (axis, value) in found.into_iter().enumerate() {
                    checked[axis] = check_value(KIND, row, AXES[axis], value)?;
                }
                points.push(checked);
                if let (Some(column), Some(time)) = (&mut column, time) {
                    column.push(value(time));
                }
            }
        }
        let read = TimesColumn::used(column);
        Ok(RecordedSweep {
            stamp_ns: self.stamp_ns,
            points,
            times: read.times,
            refused_times: read.refused,
            dropped,
        })
    }
}

/// The type of a field by its number in the message.
fn scalar(number: u8) -> Option<Scalar> {
    let types = [
        Scalar::I8,
        Scalar::U8,
        Scalar::I16,
        Scalar::U16,
        Scalar::I32,
        Scalar::U32,
        Scalar::F32,
        Scalar::F64,
    ];
    types.get(usize::from(number).wrapping_sub(1)).copied()
}
