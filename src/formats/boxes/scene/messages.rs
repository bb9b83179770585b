//! The messages of one sweep.

use super::protobuf::Message;
use super::schema::FLOAT32;
use crate::flow::tracks::{Track, TrackState};
use crate::flow::{Point, RigidTransform};

/// The frame of the clouds and boxes.
const SENSOR: &str = "lidar";
/// The frame that does not move.
const WORLD: &str = "world";

/// Bytes of a point: x, y, z as float32.
const STRIDE: u32 = 12;

/// The slowest object with an arrow, m/s.
const ARROW_FROM_M_S: f64 = 0.3;
/// Opacity of the box of a track that is seen.
const SEEN: f64 = 0.4;
/// Opacity of the box of a track that is hidden.
const HIDDEN: f64 = 0.15;
/// Height of the letters over a box, metres.
const LETTERS_M: f64 = 0.6;

/// Colors of tracks, in turn: red, green and blue.
const COLORS: [[u8; 3]; 8] = [
    [232, 89, 12],
    [34, 139, 230],
    [64, 192, 87],
    [190, 75, 219],
    [250, 176, 5],
    [21, 170, 191],
    [230, 73, 128],
    [130, 201, 30],
];

fn timestamp(ns: u64) -> Message {
    let (seconds, rest) = (ns / 1_000_000_000, ns % 1_000_000_000);
    Message::default().varint(1, seconds).varint(2, rest)
}

fn numbers<const N: usize>(values: [f64; N]) -> Message {
    let values = (1..).zip(values);
    values.fold(Message::default(), |message, (field, value)| {
        message.double(field, value)
    })
}

/// A pose with a rotation about the vertical alone.
fn pose(position: [f64; 3], yaw: f64) -> Message {
    let (sine, cosine) = (yaw / 2.0).sin_cos();
    Message::default()
        .message(1, &numbers(position))
        .message(2, &numbers([0.0, 0.0, sine, cosine]))
}

/// `foxglove.PointCloud` of the points whose coordinates are finite.
pub(super) fn point_cloud(ns: u64, points: &[Point]) -> Message {
    let is_finite = |point: &&Point| point.iter().all(|value| value.is_finite());
    let values = points.iter().filter(is_finite).flatten();
    let data: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
    let cloud = Message::default()
        .message(1, &timestamp(ns))
        .text(2, SENSOR)
        .message(3, &pose([0.0; 3], 0.0))
        .fixed32(4, STRIDE);
    let fields = [("x", 0), ("y", 4), ("z", 8)].map(|(name, offset)| {
        Message::default()
            .text(1, name)
            .fixed32(2, offset)
            .varint(3, FLOAT32)
    });
    let cloud = fields
        .iter()
        .fold(cloud, |cloud, field| cloud.message(5, field));
    cloud.bytes(6, &data)
}

/// `foxglove.FrameTransform` of the sensor in the world.
pub(super) fn transform(ns: u64, world_from_sensor: &RigidTransform) -> Message {
    let (moved, turned) = (&world_from_sensor.translation, &world_from_sensor.rotation);
    Message::default()
        .message(1, &timestamp(ns))
        .text(2, WORLD)
        .text(3, SENSOR)
        .message(4, &numbers([moved.x, moved.y, moved.z]))
        .message(5, &numbers([turned.i, turned.j, turned.k, turned.w]))
}

/// `foxglove.SceneUpdate`: an entity for each box, which replaces that of the sweep before, and the removal of
/// the tracks that have `ended`.
pub(super) fn update(
    ns: u64,
    class: &str,
    boxes: &[(&Track, &TrackState)],
    ended: &[u32],
) -> Message {
    let removed = ended.iter().map(|id| {
        // Of type MATCHING_ID, which is 0.
        Message::default()
            .message(1, &timestamp(ns))
            .text(3, &id.to_string())
    });
    let update = removed.fold(Message::default(), |all, one| all.message(1, &one));
    let entities = boxes
        .iter()
        .map(|(track, state)| entity(ns, class, track.id, state));
    entities.fold(update, |all, one| all.message(2, &one))
}

fn entity(ns: u64, class: &str, id: u32, state: &TrackState) -> Message {
    let bounds = &state.bounds;
    let center = bounds.center.map(f64::from);
    let size = bounds.size.map(f64::from);
    let is_seen = state.points > 0;
    let [vx, vy, _] = state.velocity.map(f64::from);
    let speed = vx.hypot(vy);
    let [red, green, blue] = COLORS[id as usize % COLORS.len()].map(|part| f64::from(part) / 255.0);
    let colored = |opacity: f64| numbers([red, green, blue, opacity]);

    let entity = Message::default()
        .message(1, &timestamp(ns))
        .text(2, SENSOR)
        .text(3, &id.to_string());
    let known = [
        ("class", class.to_owned()),
        ("speed_m_s", format!("{speed:.2}")),
        ("points", state.points.to_string()),
        ("confidence", format!("{:.2}", state.confidence)),
        ("seen", is_seen.to_string()),
    ];
    let entity = known.iter().fold(entity, |entity, (key, value)| {
        entity.message(6, &Message::default().text(1, key).text(2, value))
    });
    let entity = match speed > ARROW_FROM_M_S {
        false => entity,
        // Its shaft is the way of one second.
        true => entity.message(
            7,
            &Message::default()
                .message(1, &pose(center, vy.atan2(vx)))
                .double(2, speed)
                .double(3, 0.12)
                .double(4, 0.5)
                .double(5, 0.35)
                .message(6, &colored(1.0)),
        ),
    };
    let cube = Message::default()
        .message(1, &pose(center, f64::from(bounds.yaw)))
        .message(2, &numbers(size))
        .message(3, &colored(if is_seen { SEEN } else { HIDDEN }));
    let [x, y, z] = center;
    let text = Message::default()
        .message(1, &pose([x, y, z + size[2] / 2.0 + LETTERS_M], 0.0))
        .varint(2, u64::from(true))
        .double(3, LETTERS_M)
        .message(5, &colored(1.0))
        .text(6, &format!("{id}: {speed:.1} m/s"));
    entity.message(8, &cube).message(13, &text)
}
