"""Seconds to read sweeps from HDF5, MCAP and LAS, beside the usual readers of Python.

    pip install h5py laspy mcap mcap-ros2-support numpy clients/python
    python benches/formats.py target/release/fnsf [--sweeps 40] [--points 120000] [--rounds 5]

`fnsf unpack` also writes the sweeps, as pcd. The others read into numpy arrays. All take turns; medians are printed.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import laspy
import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

import fnsf

FIELDS = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7)]
CLOUD = """std_msgs/Header header
uint32 height
uint32 width
PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def write_scene(path: Path, sweeps: list[np.ndarray], compression: str | None) -> None:
    """A scene as OpenSceneFlow's extraction writes it."""
    with h5py.File(path, "w") as file:
        for index, points in enumerate(sweeps):
            group = file.create_group(str(1_700_000_000_000_000_000 + index * 100_000_000))
            group.create_dataset("lidar", data=points, compression=compression)
            group.create_dataset("ground_mask", data=np.zeros(len(points), bool), compression=compression)
            group.create_dataset("pose", data=np.eye(4, dtype=np.float32))


def write_recording(path: Path, sweeps: list[np.ndarray], compression: CompressionType) -> None:
    """A recording of ROS 2."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=compression)
        schema = writer.register_msgdef("sensor_msgs/msg/PointCloud2", CLOUD)
        for index, points in enumerate(sweeps):
            stamp = 1_700_000_000_000_000_000 + index * 100_000_000
            message = {
                "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "lidar"},
                "height": 1,
                "width": len(points),
                "fields": [{"name": n, "offset": o, "datatype": t, "count": 1} for n, o, t in FIELDS],
                "is_bigendian": False,
                "point_step": 16,
                "row_step": 16 * len(points),
                "data": points.tobytes(),
                "is_dense": True,
            }
            writer.write_message("/lidar", schema, message, stamp, stamp)
        writer.finish()


def write_las(path: Path, sweeps: list[np.ndarray]) -> None:
    points = np.concatenate(sweeps)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points[:, :3].T.astype(np.float64)
    las.write(path)


def read_scene(path: Path) -> None:
    with h5py.File(path) as file:
        for group in file.values():
            for array in group.values():
                array[:]


def read_recording(path: Path) -> None:
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, _, message in reader.iter_decoded_messages():
            np.frombuffer(message.data, np.float32).reshape(-1, 4)[:, :3].copy()


def read_las(path: Path) -> None:
    np.asarray(laspy.read(path).xyz, np.float32)


def seconds(read: Callable[[Path], object], path: Path) -> float:
    began = time.perf_counter()
    read(path)
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description="Seconds to read sweeps, beside the usual readers of Python.")
    parser.add_argument("program", help="fnsf")
    parser.add_argument("--sweeps", type=int, default=40)
    parser.add_argument("--points", type=int, default=120_000, help="of a sweep")
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    numbers = np.random.default_rng(0)
    sweeps = [numbers.normal(0, 20, (given.points, 4)).astype(np.float32) for _ in range(given.sweeps)]

    def unpack(path: Path) -> None:
        with tempfile.TemporaryDirectory() as out:
            subprocess.run([given.program, "unpack", path, "-o", out], check=True, capture_output=True)

    cases = [
        *(
            (f"HDF5, {name}", partial(write_scene, compression=code), unpack, "h5py", read_scene)
            for name, code in [("not compressed", None), ("lzf", "lzf"), ("gzip", "gzip")]
        ),
        *(
            (f"MCAP, {name}", partial(write_recording, compression=code), unpack, "mcap", read_recording)
            for name, code in [
                ("not compressed", CompressionType.NONE),
                ("lz4", CompressionType.LZ4),
                ("zstd", CompressionType.ZSTD),
            ]
        ),
        ("LAS", write_las, fnsf.read, "laspy", read_las),
    ]
    million = given.sweeps * given.points / 1e6
    print(
        "| file | MB | fnsf, seconds | a million points | reader of Python | its seconds |\n|---|---|---|---|---|---|"
    )
    for name, write, ours, reader, theirs in cases:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "file")
            write(path, sweeps)
            # The first round is not counted.
            times = [(seconds(ours, path), seconds(theirs, path)) for _ in range(given.rounds + 1)][1:]
            mine, other = (statistics.median(column) for column in zip(*times, strict=True))
            size = path.stat().st_size / 1e6
            print(f"| {name} | {size:.0f} | {mine:.2f} | {mine / million:.3f} | {reader} | {other:.2f} |", flush=True)


if __name__ == "__main__":
    main()
