"""What the distance to the nearest point tells of moving objects whose points are known.

The points of each true object are moved by the true ego motion, then by the shift and turn in the plane with the
least mean distance to the target off the ground. Heights are true. Clustering, registration and acceptance have no part
in the error.

    python true_objects.py PAIR.npz -o shifted.npz
    fnsf eval shifted.npz --truth PAIR.npz
"""

import argparse

import numpy as np

LEAST_POINTS = 5
MOST_POINTS = 200
"""Points of an object that are compared, drawn at random."""
TRUNCATION_M = 0.5
REACH_M = 1.6
COARSE_M, FINE_M = 0.1, 0.02
TURNS = (-0.02, 0.0, 0.02)
"""Turns in radians that are tried with the fine shifts."""


def turned(points, turn):
    """The points, turned about the vertical through their mean."""
    center = points.mean(0)
    sine, cosine = np.sin(turn), np.cos(turn)
    return (points - center) @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) + center


def mean_distance(points, target):
    """The mean distance of the points from their nearest target points, truncated."""
    nearest = np.sqrt(((points[:, None] - target[None]) ** 2).sum(-1)).min(1)
    return np.minimum(nearest, TRUNCATION_M).mean()


def best_shift(points, target, height):
    """The shift (3 numbers, metres) with the least mean distance, and that distance."""

    def cost(x, y, turn=0.0):
        return mean_distance(turned(points, turn) + np.array([x, y, height]), target)

    steps = np.arange(-REACH_M, REACH_M + COARSE_M / 2, COARSE_M)
    _, x, y = min((cost(x, y), x, y) for x in steps for y in steps)
    steps = np.arange(-COARSE_M, COARSE_M + FINE_M / 2, FINE_M)
    least, x, y = min((cost(x + dx, y + dy, turn), x + dx, y + dy) for dx in steps for dy in steps for turn in TURNS)
    return np.array([x, y, height]), least


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pair")
    parser.add_argument("-o", "--output", required=True)
    arguments = parser.parse_args()
    pair = np.load(arguments.pair)
    ego = pair["ego_SE3"]
    aligned = pair["pc1"] @ ego[:3, :3].T + ego[:3, 3]
    residual = pair["pc1"] + pair["flow"] - aligned
    target = pair["pc2"][~pair["ground2"]]
    moving = pair["dynamic"] & pair["valid"] & ~pair["ground1"]
    flow = aligned - pair["pc1"]
    random = np.random.default_rng(0)
    print("| object | points | range, m | motion, m | off by, m | distance at truth, m | least, m | at rest, m |")
    print("|---|---|---|---|---|---|---|---|")
    for number in np.unique(pair["box_id"][moving]):
        rows = np.flatnonzero(moving & (pair["box_id"] == number))
        if len(rows) < LEAST_POINTS:
            continue
        points = aligned[random.permutation(rows)[:MOST_POINTS]]
        true = residual[rows].mean(0)
        low, high = points.min(0) - REACH_M - 1, points.max(0) + REACH_M + 1
        around = target[((target > low) & (target < high)).all(1)]
        if len(around) == 0:
            continue
        shift, least = best_shift(points, around, true[2])
        flow[rows] += shift
        off, way = (np.hypot(*vector[:2]) for vector in (shift - true, true))
        distance = np.hypot(*points.mean(0)[:2])
        at = [mean_distance(points + vector, around) for vector in (true, np.zeros(3))]
        print(
            f"| {number} | {len(rows)} | {distance:.1f} | {way:.3f} | {off:.3f} "
            f"| {at[0]:.3f} | {least:.3f} | {at[1]:.3f} |"
        )
    np.savez(arguments.output, flow=flow.astype(np.float32))


if __name__ == "__main__":
    main()
