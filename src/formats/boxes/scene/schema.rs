//! The messages of Foxglove's schemas, and what describes them in a recording: a `FileDescriptorSet` of
//! protocol buffers.

use super::protobuf::Message;

const PACKAGE: &str = "foxglove";

/// A message a line: its name, and the name, type and number of each field. A list has `*` before its type.
const MESSAGES: &str = "\
Vector3: x double 1, y double 2, z double 3
Point3: x double 1, y double 2, z double 3
Quaternion: x double 1, y double 2, z double 3, w double 4
Pose: position Vector3 1, orientation Quaternion 2
Color: r double 1, g double 2, b double 3, a double 4
KeyValuePair: key string 1, value string 2
PackedElementField: name string 1, offset fixed32 2, type NumericType 3
PointCloud: timestamp google.protobuf.Timestamp 1, frame_id string 2, pose Pose 3, point_stride fixed32 4, fields *PackedElementField 5, data bytes 6
FrameTransform: timestamp google.protobuf.Timestamp 1, parent_frame_id string 2, child_frame_id string 3, translation Vector3 4, rotation Quaternion 5
ArrowPrimitive: pose Pose 1, shaft_length double 2, shaft_diameter double 3, head_length double 4, head_diameter double 5, color Color 6
CubePrimitive: pose Pose 1, size Vector3 2, color Color 3
SpherePrimitive: pose Pose 1, size Vector3 2, color Color 3
CylinderPrimitive: pose Pose 1, size Vector3 2, bottom_scale double 3, top_scale double 4, color Color 5
LinePrimitive: type Type 1, pose Pose 2, thickness double 3, scale_invariant bool 4, points *Point3 5, color Color 6, colors *Color 7, indices *fixed32 8
TriangleListPrimitive: pose Pose 1, points *Point3 2, color Color 3, colors *Color 4, indices *fixed32 5
TextPrimitive: pose Pose 1, billboard bool 2, font_size double 3, scale_invariant bool 4, color Color 5, text string 6
ModelPrimitive: pose Pose 1, scale Vector3 2, color Color 3, override_color bool 4, url string 5, media_type string 6, data bytes 7
SceneEntityDeletion: timestamp google.protobuf.Timestamp 1, type Type 2, id string 3
SceneEntity: timestamp google.protobuf.Timestamp 1, frame_id string 2, id string 3, lifetime google.protobuf.Duration 4, frame_locked bool 5, metadata *KeyValuePair 6, arrows *ArrowPrimitive 7, cubes *CubePrimitive 8, spheres *SpherePrimitive 9, cylinders *CylinderPrimitive 10, lines *LinePrimitive 11, triangles *TriangleListPrimitive 12, texts *TextPrimitive 13, models *ModelPrimitive 14
SceneUpdate: deletions *SceneEntityDeletion 1, entities *SceneEntity 2";

/// The enumerations: their message, their name, and their values from 0.
const ENUMERATIONS: [(&str, &str, &[&str]); 3] = [
    (
        "PackedElementField",
        "NumericType",
        &[
            "UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64",
        ],
    ),
    (
        "LinePrimitive",
        "Type",
        &["LINE_STRIP", "LINE_LOOP", "LINE_LIST"],
    ),
    ("SceneEntityDeletion", "Type", &["MATCHING_ID", "ALL"]),
];

/// `PackedElementField.NumericType.FLOAT32`.
pub(super) const FLOAT32: u64 = 7;

/// The numbers of scalar types in a `FieldDescriptorProto`.
const SCALARS: [(&str, u64); 7] = [
    ("double", 1),
    ("int64", 3),
    ("int32", 5),
    ("fixed32", 7),
    ("bool", 8),
    ("string", 9),
    ("bytes", 12),
];
const TYPE_MESSAGE: u64 = 11;
const TYPE_ENUMERATION: u64 = 14;
const LABEL_ONE: u64 = 1;
const LABEL_LIST: u64 = 3;

/// The `FileDescriptorSet` of all messages.
pub(super) fn descriptor_set() -> Vec<u8> {
    let times = [("timestamp", "Timestamp"), ("duration", "Duration")].map(|(name, message)| {
        let message = format!("{message}: seconds int64 1, nanos int32 2");
        let path = format!("google/protobuf/{name}.proto");
        (file(&path, "google.protobuf", &[], &message), path)
    });
    let uses = [times[0].1.as_str(), times[1].1.as_str()];
    let ours = file("foxglove/Scene.proto", PACKAGE, &uses, MESSAGES);
    let files = times.iter().map(|(file, _)| file).chain([&ours]);
    let set = files.fold(Message::default(), |set, file| set.message(1, file));
    set.into_bytes()
}

/// A `FileDescriptorProto`.
fn file(path: &str, package: &str, uses: &[&str], messages: &str) -> Message {
    let file = Message::default().text(1, path).text(2, package);
    let file = uses.iter().fold(file, |file, path| file.text(3, path));
    let messages = messages.lines().map(|line| definition(package, line));
    let file = messages.fold(file, |file, message| file.message(4, &message));
    file.text(12, "proto3")
}

/// A `DescriptorProto` of a line of [`MESSAGES`].
fn definition(package: &str, line: &str) -> Message {
    let (name, fields) = line.split_once(": ").expect("a line has a name");
    let message = Message::default().text(1, name);
    let fields = fields
        .split(", ")
        .map(|field| described(package, name, field));
    let message = fields.fold(message, |message, field| message.message(2, &field));
    let own = ENUMERATIONS.iter().filter(|(of, ..)| *of == name);
    own.fold(message, |message, (_, name, values)| {
        message.message(4, &enumeration(name, values))
    })
}

/// A `FieldDescriptorProto` of the message `of`.
fn described(package: &str, of: &str, field: &str) -> Message {
    let words: Vec<&str> = field.split(' ').collect();
    let [name, kind, number]: [&str; 3] = words.try_into().expect("a field has three words");
    let number: u64 = number.parse().expect("a field has a number");
    let (label, kind) = match kind.strip_prefix('*') {
        Some(kind) => (LABEL_LIST, kind),
        None => (LABEL_ONE, kind),
    };
    let field = Message::default()
        .text(1, name)
        .varint(3, number)
        .varint(4, label);
    if let Some((_, code)) = SCALARS.iter().find(|(name, _)| *name == kind) {
        return field.varint(5, *code);
    }
    let mut enumerations = ENUMERATIONS.iter();
    if enumerations.any(|(message, name, _)| *message == of && *name == kind) {
        let path = format!(".{package}.{of}.{kind}");
        return field.varint(5, TYPE_ENUMERATION).text(6, &path);
    }
    let path = match kind.contains('.') {
        true => format!(".{kind}"),
        false => format!(".{package}.{kind}"),
    };
    field.varint(5, TYPE_MESSAGE).text(6, &path)
}

/// An `EnumDescriptorProto`.
fn enumeration(name: &str, values: &[&str]) -> Message {
    let enumeration = Message::default().text(1, name);
    let values = values.iter().zip(0_u64..);
    let values = values.map(|(name, number)| Message::default().text(1, name).varint(2, number));
    values.fold(enumeration, |all, value| all.message(2, &value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_of_a_field_is_defined_and_no_number_is_used_twice() {
        let lines: Vec<_> = MESSAGES
            .lines()
            .map(|line| line.split_once(": ").expect("a name"))
            .collect();
        for (message, fields) in &lines {
            let mut numbers = Vec::new();
            for field in fields.split(", ") {
                let words: Vec<&str> = field.split(' ').collect();
                let kind = words[1].trim_start_matches('*');
                let known = lines.iter().any(|(name, _)| *name == kind)
                    || SCALARS.iter().any(|(name, _)| *name == kind)
                    || ENUMERATIONS
                        .iter()
                        .any(|(of, name, _)| of == message && *name == kind)
                    || kind.starts_with("google.protobuf.");
                assert!(known, "{message}: {field}");
                numbers.push(words[2].parse::<u32>().expect("a number"));
            }
            assert!(numbers.is_sorted_by(|a, b| a < b), "{message}");
        }
        assert_eq!(ENUMERATIONS[0].2[FLOAT32 as usize], "FLOAT32");
        assert!(!descriptor_set().is_empty());
    }
}
