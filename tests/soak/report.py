"""The report of a soak: figures, growth, violations with their evidence, and plots."""

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from health import LIMIT_MS, percentile
from plots import Panel, Series, figure
from state import read
from trends import MIB, OF_A_JOB, Line, lines

# Colors of the vertical marks in the plots.
MARKS = {"kills": "red", "database kills": "purple", "restarts": "green", "pauses": "gray"}


def write(folder: Path) -> None:
    """Writes `report.md` and the plots beside the records."""
    totals = json.loads((folder / "totals.json").read_text())
    counts: dict[str, int] = totals["counts"]
    parts = [
        "# Report of a soak",
        _summary(totals, counts),
        "## Jobs by kind and outcome",
        _jobs(counts),
        "## Health of the admin port",
        _health(totals, counts),
        "## Growth",
        _growth(lines(folder)),
        "## Plots",
        "Vertical lines mark kills (red), orderly restarts (green), pauses (gray) and kills of the database (purple).",
        *(f"![{name}]({name}.svg)" for name in ("processes", "store", "health", "jobs")),
        "## Violations",
        _violations(folder, counts),
        "## Counters",
        _table(("counter", "count"), sorted(counts.items())),
    ]
    (folder / "report.md").write_text("\n\n".join(parts) + "\n")
    for name, panels in _plots(folder).items():
        (folder / f"{name}.svg").write_text(figure(panels))


def _table(head: tuple[str, ...], rows: Any) -> str:
    lines_ = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines_ + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows])


def _sum(counts: dict[str, int], begin: str) -> int:
    return sum(count for name, count in counts.items() if name.startswith(begin))


def _summary(totals: dict[str, Any], counts: dict[str, int]) -> str:
    rows = [
        ("queue", totals.get("queue", "")),
        ("minutes", f"{totals['seconds'] / 60:.1f} in {totals['pieces']} pieces"),
        ("requests", counts.get("requests", 0)),
        ("durable jobs acknowledged", counts.get("jobs acknowledged", 0)),
        ("durable jobs ended and checked", _sum(counts, "ended ")),
        ("flows in one call", counts.get("flows answered", 0)),
        ("results equal to the undisturbed ones", counts.get("results compared", 0) - counts.get("wrong results", 0)),
        ("results with deadlines, checked to be finite", counts.get("results with deadlines", 0)),
        ("kills of the server", counts.get("kills", 0)),
        ("kills of the database", counts.get("database kills", 0)),
        ("orderly restarts", counts.get("restarts", 0)),
        ("pauses", counts.get("pauses", 0)),
        ("bad files sent", counts.get("bad files sent", 0)),
        ("calls hung up", counts.get("hung up while waiting", 0) + counts.get("hung up in an upload", 0)),
        ("webhooks taken", counts.get("webhooks taken", 0)),
        ("webhooks told again after they were taken", counts.get("webhooks told again", 0)),
        ("**violations**", f"**{_sum(counts, 'violation ')}**"),
    ]
    return _table(("what", "figure"), rows)


def _jobs(counts: dict[str, int]) -> str:
    states = ("succeeded", "cancelled", "expired", "failed")
    kinds = ("pair", "sequence", "dense")
    return _table(
        ("kind", *states), [(kind, *(counts.get(f"ended {kind} {state}", 0) for state in states)) for kind in kinds]
    )


def _health(totals: dict[str, Any], counts: dict[str, int]) -> str:
    steps, worst = totals.get("health", {}), totals.get("health_worst", {})
    median, most = percentile(steps, 0.5), percentile(steps, 0.99)
    said = (
        f"Normal times: median {median:.1f} ms, 99 % {most:.1f} ms, worst {worst.get('normal', 0):.1f} ms. "
        f"The limit is {LIMIT_MS:.0f} ms. Only normal times count as violations."
    )
    reasons = ("normal", "machine overloaded", "beside a start", "paused")
    rows = [
        (
            reason,
            counts.get(f"health answers: {reason}", 0),
            counts.get(f"health above {LIMIT_MS:.0f} ms: {reason}", 0),
            f"{worst.get(reason, 0):.1f}",
        )
        for reason in reasons
    ]
    return said + "\n\n" + _table(("time", "answers", f"above {LIMIT_MS:.0f} ms", "worst, ms"), rows)


def _growth(found: list[Line]) -> str:
    if not found:
        return "Nothing is judged: no life and no run was long enough."
    scale = {name: (MIB, "MiB") for name in ("rss", "queue", "orphan_bytes")} | dict.fromkeys(OF_A_JOB, (1024, "KiB"))
    rows = []
    for line in found:
        unit, name = scale.get(line.name, (1, ""))
        rows.append(
            (
                f"{line.name} {name}".strip(),
                line.scope,
                f"{line.seconds / 60:.1f}",
                f"{line.mean / unit:.1f}",
                f"{line.rise / unit:+.1f}",
                f"{line.allowed / unit:.1f}",
                "**grows**" if line.grows else "steady",
            )
        )
    return _table(("quantity", "scope", "minutes", "mean", "rise of the fitted line", "allowed", "verdict"), rows)


def _violations(folder: Path, counts: dict[str, int]) -> str:
    if not _sum(counts, "violation "):
        return "None."
    parts = []
    for one in read(folder, "violations"):
        evidence = json.dumps(one["evidence"], indent=1)[:4000]
        parts.append(f"### {one['kind']}, minute {one['s'] / 60:.1f}, piece {one['piece']}\n\n```json\n{evidence}\n```")
    return "\n\n".join(parts)


def _plots(folder: Path) -> dict[str, list[Panel]]:
    marks: dict[str, list[float]] = defaultdict(list)
    for one in read(folder, "trouble"):
        marks[MARKS[one["what"]]].append(one["s"] / 60)
    processes, store, health = (read(folder, name) for name in ("processes", "store", "health"))

    def by_life(name: str, unit: float = 1.0) -> list[Series]:
        nodes: dict[str, dict[int, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
        for one in processes:
            if name in one:
                nodes[one["node"]][one["life"]].append((one["s"] / 60, one[name] / unit))
        return [Series(node, list(lives.values())) for node, lives in nodes.items()]

    def of_store(names: dict[str, str], unit: float = 1.0) -> list[Series]:
        found = []
        for name, title in names.items():
            pieces: dict[int, list[tuple[float, float]]] = defaultdict(list)
            for one in store:
                if name in one:
                    pieces[one["piece"]].append((one["s"] / 60, one[name] / unit))
            found.append(Series(title, list(pieces.values())))
        return found

    reasons: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for one in health:
        reasons[one["reason"]].append((one["s"] / 60, one["ms"]))
    dots = [Series(reason, [points], True) for reason, points in sorted(reasons.items(), reverse=True)]
    return {
        "processes": [
            Panel("resident memory, MiB", by_life("rss", MIB), marks),
            Panel("open descriptors", by_life("descriptors"), marks),
            Panel("threads", by_life("threads"), marks),
            Panel("metric series", by_life("series"), marks),
        ],
        "store": [
            Panel("payloads and results of known jobs, MiB", of_store({"blobs": "blobs"}, MIB), marks),
            Panel("queue, MiB", of_store({"queue": "queue", "wal": "write-ahead log"}, MIB), marks),
            Panel("rows of the jobs table", of_store({"rows": "rows"}), marks),
            Panel("folders of payloads without a job", of_store({"orphans": "orphans"}), marks),
        ],
        "health": [Panel("health, ms (all above 10 ms, of others one in 20)", dots, marks, True, LIMIT_MS)],
        "jobs": [
            Panel("jobs and flows done", of_store({"done": "done"}), marks),
            Panel("durable jobs that wait or run", of_store({"waiting": "waiting"}), marks),
            Panel("lanes that compute", by_life("fnsf_device_busy_ratio"), marks),
        ],
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="tests/soak/report", description="Writes report.md and plots of a soak.")
    parser.add_argument("--state", type=Path, default=Path("soak-state"))
    folder = parser.parse_args().state
    write(folder)
    print(folder / "report.md")
