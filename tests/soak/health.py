"""Judges the answers of the admin ports: fast, or slow for a reason, or a violation."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from server import Node
from state import State
from timeline import Timeline

LIMIT_MS = 50.0
# Where a process that only echoes a byte takes so long, the machine is at fault.
OVERLOAD_MS = 20.0


class Health(threading.Thread):
    """Reads what `probe.py` measures. Latencies are counted in steps of 0.1 ms."""

    def __init__(self, state: State, times: Timeline, nodes: list[Node]) -> None:
        super().__init__(daemon=True, name="health")
        self.state, self.times = state, times
        self.steps: dict[str, int] = state.totals.setdefault("health", {})
        self.worst: dict[str, float] = state.totals.setdefault("health_worst", {})
        program = str(Path(__file__).with_name("probe.py"))
        self.process = subprocess.Popen(
            [sys.executable, program, *(f"{node.name}={node.admin}" for node in nodes)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            process_group=0,
        )

    def run(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.judge(json.loads(line))

    def judge(self, answer: dict[str, Any]) -> None:
        """Counts one answer under the reason for its latency."""
        since, until = answer["at"] - 0.05, answer["at"] + answer["ms"] / 1e3 + 0.05
        own, all_ = self.times.kinds(since, until, answer["node"]), self.times.kinds(since, until)
        if own & {"down", "stopping"} or (answer["status"] != 200 and own & {"starting", "paused", "database"}):
            self.state.count("health questions while down or stopping")
            return
        if answer["status"] != 200:
            self.state.violation("health", **answer)
            return
        if own & {"paused"}:
            reason = "paused"
        elif all_ & {"starting", "down"}:
            reason = "beside a start"
        elif answer["control_ms"] > OVERLOAD_MS:
            reason = "machine overloaded"
        else:
            reason = "normal"
        step = f"{int(answer['ms'] * 10)}"
        if reason == "normal":
            self.steps[step] = self.steps.get(step, 0) + 1
        self.worst[reason] = max(self.worst.get(reason, 0.0), answer["ms"])
        self.state.count(f"health answers: {reason}")
        if answer["ms"] > LIMIT_MS:
            self.state.count(f"health above {LIMIT_MS:.0f} ms: {reason}")
            if reason == "normal":
                self.state.violation("health is slow", **answer)
        if answer["ms"] > LIMIT_MS / 5 or self.state.counts[f"health answers: {reason}"] % 20 == 0:
            record = {"node": answer["node"], "ms": round(answer["ms"], 2), "reason": reason}
            self.state.write("health", record | {"control_ms": round(answer["control_ms"], 1)})

    def close(self) -> None:
        """Ends the probe."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def percentile(steps: dict[str, int], share: float) -> float:
    """The latency in ms that this share of the answers does not exceed."""
    left = share * sum(steps.values())
    for step, count in sorted((int(step), count) for step, count in steps.items()):
        left -= count
        if left <= 0:
            return (step + 1) / 10
    return 0.0
