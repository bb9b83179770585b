"""Samples of what must not grow: memory, descriptors, threads, disk, rows, metric series. Also orphaned payloads."""

import contextlib
import os
import sqlite3
import threading
import time
import uuid
from pathlib import Path
from typing import Any

from client import Unreachable, call
from context import Soak
from postgres import Postgres
from server import Node

PERIOD = 2.0
# Counting files and rows costs more.
STORE_EVERY = 6
# Payloads of interrupted uploads are removed one to two hours later, by a server that has run for five minutes;
# docs/operations.md says so.
ORPHAN_SECONDS = 2 * 3600 + 600
SEARCHED_SECONDS = 360


def of_process(pid: int) -> dict[str, int]:
    """Resident bytes, threads and open descriptors of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    return {
        "rss": int(fields["VmRSS"].split()[0]) * 1024,
        "threads": int(fields["Threads"]),
        "descriptors": len(os.listdir(f"/proc/{pid}/fd")),
    }


def series(node: Node) -> tuple[int, dict[str, float]]:
    """The number of metric series, and some of their values.

    Raises `Unreachable` where the node is away.
    """
    text = call(node.admin, "GET", "/metrics", {}, timeout=10).body.decode()
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    names = ("fnsf_queue_depth", "fnsf_jobs_running", "fnsf_dead_letters_total", "fnsf_leases_expired_total")
    names += ("fnsf_device_busy_ratio",)
    values: dict[str, float] = {}
    for line in lines:
        name = line.split("{")[0].split(" ")[0]
        if name in names:
            values[name] = values.get(name, 0.0) + float(line.split()[-1])
    return len(lines), values


def known_jobs(data: Path, database: Postgres | None) -> set[str] | None:
    """The ids of all rows of the jobs table, as hexadecimal digits; `None` where the database is away."""
    if database:
        found = database.ask("SELECT encode(id, 'hex') FROM jobs")
        return None if found is None else set(found.split())
    try:
        with contextlib.closing(sqlite3.connect(f"file:{data}/queue.sqlite3?mode=ro", uri=True, timeout=2)) as queue:
            return {row[0].hex() for row in queue.execute("SELECT id FROM jobs")}
    except sqlite3.Error:
        return None


def size(folder: Path) -> tuple[int, float]:
    """Bytes of the files below a folder, and the time of the latest change."""
    total, latest = 0, 0.0
    for path, _, names in os.walk(folder):
        with contextlib.suppress(OSError):
            latest = max(latest, os.stat(path).st_mtime)
        for name in names:
            with contextlib.suppress(OSError):
                about = os.stat(os.path.join(path, name))
                total, latest = total + about.st_size, max(latest, about.st_mtime)
    return total, latest


def of_store(data: Path, database: Postgres | None) -> dict[str, Any] | None:
    """Bytes of known jobs and of orphans, the size of the queue and its rows."""
    folders = [job for group in (data / "blobs" / "jobs").glob("*") for job in group.glob("*")]
    # Rows are read after the folders: a folder that is there before its row is an upload under way.
    known = known_jobs(data, database)
    if known is None:
        return None
    found: dict[str, Any] = {"rows": len(known), "blobs": 0, "orphans": 0, "orphan_bytes": 0, "old_orphans": []}
    for folder in folders:
        total, latest = size(folder)
        if uuid.UUID(folder.name).hex in known:
            found["blobs"] += total
        elif time.time() - latest > 10 and folder.exists():
            found["orphans"] += 1
            found["orphan_bytes"] += total
            if time.time() - latest > ORPHAN_SECONDS:
                found["old_orphans"].append(folder.name)
    if database:
        found["queue"] = int(database.ask("SELECT pg_total_relation_size('jobs')") or 0)
    else:
        found["queue"] = (data / "queue.sqlite3").stat().st_size
        found["wal"] = size_of(data / "queue.sqlite3-wal")
    return found


def size_of(path: Path) -> int:
    """Bytes of a file; 0 where there is none."""
    return path.stat().st_size if path.exists() else 0


class Sampler(threading.Thread):
    """Writes samples of each process every 2 s, and of the store every 12 s."""

    def __init__(self, soak: Soak, data: Path, database: Postgres | None) -> None:
        super().__init__(daemon=True, name="sampler")
        self.soak, self.data, self.database = soak, data, database
        self.is_over = threading.Event()

    def run(self) -> None:
        turn = 0
        while not self.is_over.wait(PERIOD):
            turn += 1
            for node in self.soak.nodes:
                with contextlib.suppress(OSError, Unreachable, KeyError):
                    self.process(node, turn % STORE_EVERY == 0)
            if turn % STORE_EVERY == 0:
                self.store()
            self.soak.state.save()

    def process(self, node: Node, has_series: bool) -> None:
        """One sample of a process."""
        pid, life = node.pid, node.life
        if pid is None:
            return
        sample: dict[str, Any] = {"node": node.name, "life": life, "age": time.time() - node.started, **of_process(pid)}
        if has_series and not self.soak.times.kinds(time.time(), time.time(), node.name):
            sample["series"], values = series(node)
            sample |= values
            if values.get("fnsf_leases_expired_total") and not self.database:
                self.soak.state.violation("lease expired", node=node.name, life=life)
        self.soak.state.write("processes", sample)

    def store(self) -> None:
        """One sample of the store and of the jobs done."""
        with contextlib.suppress(OSError):
            found = of_store(self.data, self.database)
            if found is None:
                return
            for old in found.pop("old_orphans"):
                self.soak.state.count("orphans older than promised")
                self.orphan(old)
            counts = self.soak.state.counts
            found["done"] = sum(count for name, count in counts.items() if name.startswith("ended "))
            found["done"] += counts.get("flows answered", 0)
            found["waiting"] = self.soak.ledger.waiting()
            self.soak.state.write("store", found)

    def orphan(self, job: str) -> None:
        """Payloads without a job that are older than documented, told once each."""
        told: list[str] = self.soak.state.totals.setdefault("old_orphans", [])
        lives = [round(time.time() - node.started) for node in self.soak.nodes]
        if job not in told and max(lives) > SEARCHED_SECONDS:
            told.append(job)
            self.soak.state.violation("payload without a job", job=job, seconds_since_start=lives)
