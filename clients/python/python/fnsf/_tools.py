"""Ground segmentation, registration, evaluation and simulation."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import _arrays, _native
from ._arrays import Mask, Matrix
from ._files import Pair, Sweep, pair_of
from ._flow import Flow


def ground(points: Any) -> Mask:
    """The flags of the ground points of a sweep, N x 3 metres, x forward and z up, the vehicle near the origin."""
    return _native.ground(_arrays.points("points", points))


class Registration(NamedTuple):
    """A registration of two sweeps."""

    motion: Matrix
    """4 x 4 target_from_source, metres."""
    covariance: Matrix | None
    """6 x 6: of the position of the source's origin (x, y, z, metres) and of the rotation (radians)."""


def register(source: Any, target: Any, *, prior: Any = None, threads: int | None = None) -> Registration:
    """The ego motion between two sweeps, N x 3 and M x 3 metres, by generalized ICP around `prior`."""
    answer = _native.register(
        _arrays.points("source", source),
        _arrays.points("target", target),
        prior=None if prior is None else _arrays.matrix("prior", prior),
        threads=threads,
    )
    return Registration(*answer)


def evaluate(estimated: Any, truth: Pair) -> dict[str, Any]:
    """The scores of a flow against its truth, as `fnsf eval --json` prints them.

    Args:
        estimated: a `Flow`, or N x 3 displacements, metres.
        truth: the pair with its true flow, as `read_pair` and `Street.pair` return it.
    """
    if not isinstance(estimated, Flow):
        displacements = _arrays.points("flow", estimated)
        estimated = Flow(displacements, np.ones(len(displacements), dtype=np.bool_))
    if truth.flow is None:
        raise _native.InputError("the pair has no true flow")
    columns = (estimated.flow, estimated.valid, estimated.dynamic, estimated.confidence, estimated.moving)
    known = (
        truth.source,
        truth.flow,
        truth.valid,
        truth.dynamic,
        truth.foreground,
        truth.category,
        truth.masks[0] if truth.masks else None,
    )
    scores: dict[str, Any] = json.loads(_native.evaluate(columns, known, truth.ego))
    return scores


class Street:
    """A simulated street: sweeps of a spinning lidar, with the true motion of every point."""

    def __init__(self, native: _native.Street) -> None:
        self._native = native

    def __len__(self) -> int:
        """Number of sweeps."""
        return len(self._native)

    def sweep(self, index: int) -> Sweep:
        """A sweep."""
        answer = self._native.sweep(index)
        return Sweep(answer["points"], answer["times"])

    def pose(self, index: int) -> Matrix:
        """The 4 x 4 pose world_from_sensor of a sweep, metres."""
        pose: Matrix = self._native.sweep(index)["pose"]
        return pose

    def pair(self, index: int) -> Pair:
        """Sweep `index` and the next one, with the truth."""
        return pair_of(self._native.pair(index))

    def tracks(self) -> npt.NDArray[Any]:
        """The true tracks of the moving objects, in the form of `Sequence.tracks`."""
        return self._native.tracks()


def simulate(
    sweeps: int = 2,
    *,
    seed: int = 0,
    beams: int = 64,
    azimuth_steps: int = 2000,
    movers: int = 24,
    speed: float | None = None,
    rolling: bool = False,
) -> Street:
    """A simulated street of `sweeps` sweeps, 0.1 s apart. The same arguments give the same street.

    Args:
        sweeps: 1 to 1,000.
        seed: of all random choices.
        beams: lasers, 1 to 256.
        azimuth_steps: columns of a turn, 16 to 8,192.
        movers: moving cars, cyclists and pedestrians, 0 to 256.
        speed: of the sensor's vehicle, m/s; drawn from the seed where not given.
        rolling: measures the columns of a sweep one after the other, so that its points have times.
    """
    return Street(
        _native.Street(
            seed=seed,
            sweeps=sweeps,
            beams=beams,
            azimuth_steps=azimuth_steps,
            movers=movers,
            speed=speed,
            rolling=rolling,
        )
    )
