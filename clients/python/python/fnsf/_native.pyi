"""The native part. Arrays are C-contiguous and of the types that are named."""

from collections.abc import Sequence as Listed
from typing import Any, TypeAlias, final

import numpy as np
import numpy.typing as npt

_Points: TypeAlias = npt.NDArray[np.float32]
_Mask: TypeAlias = npt.NDArray[np.bool_]
_Values: TypeAlias = npt.NDArray[np.float32]
_Matrix: TypeAlias = npt.NDArray[np.float64]

__version__: str

class Error(Exception):
    """Any error of fnsf."""

class InputError(Error):
    """The input or its options are refused: sweeps, masks, files, values out of range."""

class DeviceError(Error):
    """The device is missing, has too little memory, or failed."""

@final
class Motion:
    """The motion of any point from the source sweep's time to the target's."""

    def __call__(self, points: _Points, device: str = "auto", threads: int | None = None) -> _Points: ...
    def to_bytes(self) -> bytes: ...
    @staticmethod
    def from_bytes(bytes: bytes) -> Motion: ...
    def __reduce__(self) -> tuple[Any, tuple[bytes]]: ...

@final
class Sequence:
    def __new__(
        cls, options: str, *, device: str = "auto", threads: int | None = None, track: bool = False
    ) -> Sequence: ...
    def push(
        self,
        sweep: _Points,
        *,
        mask: _Mask | None = None,
        times: _Values | None = None,
        ego: _Matrix | None = None,
        dt_s: float | None = None,
        deadline: float | None = None,
        progress: Any = None,
    ) -> list[dict[str, Any]]: ...
    def finish(self, *, deadline: float | None = None, progress: Any = None) -> list[dict[str, Any]]: ...
    def tracks(self) -> npt.NDArray[Any] | None: ...

@final
class Street:
    def __new__(
        cls,
        *,
        seed: int = 0,
        sweeps: int = 2,
        beams: int = 64,
        azimuth_steps: int = 2000,
        movers: int = 24,
        speed: float | None = None,
        rolling: bool = False,
    ) -> Street: ...
    def __len__(self) -> int: ...
    def sweep(self, index: int) -> dict[str, Any]: ...
    def pair(self, index: int) -> dict[str, Any]: ...
    def tracks(self) -> npt.NDArray[Any]: ...

def protocol() -> bytes: ...
def object_types() -> tuple[np.dtype[Any], np.dtype[Any]]: ...
def device_name(name: str, threads: int | None = None) -> str:
    """The name of a device as reports show it. It is opened if it is not open yet."""

def pair_interval(
    names: tuple[str, str], clocks: tuple[tuple[float, float | None] | None, tuple[float, float | None] | None]
) -> float | None: ...
def keeps_ground(options: str) -> bool: ...
def check_options(
    options: str, *, deadline: float | None = None, device: str = "auto", threads: int | None = None
) -> None: ...
def estimate(
    source: _Points,
    target: _Points,
    options: str,
    *,
    masks: tuple[_Mask, _Mask] | None = None,
    times: tuple[_Values, _Values] | None = None,
    deadline: float | None = None,
    device: str = "auto",
    threads: int | None = None,
    progress: Any = None,
) -> dict[str, Any]: ...
def densify(
    sweeps: Listed[tuple[_Points, _Mask | None]],
    options: str,
    *,
    poses: Listed[_Matrix] | None = None,
    device: str = "auto",
    threads: int | None = None,
    progress: Any = None,
) -> dict[str, Any]: ...
def write_dense(name: str, cloud: tuple[_Points, npt.NDArray[np.uint32], _Values, _Mask, _Mask]) -> bytes: ...
def ground(sweep: _Points) -> _Mask: ...
def register(
    source: _Points, target: _Points, prior: _Matrix | None = None, threads: int | None = None
) -> tuple[_Matrix, _Matrix | None]: ...
def evaluate(
    estimated: tuple[_Points, _Mask | None, _Mask | None, _Values | None, _Values | None],
    known: tuple[
        _Points | None,
        _Points,
        _Mask | None,
        _Mask | None,
        _Mask | None,
        npt.NDArray[np.uint8] | None,
        _Mask | None,
    ],
    ego: _Matrix | None = None,
) -> str: ...
def read_sweep(bytes: bytes, name: str) -> dict[str, Any]: ...
def read_pair(bytes: bytes, name: str) -> dict[str, Any]: ...
def read_flow(bytes: bytes, name: str) -> dict[str, Any]: ...
def write_flow(
    name: str,
    flow: tuple[_Points, _Points, _Mask, _Mask | None, _Matrix | None],
    objects: tuple[npt.NDArray[np.int32], _Values, _Values, bytes] | None = None,
) -> bytes: ...
def picture(
    flow: tuple[_Points, _Points, _Mask, _Mask | None, _Matrix | None], clusters: bytes | None = None
) -> bytes: ...
def write_points(name: str, sweep: _Points) -> bytes: ...
