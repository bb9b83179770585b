"""The recording of a sequence, read by MCAP's own reader and compared with Foxglove's own messages."""

import importlib
import math

import numpy as np
import pytest
from google.protobuf import descriptor_pb2
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

LATER = 0.5


@pytest.fixture
def recording(exported, drive, tmp_path):
    poses = tmp_path / "poses.txt"
    poses.write_text("".join(f"1 0 0 {LATER * sweep} 0 1 0 0 0 0 1 0\n" for sweep in range(5)))
    folder, names = exported("mcap", options=("--poses", poses))
    return folder / "scene.mcap", [int(name) for name in names]


def messages(file, topic):
    with open(file, "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(topics=[topic])
        return [(message.log_time, decoded) for _, _, message, decoded in found]


def test_the_index_has_all_messages(recording):
    file, times = recording
    with open(file, "rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    counts = summary.statistics.channel_message_counts
    topics = {channel.topic: counts[number] for number, channel in summary.channels.items()}
    assert topics == {"/lidar": 5, "/objects": 5, "/tf": 5}
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (times[0], times[-1])


def test_clouds_have_the_points_of_the_sweeps(recording, drive):
    file, _ = recording
    for stamp, cloud in messages(file, "/lidar"):
        assert (cloud.timestamp.seconds * 10**9 + cloud.timestamp.nanos, cloud.frame_id) == (stamp, "lidar")
        points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
        assert [(field.name, field.offset, field.type) for field in cloud.fields] == [
            ("x", 0, 7),
            ("y", 4, 7),
            ("z", 8, 7),
        ]
        body = (drive / f"{stamp}.pcd").read_bytes().split(b"DATA binary\n", 1)[1]
        assert points.tobytes() == body


def test_boxes_are_those_of_the_tracks_and_end_with_them(recording, states):
    file, _ = recording
    shown = set()
    for sweep, (_, update) in enumerate(messages(file, "/objects")):
        shown -= {int(deletion.id) for deletion in update.deletions}
        shown |= {int(entity.id) for entity in update.entities}
        expected = {track: state for (track, at), state in states.items() if at == sweep}
        assert shown == set(expected)
        for entity in update.entities:
            state = expected[int(entity.id)]
            (cube,) = entity.cubes
            position = cube.pose.position
            np.testing.assert_allclose([position.x, position.y, position.z], state["center"], atol=1e-6)
            np.testing.assert_allclose([cube.size.x, cube.size.y, cube.size.z], state["size"], atol=1e-6)
            yaw = 2 * math.atan2(cube.pose.orientation.z, cube.pose.orientation.w)
            assert math.remainder(yaw - state["yaw"], 2 * math.pi) == pytest.approx(0, abs=1e-6)
            known = {pair.key: pair.value for pair in entity.metadata}
            assert known["class"] == "Car"
            speed = math.hypot(*state["velocity"][:2])
            assert [arrow.shaft_length for arrow in entity.arrows] == ([pytest.approx(speed)] if speed > 0.3 else [])


def test_the_sensor_moves_with_the_poses(recording):
    file, _ = recording
    for sweep, (_, transform) in enumerate(messages(file, "/tf")):
        assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "lidar")
        assert (transform.translation.x, transform.rotation.w) == (LATER * sweep, 1)


def test_the_messages_are_those_of_foxglove(recording):
    file, _ = recording
    with open(file, "rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
    for schema in schemas:
        described = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
        (own,) = [file for file in described.file if file.package == "foxglove"]
        assert schema.name.removeprefix("foxglove.") in {message.name for message in own.message_type}
        for message in own.message_type:
            module = importlib.import_module(f"foxglove_schemas_protobuf.{message.name}_pb2")
            published = descriptor_pb2.DescriptorProto()
            getattr(module, message.name).DESCRIPTOR.CopyToProto(published)

            def fields(of):
                return {(field.name, field.number, field.type, field.label, field.type_name) for field in of.field}

            def values(of):
                return {(kind.name, value.name, value.number) for kind in of.enum_type for value in kind.value}

            assert fields(message) == fields(published)
            assert values(message) == values(published)
