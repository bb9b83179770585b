"""The options of an estimate: those of the service, by the same names."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, TypedDict

import numpy as np

from . import _arrays, _native
from ._native import InputError

Preset: TypeAlias = Literal[
    "default",
    "label",
    "neural",
    "paper",
    "nsfp",
    "nsfp-baseline",
    "nsfp-kdtree",
    "nsfp++",
    "nsfp++-dt",
    "fnsf-linear",
    "nsfp-linear",
    "nsfp-kdtree-linear",
]
"""The methods; the guide says which to use."""


class Options(TypedDict, total=False):
    """Options of the estimates of `flow`, `Sequence`, `densify` and `Client`.

    preset: the method, `default` where not given.
    seed: of all random choices; the same seed gives the same bits.
    ground: of ground points. `keep`: as any other point. `mask`: the points of the masks take no part. `auto`: they get
        the flow of the ego motion, by the masks or else by ground segmentation.
    ego: the ego motion. `off`: not separated. `auto`: estimated. A 4 x 4 matrix target_from_source: given.
    max_points: points that get a flow, drawn at random from a larger cloud.
    crop_m: half the side of a square about the sensor, metres; points outside take no part.
    min_range_m: points nearer to the sensor than this, metres, take no part.
    dt_s: seconds from one sweep to the next, for velocities.
    force: also estimates pairs that are refused as nonsense.
    precision: `f32`, or `f16` on a GPU whose matrix units pass their self-test.
    field: options of the fit of a field, by the names of the protocol.
    """

    preset: Preset
    seed: int
    ground: Literal["auto", "keep", "mask"] | None
    ego: Any
    max_points: int | None
    crop_m: float | None
    min_range_m: float | None
    dt_s: float | None
    force: bool
    precision: Literal["f32", "f16"]
    field: Mapping[str, Any] | None


KNOWN = frozenset(Options.__annotations__)


def as_json(options: Mapping[str, Any], **more: Any) -> str:
    """The options as the JSON object of the service, without those that are None."""
    unknown = sorted(set(options) - KNOWN)
    if unknown:
        raise TypeError(f"no option {unknown[0]!r}; there are {', '.join(sorted(KNOWN))}")
    named = {name: _plain(name, value) for name, value in {**options, **more}.items() if value is not None}
    return json.dumps(named)


def of_masks(preset: str | None) -> Literal["mask"] | None:
    """The option `ground` of sweeps with masks: presets that keep the ground leave its points out."""
    return "mask" if _native.keeps_ground(as_json({"preset": preset})) else None


def _plain(name: str, value: Any) -> Any:
    if name == "ego" and not isinstance(value, str):
        return _arrays.matrix("ego", value).tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: _plain(key, part) for key, part in value.items() if part is not None}
    if isinstance(value, (bool, int, float, str)):
        return value
    raise InputError(f"option {name} is {value!r}, which has no JSON form")
