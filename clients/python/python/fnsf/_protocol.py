"""The protocol of the service: its messages, made from the descriptors that the wheel was built with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

from . import _arrays, _native
from ._arrays import Mask, Points
from ._dense import DenseCloud
from ._flow import Flow
from ._options import KNOWN

SERVICE = "fnsf.v1.SceneFlow"
CHUNK_POINTS = 48 * 1024
"""48 Ki points and their flags stay below the 1 MiB that the server takes in a message."""


def _load() -> tuple[dict[str, Any], dict[str, Any]]:
    files = descriptor_pb2.FileDescriptorSet.FromString(_native.protocol())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    own = pool.FindFileByName("fnsf/v1/scene_flow.proto")
    named = own.message_types_by_name.items()
    messages = {name: message_factory.GetMessageClass(message) for name, message in named}
    methods = own.services_by_name["SceneFlow"].methods_by_name
    return messages, dict(methods)


MESSAGES, METHODS = _load()
"""The classes of the messages, and the descriptors of the calls, by name."""


def message_class(descriptor: Any) -> Any:
    """The class of a message."""
    return message_factory.GetMessageClass(descriptor)


def nested(message: str, name: str) -> Any:
    """The class of a message inside of another."""
    return message_class(MESSAGES[message].DESCRIPTOR.nested_types_by_name[name])


def word(prefix: str, value: str) -> str:
    """The protocol's name of a word: `nsfp++-dt` of `preset` is PRESET_NSFP_PLUS_PLUS_DT."""
    return f"{prefix}_{value.replace('++', '_plus_plus').replace('-', '_')}".upper()


def plain(message: Any, field: str) -> Any:
    """The word of an enumeration's value, such as `max_iterations`; None where it is not set.

    A value that only a newer protocol has is its number.
    """
    number = getattr(message, field)
    values = message.DESCRIPTOR.fields_by_name[field].enum_type.values_by_number
    if number == 0:
        return None
    if number not in values:
        return str(number)
    # The name of each value begins with that of its enumeration.
    prefix = values[0].name.removesuffix("UNSPECIFIED")
    return values[number].name.removeprefix(prefix).lower()


SUBMITTED = frozenset({"priority", "deadline_ms", "device", "labels", "webhook", "result_uri", "densify"})
"""Options that only a server knows."""


def options_message(options: Mapping[str, Any]) -> Any:
    """The options of a request. The names are those of `Options`, and of `SUBMITTED`."""
    unknown = sorted(set(options) - KNOWN - SUBMITTED)
    if unknown:
        raise TypeError(f"no option {unknown[0]!r}; there are {', '.join(sorted(KNOWN | SUBMITTED))}")
    given = {name: value for name, value in options.items() if value is not None}
    ego = given.pop("ego", None)
    if isinstance(ego, str):
        given["ego"] = word("ego", ego)
    elif ego is not None:
        given["ego_motion"] = _arrays.matrix("ego", ego).ravel().tolist()
    for name in ("preset", "ground", "priority", "device", "precision"):
        if name in given:
            given[name] = word(name, given[name])
    if "densify" in given:
        densify = dict(given["densify"])
        if "later_sweeps" in densify:
            densify["later_sweeps"] = word("later_sweeps", densify["later_sweeps"])
        given["densify"] = densify
    try:
        return json_format.ParseDict(given, MESSAGES["Options"]())
    except json_format.ParseError as error:
        raise _native.InputError(f"options: {error}") from None


def chunks(points: Points, mask: Mask | None) -> Iterator[Any]:
    """A cloud in pieces."""
    for first in range(0, len(points), CHUNK_POINTS):
        piece = points[first : first + CHUNK_POINTS]
        flags = b"" if mask is None else mask[first : first + CHUNK_POINTS].tobytes()
        yield MESSAGES["Chunk"](points=piece.astype("<f4", copy=False).tobytes(), ground=flags)


UNITS = {"metres": "m", "square_metres": "m²", None: ""}
"""The units of losses."""

CLUSTER, STATE = _native.object_types()
"""The types of the arrays of clusters and of tracks."""


def _row(message: Any, dtype: Any, **more: int) -> tuple[Any, ...]:
    values: list[Any] = [more.get(name, getattr(message, name, None)) for name in dtype.names]
    return tuple(value if np.isscalar(value) else tuple(value) for value in values)


def tracks(messages: Iterable[Any]) -> Any:
    """The tracks as a structured array, in the form of `Sequence.tracks`."""
    rows = [_row(state, STATE, id=track.id) for track in messages for state in track.states]
    return np.array(rows, dtype=STATE)


def _joined(pieces: list[Any], name: str, dtype: str) -> Any:
    return np.frombuffer(b"".join(getattr(piece, name) for piece in pieces), dtype=dtype).copy()


def flow(header: Any, pieces: list[Any], source: Points | None) -> Flow:
    """The flow of its header and its pieces."""
    flags = _joined(pieces, "flags", "u1")
    clusters = cluster = confidence = moving = None
    if header.WhichOneof("method") == "objects":
        described = [_row(one, CLUSTER) for piece in pieces for one in piece.clusters]
        clusters = np.array(described, dtype=CLUSTER)
        cluster = _joined(pieces, "cluster", "<i4")
        confidence, moving = _joined(pieces, "confidence", "<f4"), _joined(pieces, "moving", "<f4")
    ego = np.array(header.ego_motion, dtype=np.float64).reshape(4, 4) if header.ego_motion else None
    covariance = header.ego_covariance
    report = json_format.MessageToDict(
        header, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    # 64-bit numbers are strings in protobuf's JSON.
    report.update(points=header.points, valid_points=header.valid_points)
    if header.WhichOneof("method") == "objects":
        report["objects"]["own_points"] = header.objects.own_points
        report["objects"].setdefault("cost_m")
    report["ego_motion"] = None if ego is None else ego.tolist()
    if covariance:
        report["ego_covariance"] = np.reshape(covariance, (6, 6)).tolist()
    else:
        report.pop("ego_covariance", None)
    report.setdefault("overlap")
    if not header.warnings:
        report.pop("warnings", None)
    # The words of the program.
    report["stop_reason"] = plain(header, "stop_reason")
    if header.WhichOneof("method") == "field":
        unit = plain(header.field, "loss_unit")
        report["field"]["loss_unit"] = UNITS.get(unit, unit)
        report["field"].setdefault("best_loss")
    return Flow(
        flow=_joined(pieces, "flow", "<f4").reshape(-1, 3),
        valid=(flags & 1).astype(bool),
        dynamic=(flags & 2).astype(bool) if ego is not None else None,
        ego=ego,
        ego_covariance=np.array(covariance, dtype=np.float64).reshape(6, 6) if covariance else None,
        cluster=cluster,
        confidence=confidence,
        moving=moving,
        clusters=clusters,
        source=source,
        report=report,
    )


def dense(pieces: list[Any]) -> DenseCloud:
    """The dense cloud of its pieces."""
    flags = _joined(pieces, "flags", "u1")
    return DenseCloud(
        points=_joined(pieces, "points", "<f4").reshape(-1, 3),
        sweep=_joined(pieces, "sweep", "<u4"),
        age=_joined(pieces, "age", "<f4"),
        dynamic=(flags & 1).astype(bool),
        converged=(flags & 2).astype(bool),
    )
