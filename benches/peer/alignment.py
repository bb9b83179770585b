"""The ego motion alone, beside small_gicp and KISS-ICP: time and error on pairs with a known pose.

Every program gets the two whole sweeps as they are, from points in memory to the motion in memory, with the same
number of threads, and the identity as its first guess. They take turns in every round. One point is moved by a
millimetre from round to round, so that no program can remember the sweeps of the round before.

    python alignment.py PAIR.npz... --threads 2 --rounds 9

Needs the Python package `fnsf` (`clients/python`), `small_gicp` and `kiss-icp`.
"""

import argparse
import os
import time
from functools import partial
from pathlib import Path
from statistics import median


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", type=Path, help=".npz files with pc1, pc2 and ego_SE3")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=9)
    return parser.parse_args()


ARGUMENTS = parsed()
# KISS-ICP's threads are those of TBB and OpenMP.
os.environ["OMP_NUM_THREADS"] = str(ARGUMENTS.threads)

import fnsf  # noqa: E402
import numpy as np  # noqa: E402
import small_gicp  # noqa: E402
from odometry import by_kiss_icp  # noqa: E402


def by_fnsf(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return fnsf.register(source, target, threads=ARGUMENTS.threads).motion


def by_small_gicp(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """GICP on clouds of 0.25 m voxels, the defaults of its `align`."""
    found = small_gicp.align(
        target,
        source,
        registration_type="GICP",
        downsampling_resolution=0.25,
        max_correspondence_distance=1.0,
        num_threads=ARGUMENTS.threads,
    )
    return found.T_target_source


PROGRAMS = {
    "fnsf": by_fnsf,
    "small_gicp": by_small_gicp,
    "KISS-ICP": partial(by_kiss_icp, threads=ARGUMENTS.threads),
}


def error(found: np.ndarray, truth: np.ndarray, sweep: np.ndarray) -> tuple[float, float, float]:
    """Of the position of the source's origin, metres; of the rotation, degrees; mean of the points, metres."""
    off = np.linalg.inv(truth) @ found
    turn = np.degrees(np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    moved = [pose[:3, :3] @ sweep.T + pose[:3, 3:] for pose in (found, truth)]
    return (
        float(np.linalg.norm(off[:3, 3])),
        float(turn),
        float(np.linalg.norm(moved[0] - moved[1], axis=0).mean()),
    )


def main() -> None:
    print(f"{ARGUMENTS.threads} threads, medians of {ARGUMENTS.rounds} rounds in turn\n")
    print("| pair | points | program | ms | shift m | turn deg | points m |")
    print("|---|---|---|---|---|---|---|")
    for path in ARGUMENTS.pairs:
        pair = np.load(path)
        clouds = [np.ascontiguousarray(pair[name], dtype=np.float64) for name in ("pc1", "pc2")]
        clouds = [cloud[np.isfinite(cloud).all(axis=1)] for cloud in clouds]
        truth = np.asarray(pair["ego_SE3"], dtype=np.float64)
        seconds: dict[str, list[float]] = {name: [] for name in PROGRAMS}
        motions: dict[str, np.ndarray] = {}
        for round_ in range(ARGUMENTS.rounds):
            for cloud in clouds:
                cloud[0, 2] += 1e-3 if round_ % 2 else -1e-3
                cloud[round_ + 1, 2] += 1e-3
            for name, program in PROGRAMS.items():
                began = time.perf_counter()
                motions[name] = program(*clouds)
                seconds[name].append(time.perf_counter() - began)
        for name, motion in motions.items():
            shift, turn, mean = error(motion, truth, clouds[0])
            ms = median(seconds[name]) * 1e3
            print(
                f"| {path.parent.name} | {len(clouds[0])} | {name} | {ms:.1f} | {shift:.4f} | {turn:.4f} | {mean:.4f} |"
            )


if __name__ == "__main__":
    main()
