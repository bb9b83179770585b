"""Runs fnsf and its PyTorch peer side by side on one pair and prints a Markdown table.

Runs are interleaved (every contestant once per seed, then the next seed), so that a slow spell of
the machine falls on all of them. fnsf's `total - load` stands beside the peer's `total`: both span
points in memory to flow in memory. The two draw from different random number generators, so a
seed pairs runs in number only: neither the sampled points nor the starting weights are the same.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import median

PEER = Path(__file__).with_name("peer.py")
METHODS = (
    "paper",
    "nsfp-baseline",
    "nsfp",
    "nsfp-kdtree",
    "fnsf-linear",
    "nsfp-linear",
    "nsfp-kdtree-linear",
)
METHODS_WITH_TRANSFORM = {"paper", "fnsf-linear"}
PEER_DEVICES = {"cpu": "cpu", "gpu": "cuda"}


@dataclass(frozen=True)
class Contestant:
    """One row of runs: fnsf with a preset, or the peer with a method and a transform."""

    program: str
    variant: str

    @property
    def name(self) -> str:
        """How the table calls it."""
        return f"{self.program} {self.variant}"


@dataclass(frozen=True)
class Run:
    """What one run cost and how good its flow is."""

    seconds: float
    precompute: float
    epe: float
    acc5: float
    points: int
    iterations: int
    peak_rss_bytes: int


def run_json(command: list[str]) -> dict:
    """Runs a command and parses the one JSON object on its stdout; its stderr passes through."""
    finished = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if finished.returncode != 0:
        raise SystemExit(f"exit code {finished.returncode} from: {' '.join(command)}")
    return json.loads(finished.stdout)


def problem_options(args: argparse.Namespace, seed: int) -> list[str]:
    """The options that `fnsf flow` and the peer share."""
    options = ["--ground", args.ground, "--seed", str(seed), "--threads", str(args.threads)]
    if args.crop_m is not None:
        options += ["--crop-m", str(args.crop_m)]
    if args.max_points is not None:
        options += ["--max-points", str(args.max_points)]
    return [*options, "--json"]


def run_fnsf(args: argparse.Namespace, preset: str, seed: int) -> Run:
    """`fnsf flow`, then `fnsf eval` on what it wrote."""
    with tempfile.TemporaryDirectory() as folder:
        output = str(Path(folder) / "flow.npz")
        flow_command = [args.fnsf, "flow", str(args.pair), "-o", output]
        flow_command += ["--preset", preset, "--device", args.device]
        flow = run_json(flow_command + problem_options(args, seed))
        metrics = run_json([args.fnsf, "eval", output, "--truth", str(args.pair), "--json"])
    seconds = flow["seconds"]
    return Run(
        seconds=seconds["total"] - seconds["load"],
        precompute=seconds["precompute"],
        epe=metrics["epe"],
        acc5=metrics["acc5"],
        points=metrics["points"],
        iterations=flow["field"]["iterations"],
        peak_rss_bytes=flow["peak_rss_bytes"],
    )


def run_peer(args: argparse.Namespace, variant: str, seed: int) -> Run:
    """The peer, in the interpreter that runs this script. The variant is `method transform`."""
    method, transform = variant.split()
    command = [sys.executable, str(PEER), str(args.pair), "--method", method]
    command += ["--transform", transform]
    command += ["--device", PEER_DEVICES[args.device.split(":")[0]]]
    report = run_json(command + problem_options(args, seed))
    return Run(
        seconds=report["seconds"]["total"],
        precompute=report["seconds"]["precompute"],
        epe=report["epe"],
        acc5=report["acc5"],
        points=report["points"],
        iterations=report["iterations"],
        peak_rss_bytes=report["peak_rss_bytes"],
    )


def run_all(args: argparse.Namespace, contestants: list[Contestant]) -> dict[Contestant, list[Run]]:
    """Every contestant once per seed, interleaved: A B C D A B C D."""
    runners = {"fnsf": run_fnsf, "peer": run_peer}
    runs: dict[Contestant, list[Run]] = {contestant: [] for contestant in contestants}
    for seed in args.seeds:
        for contestant in contestants:
            run = runners[contestant.program](args, contestant.variant, seed)
            runs[contestant].append(run)
            progress = (
                f"seed {seed}  {contestant.name:<24}  {run.seconds:8.3f} s  EPE {run.epe:.4f}"
            )
            print(progress, file=sys.stderr)
    return runs


def spread(values: list[float], digits: int) -> str:
    """The median, with the range."""
    return f"{median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def ratio_cell(runs: list[Run], baseline: list[Run]) -> str:
    """Median of the per-seed time ratios, with their range."""
    ratios = [run.seconds / base.seconds for run, base in zip(runs, baseline, strict=True)]
    return spread(ratios, 2)


def table_row(contestant: Contestant, runs: list[Run], baselines: list[list[Run]]) -> str:
    """One contestant's medians, the range of its EPE, and its time over each fnsf preset's."""
    cells = [
        contestant.name,
        f"{median(run.seconds for run in runs):.3f}",
        f"{median(run.precompute for run in runs):.3f}",
        spread([run.epe for run in runs], 4),
        f"{median(run.acc5 for run in runs):.3f}",
        f"{median(run.points for run in runs):.0f}",
        f"{median(run.iterations for run in runs):.0f}",
        f"{max(run.peak_rss_bytes for run in runs) / 2**20:.0f}",
        *(ratio_cell(runs, baseline) for baseline in baselines),
    ]
    return f"| {' | '.join(cells)} |"


def print_table(args: argparse.Namespace, runs: dict[Contestant, list[Run]]) -> None:
    """The caption, which says what was run, and the table."""
    presets = [contestant for contestant in runs if contestant.program == "fnsf"]
    header = ["", "seconds", "precompute", "EPE (m)", "Acc5", "points", "iterations", "peak MiB"]
    header += [*(f"time / {preset.name}" for preset in presets)]
    print(
        f"{args.pair}, range {args.crop_m or 'off'}, ground {args.ground}, "
        f"{args.max_points or 'all'} points, {args.device}, {args.threads} threads, "
        f"seeds {' '.join(map(str, args.seeds))}. Medians over seeds; time ratios are the median "
        "(lowest to highest) of the ratios per seed. A seed pairs runs in number only.\n"
    )
    print(f"| {' | '.join(header)} |")
    print(f"|---|{'---:|' * (len(header) - 1)}")
    baselines = [runs[preset] for preset in presets]
    for contestant, its_runs in runs.items():
        print(table_row(contestant, its_runs, baselines))


def parse_args() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pair", type=Path, metavar="PAIR.npz")
    parser.add_argument("--fnsf", default="fnsf", help="the binary (default: fnsf on PATH)")
    parser.add_argument("--crop-m", type=float, help="crop to |x|, |y| <= R (default: off)")
    parser.add_argument("--ground", choices=("keep", "mask"), default="mask")
    parser.add_argument("--max-points", type=int, help="sample both clouds (default: off)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--device", default="cpu", help="cpu, gpu or gpu:CARD (default: cpu)")
    parser.add_argument("--presets", nargs="+", default=["paper", "neural"], help="of fnsf")
    parser.add_argument(
        "--methods", choices=METHODS, nargs="+", default=["paper"], help="of the peer"
    )
    parser.add_argument(
        "--transforms", choices=("edt", "fastgeodis"), nargs="+", default=["edt", "fastgeodis"]
    )
    return parser.parse_args()


def main() -> None:
    """Runs the comparison."""
    args = parse_args()
    contestants = [Contestant("fnsf", preset) for preset in args.presets]
    for method in args.methods:
        transforms = args.transforms if method in METHODS_WITH_TRANSFORM else ["edt"]
        contestants += [Contestant("peer", f"{method} {transform}") for transform in transforms]
    print_table(args, run_all(args, contestants))


if __name__ == "__main__":
    main()
