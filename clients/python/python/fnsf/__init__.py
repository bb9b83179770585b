"""Scene flow: two lidar sweeps in, the motion of every point out.

    import fnsf
    pair = fnsf.simulate().pair(0)
    flow = fnsf.flow(pair.source, pair.target)
    print(flow, fnsf.evaluate(flow, pair)["epe"])

Points are N x 3 in metres, in the sensor's frame of their sweep. Nothing needs training, a map or a GPU.
"""

from typing import TYPE_CHECKING, Any

from ._dense import DenseCloud, densify
from ._files import Pair, Sweep, read, read_flow, read_pair, read_sweep, write
from ._flow import Flow, flow
from ._native import DeviceError, Error, InputError, Motion, __version__, device_name
from ._options import Options, Preset
from ._sequence import Sequence
from ._tools import Registration, Street, evaluate, ground, register, simulate

if TYPE_CHECKING:
    from .client import Client

__all__ = [
    "Client",
    "DenseCloud",
    "DeviceError",
    "Error",
    "Flow",
    "InputError",
    "Motion",
    "Options",
    "Pair",
    "Preset",
    "Registration",
    "Sequence",
    "Street",
    "Sweep",
    "__version__",
    "densify",
    "device_name",
    "evaluate",
    "flow",
    "ground",
    "read",
    "read_flow",
    "read_pair",
    "read_sweep",
    "register",
    "simulate",
    "write",
]


def __getattr__(name: str) -> Any:
    # The client needs grpcio and protobuf, which the estimates do not.
    if name == "Client":
        from .client import Client

        return Client
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
