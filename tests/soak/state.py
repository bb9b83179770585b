"""The folder that carries a soak from one piece to the next: totals, records as JSON lines, violations."""

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

# A kind of violation keeps this many pieces of evidence; all are counted.
MOST_EVIDENCE = 50


class State:
    """Counters and records of a soak. All of its methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._lock = threading.Lock()
        self._files: dict[str, Any] = {}
        held = folder / "totals.json"
        self.totals: dict[str, Any] = json.loads(held.read_text()) if held.exists() else {}
        self.counts: dict[str, int] = self.totals.setdefault("counts", {})
        self.totals["pieces"] = self.totals.get("pieces", 0) + 1
        self.piece: int = self.totals["pieces"]
        self._before: float = self.totals.setdefault("seconds", 0.0)
        self._began = time.monotonic()
        self.violated = 0

    def seconds(self) -> float:
        """Seconds of all pieces until now."""
        return self._before + time.monotonic() - self._began

    def count(self, name: str, by: int = 1) -> int:
        """Adds to a counter and returns it."""
        with self._lock:
            self.counts[name] = self.counts.get(name, 0) + by
            return self.counts[name]

    def write(self, file: str, record: dict[str, Any]) -> None:
        """Appends a record to `FILE.jsonl`, with the time and the seconds of the soak."""
        record = {"t": round(time.time(), 3), "s": round(self.seconds(), 3), "piece": self.piece, **record}
        line = json.dumps(record) + "\n"
        with self._lock:
            if file not in self._files:
                self._files[file] = (self.folder / f"{file}.jsonl").open("a")
            self._files[file].write(line)
            self._files[file].flush()

    def violation(self, kind: str, **evidence: Any) -> None:
        """Counts a violation of an invariant and keeps its evidence."""
        self.violated += 1
        if self.count(f"violation {kind}") <= MOST_EVIDENCE:
            self.write("violations", {"kind": kind, "evidence": evidence})
            print(f"VIOLATION {kind}: {json.dumps(evidence)[:600]}", flush=True)

    def save(self) -> None:
        """Writes the totals, whole or not at all."""
        with self._lock:
            self.totals["seconds"] = self._before + time.monotonic() - self._began
            text = json.dumps(self.totals, indent=1)
        new = self.folder / "totals.json.new"
        new.write_text(text)
        os.replace(new, self.folder / "totals.json")


def read(folder: Path, file: str) -> list[dict[str, Any]]:
    """The records of `FILE.jsonl`. A last line that was cut off is left out."""
    path = folder / f"{file}.jsonl"
    records = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            records.append(json.loads(line))
        except ValueError:
            continue
    return records
