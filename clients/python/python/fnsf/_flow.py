"""The flow of a pair."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from . import _arrays, _files, _native, _options
from ._arrays import Mask, Matrix, Points, Values

Progress = Callable[[int, int, float | None], object]
"""Called with what is done, how much there is, and the loss, a few times a second."""


@dataclass(frozen=True, eq=False)
class Flow:
    """The motion of every point of a sweep to the next one. Rows keep the order of the source's points.

    Displacements are in metres, from the point's position in the source's frame to its position in the target's frame,
    so the ego motion is in them.
    """

    flow: Points
    """N x 3 displacements; zero in rows without a flow."""
    valid: Mask
    """N flags: the row has a flow."""
    dynamic: Mask | None = None
    """N flags: the point moves at least 0.05 m against the static world. None without an ego motion."""
    ego: Matrix | None = None
    """4 x 4 ego motion target_from_source, metres. None where it was not separated."""
    ego_covariance: Matrix | None = None
    """6 x 6: of the position of the source's origin in the target's frame, metres, and of the rotation, radians."""
    cluster: npt.NDArray[np.int32] | None = None
    """N indices into `clusters`, -1 for none (presets default and label)."""
    confidence: Values | None = None
    """N probabilities that the row's flow is less than 0.05 m off (presets default and label)."""
    moving: Values | None = None
    """N probabilities that the point moves (presets default and label)."""
    clusters: npt.NDArray[Any] | None = None
    """K rows: points, dynamic, center and size (m), yaw (rad), velocity (m/s), yaw_rate (rad/s), confidence, moving."""
    source: Points | None = None
    """N x 3 points that the flow starts from: those given, or deskewed ones. None where a file does not hold them."""
    report: Mapping[str, Any] = field(default_factory=dict)
    """What `fnsf flow --json` reports: stop_reason, seconds by phase, device, warnings, ..."""
    motion: _native.Motion | None = None
    """The motion field; None for a flow that was read or downloaded."""

    def __len__(self) -> int:
        return len(self.flow)

    def __repr__(self) -> str:
        moving = "" if self.dynamic is None else f", {int(self.dynamic.sum())} move"
        return f"<fnsf.Flow of {len(self)} points, {int(self.valid.sum())} with a flow{moving}>"

    def __call__(self, points: Any, *, device: str = "cpu", threads: int | None = None) -> Points:
        """The displacements, N x 3 metres, of any points, N x 3 metres, in the source's frame."""
        if self.motion is None:
            raise _native.Error("this flow has no motion field: it was read from a file or downloaded")
        return self.motion(_arrays.points("points", points), device=device, threads=threads)

    @property
    def stop_reason(self) -> str | None:
        """Why the method ended: completed, converged, max_iterations or deadline."""
        return self.report.get("stop_reason")

    @property
    def seconds(self) -> float | None:
        """Seconds of all phases."""
        seconds = self.report.get("seconds")
        return seconds and seconds["total"]

    @property
    def warnings(self) -> list[str]:
        """What is suspicious about the input, in words."""
        return list(self.report.get("warnings", []))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the flow. The ending gives the format: .npz, .npy, .feather, .ply, .pcd or .json."""
        name = os.path.basename(os.fspath(path))
        _files.put(path, self._written_as(name))

    def to_bytes(self, ending: str = "npz") -> bytes:
        """The bytes of a file with this ending, as `save` writes it."""
        return self._written_as(f"flow.{ending}")

    def _written_as(self, name: str) -> bytes:
        ending = os.path.splitext(name)[1].lower()
        if self.source is None and ending in (".ply", ".pcd"):
            raise _native.Error(
                f"this flow has no source points, which {ending} files hold: save it as .npz, .npy, .feather or .json"
            )
        objects = None
        if self.cluster is not None and self.confidence is not None and self.moving is not None:
            cluster = self.cluster
            if self.clusters is None and ending in (".npz", ".json"):
                # These formats describe the clusters that they number.
                cluster = np.full_like(cluster, -1)
            objects = (cluster, self.confidence, self.moving, self._clusters())
        return _native.write_flow(name, self._columns(), objects)

    def picture(self, path: str | os.PathLike[str]) -> None:
        """Writes a picture of the flow from above as .png, colored by the direction of motion."""
        _files.put(path, self._repr_png_())

    def _repr_png_(self) -> bytes:
        """The picture that a notebook shows."""
        if self.source is None:
            raise _native.Error("this flow has no source points to draw: it was read from a file")
        return _native.picture(self._columns(), self._clusters())

    def _columns(self) -> tuple[Points, Points, Mask, Mask | None, Matrix | None]:
        source = np.full_like(self.flow, np.nan) if self.source is None else self.source
        return source, self.flow, self.valid, self.dynamic, self.ego

    def _clusters(self) -> bytes:
        return b"" if self.clusters is None else self.clusters.tobytes()


def of_answer(answer: dict[str, Any]) -> Flow:
    """The flow of the native part's dictionary."""
    report = json.loads(answer.pop("report"))
    return Flow(report=report, **answer)


def flow(
    pc1: Any,
    pc2: Any,
    *,
    preset: _options.Preset = "default",
    ground: Literal["auto", "keep", "mask"] | tuple[Any, Any] | None = None,
    ego: Any = None,
    seed: int = 0,
    max_points: int | None = None,
    crop_m: float | None = None,
    min_range_m: float | None = None,
    dt_s: float | None = None,
    times: tuple[Any, Any] | None = None,
    deadline: float | None = None,
    threads: int | None = None,
    device: str = "auto",
    precision: Literal["f32", "f16"] = "f32",
    force: bool = False,
    field: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Flow:
    """The motion of every point of `pc1` to `pc2`.

    Args:
        pc1: N x 3 or more numbers: the source sweep, metres, in its sensor's frame. Rows of three NaN have no flow.
        pc2: M x 3 or more numbers: the target sweep, metres, in its own sensor's frame.
        preset: the method. `default` and `label` find rigid motions of objects, the others fit a field.
        ground: `auto`, `keep` or `mask`, as in `Options`; or the ground masks of both sweeps, N and M flags.
            With masks, presets that keep the ground leave its points out.
        ego: `off`, `auto`, or the 4 x 4 matrix target_from_source where it is known.
        seed: of all random choices; the same seed gives the same bits.
        max_points: points that get a flow, drawn at random from a larger cloud.
        crop_m: half the side of a square about the sensor, metres; points outside take no part.
        min_range_m: points nearer to the sensor than this, metres, take no part.
        dt_s: seconds between the sweeps, for velocities and for deskewing. Where not given, the time from the first
            point of the source to the last, because a spinning lidar does not pause; 0.1 without `times`.
        times: N and M seconds after the sweeps' times, with which sweeps are deskewed where they fit better then.
        deadline: seconds, after which the best flow so far is returned.
        threads: CPU threads, 1 to 256; all cores where not given. The result does not depend on it.
        device: `auto`, `cpu`, `gpu` or `gpu:CARD`. `default` and `label` are computed on the CPU.
        precision: `f32`, or `f16` on a GPU whose matrix units pass their self-test.
        force: also estimates pairs that are refused as nonsense.
        field: options of the fit of a field, by the names of the protocol.
        progress: called with what is done, how much there is, and the loss.

    Raises:
        InputError: the sweeps or the options are refused.
        DeviceError: the device is missing, has too little memory, or failed.
        KeyboardInterrupt: Ctrl-C ends the estimate within a fraction of a second.
    """
    source, target = _arrays.points("pc1", pc1), _arrays.points("pc2", pc2)
    masks = None
    if isinstance(ground, tuple):
        first, second = ground
        masks = (_arrays.mask("the ground mask of pc1", first), _arrays.mask("the ground mask of pc2", second))
        ground = _options.of_masks(preset)
    if times is not None:
        first, second = times
        times = (_arrays.times("the times of pc1", first, source), _arrays.times("the times of pc2", second, target))
    options = _options.as_json(
        {
            "preset": preset,
            "ground": ground,
            "ego": ego,
            "seed": seed,
            "max_points": max_points,
            "crop_m": crop_m,
            "min_range_m": min_range_m,
            "dt_s": dt_s,
            "precision": precision,
            "force": force,
            "field": field,
        },
    )
    answer = _native.estimate(
        source,
        target,
        options,
        masks=masks,
        times=times,
        deadline=deadline,
        device=device,
        threads=threads,
        progress=progress,
    )
    return of_answer(answer)


def check(
    *,
    deadline: float | None = None,
    threads: int | None = None,
    device: str = "auto",
    **options: Any,
) -> None:
    """Raises what `flow` raises for options that can be used with no pair. The device is open then."""
    known = _options.as_json({"preset": "default", **options})
    _native.check_options(known, deadline=deadline, device=device, threads=threads)
