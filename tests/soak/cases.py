"""The cases of the load: which files are sent with which options, and what an undisturbed server makes of them."""

import hashlib
import io
import json
import zipfile
from array import array
from dataclasses import dataclass, field
from typing import Any

from clouds import WRITERS, npy, npz, sweep

FLOW_FORMATS = {
    "npz": "application/x-npz",
    "npy": "application/x-npy",
    "feather": "application/vnd.apache.arrow.file",
    "ply": "application/x-ply",
    "pcd": "application/x-pcd",
    "f32": "application/octet-stream",
    "json": "application/json",
}
DENSE_FORMATS = {"npz": "application/x-npz", "ply": "application/x-ply", "pcd": "application/x-pcd"}
ARCHIVES = {"zip": "application/zip"}

PAPER = {"preset": "paper", "max_points": 1024, "field": {"max_iterations": 60}}
LONG_PAPER = {"preset": "paper", "max_points": 2048, "field": {"max_iterations": 250}}
NEURAL = {"preset": "neural", "max_points": 512, "field": {"max_iterations": 40}}


@dataclass
class Case:
    """One input with its options.

    `weight` is its share of the load. `error` is the job error of a pair that is refused.
    """

    name: str
    kind: str
    parts: list[tuple[str, str, bytes]]
    options: dict[str, Any]
    points: list[array]
    weight: int = 4
    error: str = ""
    formats: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # The clouds are small: too sparse to overlap by the server's measure.
        if not self.error:
            self.options = {"force": True, **self.options}
        self.formats = {"pair": FLOW_FORMATS, "sequence": ARCHIVES, "dense": DENSE_FORMATS}[self.kind]

    @property
    def rows(self) -> int:
        """Rows of a pair's flow."""
        return len(self.points[0]) // 3


def _pair(name: str, seed: int, points: int, ending: str, options: dict[str, Any], weight: int = 4) -> Case:
    clouds = [sweep(seed, 0, points), sweep(seed, 1, points + 37)]
    if ending == "npz":
        parts = [("source", "pair.npz", npz({"pc1": npy(clouds[0]), "pc2": npy(clouds[1])}))]
    else:
        names = (("source", f"a.{ending}"), ("target", f"b.{ending}"))
        parts = [(part, file, WRITERS[ending](cloud)) for (part, file), cloud in zip(names, clouds, strict=True)]
    return Case(name, "pair", parts, options, clouds, weight)


def _two_streets(name: str, seed: int) -> Case:
    """A pair of two streets: the server refuses it when it looks for the ego motion."""
    clouds = [sweep(seed, 0, 1500), sweep(seed + 1, 0, 1500)]
    parts = [("source", "a.npy", npy(clouds[0])), ("target", "b.npy", npy(clouds[1]))]
    return Case(name, "pair", parts, {}, clouds, 2, "no_overlap")


def _sequence(name: str, seed: int, sweeps: int, points: int, options: dict[str, Any], weight: int = 1) -> Case:
    clouds = [sweep(seed, index, points + 11 * index) for index in range(sweeps)]
    parts = [("sweep", f"{index}.npy", npy(cloud)) for index, cloud in enumerate(clouds)]
    return Case(name, "dense" if "densify" in options else "sequence", parts, options, clouds, weight)


def catalogue(seed: int) -> list[Case]:
    """All cases. The same seed gives the same files."""
    base = seed * 100
    return [
        _pair("default-npy", base + 1, 400, "npy", {}, 6),
        _pair("default-pcd", base + 2, 1500, "pcd", {}, 6),
        _pair("default-ascii", base + 3, 800, "ascii.pcd", {"crop_m": 20.0}, 4),
        _pair("default-bin", base + 4, 3000, "bin", {}, 6),
        _pair("default-ply", base + 5, 6000, "ply", {"seed": 3}, 3),
        _pair("default-npz", base + 6, 2000, "npz", {"ground": "keep"}, 4),
        _pair("neural-npy", base + 7, 700, "npy", NEURAL, 4),
        _pair("neural-ply", base + 8, 2000, "ply", {**NEURAL, "seed": 5}, 3),
        _pair("paper-npy", base + 9, 1500, "npy", PAPER, 4),
        _pair("paper-bin", base + 10, 1200, "bin", {**PAPER, "seed": 11, "ego": "auto"}, 3),
        _pair("long-paper", base + 11, 3000, "npz", LONG_PAPER, 2),
        _two_streets("two-streets", base + 12),
        _sequence("sequence-default", base + 20, 4, 900, {}, 2),
        _sequence("sequence-label", base + 21, 6, 700, {"preset": "label"}),
        _sequence("sequence-neural", base + 22, 3, 500, NEURAL),
        _sequence("dense-default", base + 23, 4, 700, {"densify": {"reference_time": 1.5}}, 2),
        _sequence("dense-paper", base + 24, 3, 600, {**PAPER, "densify": {"reference_time": 1, "substeps": 2}}),
    ]


def digest(form: str, body: bytes) -> dict[str, str]:
    """SHA-256 of each part of a result. What differs between two equal computations is left out: times and ids."""
    if form in ("npz", "zip"):
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            parts: dict[str, str] = {}
            for name in archive.namelist():
                inner = archive.read(name)
                held = digest("npz", inner) if name.endswith(".npz") else {"": hashlib.sha256(inner).hexdigest()}
                parts.update({name + ("/" + key if key else ""): value for key, value in held.items()})
            return parts
    if form == "json":
        view = json.loads(body)
        skipped = ("seconds", "job_id", "device", "report")
        return {
            key: hashlib.sha256(json.dumps(value).encode()).hexdigest()
            for key, value in view.items()
            if key not in skipped
        }
    return {"file": hashlib.sha256(body).hexdigest()}


def differences(expected: dict[str, str], found: dict[str, str]) -> list[str]:
    """Names of the parts that differ or that one of them lacks."""
    return sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
