"""Files: sweeps, pairs and flows, recognized by content."""

from __future__ import annotations

import contextlib
import os
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import _arrays, _native
from ._arrays import Mask, Matrix, Points, Values

if TYPE_CHECKING:
    from ._flow import Flow

MAX_FILE = 4 << 30
"""The largest file that is read, bytes."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """A sweep of N points."""

    points: Points
    """N x 3, metres. A beam without return is a row of NaN."""
    times: Values | None = None
    """N seconds after the sweep's time, where the file has them."""
    time: float | None = None
    """The sweep's time on the sensor's clock, seconds, where the file has it."""
    duration: float | None = None
    """Seconds from the first point to the last, where the file has times."""
    refused_times: str | None = None
    """Why the file's column of times is not used, in words."""

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two sweeps of N and M points, with what is known of the true motion."""

    source: Points
    """N x 3, metres."""
    target: Points
    """M x 3, metres."""
    flow: Points | None = None
    """N x 3 true displacements, metres."""
    valid: Mask | None = None
    """N flags: the true displacement is known."""
    dynamic: Mask | None = None
    """N flags: the point moves against the static world."""
    foreground: Mask | None = None
    """N flags: the point lies on an object."""
    category: npt.NDArray[np.uint8] | None = None
    """N Argoverse 2 categories."""
    masks: tuple[Mask, Mask] | None = None
    """N and M flags: ground points. `flow(..., ground=pair.masks)` takes them."""
    ego: Matrix | None = None
    """4 x 4 ego motion target_from_source, metres."""


def put(path: str | os.PathLike[str], data: bytes) -> None:
    """Writes a file under a temporary name, then renames it: it is there whole, or not at all."""
    folder, name = os.path.split(os.path.abspath(path))
    part = os.path.join(folder, f"{name[:40]}.{uuid.uuid4().hex}.part")
    with open(part, "xb") as file:
        try:
            file.write(data)
            file.flush()
            os.replace(part, path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(part)
            raise


def _bytes(path: str | os.PathLike[str]) -> tuple[bytes, str]:
    with open(path, "rb") as file:
        data = file.read(MAX_FILE + 1)
    if len(data) > MAX_FILE:
        raise _native.InputError(f"{os.fspath(path)}: more than {MAX_FILE} bytes")
    return data, os.fspath(path)


def read(path: str | os.PathLike[str]) -> Points:
    """The points of a sweep, N x 3 metres, of any format that `fnsf flow` reads."""
    return read_sweep(path).points


def read_sweep(path: str | os.PathLike[str]) -> Sweep:
    """A sweep with the times of its points."""
    return Sweep(**_native.read_sweep(*_bytes(path)))


def read_pair(path: str | os.PathLike[str]) -> Pair:
    """The two sweeps of an .npz with pc1 and pc2, and what it has of flow, valid, masks and ego motion."""
    answer = _native.read_pair(*_bytes(path))
    return pair_of(answer)


def pair_of(answer: dict[str, Any]) -> Pair:
    """The pair of the native part's dictionary."""
    masks = answer.pop("masks")
    return Pair(masks=masks and (masks[0], masks[1]), **answer)


def read_flow(path: str | os.PathLike[str]) -> Flow:
    """A flow of any format that `fnsf flow` writes. It has no motion field."""
    from ._flow import Flow

    return Flow(**_native.read_flow(*_bytes(path)))


def write(path: str | os.PathLike[str], points: Any) -> None:
    """Writes a sweep, N x 3 metres. The ending gives the format: .npy, .ply, .pcd, .feather or .bin (KITTI)."""
    put(path, _native.write_points(os.path.basename(os.fspath(path)), _arrays.points("points", points)))
