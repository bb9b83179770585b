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
LONGEST_SWEEP = 1.0
"""Seconds from the first point of a sweep to the last."""
TRANSPOSED_ROWS = range(3, 9)
MOST_COLUMNS = 64
"""An array with so many rows and more columns than this is transposed: its rows are x, y, z and perhaps others."""
LATEST = 1000.0
"""Seconds from the time of a sweep to a point. float32 has steps of less than 0.1 ms up to here."""


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
    if array.shape[0] in TRANSPOSED_ROWS and array.shape[1] > MOST_COLUMNS:
        raise InputError(f"{name} has shape {array.shape}, but each row is a point: pass the transposed array, N x 3")
    return np.require(array[:, :3], dtype=np.float32, requirements=["C", "A"])


def mask(name: str, value: Any, rows: int | None = None) -> Mask:
    """N flags of an array of flags or numbers; all but 0 is true. `rows` is N, where it is known."""
    array = _array(name, value, "bfiu", "flags")
    if array.ndim != 1:
        raise InputError(f"{name} has shape {array.shape}: one flag a point is needed")
    if rows is not None and len(array) != rows:
        raise InputError(f"{name} has {len(array)} rows for {rows} points")
    if array.dtype.kind == "f" and np.isnan(array).any():
        raise InputError(f"{name} has NaN in row {np.isnan(array).argmax()}: flags are needed")
    return np.require(array, dtype=np.bool_, requirements=["C", "A"])


def times(name: str, value: Any, points: Points) -> Values:
    """N float32 seconds after the time of a sweep of N points, of an array of N numbers."""
    array = _array(name, value, "fiu", "numbers")
    if array.ndim != 1:
        raise InputError(f"{name} has shape {array.shape}: one number a point is needed")
    if len(array) != len(points):
        raise InputError(f"{name} has {len(array)} rows for {len(points)} points")
    measured = np.isfinite(points).all(axis=1)
    broken = measured & ~np.isfinite(array)
    if broken.any():
        raise InputError(
            f"{name} has {array[broken][0]} in row {broken.argmax()}: give no times where some are unknown"
        )
    known = array[measured]
    if len(known) and (np.ptp(known) > LONGEST_SWEEP or np.abs(known).max() > LATEST):
        raise InputError(
            f"{name} has {known.min()} to {known.max()}: seconds after the sweep's time, at most 1 s apart, are needed"
        )
    return np.require(array, dtype=np.float32, requirements=["C", "A"])


def matrix(name: str, value: Any) -> Matrix:
    """4 x 4 float64 of a rigid motion."""
    array = _array(name, value, "fiu", "numbers")
    if array.shape != (4, 4):
        raise InputError(f"{name} has shape {array.shape}: 4 x 4 is needed")
    return np.require(array, dtype=np.float64, requirements=["C", "A"])
