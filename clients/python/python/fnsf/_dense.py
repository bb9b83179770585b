"""Densification: the sweeps of a sequence as one dense cloud."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from . import _arrays, _files, _native, _options
from ._arrays import Mask, Points, Values
from ._flow import Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True, eq=False)
class DenseCloud:
    """The points of all sweeps at one time: M rows, in the sensor's frame of that time."""

    points: Points
    """M x 3, metres."""
    sweep: npt.NDArray[np.uint32]
    """M: index of the sweep that measured the point."""
    age: Values
    """M: reference time minus the time of the point's sweep, in sweeps."""
    dynamic: Mask
    """M flags: the point moved against the static world."""
    converged: Mask
    """M flags: the position is reliable."""

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"<fnsf.DenseCloud of {len(self)} points, {int(self.dynamic.sum())} move>"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the cloud. The ending gives the format: .npz, .ply, .pcd, .laz or .las."""
        columns = (self.points, self.sweep, self.age, self.dynamic, self.converged)
        _files.put(path, _native.write_dense(os.path.basename(os.fspath(path)), columns))


def densify(
    sweeps: Iterable[Any],
    reference_time: float,
    *,
    masks: Iterable[Any] | None = None,
    poses: Iterable[Any] | None = None,
    substeps: int = 1,
    later_sweeps: Literal["reverse", "inverse"] = "reverse",
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[_options.Options],
) -> DenseCloud:
    """Moves the points of all sweeps to `reference_time`, by Euler integration of their flows.

    Args:
        sweeps: two or more, N x 3 metres each, in the order in which they were recorded.
        reference_time: in sweeps from 0; 4.5 is half way from sweep 4 to sweep 5.
        masks: the ground masks of the sweeps. Presets that keep the ground use them with `ground="mask"` alone.
        poses: the 4 x 4 poses world_from_sensor of the sweeps, where they are known.
        substeps: Euler steps from sweep to sweep, 1 to 64.
        later_sweeps: how sweeps after the reference time are moved: through flow estimated backward in time, or by the
            inverse of the flow estimated forward.
        device: as in `flow`.
        threads: as in `flow`.
        progress: called with the pairs that are done, all pairs, and None.
        options: as in `Options`.
    """
    clouds = [_arrays.points(f"sweep {index}", sweep) for index, sweep in enumerate(sweeps)]
    flags: list[Mask | None] = [None] * len(clouds)
    if masks is not None:
        flags = [_arrays.mask(f"the ground mask of sweep {index}", mask) for index, mask in enumerate(masks)]
        if len(flags) != len(clouds):
            raise _native.InputError(f"{len(flags)} masks for {len(clouds)} sweeps")
    asked = {"reference_time": reference_time, "substeps": substeps, "later_sweeps": later_sweeps}
    answer = _native.densify(
        list(zip(clouds, flags, strict=True)),
        _options.as_json(options, densify=asked),
        poses=None if poses is None else [_arrays.matrix("a pose", pose) for pose in poses],
        device=device,
        threads=threads,
        progress=progress,
    )
    return DenseCloud(**answer)
