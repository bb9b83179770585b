"""The trouble: kills, orderly restarts, pauses and crashes of the database, at random moments.

Times of trouble and calm times take turns. In a calm time a process lives long enough to see whether it grows.
"""

import itertools
import random
import threading
import time
from collections.abc import Callable

from postgres import Postgres
from server import LEASE_SECONDS, Node
from state import State
from timeline import Timeline

TROUBLE_SECONDS = 300.0
# Every third calm time is long: small growth needs a long life to be seen.
CALM_SECONDS = (200.0, 200.0, 900.0)


class Trouble(threading.Thread):
    """Makes trouble for one node after the other until it is told to stop."""

    def __init__(
        self, state: State, times: Timeline, nodes: list[Node], database: Postgres | None, every: float, seed: int
    ) -> None:
        super().__init__(daemon=True, name="trouble")
        self.state, self.times, self.nodes, self.database = state, times, nodes, database
        self.every, self.dice = every, random.Random(seed)
        self.is_over = threading.Event()

    def run(self) -> None:
        began = time.monotonic()
        # Kinds of trouble and nodes are drawn without putting them back, so that a short run has some of each.
        bag: list[Callable[[Node], None]] = []
        nodes: list[Node] = []
        calms = itertools.cycle(CALM_SECONDS)
        while True:
            self.is_over.wait(self.every * self.dice.uniform(0.3, 1.7))
            if time.monotonic() - began > TROUBLE_SECONDS:
                self.is_over.wait(next(calms))
                began = time.monotonic()
            if self.is_over.is_set():
                return
            if not bag:
                bag = [self.kill] * 7 + [self.restart] + [self.pause] * 2
                bag += [self.crash_database] * 3 if self.database else []
                self.dice.shuffle(bag)
            nodes = nodes or self.dice.sample(self.nodes, len(self.nodes))
            bag.pop()(nodes.pop())

    def _note(self, what: str, node: str, **more: float) -> None:
        self.state.count(what)
        self.state.write("trouble", {"what": what, "node": node, **more})

    def kill(self, node: Node) -> None:
        """kill -9 and a start at once. One in five is killed again while it starts or soon after."""
        while True:
            with node.lock:
                node.kill()
                self._note("kills", node.name)
                node.start()
            if self.is_over.is_set() or self.dice.random() > 0.2:
                return
            time.sleep(self.dice.uniform(0.0, 1.0))

    def restart(self, node: Node) -> None:
        """An orderly stop, then a start."""
        with node.lock:
            self._note("restarts", node.name)
            node.stop()
            node.start()

    def pause(self, node: Node) -> None:
        """The process stands still for some seconds, one time in four for longer than a lease."""
        longest = self.dice.random() < 0.25
        seconds = LEASE_SECONDS + self.dice.uniform(1.0, 4.0) if longest else self.dice.uniform(1.0, 5.0)
        self._note("pauses", node.name, seconds=seconds)
        node.pause(seconds, self.is_over)

    def crash_database(self, _: Node) -> None:
        """kill -9 of the postmaster and a start, at once or some seconds later."""
        assert self.database is not None
        span = self.times.begin("database", "database")
        self.times.shock()
        self._note("database kills", "database")
        self.database.kill()
        self.is_over.wait(self.dice.choice((0.0, 0.0, 3.0)))
        self.database.start()
        # Nodes find a database that is back within 10 s.
        self.times.end(span, 10.0)
