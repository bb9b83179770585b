"""ICP-Flow (Lin et al., CVPR 2024) on the CPU beside fnsf's `default`: time and error on the same pairs.

The pipeline and its settings for Argoverse 2 are the published ones: HDBSCAN of both sweeps together, matches of
clusters first under one label and then with all others, a histogram of translations, ICP, and tests of the result.
It differs where that makes it faster on a CPU: numpy and scipy's k-d trees stand for PyTorch and pytorch3d, which
compares all points with all. Clusters are handled one pair at a time, without padding to the largest.

    python icp_flow.py PAIR.npz... --fnsf path/to/fnsf --threads 2 --rounds 3

Ground is taken out by the masks of the pair, for both programs. Each has a row with the ego motion that it finds
itself (KISS-ICP in ICP-Flow) and a row with the pair's own. Time runs from points in memory to flow in memory.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

THREADS = "OMP_NUM_THREADS"


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", type=Path, help=".npz files with pc1, pc2, ground1, ground2 and ego_SE3")
    parser.add_argument("--fnsf", default="fnsf")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    return parser.parse_args()


ARGUMENTS = parsed()
os.environ[THREADS] = str(ARGUMENTS.threads)

import hdbscan  # noqa: E402
import numpy as np  # noqa: E402
from odometry import by_kiss_icp  # noqa: E402
from scipy.ndimage import maximum_filter  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

# The published settings for Argoverse 2; lengths in metres.
MIN_CLUSTER_POINTS = 20
MOST_CLUSTERS = 200
MOST_POINTS = 10_000
MOST_TRANSLATION = 2.0
BIN = 0.1
INLIER = 0.1
PEAKS = 5
PEAK_BINS = 11
ITERATIONS = 100
RELATIVE_RMSE = 1e-6
MIN_BOX_RATIO = 0.1
MIN_IOU = 0.2
MAX_ERROR = 0.2

Array = np.ndarray


class Cloud:
    """The points of one cluster with their k-d tree, float64[N, 3]."""

    def __init__(self, points: Array) -> None:
        self.points = points
        self.tree = cKDTree(points)

    def distances(self, points: Array) -> Array:
        return self.tree.query(points, workers=ARGUMENTS.threads)[0]

    def moved(self, motion: Array) -> "Cloud":
        return Cloud(transformed(motion, self.points))


def transformed(motion: Array, points: Array) -> Array:
    return points @ motion[:3, :3].T + motion[:3, 3]


def clusters(source: Array, target: Array) -> tuple[Array, Array]:
    """Labels of both clouds, clustered together; -1 is no cluster, and only the largest clusters are kept."""
    clusterer = hdbscan.HDBSCAN(min_cluster_size=MIN_CLUSTER_POINTS, leaf_size=100, core_dist_n_jobs=ARGUMENTS.threads)
    labels = clusterer.fit(np.concatenate([target, source])).labels_
    sizes = np.bincount(labels[labels >= 0])
    largest = np.argsort(-sizes, kind="stable")[:MOST_CLUSTERS]
    labels = np.where(np.isin(labels, largest), labels, -1)
    return labels[len(target) :], labels[: len(target)]


def members(points: Array, labels: Array, generator: np.random.Generator) -> dict[int, Cloud]:
    """The clusters of one cloud that are large enough to match, each with at most `MOST_POINTS` points."""
    found = {}
    for label in np.unique(labels[labels >= 0]):
        own = points[labels == label]
        if len(own) > MOST_POINTS:
            own = generator.choice(own, MOST_POINTS, replace=False)
        if len(own) >= MIN_CLUSTER_POINTS:
            found[int(label)] = Cloud(own)
    return found


def comparable(source: Cloud, target: Cloud) -> bool:
    """Whether two clusters are near enough and of similar extent."""
    apart = target.points.mean(axis=0) - source.points.mean(axis=0)
    if np.hypot(apart[0], apart[1]) > MOST_TRANSLATION:
        return False
    extents = [np.sort(np.ptp(cloud.points, axis=0)) for cloud in (source, target)]
    return bool((np.minimum(*extents) >= MIN_BOX_RATIO * np.maximum(*extents)).all())


def votes(source: Cloud, target: Cloud) -> Array:
    """The most frequent translations from points of one cluster to points of the other, with zero as the last."""
    steps = round(MOST_TRANSLATION / BIN)
    shape = np.array([2 * steps + 1, 2 * steps + 1, 3])
    middle = np.array([steps, steps, 1])
    histogram = np.zeros(shape.prod(), dtype=np.int64)
    for part in np.array_split(source.points, 1 + len(source.points) * len(target.points) // 4_000_000):
        bins = np.rint((target.points[None] - part[:, None]).reshape(-1, 3) / BIN).astype(np.int64) + middle
        bins = bins[((bins >= 0) & (bins < shape)).all(axis=1)]
        histogram += np.bincount(np.ravel_multi_index(bins.T, shape), minlength=len(histogram))
    volume = histogram.reshape(shape)
    peaks = np.where(volume == maximum_filter(volume, PEAK_BINS, mode="constant"), volume, 0).ravel()
    highest = np.argsort(-peaks, kind="stable")[:PEAKS]
    bins = np.stack(np.unravel_index(highest, shape), axis=1)
    return np.concatenate([(bins - middle) * BIN, np.zeros((1, 3))])


def first_guess(source: Cloud, target: Cloud) -> Array:
    """The voted translation with the smallest mean distance, in the better of both directions."""

    def error(translation: Array) -> float:
        forward = target.distances(source.points + translation).mean()
        backward = source.distances(target.points - translation).mean()
        return min(forward, backward)

    motion = np.eye(4)
    motion[:3, 3] = min(votes(source, target), key=error)
    return motion


def rigid(source: Array, target: Array) -> Array:
    """The rotation and translation that lead points to their partners, by least squares."""
    means = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - means[0]).T @ (target - means[1]))
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    motion = np.eye(4)
    motion[:3, :3] = (u @ vt).T
    motion[:3, 3] = means[1] - motion[:3, :3] @ means[0]
    return motion


def refined(source: Cloud, target: Cloud, guess: Array) -> Array:
    """ICP over the pairs within `INLIER`; the guess, where ICP ends no nearer."""
    motion, last = guess, None
    for _ in range(ITERATIONS):
        distances, partners = target.tree.query(transformed(motion, source.points), workers=ARGUMENTS.threads)
        near = distances <= INLIER
        if near.sum() < 3:
            return guess
        ends = target.points[partners[near]]
        motion = rigid(source.points[near], ends)
        rmse = np.sqrt(((transformed(motion, source.points[near]) - ends) ** 2).sum(axis=1).mean())
        if last is not None and last - rmse <= RELATIVE_RMSE * last:
            break
        last = rmse
    before, after = (target.distances(transformed(end, source.points)).mean() for end in (guess, motion))
    return motion if after < before else guess


@dataclass(frozen=True)
class Match:
    """A cluster's motion to a cluster of the other sweep, and how far apart the two then lie."""

    motion: Array
    error: float


def match(source: Cloud, target: Cloud) -> Match | None:
    """The smaller cluster is fitted to the larger; nothing where the result fails the published tests."""
    if len(source.points) > len(target.points):
        motion = np.linalg.inv(refined(target, source, first_guess(target, source)))
    else:
        motion = refined(source, target, first_guess(source, target))
    moved = source.moved(motion)
    forward, backward = target.distances(moved.points), moved.distances(target.points)
    inliers = (forward < INLIER).sum(), (backward < INLIER).sum()
    both = len(forward) + len(backward)
    iou = min(inliers[0] / (both - inliers[1]), inliers[1] / (both - inliers[0]))
    shift = np.linalg.norm((moved.points - source.points).mean(axis=0))
    if shift > MOST_TRANSLATION or iou < MIN_IOU:
        return None
    return Match(motion, float(min(forward.mean(), backward.mean())))


def matches(
    source: dict[int, Cloud], target: dict[int, Cloud], pairs: list[tuple[int, int]]
) -> dict[int, tuple[Match, int]]:
    """The best match of each cluster of the source among the pairs, with the label of its partner."""
    best: dict[int, tuple[Match, int]] = {}
    for one, other in pairs:
        found = match(source[one], target[other]) if comparable(source[one], target[other]) else None
        if found and (one not in best or found.error < best[one][0].error):
            best[one] = found, other
    return {one: found for one, found in best.items() if found[0].error < MAX_ERROR}


def icp_flow(source: Array, target: Array, ego: Array, seed: int) -> tuple[Array, dict[str, float]]:
    """The flow of the points of the source, and the seconds of both parts."""
    began = time.perf_counter()
    still = transformed(ego, source)
    labels = clusters(still, target)
    clustered = time.perf_counter()
    generator = np.random.default_rng(seed)
    ones, others = members(still, labels[0], generator), members(target, labels[1], generator)
    found = matches(ones, others, [(label, label) for label in ones if label in others])
    taken = {other for _, other in found.values()}
    left = [one for one in ones if one not in found], [other for other in others if other not in taken]
    found |= matches(ones, others, [(one, other) for one in left[0] for other in left[1]])
    end = still.copy()
    for label, (one, _) in found.items():
        rows = labels[0] == label
        end[rows] = transformed(one.motion, still[rows])
    return end - source, {"clusters": clustered - began, "match": time.perf_counter() - clustered}


def run_peer(path: Path, given: bool, folder: Path, seed: int) -> dict[str, float]:
    """ICP-Flow on a pair; writes its flow."""
    with np.load(path) as pair:
        whole = [pair[name].astype(np.float64) for name in ("pc1", "pc2")]
        off = [~pair[name] for name in ("ground1", "ground2")]
        ego = pair["ego_SE3"].astype(np.float64)
    began = time.perf_counter()
    ego = ego if given else by_kiss_icp(*whole, ARGUMENTS.threads)
    aligned = time.perf_counter() - began
    flow = transformed(ego, whole[0]) - whole[0]
    flow[off[0]], seconds = icp_flow(whole[0][off[0]], whole[1][off[1]], ego, seed)
    np.savez(folder / "flow.npz", flow=flow.astype(np.float32), valid=off[0])
    return {"ego": aligned, **seconds, "total": time.perf_counter() - began}


def run_fnsf(path: Path, given: bool, folder: Path, seed: int) -> dict[str, float]:
    """`fnsf flow` on a pair; writes its flow."""
    command = [ARGUMENTS.fnsf, "flow", path, "-o", folder / "flow.npz", "--ground", "mask", "--json"]
    command += ["--preset", "default", "--device", "cpu", "--threads", ARGUMENTS.threads, "--seed", seed]
    command += ["--ego", path] if given else []
    seconds = answer(command)["seconds"]
    return {"total": seconds["total"] - seconds["load"]}


def answer(command: list[object]) -> dict:
    """The JSON that a command prints."""
    done = subprocess.run([str(word) for word in command], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


PROGRAMS = {"fnsf default": run_fnsf, "ICP-Flow": run_peer}
EGO = {False: "found", True: "given"}


def main() -> None:
    print(f"{ARGUMENTS.threads} threads, medians of {ARGUMENTS.rounds} rounds in turn\n")
    print("| pair | points | program | ego motion | seconds | of these: ego, clusters, match | EPE | moving | Acc5 |")
    print("|---|---|---|---|---|---|---|---|---|")
    for path in ARGUMENTS.pairs:
        rows = {(name, given): ([], []) for given in EGO for name in PROGRAMS}
        for seed in range(ARGUMENTS.rounds):
            for (name, given), (seconds, errors) in rows.items():
                with tempfile.TemporaryDirectory() as folder:
                    seconds.append(PROGRAMS[name](path, given, Path(folder), seed))
                    flow = Path(folder) / "flow.npz"
                    errors.append(answer([ARGUMENTS.fnsf, "eval", flow, "--truth", path, "--json"]))
        for (name, given), (seconds, errors) in rows.items():
            parts = [f"{median(s[part] for s in seconds):.2f}" for part in seconds[0] if part != "total"]
            moving = [e["epe_dynamic"] for e in errors if e["epe_dynamic"] is not None]
            cells = [
                path.parent.name,
                str(errors[0]["points"]),
                name,
                EGO[given],
                f"{median(s['total'] for s in seconds):.3f}",
                ", ".join(parts),
                f"{median(e['epe'] for e in errors):.4f}",
                f"{median(moving):.3f}" if moving else "",
                f"{median(e['acc5'] for e in errors):.3f}",
            ]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
