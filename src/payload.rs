//! Binary encoding of the stored data of a job: clouds, flow and dense cloud.
//!
//! Versioned and little endian. Counts are checked against the bytes present, and a checksum over
//! all bytes detects truncated or altered files. Independent of the storage.

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use crate::flow::{
    Cluster, DenseCloud, Estimate, Objects, OrientedBox, Point, RigidTransform, Solution,
};
use crate::formats::{SweepTime, TimeUnit};

const CLOUD: &[u8; 8] = b"fnsfcld3";
const FLOW: &[u8; 8] = b"fnsfflw4";
const DENSE: &[u8; 8] = b"fnsfdns1";

/// Bytes of the checksum at the end: the first 16 bytes of the BLAKE3 hash.
const SUM: usize = 16;

/// The bytes are damaged or have another format version.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("stored bytes are damaged or of another version: {0}")]
pub struct CorruptPayload(&'static str);

/// One stored sweep of N points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StoredCloud {
    /// N x 3 coordinates, metres, in the sensor frame. Points without a return are NaN.
    pub points: Vec<Point>,
    /// N flags: which points are ground, if known.
    pub ground: Option<Vec<bool>>,
    /// The time of recording, if known.
    pub time: Option<SweepTime>,
    /// The pose `world_from_sensor`, translation in metres, if known.
    pub pose: Option<RigidTransform>,
}

/// The stored flow of a pair with N source points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StoredFlow {
    /// N x 3 displacements from the source sweep's time to the target's, metres, ego motion
    /// included. Zero where `valid` is false.
    pub flow: Vec<Point>,
    /// N flags: which rows have a flow.
    pub valid: Vec<bool>,
    /// N flags: true for points whose residual motion is at least 0.05 m, if the ego motion is
    /// known.
    pub dynamic: Option<Vec<bool>>,
    /// Clusters of the points, confidence of their flow and probabilities that they move, if known.
    pub objects: Option<Objects>,
    /// The ego motion target_from_source, translation in metres, if known.
    pub ego: Option<RigidTransform>,
}

impl StoredCloud {
    /// Encodes the cloud. If its lists differ in length, the bytes cannot be decoded.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = Writer::new(CLOUD, self.points.len(), 13 * self.points.len());
        out.points(&self.points);
        out.flags(self.ground.as_deref());
        out.time(self.time);
        out.motion(self.pose.as_ref());
        out.finish()
    }

    /// Decodes a cloud.
    ///
    /// # Errors
    /// [`CorruptPayload`] if the bytes are damaged or of another version.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CorruptPayload> {
        let mut reader = Reader::new(CLOUD, bytes)?;
        let cloud = Self {
            points: reader.points()?,
            ground: reader.flags()?,
            time: reader.time()?,
            pose: reader.motion()?,
        };
        reader.finish()?;
        Ok(cloud)
    }
}

impl StoredFlow {
    /// Encodes the flow. If its lists differ in length, the bytes cannot be decoded.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = Writer::new(FLOW, self.flow.len(), 26 * self.flow.len());
        out.points(&self.flow);
        out.flags(Some(&self.valid));
        out.flags(self.dynamic.as_deref());
        out.objects(self.objects.as_ref());
        out.motion(self.ego.as_ref());
        out.finish()
    }

    /// Decodes a flow.
    ///
    /// # Errors
    /// [`CorruptPayload`] if the bytes are damaged or of another version.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CorruptPayload> {
        let mut reader = Reader::new(FLOW, bytes)?;
        let flow = reader.points()?;
        let valid = reader.flags()?.ok_or(CorruptPayload("no mask"))?;
        let stored = Self {
            flow,
            valid,
            dynamic: reader.flags()?,
            objects: reader.objects()?,
            ego: reader.motion()?,
        };
        reader.finish()?;
        Ok(stored)
    }
}

/// The stored dense cloud of a sequence, with its points in metres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StoredDense(pub DenseCloud);

impl StoredDense {
    /// Encodes the dense cloud. If its lists differ in length, the bytes cannot be decoded.
    pub fn to_bytes(&self) -> Vec<u8> {
        let Self(cloud) = self;
        let mut out = Writer::new(DENSE, cloud.points.len(), 22 * cloud.points.len());
        out.points(&cloud.points);
        out.words(cloud.sweep.iter().copied());
        out.words(cloud.age.iter().map(|age| age.to_bits()));
        out.flags(Some(&cloud.dynamic));
        out.flags(Some(&cloud.converged));
        out.finish()
    }

    /// Decodes a dense cloud.
    ///
    /// # Errors
    /// [`CorruptPayload`] if the bytes are damaged or of another version.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, CorruptPayload> {
        let mut reader = Reader::new(DENSE, bytes)?;
        let points = reader.points()?;
        let sweep = reader.words()?.collect();
        let age = reader.words()?.map(f32::from_bits).collect();
        let cloud = DenseCloud {
            points,
            sweep,
            age,
            dynamic: reader.flags()?.ok_or(CorruptPayload("no mask"))?,
            converged: reader.flags()?.ok_or(CorruptPayload("no mask"))?,
        };
        reader.finish()?;
        Ok(Self(cloud))
    }
}

impl From<Estimate> for StoredFlow {
    fn from(estimate: Estimate) -> Self {
        Self {
            flow: estimate.flow,
            valid: estimate.valid,
            dynamic: estimate.dynamic,
            objects: match estimate.solution {
                Solution::Objects(solution) => Some(solution.objects),
                Solution::Field(_) => None,
            },
            ego: estimate.ego,
        }
    }
}

struct Writer(Vec<u8>);

impl Writer {
    fn new(magic: &[u8], rows: usize, expected: usize) -> Self {
        let mut bytes = Vec::with_capacity(expected + 256);
        bytes.extend(magic);
        bytes.extend((rows as u64).to_le_bytes());
        Self(bytes)
    }

    fn points(&mut self, points: &[Point]) {
        put_points(points, &mut self.0);
    }

    fn flags(&mut self, flags: Option<&[bool]>) {
        self.0.push(u8::from(flags.is_some()));
        self.0
            .extend(flags.unwrap_or_default().iter().map(|&flag| u8::from(flag)));
    }

    fn words(&mut self, words: impl Iterator<Item = u32>) {
        self.0.extend(words.flat_map(u32::to_le_bytes));
    }

    fn objects(&mut self, objects: Option<&Objects>) {
        self.0.push(u8::from(objects.is_some()));
        let Some(objects) = objects else {
            return;
        };
        self.words(objects.cluster.iter().map(|id| id.cast_unsigned()));
        let probabilities = objects.confidence.iter().chain(&objects.moving);
        self.words(probabilities.map(|probability| probability.to_bits()));
        self.0.extend((objects.clusters.len() as u64).to_le_bytes());
        for cluster in &objects.clusters {
            self.words([cluster.points, u32::from(cluster.dynamic)].into_iter());
            let (bounds, velocity) = (&cluster.bounds, &cluster.velocity);
            let values = [&bounds.center, &bounds.size, velocity]
                .into_iter()
                .flatten();
            let values = values.chain([&bounds.yaw, &cluster.yaw_rate]);
            let values = values.chain([&cluster.confidence, &cluster.moving]);
            self.words(values.map(|value| value.to_bits()));
        }
    }

    fn motion(&mut self, motion: Option<&RigidTransform>) {
        self.0.push(u8::from(motion.is_some()));
        if let Some(motion) = motion {
            let (translation, rotation) = (motion.translation.vector, motion.rotation.coords);
            let values = translation.iter().chain(&rotation);
            self.0.extend(values.flat_map(|value| value.to_le_bytes()));
        }
    }

    fn time(&mut self, time: Option<SweepTime>) {
        let (unit, ticks) = match time {
            None => (0, 0),
            Some(SweepTime { ticks, unit }) => match unit {
                TimeUnit::Nanoseconds => (1, ticks),
                TimeUnit::Microseconds => (2, ticks),
                TimeUnit::Milliseconds => (3, ticks),
            },
        };
        self.0.push(unit);
        self.0.extend(ticks.to_le_bytes());
    }

    fn finish(mut self) -> Vec<u8> {
        let sum = blake3::hash(&self.0);
        self.0.extend(&sum.as_bytes()[..SUM]);
        self.0
    }
}

struct Reader<'a> {
    rows: usize,
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    fn new(magic: &[u8], bytes: &'a [u8]) -> Result<Self, CorruptPayload> {
        let body = bytes
            .len()
            .checked_sub(SUM)
            .ok_or(CorruptPayload("too short"))?;
        let (body, sum) = bytes.split_at(body);
        if blake3::hash(body).as_bytes()[..SUM] != *sum {
            return Err(CorruptPayload("the sum is wrong"));
        }
        let rest = body
            .strip_prefix(magic)
            .ok_or(CorruptPayload("the beginning is wrong"))?;
        let mut reader = Self { rows: 0, rest };
        let rows = u64::from_le_bytes(reader.array()?);
        reader.rows = usize::try_from(rows).map_err(|_| CorruptPayload("too many rows"))?;
        Ok(reader)
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], CorruptPayload> {
        let (taken, rest) = self
            .rest
            .split_at_checked(count)
            .ok_or(CorruptPayload("too short"))?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], CorruptPayload> {
        let taken = self.take(N)?;
        taken.try_into().map_err(|_| CorruptPayload("too short"))
    }

    fn points(&mut self) -> Result<Vec<Point>, CorruptPayload> {
        let bytes = self
            .rows
            .checked_mul(12)
            .ok_or(CorruptPayload("too many rows"))?;
        Ok(points_from_le_bytes(self.take(bytes)?))
    }

    fn flags(&mut self) -> Result<Option<Vec<bool>>, CorruptPayload> {
        let [there] = self.array()?;
        if there == 0 {
            return Ok(None);
        }
        let flags = self.take(self.rows)?;
        Ok(Some(flags.iter().map(|&flag| flag != 0).collect()))
    }

    fn words(&mut self) -> Result<impl Iterator<Item = u32> + 'a, CorruptPayload> {
        let bytes = self
            .rows
            .checked_mul(4)
            .ok_or(CorruptPayload("too many rows"))?;
        let (words, _) = self.take(bytes)?.as_chunks::<4>();
        Ok(words.iter().map(|word| u32::from_le_bytes(*word)))
    }

    fn objects(&mut self) -> Result<Option<Objects>, CorruptPayload> {
        const WORDS: usize = 15;
        let [there] = self.array()?;
        if there == 0 {
            return Ok(None);
        }
        let cluster = self.words()?.map(u32::cast_signed).collect();
        let confidence = self.words()?.map(f32::from_bits).collect();
        let moving = self.words()?.map(f32::from_bits).collect();
        let count = u64::from_le_bytes(self.array()?);
        let bytes = usize::try_from(count).ok();
        let bytes = bytes.and_then(|count| count.checked_mul(4 * WORDS));
        let described = self.take(bytes.ok_or(CorruptPayload("too many clusters"))?)?;
        let (described, _) = described.as_chunks::<{ 4 * WORDS }>();
        let clusters = described.iter().map(|described| {
            let word = |at: usize| {
                let bytes = core::array::from_fn(|byte| described[4 * at + byte]);
                u32::from_le_bytes(bytes)
            };
            let value = |at: usize| f32::from_bits(word(at));
            let point = |at: usize| [value(at), value(at + 1), value(at + 2)];
            Cluster {
                points: word(0),
                dynamic: word(1) != 0,
                bounds: OrientedBox {
                    center: point(2),
                    size: point(5),
                    yaw: value(11),
                },
                velocity: point(8),
                yaw_rate: value(12),
                confidence: value(13),
                moving: value(14),
            }
        });
        Ok(Some(Objects {
            cluster,
            confidence,
            moving,
            clusters: clusters.collect(),
        }))
    }

    fn motion(&mut self) -> Result<Option<RigidTransform>, CorruptPayload> {
        let [there] = self.array()?;
        if there == 0 {
            return Ok(None);
        }
        let mut values = [0.0; 7];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array()?);
        }
        let [x, y, z, i, j, k, w] = values;
        // The same bits as before: not normalized again.
        let rotation = UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k));
        let translation = Translation3::new(x, y, z);
        Ok(Some(RigidTransform::from_parts(translation, rotation)))
    }

    fn time(&mut self) -> Result<Option<SweepTime>, CorruptPayload> {
        let [unit] = self.array()?;
        let ticks = u64::from_le_bytes(self.array()?);
        let unit = match unit {
            0 => return Ok(None),
            1 => TimeUnit::Nanoseconds,
            2 => TimeUnit::Microseconds,
            3 => TimeUnit::Milliseconds,
            _ => return Err(CorruptPayload("no unit of time")),
        };
        Ok(Some(SweepTime { ticks, unit }))
    }

    fn finish(self) -> Result<(), CorruptPayload> {
        if self.rest.is_empty() {
            Ok(())
        } else {
            Err(CorruptPayload("too long"))
        }
    }
}

/// Points as packed little-endian float32 triples: x, y, z; 12 bytes each.
pub fn points_to_le_bytes(points: &[Point]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(size_of_val(points));
    put_points(points, &mut bytes);
    bytes
}

fn put_points(points: &[Point], bytes: &mut Vec<u8>) {
    if cfg!(target_endian = "little") {
        bytes.extend_from_slice(bytemuck::cast_slice(points));
    } else {
        let values = points.as_flattened().iter();
        bytes.extend(values.flat_map(|value| value.to_le_bytes()));
    }
}

/// Decodes packed little-endian float32 triples (x, y, z; 12 bytes each) as points. The bytes of an
/// incomplete triple at the end are ignored.
pub fn points_from_le_bytes(bytes: &[u8]) -> Vec<Point> {
    const POINT: usize = size_of::<Point>();
    let mut points: Vec<Point> = vec![[0.0; 3]; bytes.len() / POINT];
    let whole = &bytes[..points.len() * POINT];
    bytemuck::cast_slice_mut::<Point, u8>(&mut points).copy_from_slice(whole);
    if cfg!(target_endian = "big") {
        for value in points.as_flattened_mut() {
            *value = f32::from_bits(value.to_bits().swap_bytes());
        }
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow() -> StoredFlow {
        StoredFlow {
            flow: vec![[1.0, -2.0, 0.5], [0.0; 3]],
            valid: vec![true, false],
            dynamic: Some(vec![false, true]),
            objects: Some(Objects {
                cluster: vec![0, Objects::NONE],
                confidence: vec![0.875, 0.0],
                moving: vec![0.25, 0.0],
                clusters: vec![Cluster {
                    points: 1,
                    dynamic: true,
                    bounds: OrientedBox {
                        center: [1.0, 2.0, 3.0],
                        size: [4.0, 5.0, 6.0],
                        yaw: 7.0,
                    },
                    velocity: [8.0, 9.0, 10.0],
                    yaw_rate: 11.0,
                    confidence: 0.5,
                    moving: 0.375,
                }],
            }),
            ego: Some(RigidTransform::new(
                [1.0, 2.0, 3.0].into(),
                [0.0, 0.0, 0.1].into(),
            )),
        }
    }

    #[test]
    fn clouds_and_flows_come_back_bit_for_bit() {
        let cloud = StoredCloud {
            points: vec![[1.5, f32::MIN_POSITIVE, -3.0]],
            ground: Some(vec![true]),
            time: SweepTime::from_name("315966265259836000.feather"),
            pose: flow().ego,
        };
        assert!(cloud.time.is_some());
        assert_eq!(StoredCloud::from_bytes(&cloud.to_bytes()), Ok(cloud));
        let stored = flow();
        let back = StoredFlow::from_bytes(&stored.to_bytes()).expect("good bytes");
        assert_eq!(back, stored);
    }

    #[test]
    fn a_dense_cloud_comes_back_bit_for_bit() {
        let stored = StoredDense(DenseCloud {
            points: vec![[1.0, -2.0, 0.5], [0.0; 3]],
            sweep: vec![0, 7],
            age: vec![0.25, -6.75],
            dynamic: vec![true, false],
            converged: vec![true, false],
        });
        let bytes = stored.to_bytes();
        assert_eq!(StoredDense::from_bytes(&bytes), Ok(stored));
        assert!(StoredDense::from_bytes(&bytes[..bytes.len() - 1]).is_err());
    }

    #[test]
    fn torn_and_edited_bytes_are_refused() {
        let bytes = flow().to_bytes();
        for end in 0..bytes.len() {
            assert!(StoredFlow::from_bytes(&bytes[..end]).is_err(), "{end}");
        }
        for at in 0..bytes.len() {
            let mut edited = bytes.clone();
            edited[at] ^= 1;
            assert!(StoredFlow::from_bytes(&edited).is_err(), "{at}");
        }
        assert!(StoredCloud::from_bytes(&bytes).is_err());
        assert!(StoredDense::from_bytes(&bytes).is_err());
    }
}
