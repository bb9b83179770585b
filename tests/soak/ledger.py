"""The jobs that were submitted: what was asked, what was acknowledged, how they ended."""

import threading
import time
from dataclasses import dataclass, field
from typing import Any

from cases import Case
from server import Key
from state import State, read

ENDS = ("succeeded", "failed", "cancelled", "expired")


@dataclass
class Job:
    """A submission. `number` is its label `soak`, by which lists find it."""

    number: int
    case: str
    tenant: str
    key: str = ""
    deadline_ms: int = 0
    webhook: bool = False
    id: str = ""
    plan: str = "leave"
    acknowledged: float = 0.0
    seen: float = 0.0
    ended: float = 0.0
    end: dict[str, Any] = field(default_factory=dict)
    cancel_asked: bool = False
    is_cancelled: bool = False
    requeues: int = 0
    is_told: bool = False
    removal_asked: bool = False
    is_busy: bool = False
    next_look: float = 0.0

    def record(self) -> dict[str, Any]:
        """What the next piece of the soak needs of it."""
        names = ("number", "case", "tenant", "key", "deadline_ms", "webhook", "id", "plan", "acknowledged", "ended")
        return {name: getattr(self, name) for name in names}


class Ledger:
    """Open jobs by number. Records go to `jobs.jsonl`."""

    def __init__(self, state: State) -> None:
        self.state = state
        self._lock = threading.Lock()
        self.open: dict[int, Job] = {}
        self.from_before = self._read()
        for job in self.from_before:
            self.open[job.number] = job

    def _read(self) -> list[Job]:
        """Jobs that an earlier piece left open."""
        jobs: dict[int, Job] = {}
        for line in read(self.state.folder, "jobs"):
            if line["event"] == "acknowledged":
                jobs[line["job"]["number"]] = self._carried(Job(**line["job"]))
            elif line["event"] == "closed":
                jobs.pop(line["number"], None)
        return list(jobs.values())

    @staticmethod
    def _carried(job: Job) -> Job:
        """A job of an earlier piece. What was done to it since its submission is not known."""
        job.cancel_asked, job.removal_asked = job.plan in ("cancel", "requeue"), job.plan == "remove"
        job.requeues, job.is_told, job.ended, job.seen = 1, True, 0.0, job.acknowledged
        return job

    def new(self, case: Case, key: Key, **more: Any) -> Job:
        """A new submission, not acknowledged yet."""
        number = self.state.count("submissions")
        return Job(number, case.name, key.tenant, **more)

    def acknowledge(self, job: Job, id: str) -> None:
        """The server has promised to do this job."""
        with self._lock:
            if job.id:
                if job.id != id:
                    self.state.violation("two jobs for one key", job=job.record(), other=id)
                return
            job.id, job.acknowledged, job.seen = id, time.time(), time.time()
            self.open[job.number] = job
        self.state.count("jobs acknowledged")
        self.state.write("jobs", {"event": "acknowledged", "job": job.record()})

    def close(self, job: Job, outcome: str) -> None:
        """All of a job is checked."""
        with self._lock:
            self.open.pop(job.number, None)
        self.state.write("jobs", {"event": "closed", "number": job.number, "id": job.id, "outcome": outcome})

    def waiting(self) -> int:
        """Jobs that have not been seen to end."""
        with self._lock:
            return sum(not job.ended for job in self.open.values())

    def due(self) -> Job | None:
        """A job that is to be looked at now. The caller gives it back with `release`."""
        with self._lock:
            now = time.time()
            ready = [job for job in self.open.values() if not job.is_busy and job.next_look <= now]
            if not ready:
                return None
            job = min(ready, key=lambda one: one.next_look)
            job.is_busy = True
            return job

    def release(self, job: Job, seconds: float) -> None:
        """Gives a job back, to be looked at again after some seconds."""
        job.next_look = time.time() + seconds
        job.is_busy = False
