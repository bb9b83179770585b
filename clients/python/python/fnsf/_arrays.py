"""Conversion of what callers have to the arrays that the native part takes."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ._native import InputError

Points: TypeAlias = npt.NDArray[np.float32]
"""N x 3 float32, metres."""
Mask: TypeAlias = npt.NDArray[np.bool_]
"""N flags."""
Values: TypeAlias = npt.NDArray[np.float32]
"""N float32."""
Matrix: TypeAlias = npt.NDArray[np.float64]
"""4 x 4 or 6 x 6 float64."""


def _array(name: str, value: Any, kinds: str, wanted: str) -> npt.NDArray[Any]:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{name} is no array: {error}") from error
    if array.dtype.kind not in kinds:
        raise InputError(f"{name} has type {array.dtype}: {wanted} are needed")
    return array


def points(name: str, value: Any) -> Points:
    """N x 3 float32 of an array or tensor of N x 3 numbers or more; the first three columns count."""
    array = _array(name, value, "fiu", "numbers")
    if array.ndim != 2 or array.shape[1] < 3:
        raise InputError(f"{name} has shape {array.shape}: N x 3 is needed")
    return np.require(array[:, :3], dtype=np.float32, requirements=["C", "A"])


def mask(name: str, value: Any) -> Mask:
    """N flags of an array of flags or numbers; all but 0 is true."""
    array = _array(name, value, "bfiu", "flags")
    if array.ndim != 1:
        raise InputError(f"{name} has shape {array.shape}: one flag a point is needed")
    return np.require(array, dtype=np.bool_, requirements=["C", "A"])


def values(name: str, value: Any) -> Values:
    """N float32 of an array of N numbers."""
    array = _array(name, value, "fiu", "numbers")
    if array.ndim != 1:
        raise InputError(f"{name} has shape {array.shape}: one number a point is needed")
    return np.require(array, dtype=np.float32, requirements=["C", "A"])


def matrix(name: str, value: Any) -> Matrix:
    """4 x 4 float64 of a rigid motion."""
    array = _array(name, value, "fiu", "numbers")
    if array.shape != (4, 4):
        raise InputError(f"{name} has shape {array.shape}: 4 x 4 is needed")
    return np.require(array, dtype=np.float64, requirements=["C", "A"])
