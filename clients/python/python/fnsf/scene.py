"""Scenes of OpenSceneFlow: the flows of `fnsf label` in the HDF5 file that they were estimated from.

    fnsf unpack scene.h5 -o drives
    fnsf label drives -o labels --preset default --ignore-times
    python -m fnsf.scene scene.h5 labels/scene --name fnsf

Each group of the file then has an array of this name beside `lidar`, which OpenSceneFlow's own scripts take for their
evaluation and pictures. Needs h5py.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

import h5py
import numpy as np
import numpy.typing as npt

from . import _native
from ._files import read_flow


def write_flows(
    scene: str | os.PathLike[str], labels: str | os.PathLike[str], *, name: str = "fnsf"
) -> tuple[int, int]:
    """Writes the flows of a folder into a scene.

    The flow of the sweep STAMP, `labels/STAMP.npz` or `.feather`, becomes the array `STAMP/name`: N x 3 float32 in
    metres, ego motion included. Points without a flow get the ego motion, and NaN where that is not known. An array
    of this name is replaced, if this function wrote it: it has the attribute `fnsf`. All flows are read and checked
    before the file is changed; h5py changes it in place.

    Args:
        scene: HDF5 file with a group for each sweep.
        labels: folder of the flows.
        name: name of the arrays.

    Returns:
        The number of flows that were written, and of sweeps in the file.

    Raises:
        InputError: A flow has not one row for each point, there is no flow of any sweep, or the file has an array of
            this name of its own.
    """
    if not name or "/" in name:
        raise _native.InputError(f"{name!r} is no name of an array")
    with h5py.File(scene, "r") as file:
        stamps = [stamp for stamp in file if stamp.isascii() and stamp.isdigit() and _is_own(file, stamp)]
        found = {stamp: path for stamp in stamps if (path := _label(labels, stamp))}
        for stamp, path in found.items():
            _rows(path, file[stamp]["lidar"])
            if name in file[stamp] and "fnsf" not in file[stamp][name].attrs:
                raise _native.InputError(f"{stamp}/{name} is an array of the data set itself")
    if not found:
        raise _native.InputError(f"{os.fspath(labels)} has no flow of a sweep in {os.fspath(scene)}")
    with h5py.File(scene, "r+") as file:
        for stamp, path in found.items():
            group = file[stamp]
            rows = _rows(path, group["lidar"])
            if name in group:
                del group[name]
            group.create_dataset(name, data=rows).attrs["fnsf"] = True
    return len(found), len(stamps)


def _is_own(file: h5py.File, stamp: str) -> bool:
    """Whether a sweep lies in this file. A link may lead to another one, which would be changed."""
    if not isinstance(file.get(stamp, getlink=True), h5py.HardLink) or not isinstance(file[stamp], h5py.Group):
        return False
    group = file[stamp]
    return isinstance(group.get("lidar", getlink=True), h5py.HardLink) and group.file == file


def _label(labels: str | os.PathLike[str], stamp: str) -> str | None:
    paths = (os.path.join(labels, f"{stamp}.{ending}") for ending in ("npz", "feather"))
    return next((path for path in paths if os.path.exists(path)), None)


def _rows(path: str, lidar: h5py.Dataset) -> npt.NDArray[np.float32]:
    """The rows of a flow, one for each point."""
    flow = read_flow(path)
    if len(flow.flow) != len(lidar):
        raise _native.InputError(f"{path} has {len(flow.flow)} rows, and its sweep {len(lidar)} points")
    rows = np.array(flow.flow, dtype=np.float32)
    missing = ~flow.valid
    if flow.ego is None:
        rows[missing] = np.nan
    elif missing.any():
        points = lidar[:][missing, :3].astype(np.float64)
        rows[missing] = points @ flow.ego[:3, :3].T + flow.ego[:3, 3] - points
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m fnsf.scene", description="Write the flows of fnsf label into a scene of OpenSceneFlow."
    )
    parser.add_argument("scene", help="HDF5 file; it is changed in place")
    parser.add_argument("labels", help="folder with STAMP.npz or STAMP.feather")
    parser.add_argument("--name", default="fnsf", help="name of the arrays (default: %(default)s)")
    given = parser.parse_args(arguments)
    try:
        written, sweeps = write_flows(given.scene, given.labels, name=given.name)
    except (OSError, _native.InputError) as error:
        parser.exit(65, f"fnsf: {error}\n")
    print(f"{given.scene}: {written} flows of {sweeps} sweeps, as {given.name}")


if __name__ == "__main__":
    main()
