"""Files to clouds and flows to files. It must not know how they travel.

numpy is imported where a format needs it, so that packed .f32 files go without it.
"""

import sys
from array import array
from dataclasses import dataclass
from pathlib import Path

POINT_BYTES = 12
_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}


class BadFile(Exception):
    """A file is not what its name says."""


@dataclass(frozen=True)
class Cloud:
    """A sweep as it travels: packed little-endian float32 x y z, and perhaps a ground flag a point."""

    points: bytes
    ground: bytes = b""

    def __len__(self):
        return len(self.points) // POINT_BYTES


def _numpy(path):
    try:
        import numpy
    except ImportError:
        raise BadFile(f"{path}: this format needs numpy (pip install numpy); packed .f32 does not") from None
    return numpy


def _packed(np, path, rows):
    if rows.ndim != 2 or rows.shape[1] < 3:
        raise BadFile(f"{path}: points are rows of x y z, not an array of shape {rows.shape}")
    return np.ascontiguousarray(rows[:, :3], dtype="<f4").tobytes()


def read_cloud(path, place="1"):
    """Reads a sweep. `place` says which of an .npz pair's clouds is meant: 1 is pc1, 2 is pc2."""
    path = Path(path)
    readers = {".pcd": _read_pcd, ".npy": _read_npy, ".npz": _read_npz, ".f32": _read_f32}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise BadFile(f"{path}: known are {', '.join(readers)}")
    try:
        return reader(path, place)
    except (ValueError, KeyError, IndexError, EOFError) as error:
        raise BadFile(f"{path}: {error}") from None


def _read_f32(path, _place):
    points = path.read_bytes()
    if len(points) % POINT_BYTES:
        raise BadFile(f"{path}: {len(points)} bytes are not a multiple of {POINT_BYTES}")
    return Cloud(points)


def _read_npy(path, _place):
    np = _numpy(path)
    return Cloud(_packed(np, path, np.load(path, allow_pickle=False)))


def _read_npz(path, place):
    np = _numpy(path)
    with np.load(path, allow_pickle=False) as arrays:
        name = f"pc{place}"
        if name not in arrays:
            names = [name for name in arrays if arrays[name].ndim == 2 and arrays[name].shape[1] == 3]
            if len(names) != 1:
                raise BadFile(f"{path}: has neither pc{place} nor exactly one N x 3 array")
            name = names[0]
        ground = b""
        if f"ground{place}" in arrays:
            ground = arrays[f"ground{place}"].astype("u1").tobytes()
        return Cloud(_packed(np, path, arrays[name]), ground)


def _read_pcd(path, _place):
    np = _numpy(path)
    with path.open("rb") as file:
        header = _pcd_header(path, file)
        fields, sizes, kinds = header["FIELDS"], header["SIZE"], header["TYPE"]
        counts = header.get("COUNT", ["1"] * len(fields))
        points, layout = int(header["POINTS"][0]), header["DATA"][0]
        rows = zip(fields, kinds, sizes, counts, strict=True)
        # Fields may share a name (padding is "_"), which a record may not.
        record = np.dtype(
            [(f"{place} {name}", f"<{_PCD_KINDS[kind]}{size}", (int(count),)) for place, (name, kind, size, count) in enumerate(rows)]
        )
        columns = [f"{fields.index(axis)} {axis}" for axis in "xyz"]
        if layout == "binary":
            data = file.read(points * record.itemsize)
            table = np.frombuffer(data, dtype=record, count=points)
            xyz = [table[column][:, 0] for column in columns]
        elif layout == "ascii":
            starts = np.cumsum([0, *map(int, counts)])
            wanted = [int(starts[fields.index(axis)]) for axis in "xyz"]
            xyz = np.loadtxt(file, dtype="f8", ndmin=2, usecols=wanted, max_rows=points).T
            if len(xyz[0]) != points:
                raise BadFile(f"{path}: has {len(xyz[0])} of {points} points")
        else:
            raise BadFile(f"{path}: DATA {layout} is not read here; ascii and binary are")
    return Cloud(_packed(np, path, np.stack(xyz, axis=1)))


def _pcd_header(path, file):
    header = {}
    while "DATA" not in header:
        line = file.readline(4096)
        if not line:
            raise BadFile(f"{path}: ends within its header")
        words = line.decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header


def write_flow(path, flow):
    """Writes a flow: .npz with everything, .npy or .f32 with the displacements alone."""
    path = Path(path)
    if path.suffix == ".f32":
        path.write_bytes(flow.rows)
        return
    if path.suffix not in (".npz", ".npy"):
        raise BadFile(f"{path}: a flow is written as .npz, .npy or .f32")
    np = _numpy(path)
    rows = np.frombuffer(flow.rows, dtype="<f4").reshape(-1, 3)
    if path.suffix == ".npy":
        np.save(path, rows)
        return
    flags = np.frombuffer(flow.flags, dtype="u1")
    arrays = {"flow": rows, "valid": flags & 1 != 0, "dynamic": flags & 2 != 0}
    if flow.header.ego_motion:
        arrays["ego"] = np.array(flow.header.ego_motion).reshape(4, 4)
    if flow.cluster:
        arrays["cluster"] = np.frombuffer(flow.cluster, dtype="<i4")
        arrays["confidence"] = np.frombuffer(flow.confidence, dtype="<f4")
        arrays["moving"] = np.frombuffer(flow.moving, dtype="<f4")
        arrays.update(_clusters(np, flow.clusters))
    np.savez_compressed(path, **arrays)


def _clusters(np, clusters):
    """The clusters as the arrays that the fnsf program writes."""
    kinds = {"points": "u4", "dynamic": "?", "center": "f4", "size": "f4", "yaw": "f4", "velocity": "f4"}
    kinds |= {"yaw_rate": "f4", "confidence": "f4", "moving": "f4"}
    widths = {name: 3 for name in ("center", "size", "velocity")}

    def column(name, kind):
        values = [getattr(cluster, name) for cluster in clusters]
        return np.array([list(value) if name in widths else value for value in values], dtype=kind)

    shape = {name: (-1, width) for name, width in widths.items()}
    return {f"clusters_{name}": column(name, kind).reshape(shape.get(name, -1)) for name, kind in kinds.items()}


def read_poses(path, sweeps):
    """Poses world_from_sensor as 16 numbers each, from KITTI's text: 12 numbers a line, one line a sweep."""
    lines = [line.split() for line in Path(path).read_text().splitlines() if line.strip()]
    try:
        rows = [[float(word) for word in line] for line in lines]
    except ValueError as error:
        raise BadFile(f"{path}: {error}") from None
    if len(rows) != sweeps or any(len(row) != 12 for row in rows):
        raise BadFile(f"{path}: {sweeps} lines of 12 numbers are needed, one line a sweep")
    return [row + [0.0, 0.0, 0.0, 1.0] for row in rows]


def mean_length(flow):
    """Mean length of the valid rows, metres, and the share that moves against the world."""
    rows = array("f", flow.rows)
    if sys.byteorder == "big":
        rows.byteswap()
    total, valid, moving = 0.0, 0, 0
    for place, flag in enumerate(flow.flags):
        if flag & 1:
            x, y, z = rows[3 * place : 3 * place + 3]
            total += (x * x + y * y + z * z) ** 0.5
            valid += 1
            moving += flag >> 1 & 1
    return total / max(valid, 1), moving / max(valid, 1)
