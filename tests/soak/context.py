"""What the parts of a soak share: the nodes, the cases, the records, and the end that is asked for."""

import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any

from cases import Case
from client import Answer, call, form, headers_of
from hooks import Receiver
from ledger import Job, Ledger
from server import WRITERS, Node
from state import State
from timeline import Timeline

TENANT_KEYS = {key.tenant: key.key for key in WRITERS}


@dataclass
class Soak:
    """A running soak."""

    state: State
    times: Timeline
    nodes: list[Node]
    cases: dict[str, Case]
    receiver: Receiver
    ledger: Ledger
    # By case and format, what `cases.digest` says of an undisturbed result.
    references: dict[str, dict[str, dict[str, str]]] = field(default_factory=dict)
    # Set when no more load is wanted, and when everything is to end.
    is_draining: threading.Event = field(default_factory=threading.Event)
    is_over: threading.Event = field(default_factory=threading.Event)
    _later: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _turn: int = 0

    def node(self) -> Node:
        """A node to call."""
        return random.choice(self.nodes)

    def call(self, method: str, path: str, tenant: str, body: bytes | None = None, **more: Any) -> Answer:
        """One call as a tenant, to any node. `key` and `headers` replace what is sent.

        Raises `Unreachable` where no complete answer came.
        """
        key = more.pop("key", TENANT_KEYS.get(tenant, ""))
        headers = headers_of(key, more.pop("headers", None), body is not None)
        self.state.count("requests")
        answer = call(self.node().port, method, path, headers, body, **more)
        self.state.count(f"status {answer.status}" + (f" {answer.code}" if answer.code else ""))
        return answer

    def body(self, job: Job) -> bytes:
        """The form of a submission; the same each time."""
        case = self.cases[job.case]
        options: dict[str, Any] = {**case.options, "labels": {"soak": str(job.number), "case": case.name}}
        if job.deadline_ms:
            options["deadline_ms"] = job.deadline_ms
        if job.webhook:
            options["webhook"] = self.receiver.url + str(job.number)
        return form(case.parts, options)

    def found(self, job: Job) -> list[Any] | None:
        """The jobs of the server's list with the label of a submission; `None` where it does not say."""
        answer = self.call("GET", f"/v1/jobs?label=soak%3D{job.number}", job.tenant)
        return answer.json()["jobs"] if answer.status == 200 else None

    def later(self, seconds: float, task: Callable[[], None]) -> None:
        """Has a task done after some seconds."""
        with self._lock:
            self._turn += 1
            heappush(self._later, (time.time() + seconds, self._turn, task))

    def due_task(self) -> Callable[[], None] | None:
        """A task whose time has come."""
        with self._lock:
            if self._later and self._later[0][0] <= time.time():
                return heappop(self._later)[2]
            return None

    def has_tasks(self) -> bool:
        """Whether tasks are left."""
        with self._lock:
            return bool(self._later)
