"""Simulated sweeps of a street, files of them in several formats, and bad files.

A sweep is an `array('f')` with x, y, z of each point in metres. All of it follows from a seed.
"""

import io
import random
import struct
import zipfile
from array import array

Cloud = array

CARS = 4


def sweep(seed: int, index: int, points: int) -> Cloud:
    """Sweep `index` of the street `seed`: ground, two walls and moving cars, seen from a moving vehicle."""
    street = random.Random(seed)
    speed = street.uniform(3.0, 9.0)
    cars = [(street.uniform(-20, 20), street.choice((-4.0, 4.0)), street.uniform(-8, 12)) for _ in range(CARS)]
    # The same places of all surfaces in each sweep, so that sparse sweeps overlap; the noise differs.
    draw, noise = random.Random(seed * 1000), random.Random(seed * 1000 + 1 + index)
    seconds = index * 0.1
    cloud = array("f")
    for row in range(points):
        part = row % 10
        if part < 3:
            x, y, z = draw.uniform(-25, 25), draw.uniform(-8, 8), -1.7
        elif part < 6:
            x, y, z = draw.uniform(-25, 25), draw.choice((-9.0, 9.0)), draw.uniform(-1.7, 3.0)
            y += 0.5 * (int(x) % 5 == 0)
        else:
            at, lane, velocity = cars[row % CARS]
            x = at + velocity * seconds + draw.choice((-2.0, 2.0, draw.uniform(-2, 2)))
            y, z = lane + draw.choice((-0.9, 0.9, draw.uniform(-0.9, 0.9))), draw.uniform(-1.5, 0.0)
        cloud.extend((x - speed * seconds + noise.gauss(0, 0.01), y + noise.gauss(0, 0.01), z + noise.gauss(0, 0.01)))
    return cloud


def npy(cloud: Cloud, rows: int | None = None) -> bytes:
    """numpy's format. `rows` replaces the number of rows in the header."""
    shape = f"({len(cloud) // 3 if rows is None else rows}, 3)"
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    header = header.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + cloud.tobytes()


def npz(arrays: dict[str, bytes]) -> bytes:
    """A compressed archive of npy files."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data)
    return held.getvalue()


def pcd(cloud: Cloud, kind: str, rows: int | None = None) -> bytes:
    """The format of PCL; `kind` is `ascii` or `binary`."""
    count = len(cloud) // 3 if rows is None else rows
    header = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {kind}\n"
    ).encode()
    if kind == "binary":
        return header + cloud.tobytes()
    lines = (" ".join(repr(value) for value in cloud[at : at + 3]) for at in range(0, len(cloud), 3))
    return header + "\n".join(lines).encode() + b"\n"


def kitti(cloud: Cloud) -> bytes:
    """KITTI's format: x, y, z and an intensity."""
    held = array("f")
    for at in range(0, len(cloud), 3):
        held.extend((*cloud[at : at + 3], 0.5))
    return held.tobytes()


def ply(cloud: Cloud, rows: int | None = None) -> bytes:
    """Binary ply. `rows` replaces the number of vertices in the header."""
    count = len(cloud) // 3 if rows is None else rows
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    return (header + "property float x\nproperty float y\nproperty float z\nend_header\n").encode() + cloud.tobytes()


WRITERS = {
    "npy": npy,
    "pcd": lambda cloud: pcd(cloud, "binary"),
    "ascii.pcd": lambda cloud: pcd(cloud, "ascii"),
    "bin": kitti,
    "ply": ply,
}


def bad_files(seed: int) -> dict[str, tuple[str, bytes]]:
    """Files that a server has to refuse, by what is wrong: the name to send and the bytes."""
    draw = random.Random(seed)
    cloud = sweep(seed, 0, 600)
    far, blank = array("f", cloud), array("f", cloud)
    far[30], blank[30] = 1e9, float("nan")
    noise = draw.randbytes(4096)
    zeros = npy(array("f", bytes(48 << 20)))
    whole = npz({"pc1": npy(cloud), "pc2": npy(cloud)})
    bomb = npz({"pc1": zeros, "pc2": npy(cloud)})
    return {
        "empty": ("a.npy", b""),
        "npy cut off": ("a.npy", npy(cloud)[: draw.randrange(200, 5000)]),
        "npy that claims 10^12 rows": ("a.npy", npy(cloud, 10**12)),
        "npy header cut off": ("a.npy", npy(cloud)[:40]),
        "npy with NaN": ("a.npy", npy(blank)),
        "coordinates of 10^9 m": ("a.npy", npy(far)),
        "npz cut off": ("a.npz", whole[: len(whole) // 2]),
        "npz with damage": ("a.npz", whole[:200] + noise[:200] + whole[400:]),
        "npz bomb": ("a.npz", bomb),
        "pcd cut off": ("a.pcd", pcd(cloud, "binary")[: draw.randrange(250, 5000)]),
        "pcd that claims 4 * 10^9 points": ("a.pcd", pcd(cloud, "binary", 4_000_000_000)),
        "ascii pcd of words": ("a.pcd", pcd(cloud, "ascii")[:300] + b"one two three\n"),
        "ply that claims 10^9 points": ("a.ply", ply(cloud, 10**9)),
        "ply header alone": ("a.ply", ply(array("f"), 600)),
        "bin of odd length": ("a.bin", kitti(cloud)[:-3]),
        "random bytes": ("a.pcd", noise),
        "random bytes as bin": ("a.bin", noise),
        "random bytes as feather": ("a.feather", b"ARROW1\0\0" + noise),
        "random bytes as las": ("a.las", b"LASF" + noise),
    }
