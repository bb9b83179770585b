"""Lines through samples: does a quantity grow over a process's life, and over the whole soak?"""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from server import RETENTION_SECONDS
from state import State, read

MIB = 1 << 20
# The first seconds of a process, in which its caches fill.
LIFE_WARM_UP = 90.0
SHORTEST_LIFE = 90.0
SHOCK_SECONDS = 60.0
# Over the whole run processes are compared at this age, seconds.
COMMON_AGE = (10.0, 25.0)
# Shorter lives and runs are judged with twice the tolerance.
LONG_LIFE = 400.0
# The store is steady when the first jobs have been removed.
STORE_WARM_UP = RETENTION_SECONDS + 60.0
SHORTEST_RUN = 240.0
# Below this a store's samples are mostly noise of the load: calm and trouble take turns.
LONG_RUN = 2400.0

# Share of the mean and absolute rise over a line's length that are no growth.
TOLERANCES: dict[str, tuple[float, float]] = {
    "rss": (0.15, 16 * MIB),
    "descriptors": (0.15, 10),
    "threads": (0.1, 4),
    "series": (0.0, 0.5),
    "rows": (0.25, 200),
    "queue": (0.25, 2 * MIB),
    "blobs of a job": (0.25, 4096),
    "orphan_bytes": (0.25, 10 * MIB),
}
# The number of jobs kept follows the speed of the machine: these are divided by it.
OF_A_JOB = {"blobs of a job": "blobs"}
OF_A_PROCESS = ("rss", "descriptors", "threads", "series")


@dataclass
class Line:
    """A fitted line: mean, rise over its length, and what of that is no growth."""

    name: str
    scope: str
    seconds: float
    samples: int
    mean: float
    rise: float
    allowed: float
    is_sure: bool

    @property
    def grows(self) -> bool:
        """Whether the rise is more than allowed and more than the scatter explains."""
        return self.rise > self.allowed and self.is_sure


def fit(name: str, scope: str, at: list[float], values: list[float], slack: float = 1.0) -> Line:
    """A least-squares line. It is sure where the slope is above four standard errors."""
    count = len(at)
    mean_at, mean = sum(at) / count, sum(values) / count
    spread = sum((one - mean_at) ** 2 for one in at) or 1.0
    slope = sum((one - mean_at) * (value - mean) for one, value in zip(at, values, strict=True)) / spread
    left = sum((value - mean - slope * (one - mean_at)) ** 2 for one, value in zip(at, values, strict=True))
    error = (left / max(count - 2, 1) / spread) ** 0.5
    share, least = TOLERANCES[name]
    seconds = max(at) - min(at)
    return Line(name, scope, seconds, count, mean, slope * seconds, slack * (share * mean + least), slope > 4 * error)


def lines(folder: Path) -> list[Line]:
    """All lines of a soak: of each long life, and of the whole run."""
    processes, store = read(folder, "processes"), read(folder, "store")
    found: list[Line] = []
    for stretch in _stretches(processes, read(folder, "trouble")):
        warm = [sample for sample in stretch if sample["age"] > LIFE_WARM_UP]
        if warm and warm[-1]["age"] - warm[0]["age"] >= SHORTEST_LIFE:
            scope = f"life {warm[0]['life']} ({warm[0]['node']}) from {warm[0]['age']:.0f} s"
            found += _lines(scope, warm, OF_A_PROCESS, lambda one: one["age"])
    # Processes of one age, so that the lengths of their lives do not matter.
    settled = _one_a_life(_steady([one for one in processes if COMMON_AGE[0] < one["age"] < COMMON_AGE[1]], 60.0))
    scope, at, steady = "whole run", lambda one: one["s"], _steady(store, STORE_WARM_UP)
    found += _lines(scope, settled, OF_A_PROCESS, at, SHORTEST_RUN)
    found += _lines(scope, steady, ("rows", "queue", "orphan_bytes", *OF_A_JOB), at, SHORTEST_RUN)
    return found


def _stretches(processes: list[dict[str, Any]], trouble: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """The samples of each life, cut where the process was paused or its database killed.

    What has waited meanwhile is done at once afterwards, and takes threads and memory. These samples are left out.
    """
    shocks = [(one["node"], one["s"]) for one in trouble if one["what"] in ("pauses", "database kills")]
    found: dict[tuple[int, int], list[dict[str, Any]]] = defaultdict(list)
    for sample in processes:
        before = [at for node, at in shocks if node in (sample["node"], "database") and at < sample["s"]]
        if not before or sample["s"] - before[-1] > SHOCK_SECONDS:
            found[sample["life"], len(before)].append(sample)
    return list(found.values())


def _one_a_life(samples: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The mean sample of each life. Samples of one life depend on each other, so they show no scatter."""
    lives: dict[tuple[int, str, int], list[dict[str, Any]]] = defaultdict(list)
    for sample in samples:
        lives[sample["piece"], sample["node"], sample["life"]].append(sample)
    means = []
    for life in lives.values():
        held = {name: [one[name] for one in life if name in one] for name in ("s", *OF_A_PROCESS)}
        means.append({name: sum(values) / len(values) for name, values in held.items() if values})
    return means


def _steady(samples: list[dict[str, Any]], warm_up: float) -> list[dict[str, Any]]:
    """The samples after the warm-up of each piece."""
    began: dict[int, float] = {}
    for sample in samples:
        began.setdefault(sample["piece"], sample["s"])
    return [sample for sample in samples if sample["s"] - began[sample["piece"]] > warm_up]


def _lines(
    scope: str,
    samples: list[dict[str, Any]],
    names: tuple[str, ...],
    at: Callable[[dict[str, Any]], float],
    least: float = 0.0,
) -> list[Line]:
    found = []
    for name in names:
        held = [(at(sample), value) for sample in samples if (value := _value(sample, name)) is not None]
        if len(held) > 5 and held[-1][0] - held[0][0] >= least:
            seconds = held[-1][0] - held[0][0]
            slack = 2.0 if seconds < (LONG_RUN if scope == "whole run" else LONG_LIFE) else 1.0
            found.append(fit(name, scope, [one for one, _ in held], [value for _, value in held], slack))
    return found


def _value(sample: dict[str, Any], name: str) -> float | None:
    """A quantity of a sample; `None` where it was not measured."""
    if name not in OF_A_JOB:
        return sample.get(name)
    return sample[OF_A_JOB[name]] / sample["rows"] if sample.get("rows") else None


def judge(state: State) -> None:
    """Reports each line that grows, once."""
    told: list[str] = state.totals.setdefault("grown", [])
    for line in lines(state.folder):
        key = f"{line.name}, {line.scope}" + (f", piece {state.piece}" if line.scope == "whole run" else "")
        if line.grows and key not in told:
            told.append(key)
            state.violation("growth", **line.__dict__)
