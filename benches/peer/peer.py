"""Fast Neural Scene Flow (ICCV 2023) as published, in PyTorch: the peer of fnsf's benchmarks.

A coordinate network is fitted to one pair of clouds so that the moved source points lie where the
distance transform of the target cloud is small. Nothing is shared with fnsf but the pair file, so a
mistake there cannot hide here. All lengths are metres.
"""

import argparse
import json
import math
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

CELLS_PER_METRE = 10
CELL_M = 1 / CELLS_PER_METRE
HIDDEN_LAYERS = 8
HIDDEN_WIDTH = 128
MAX_ITERATIONS = 5000
MIN_DELTA_M = 1e-3
PAIR_ARRAYS = ("pc1", "pc2", "flow", "valid", "ground1", "ground2")

Transform = Callable[[Tensor], Tensor]
"""Occupied vertices (bool, X x Y x Z) to the distance of every vertex to the nearest of them."""


@dataclass(frozen=True)
class Settings:
    """What differs between the published full-cloud and sampled-cloud runs."""

    learning_rate: float
    patience: int


FULL_CLOUD = Settings(learning_rate=0.008, patience=10)
SAMPLED_CLOUD = Settings(learning_rate=0.01, patience=5)


@dataclass(frozen=True)
class Problem:
    """The points that take part, row by row: `truth` and `scored` go with `source`."""

    source: Tensor
    target: Tensor
    truth: Tensor
    scored: Tensor


def load_pair(path: Path) -> dict[str, Tensor]:
    """Reads the arrays of a `pair.npz` that the peer uses."""
    with np.load(path) as pair:
        return {name: torch.from_numpy(pair[name]) for name in PAIR_ARRAYS}


def within_range(points: Tensor, range_m: float | None) -> Tensor:
    """The points with |x|, |y| <= `range_m`; all of them without a range."""
    if range_m is None:
        return torch.ones(len(points), dtype=torch.bool)
    return (points[:, :2].abs() <= range_m).all(dim=1)


def select_points(
    pair: dict[str, Tensor],
    range_m: float | None,
    mask_ground: bool,
    max_points: int | None,
    generator: torch.Generator,
) -> Problem:
    """Crops, takes the ground out, and samples both clouds with one and the same permutation."""
    keep_source = within_range(pair["pc1"], range_m)
    keep_target = within_range(pair["pc2"], range_m)
    if mask_ground:
        keep_source &= ~pair["ground1"]
        keep_target &= ~pair["ground2"]
    source_rows = keep_source.nonzero().squeeze(1)
    target_rows = keep_target.nonzero().squeeze(1)
    if max_points is not None:
        shorter = min(len(source_rows), len(target_rows))
        chosen = torch.randperm(shorter, generator=generator)[:max_points]
        source_rows, target_rows = source_rows[chosen], target_rows[chosen]
    return Problem(
        source=pair["pc1"][source_rows],
        target=pair["pc2"][target_rows],
        truth=pair["flow"][source_rows],
        scored=(pair["valid"] & ~pair["ground1"])[source_rows],
    )


def load_transform(name: str, threads: int) -> Transform:
    """Imports the package behind a transform now, so that no import falls into the timing."""
    return {"edt": load_edt, "fastgeodis": load_fastgeodis}[name](threads)


def load_edt(threads: int) -> Transform:
    """The exact Euclidean distance transform, which the paper describes; always on the CPU."""
    import edt

    def transform(occupied: Tensor) -> Tensor:
        empty = (~occupied).cpu().numpy()
        distances = edt.edt(empty, anisotropy=(CELL_M,) * 3, parallel=threads)
        return torch.from_numpy(distances).to(occupied.device)

    return transform


def load_fastgeodis(_threads: int) -> Transform:
    """The raster-scan transform that the published code calls: a chamfer metric, at most 13 % long.

    It runs on the occupied vertices' device, with torch's threads.
    """
    import FastGeodis

    def transform(occupied: Tensor) -> Tensor:
        empty = (~occupied).float()[None, None]
        image = torch.zeros_like(empty)
        return FastGeodis.generalised_geodesic3d(image, empty, [CELL_M] * 3, 1e10, 0.0, 1)[0, 0]

    return transform


class DistanceMap:
    """Distance to the rasterised target, on a dense grid that covers both clouds."""

    def __init__(self, source: Tensor, target: Tensor, transform: Transform) -> None:
        lowest = torch.minimum(source.amin(dim=0), target.amin(dim=0))
        highest = torch.maximum(source.amax(dim=0), target.amax(dim=0))
        self.origin = torch.floor(lowest * CELLS_PER_METRE - 1) / CELLS_PER_METRE
        end = torch.ceil(highest * CELLS_PER_METRE + 1) / CELLS_PER_METRE
        shape = torch.ceil((end - self.origin) * CELLS_PER_METRE).long() + 2
        self.first = torch.zeros_like(self.origin)
        self.last = (shape - 1).to(self.origin.dtype)

        vertices = torch.round((target - self.origin) * CELLS_PER_METRE).long()
        occupied = torch.zeros(shape.tolist(), dtype=torch.bool, device=target.device)
        occupied[vertices.unbind(dim=1)] = True
        self.distances = transform(occupied)[None, None]

    def at(self, points: Tensor) -> Tensor:
        """Trilinear distance at every point; an axis on which a point lies outside pulls nothing.

        The clamp, not the sampler's border mode, is what zeroes that axis of the gradient.
        """
        cells = (points - self.origin) * CELLS_PER_METRE
        inside = torch.clamp(cells, self.first, self.last)
        zyx = (2 * inside / self.last - 1).flip(dims=(1,))
        sampled = nn.functional.grid_sample(
            self.distances,
            zyx[None, :, None, None, :],
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        )
        return sampled.flatten()


def build_network() -> nn.Sequential:
    """The coordinate network, point to flow, with Xavier-uniform weights and zero biases."""
    widths = [3] + [HIDDEN_WIDTH] * HIDDEN_LAYERS
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Linear(HIDDEN_WIDTH, 3))
    for layer in network:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    return network


class EarlyStopping:
    """Stops when the loss has not fallen by an absolute amount for `patience` calls, or is NaN."""

    def __init__(self, patience: int) -> None:
        self.patience = patience
        self.best = math.inf
        self.stale = 0

    def should_stop(self, loss: float) -> bool:
        """Takes the next loss in."""
        if math.isnan(loss):
            return True
        if loss < self.best - MIN_DELTA_M:
            self.best = loss
            self.stale = 0
        else:
            self.stale += 1
        return self.stale >= self.patience


def fit_flow(source: Tensor, target_map: DistanceMap, settings: Settings) -> tuple[Tensor, int]:
    """Fits the network; returns the flow of the lowest loss and the number of Adam steps taken."""
    network = build_network().to(source.device)
    optimizer = torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    stopping = EarlyStopping(settings.patience)
    best_loss, best_flow = math.inf, torch.zeros_like(source)
    steps = 0
    while steps < MAX_ITERATIONS:
        optimizer.zero_grad()
        flow = network(source)
        loss = target_map.at(source + flow).mean()
        loss.backward()
        optimizer.step()
        steps += 1
        loss_m = loss.item()
        if stopping.should_stop(loss_m):
            break
        if loss_m <= best_loss:
            best_loss, best_flow = loss_m, flow.detach()
    return best_flow, steps


def score(flow: Tensor, truth: Tensor) -> dict[str, float]:
    """The paper's metrics; the angle is in radians, and a zero vector counts as a right angle."""
    error = (flow - truth).norm(dim=1)
    relative = error / (truth.norm(dim=1) + 1e-20)
    cosine = (
        flow / flow.norm(dim=1, keepdim=True) * (truth / truth.norm(dim=1, keepdim=True))
    ).sum(1)
    angle = torch.acos(cosine.clamp(-1 + 1e-7, 1 - 1e-7).nan_to_num(nan=0.0))
    return {
        "epe": error.mean().item(),
        "acc5": ((error < 0.05) | (relative < 0.05)).float().mean().item(),
        "acc10": ((error < 0.1) | (relative < 0.1)).float().mean().item(),
        "outliers": ((error > 0.3) | (relative > 0.1)).float().mean().item(),
        "angle_error": angle.mean().item(),
    }


def warm_up(device: torch.device) -> None:
    """Pays for the device's context and its matrix library before the clock starts."""
    square = torch.ones(2, 2, device=device)
    (square @ square).sum().item()


def now(device: torch.device) -> float:
    """Seconds on a monotonic clock, once the device has done all it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def peak_rss_bytes() -> int:
    """The most host memory this process has held, torch's own libraries included."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def run(args: argparse.Namespace) -> dict[str, object]:
    """Estimates the flow of one pair and scores it; only the estimate is timed."""
    torch.set_num_threads(args.threads)
    device = torch.device(args.device)
    settings = FULL_CLOUD if args.max_points is None else SAMPLED_CLOUD
    transform = load_transform(args.transform, args.threads)
    pair = load_pair(args.pair)
    warm_up(device)
    generator = torch.manual_seed(args.seed)

    start = now(device)
    mask_ground = args.ground == "mask"
    problem = select_points(pair, args.range_m, mask_ground, args.max_points, generator)
    source, target = problem.source.to(device), problem.target.to(device)
    selected = now(device)
    target_map = DistanceMap(source, target, transform)
    prepared = now(device)
    flow, steps = fit_flow(source, target_map, settings)
    fitted = now(device)
    flow = flow.cpu()
    end = now(device)

    return {
        **score(flow[problem.scored], problem.truth[problem.scored]),
        "points": int(problem.scored.sum()),
        "iterations": steps,
        "seconds": {
            "precompute": prepared - selected,
            "network": fitted - prepared,
            "total": end - start,
        },
        "peak_rss_bytes": peak_rss_bytes(),
    }


def parse_args() -> argparse.Namespace:
    """The command line; names and meanings follow `fnsf flow`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pair", type=Path, metavar="PAIR.npz")
    parser.add_argument("--range-m", type=float, help="crop to |x|, |y| <= R (default: off)")
    parser.add_argument("--ground", choices=("keep", "mask"), default="mask")
    parser.add_argument("--max-points", type=int, help="sample both clouds (default: off)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--transform", choices=("edt", "fastgeodis"), default="edt")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser.parse_args()


def main() -> None:
    """Runs the peer and prints what came of it."""
    args = parse_args()
    report = run(args)
    if args.json:
        print(json.dumps(report))
    else:
        for name, value in report.items():
            print(f"{name:>15}  {value}")


if __name__ == "__main__":
    main()
