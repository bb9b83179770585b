"""One piece of a soak: starts the servers, references, load and trouble, and ends with everything checked."""

import argparse
import hashlib
import os
import random
import shutil
import signal
import threading
import time
from pathlib import Path

import invariants
import references
import report
import trends
from cases import catalogue
from client import Unreachable
from context import Soak
from follow import FOLLOWERS, Follower
from health import Health
from hooks import Receiver
from ledger import Ledger
from load import CALLERS, Caller
from postgres import Postgres
from samples import Sampler
from server import Node, configuration, free_port
from state import State
from timeline import Timeline
from trouble import Trouble

ROOT = Path(__file__).resolve().parents[2]
# After the load has ended: the backlog, and notices that were refused.
DRAIN_SECONDS = 240.0
LIST_EVERY = 60.0


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="tests/soak/run", description="Drives a server for hours while it is killed, and checks what must hold."
    )
    parser.add_argument("minutes", type=float, help="minutes of load; checks at the end take a few more")
    parser.add_argument("--state", type=Path, default=Path("soak-state"), help="folder that carries the soak over")
    parser.add_argument("--nodes", type=int, default=1, help="nodes; more than one needs --postgres")
    parser.add_argument("--postgres", action="store_true", help="nodes on one PostgreSQL that is started here")
    parser.add_argument("--binary", type=Path, default=ROOT / "target/release/fnsf")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kill-every", type=float, default=20.0, help="mean seconds between troubles; 0 makes none")
    asked = parser.parse_args()
    if asked.nodes > 1 and not asked.postgres:
        parser.error("more than one node needs --postgres")
    return asked


class Piece:
    """A piece of a soak, from its start to its end."""

    def __init__(self, asked: argparse.Namespace) -> None:
        self.asked = asked
        self.state = State(asked.state.resolve())
        self.seed = asked.seed * 1000 + self.state.piece
        self.data = self.state.folder / "data"
        # A copy: the program may be built again meanwhile.
        self.binary = self.state.folder / "fnsf"
        shutil.copy2(asked.binary, self.binary)
        self.key = hashlib.sha256(self.binary.read_bytes()).hexdigest()[:12] + f"-{asked.seed}"
        self.times = Timeline()
        kind = "postgres" if asked.postgres else "sqlite"
        if self.state.totals.setdefault("queue", kind) != kind:
            raise SystemExit(f"the state is of a soak on {self.state.totals['queue']}")
        self.database = Postgres(self.state.folder) if asked.postgres else None
        port = self.state.totals.setdefault("hooks_port", free_port())
        self.receiver = Receiver(self.state, port)
        self.nodes = [self._node(number) for number in range(asked.nodes)]
        cases = {case.name: case for case in catalogue(asked.seed)}
        self.soak = Soak(self.state, self.times, self.nodes, cases, self.receiver, Ledger(self.state))
        self.is_asked_to_end = threading.Event()
        self.threads: list[threading.Thread] = []
        self.health: Health | None = None
        self.sampler: Sampler | None = None
        self.trouble: Trouble | None = None

    def _node(self, number: int) -> Node:
        ports = (free_port(), free_port())
        queue = f'postgres = "{self.database.url}"\nmax_attempts = 1000\n' if self.database else ""
        devices = '["cpu:1"]' if self.asked.nodes > 1 else '["cpu:1", "cpu:1"]'
        text = configuration(self.data, ports, self.receiver.url, devices, queue, bool(self.database))
        return Node(f"node{number}", self.binary, text, ports, self.state, self.times)

    def start(self) -> None:
        """Starts the servers, undisturbed, and computes what is compared later."""
        if self.database:
            self.database.start()
        for node in self.nodes:
            node.start()
        time.sleep(2.0)
        references.compute(self.soak, self.binary, self.key)
        references.bad_files_cost_nothing(self.soak)

    def run(self) -> None:
        """Load and trouble until the time is over or the end is asked for."""
        self.health = Health(self.state, self.times, self.nodes)
        self.sampler = Sampler(self.soak, self.data, self.database)
        self.trouble = Trouble(
            self.state, self.times, self.nodes, self.database, self.asked.kill_every or 1e9, self.seed
        )
        self.threads = [Follower(self.soak, self.seed * 100 + turn) for turn in range(FOLLOWERS)]
        self.threads += [Caller(self.soak, self.seed * 100 + 50 + turn) for turn in range(CALLERS)]
        for thread in [self.health, self.sampler, self.trouble, *self.threads]:
            thread.start()
        until = time.monotonic() + self.asked.minutes * 60
        listed = time.monotonic()
        while time.monotonic() < until and not self.is_asked_to_end.wait(0.2):
            for node in self.nodes:
                node.revive()
            if time.monotonic() - listed > LIST_EVERY:
                listed = time.monotonic()
                self._compare_lists()
                self._say()

    def _compare_lists(self) -> None:
        try:
            invariants.list_is_known(self.soak)
        except Unreachable:
            self.state.count("calls cut off")
        invariants.notices_are_few(self.soak, False)

    def _say(self) -> None:
        counts = self.state.counts
        done = sum(count for name, count in counts.items() if name.startswith("ended "))
        print(
            f"{self.state.seconds() / 60:6.1f} min: {counts.get('requests', 0)} requests, {done} jobs ended, "
            f"{self.soak.ledger.waiting()} wait, {counts.get('kills', 0)} kills, {self.state.violated} violations",
            flush=True,
        )

    def drain(self) -> None:
        """Ends load and trouble, and waits until all jobs have ended and are checked."""
        if self.trouble:
            self.trouble.is_over.set()
            self.trouble.join(120)
        self.soak.is_draining.set()
        for thread in self.threads:
            if isinstance(thread, Caller):
                thread.join(120)
        until = time.monotonic() + DRAIN_SECONDS
        while time.monotonic() < until and not self.is_asked_to_end.wait(0.2):
            if not self.soak.ledger.open and not self.soak.has_tasks():
                break
        if self.is_asked_to_end.is_set():
            return
        for job in list(self.soak.ledger.open.values()):
            self.state.violation("job does not end", job=job.record(), end=job.end)
        self._compare_lists()
        invariants.notices_are_few(self.soak, True)

    def stop(self) -> None:
        """Stops everything that was started."""
        if self.trouble:
            self.trouble.is_over.set()
            self.trouble.join(120)
        self.soak.is_draining.set()
        self.soak.is_over.set()
        for thread in self.threads:
            thread.join(30)
        if self.sampler:
            self.sampler.is_over.set()
            self.sampler.join(30)
        for node in self.nodes:
            node.stop()
            if node.log.exists():
                node.read_log()
        if self.health:
            self.health.close()
        if self.database:
            self.database.stop()
        self.receiver.close()
        trends.judge(self.state)
        self.state.save()


def main() -> int:
    """Runs a piece and writes its report. The status is 1 where an invariant was violated."""
    asked = parsed()
    random.seed(asked.seed)
    piece = Piece(asked)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: piece.is_asked_to_end.set())
    try:
        piece.start()
        piece.run()
        piece.drain()
    finally:
        piece.stop()
    report.write(piece.state.folder)
    print((piece.state.folder / "report.md").read_text() if os.isatty(1) else f"{piece.state.folder}/report.md")
    return 1 if piece.state.violated else 0
