"""Plays sweeps into a folder at a lidar's rate while `fnsf flow --follow` takes them, and draws latency and memory.

    python3 benches/stream.py --fnsf target/release/fnsf --sweeps 300 --hz 10 --svg stream.svg SWEEP... -- [OPTION...]

The sweeps are played forward and backward until there are enough. Options after `--` go to `fnsf flow`. The latency of
a flow is the time from the last byte of its target to the last byte of the flow, as `--json` reports it. Memory is the
program's resident set, read every half second. Needs nothing but Python.
"""

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any


def stream_parser(description: str | None) -> argparse.ArgumentParser:
    """The options of a stream of sweeps."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="SWEEP")
    parser.add_argument("--fnsf", default="fnsf")
    parser.add_argument("--sweeps", type=int, default=300)
    parser.add_argument("--hz", type=float, default=10.0)
    return parser


def parsed(arguments: list[str]) -> tuple[argparse.Namespace, list[str]]:
    more: list[str] = []
    if "--" in arguments:
        at = arguments.index("--")
        arguments, more = arguments[:at], arguments[at + 1 :]
    parser = stream_parser(__doc__)
    parser.add_argument("--svg", type=Path)
    return parser.parse_args(arguments), more


def at_rate(sweeps: list[bytes], asked: argparse.Namespace) -> Iterator[tuple[int, bytes, float]]:
    """Numbered sweeps at their times, forward and backward, and by how many seconds each was asked for too late."""
    there_and_back = itertools.cycle(sweeps + sweeps[-2:0:-1])
    began = time.monotonic()
    for number, sweep in zip(range(asked.sweeps), there_and_back):
        left = began + number / asked.hz - time.monotonic()
        time.sleep(max(left, 0.0))
        yield number, sweep, max(-left, 0.0)


def play(sweeps: list[bytes], ending: str, folder: Path, asked: argparse.Namespace) -> float:
    """Writes the sweeps, and returns by how many seconds the player itself was late at most."""
    most = 0.0
    for number, sweep, late in at_rate(sweeps, asked):
        most = max(most, late)
        (folder / f"{number:06}{ending}").write_bytes(sweep)
    return most


def watch(process: subprocess.Popen[Any], resident: list[float]) -> None:
    """Appends the resident set of the process, MB, every half second."""
    while process.poll() is None:
        status = Path(f"/proc/{process.pid}/status")
        lines = status.read_text().splitlines() if status.exists() else []
        resident += [int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS")]
        time.sleep(0.5)


def summary(asked: argparse.Namespace, latencies: list[float], waited: int, resident: list[float]) -> str:
    """Latencies in ms and memory in MB, as text."""
    return (
        f"{len(latencies)} flows at {asked.hz:g} Hz: latency median {median(latencies):.0f} ms, "
        f"99% {sorted(latencies)[int(0.99 * (len(latencies) - 1))]:.0f} ms, most {max(latencies):.0f} ms; "
        f"at most {waited} sweeps waited; "
        f"memory {resident[len(resident) // 4]:.0f} MB after a quarter, {resident[-1]:.0f} MB at the end"
    )


def panel(values: list[float], top: int, title: str, unit: str) -> str:
    """A line over time, 600 x 120, with its scale."""
    left, width, height = 60, 600, 120
    most = max(values) * 1.1
    step = width / max(len(values) - 1, 1)
    points = " ".join(f"{left + i * step:.1f},{top + height * (1 - v / most):.1f}" for i, v in enumerate(values))
    marks = "".join(
        f'<line x1="{left}" x2="{left + width}" y1="{top + height * (1 - share):.1f}" '
        f'y2="{top + height * (1 - share):.1f}" stroke="#ddd"/>'
        f'<text x="{left - 6}" y="{top + height * (1 - share) + 4:.1f}" text-anchor="end">{most * share:.0f}</text>'
        for share in (0.0, 0.5, 1.0)
    )
    return (
        f'<text x="{left}" y="{top - 8}">{title}, {unit}</text>{marks}'
        f'<polyline points="{points}" fill="none" stroke="#1f77b4" stroke-width="1.2"/>'
    )


def main() -> None:
    asked, more = parsed(sys.argv[1:])
    sweeps = [path.read_bytes() for path in asked.files]
    with tempfile.TemporaryDirectory() as name:
        incoming, flows = Path(name, "incoming"), Path(name, "flows")
        incoming.mkdir()
        flows.mkdir()
        command = [asked.fnsf, "flow", "--follow", str(incoming), "-o", str(flows / "flow.npz"), "--idle-s", "3"]
        process = subprocess.Popen([*command, "--json", *more], stdout=subprocess.PIPE, text=True)
        resident: list[float] = []
        watcher = threading.Thread(target=watch, args=(process, resident))
        watcher.start()
        player_late = []
        player = threading.Thread(
            target=lambda: player_late.append(play(sweeps, asked.files[0].suffix, incoming, asked))
        )
        time.sleep(0.5)
        player.start()
        assert process.stdout is not None
        reports = [json.loads(line) for line in process.stdout]
        player.join()
        watcher.join()
        if process.wait() != 0:
            sys.exit(f"fnsf ended with {process.returncode}")
    latencies = [report["latency_s"] * 1e3 for report in reports]
    ends = sorted({report["stop_reason"] for report in reports})
    waited = max(report["waiting"] for report in reports)
    print(
        f"{summary(asked, latencies, waited, resident)}; ends: {', '.join(ends)}; "
        f"the player was late by {player_late[0] * 1e3:.1f} ms at most"
    )
    if asked.svg:
        body = panel(latencies, 30, "latency of each flow", "ms") + panel(resident, 200, "resident memory", "MB")
        asked.svg.write_text(
            '<svg xmlns="http://www.w3.org/2000/svg" width="680" height="340" font-family="sans-serif" font-size="12">'
            f'<rect width="680" height="340" fill="white"/>{body}</svg>\n'
        )


if __name__ == "__main__":
    main()
