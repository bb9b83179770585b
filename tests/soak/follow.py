"""Followers: each brings one job after the other to its end, and checks what the server says of it on the way."""

import random
import threading
import time
import traceback
from typing import Any

import invariants
from client import Unreachable, events, headers_of
from context import TENANT_KEYS, Soak
from ledger import ENDS, Job

FOLLOWERS = 4


class Follower(threading.Thread):
    """Takes jobs of the ledger that are due. A job has one follower at a time."""

    def __init__(self, soak: Soak, seed: int) -> None:
        super().__init__(daemon=True, name=f"follower-{seed}")
        self.soak, self.dice = soak, random.Random(seed)

    def run(self) -> None:
        while not self.soak.is_over.is_set():
            task = self.soak.due_task()
            if task:
                self._do(task)
                continue
            job = self.soak.ledger.due()
            if job is None:
                time.sleep(0.02)
                continue
            pause = [0.3]
            self._do(lambda job=job, pause=pause: pause.append(self._after_end(job) if job.ended else self._look(job)))
            self.soak.ledger.release(job, pause[-1])

    def _do(self, task: Any) -> None:
        try:
            task()
        except Unreachable:
            self.soak.state.count("calls cut off")
        except Exception as error:
            # A fault of this program, or an answer of a form that nobody expects: either is to be looked at.
            self.soak.state.violation("harness", error=repr(error), trace=traceback.format_exc()[-1500:])
            time.sleep(0.5)

    def _call(self, job: Job, method: str, path: str, **more: Any) -> Any:
        return self.soak.call(method, f"/v1/jobs/{job.id}{path}", job.tenant, **more)

    def _look(self, job: Job) -> float:
        """Looks at a job that has not ended. Returns the seconds until the next look."""
        if job.plan in ("cancel", "requeue") and not job.cancel_asked and not job.requeues:
            self._cancel(job)
        elif job.plan == "repeat" and self.dice.random() < 0.5:
            self._repeat(job)
        turn = self.dice.random()
        if turn < 0.2:
            view = self._watch(job)
        else:
            answer = self._call(job, "GET", "?wait=2" if turn < 0.5 else "")
            view = self._view(job, answer)
        if view is None:
            return 0.5
        job.seen = time.time()
        if view["state"] not in ENDS:
            return self.dice.uniform(0.1, 0.8)
        invariants.end_is_legitimate(self.soak, job, view)
        if view["state"] in ("cancelled", "expired") and job.plan == "requeue" and not job.requeues:
            return self._requeue(job)
        job.ended, job.end = time.time(), invariants.end_of(view)
        kind = self.soak.cases[job.case].kind
        self.soak.state.count(f"ended {kind} {view['state']}")
        for _ in range(2):
            self._fetch(job, view)
        return self.dice.uniform(1.0, 20.0)

    def _view(self, job: Job, answer: Any) -> dict[str, Any] | None:
        if answer.status == 200:
            return answer.json()
        if answer.status == 404:
            if invariants.job_may_be_gone(job):
                self.soak.state.count("gone by retention before it was looked at")
            else:
                self.soak.state.violation("job is lost", job=job.record(), seen=job.seen)
            self.soak.ledger.close(job, "gone")
        else:
            invariants.answer_is_expected(self.soak, "job", answer, 200)
        return None

    def _watch(self, job: Job) -> dict[str, Any] | None:
        """Follows the events of a job for some seconds. Returns the last state."""
        view = None
        self.soak.state.count("event streams")
        headers = headers_of(TENANT_KEYS[job.tenant])
        for name, data in events(self.soak.node().port, f"/v1/jobs/{job.id}/events", headers, 3.0):
            if name == "refused" and data == 404:
                return self._view(job, self._call(job, "GET", ""))
            if name == "state":
                if view and view["state"] in ENDS:
                    self.soak.state.violation("event after the end", job=job.record(), view=data)
                view = data
        return view

    def _cancel(self, job: Job) -> None:
        job.cancel_asked = True
        answer = self._call(job, "DELETE", "")
        if invariants.answer_is_expected(self.soak, "cancel", answer, 200):
            self.soak.state.count("cancels")
            job.is_cancelled = answer.json()["state"] == "cancelled"

    def _repeat(self, job: Job) -> None:
        """A submission with a known idempotency key finds its job, while the job is kept."""
        if invariants.job_may_be_gone(job):
            self.soak.state.count("gone by retention before it was repeated")
            return
        answer = self.soak.call(
            "POST", "/v1/jobs", job.tenant, self.soak.body(job), headers={"Idempotency-Key": job.key}
        )
        if invariants.answer_is_expected(self.soak, "repeated submission", answer, 200, 202):
            self.soak.state.count("repeated submissions")
            if answer.status == 202 or answer.json()["id"] != job.id:
                self.soak.state.violation("two jobs for one key", job=job.record(), view=answer.json())

    def _requeue(self, job: Job) -> float:
        """Requeues a job that was cancelled or has expired. It is then as any other, without a deadline."""
        job.requeues += 1
        job.cancel_asked, job.is_cancelled, before = False, False, (job.cancel_asked, job.is_cancelled)
        try:
            answer = self._call(job, "POST", "/requeue")
        except Unreachable:
            answer = None
        if answer is not None and invariants.answer_is_expected(self.soak, "requeue", answer, 200):
            self.soak.state.count("requeues")
            job.deadline_ms = 0
            if answer.json()["deadline"] is not None:
                self.soak.state.violation("requeued job has a deadline", view=answer.json())
        else:
            # It may be queued or not: either end is right.
            job.cancel_asked, job.is_cancelled = before[0], False
        return 0.3

    def _fetch(self, job: Job, view: dict[str, Any]) -> None:
        """Downloads the result in a format, whole or in two ranges, or a sweep, or the tracks."""
        case = self.soak.cases[job.case]
        if view["state"] != "succeeded":
            answer = self._call(job, "GET", "/result")
            invariants.answer_is_expected(self.soak, "result of a job without one", answer, 409, 422, 504)
            return
        turn = self.dice.random()
        if turn < 0.1:
            answer = self._call(job, "GET", "/sweeps/0")
            if invariants.answer_is_expected(self.soak, "sweep", answer, 200):
                invariants.sweep_is_right(self.soak, job, answer.body)
            return
        if turn < 0.2 and case.kind == "sequence" and "preset" not in case.options:
            answer = self._call(job, "GET", "/tracks")
            if invariants.answer_is_expected(self.soak, "tracks", answer, 200):
                invariants.tracks_are_whole(self.soak, job, answer)
            return
        form = self.dice.choice(list(case.formats))
        if job.deadline_ms:
            form = {"pair": "f32", "sequence": "zip", "dense": "npz"}[case.kind]
        headers = {"Accept": case.formats[form]}
        answer = self._call(job, "GET", "/result", headers=headers)
        if not invariants.answer_is_expected(self.soak, "result", answer, 200):
            return
        body = answer.body
        if turn < 0.35 and case.kind != "sequence":
            body = self._in_ranges(job, headers, len(body)) or body
        about = {"job": job.record(), "attempt": view["attempt"]}
        invariants.result_is_right(self.soak, job.case, form, body, bool(job.deadline_ms), about)

    def _in_ranges(self, job: Job, headers: dict[str, str], size: int) -> bytes | None:
        cut = self.dice.randrange(1, size)
        pieces = b""
        for span in (f"bytes=0-{cut - 1}", f"bytes={cut}-"):
            answer = self._call(job, "GET", "/result", headers={**headers, "Range": span})
            if not invariants.answer_is_expected(self.soak, "range", answer, 206):
                return None
            pieces += answer.body
        self.soak.state.count("downloads in ranges")
        return pieces

    def _after_end(self, job: Job) -> float:
        """Looks at an ended job once more, removes some, and waits for its webhook."""
        if job.plan != "checked":
            answer = self._call(job, "GET", "")
            view = self._view(job, answer)
            if view is None:
                return 1.0
            invariants.end_is_the_same(self.soak, job, view)
            if job.plan == "repeat":
                self._repeat(job)
            elif job.plan == "remove" and not self._remove(job):
                return 1.0
            job.plan = "checked"
        if job.webhook and not job.is_told and not invariants.is_told(self.soak, job):
            return 2.0
        self.soak.ledger.close(job, job.end["state"])
        return 0.0

    def _remove(self, job: Job) -> bool:
        job.removal_asked = True
        answer = self._call(job, "DELETE", "?remove=true")
        if not invariants.answer_is_expected(self.soak, "removal", answer, 204, 404):
            return False
        self.soak.state.count("removals")
        answer = self._call(job, "GET", "")
        if answer.status == 200:
            self.soak.state.violation("removed job is there", job=job.record(), view=answer.json())
        return True
