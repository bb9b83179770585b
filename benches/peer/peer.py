"""Fast Neural Scene Flow (ICCV 2023) and what it is compared with, in PyTorch: the peer of fnsf's
benchmarks.

A model is fitted to one pair of clouds so that the moved source points lie near the target. The
methods have the names of fnsf's presets, and combine a model (`models.py`) with a loss
(`losses.py`). Nothing is shared with fnsf but the pair file, so a mistake there cannot hide here.
All lengths are metres.
"""

import argparse
import json
import math
import os
import resource
import sys
import time
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from losses import Chamfer, DistanceMap, Loss, load_transform
from models import LinearModel, build_network
from torch import Tensor, nn

MAX_ITERATIONS = 5000
PAIR_ARRAYS = ("pc1", "pc2", "flow", "valid", "ground1", "ground2")


@dataclass(frozen=True)
class Method:
    """A model, a loss, and the published settings of their fit."""

    model: str
    loss: str
    learning_rate: float
    patience: int
    min_delta: float
    cycle: bool = False


PAPER = Method("network", "distance", learning_rate=0.008, patience=10, min_delta=1e-3)
BASELINE = Method("network", "chamfer", learning_rate=0.008, patience=30, min_delta=1e-4)
LINEAR = {"model": "linear", "learning_rate": 0.03, "patience": 10, "min_delta": 1e-3}
METHODS = {
    "paper": PAPER,
    "nsfp-baseline": BASELINE,
    "nsfp": replace(BASELINE, cycle=True),
    "nsfp-kdtree": replace(BASELINE, loss="kdtree"),
    "fnsf-linear": replace(PAPER, **LINEAR),
    "nsfp-linear": replace(BASELINE, **LINEAR),
    "nsfp-kdtree-linear": replace(BASELINE, **LINEAR, loss="kdtree"),
}


def method(name: str, sampled: bool) -> Method:
    """The method, with FNSF's published settings for sampled clouds where it has some."""
    if name == "paper" and sampled:
        return replace(PAPER, learning_rate=0.01, patience=5)
    return METHODS[name]


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


def within_crop(points: Tensor, crop_m: float | None) -> Tensor:
    """The points with |x|, |y| <= `crop_m`; all of them without a crop."""
    if crop_m is None:
        return torch.ones(len(points), dtype=torch.bool)
    return (points[:, :2].abs() <= crop_m).all(dim=1)


def select_points(
    pair: dict[str, Tensor],
    crop_m: float | None,
    mask_ground: bool,
    max_points: int | None,
    generator: torch.Generator,
) -> Problem:
    """Crops, takes the ground out, and samples both clouds with one and the same permutation."""
    keep_source = within_crop(pair["pc1"], crop_m)
    keep_target = within_crop(pair["pc2"], crop_m)
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


class EarlyStopping:
    """Stops when the loss has not fallen by an absolute amount for `patience` calls, or is NaN."""

    def __init__(self, patience: int, min_delta: float) -> None:
        self.patience = patience
        self.min_delta = min_delta
        self.best = math.inf
        self.stale = 0

    def should_stop(self, loss: float) -> bool:
        """Takes the next loss in."""
        if math.isnan(loss):
            return True
        if loss < self.best - self.min_delta:
            self.best = loss
            self.stale = 0
        else:
            self.stale += 1
        return self.stale >= self.patience


@dataclass(frozen=True)
class Cycle:
    """The second network of NSFP, which leads the moved points back, and its loss to the source."""

    model: nn.Module
    loss: Loss


def fit_flow(
    source: Tensor, model: nn.Module, distance: Loss, settings: Method, cycle: Cycle | None
) -> tuple[Tensor, int]:
    """Fits the model; returns the flow of the lowest loss and the number of Adam steps taken."""
    parameters = list(model.parameters())
    if cycle is not None:
        parameters += cycle.model.parameters()
    optimizer = torch.optim.Adam(parameters, lr=settings.learning_rate)
    stopping = EarlyStopping(settings.patience, settings.min_delta)
    best_loss, best_flow = math.inf, torch.zeros_like(source)
    steps = 0
    while steps < MAX_ITERATIONS:
        optimizer.zero_grad()
        flow = model(source)
        moved = source + flow
        loss = distance(moved)
        if cycle is not None:
            loss = loss + cycle.loss(moved - cycle.model(moved))
        if isinstance(model, LinearModel):
            loss = loss + model.regularization()
        loss.backward()
        optimizer.step()
        steps += 1
        value = loss.item()
        if stopping.should_stop(value):
            break
        if value <= best_loss:
            best_loss, best_flow = value, flow.detach()
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
    settings = method(args.method, args.max_points is not None)
    transform = load_transform(args.transform, args.threads)
    pair = load_pair(args.pair)
    warm_up(device)
    generator = torch.manual_seed(args.seed)

    start = now(device)
    mask_ground = args.ground == "mask"
    problem = select_points(pair, args.crop_m, mask_ground, args.max_points, generator)
    source, target = problem.source.to(device), problem.target.to(device)
    selected = now(device)

    def loss_to(cloud: Tensor) -> Loss:
        if settings.loss == "distance":
            return DistanceMap(source, cloud, transform)
        return Chamfer(cloud, trees=settings.loss == "kdtree", threads=args.threads)

    distance = loss_to(target)
    if settings.model == "network":
        model: nn.Module = build_network().to(device)
    else:
        model = LinearModel(source).to(device)
    cycle = Cycle(deepcopy(model), loss_to(source)) if settings.cycle else None
    prepared = now(device)
    flow, steps = fit_flow(source, model, distance, settings, cycle)
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
    parser.add_argument("--crop-m", type=float, help="crop to |x|, |y| <= R (default: off)")
    parser.add_argument("--ground", choices=("keep", "mask"), default="mask")
    parser.add_argument("--max-points", type=int, help="sample both clouds (default: off)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--method", choices=tuple(METHODS), default="paper")
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
