"""The load: callers in a closed loop. Each does one thing after the other, as the users of a labelling farm do."""

import random
import threading
import time
import traceback
from typing import Any

import invariants
from cases import FLOW_FORMATS, Case
from client import Unreachable, break_off, form, headers_of
from clouds import bad_files
from context import TENANT_KEYS, Soak
from ledger import ENDS, Job
from server import READER, WRITERS

CALLERS = 6
# No more durable jobs are submitted while so many have not ended.
MOST_WAITING = 30
# A hung-up call is cancelled within an iteration or a cluster; pauses and kills come between.
HANG_UP_SECONDS = 20.0


class Caller(threading.Thread):
    """One caller. What it does is drawn from its seed."""

    def __init__(self, soak: Soak, seed: int) -> None:
        super().__init__(daemon=True, name=f"caller-{seed}")
        self.soak, self.dice = soak, random.Random(seed)
        self.bad = list(bad_files(seed).items())
        self.pairs = [case for case in soak.cases.values() if case.kind == "pair" and not case.error]
        self.refused = [case for case in soak.cases.values() if case.error]
        self.sequences = [case for case in soak.cases.values() if case.kind != "pair"]
        self.actions = {
            self.flow: 24,
            self.submit_pair: 26,
            self.submit_sequence: 7,
            self.flow_with_deadline: 6,
            self.hang_up_waiting: 5,
            self.hang_up_upload: 4,
            self.flow_later: 4,
            self.bad_file: 7,
            self.wrong_key: 2,
            self.list_jobs: 4,
            self.look_around: 2,
            self.reused_key: 1,
        }

    def run(self) -> None:
        while not self.soak.is_draining.is_set():
            action = self.dice.choices(list(self.actions), list(self.actions.values()))[0]
            if action in (self.submit_pair, self.submit_sequence) and self.soak.ledger.waiting() >= MOST_WAITING:
                time.sleep(0.2)
                continue
            try:
                action()
            except Unreachable:
                self.soak.state.count("calls cut off")
                time.sleep(0.2)
            except Exception as error:
                self.soak.state.violation("harness", error=repr(error), trace=traceback.format_exc()[-1500:])
            time.sleep(self.dice.uniform(0.0, 0.15))

    def _case(self, cases: list[Case]) -> Case:
        return self.dice.choices(cases, [case.weight for case in cases])[0]

    def flow(self) -> None:
        """A pair in one call."""
        job = self.soak.ledger.new(self._case(self.pairs), self.dice.choice(WRITERS))
        kind = self.dice.choice(list(FLOW_FORMATS))
        answer = self.soak.call(
            "POST", "/v1/flow", job.tenant, self.soak.body(job), headers={"Accept": FLOW_FORMATS[kind]}
        )
        if invariants.answer_is_expected(self.soak, "flow", answer, 200):
            self.soak.state.count("flows answered")
            about = {"job": answer.headers.get("fnsf-job-id")}
            invariants.result_is_right(self.soak, job.case, kind, answer.body, False, about)

    def flow_with_deadline(self) -> None:
        """A pair in one call with a deadline, short or long, in the options or the header."""
        deadline = self.dice.choice((30, 100, 300, 1000, 5000))
        job = self.soak.ledger.new(self._case(self.pairs), self.dice.choice(WRITERS))
        headers = {"Accept": FLOW_FORMATS["f32"]}
        if deadline >= 1000 and self.dice.random() < 0.5:
            headers["Prefer"] = f"wait={deadline // 1000}"
        else:
            job.deadline_ms = deadline
        began = time.time()
        answer = self.soak.call("POST", "/v1/flow", job.tenant, self.soak.body(job), headers=headers)
        late = time.time() - began - deadline / 1000
        if late > invariants.LATE_SECONDS and not self.soak.times.kinds(began, time.time()):
            self.soak.state.count("answers late after their deadline")
        if invariants.answer_is_expected(self.soak, "flow with a deadline", answer, 200, 504):
            self.soak.state.count(f"flows with deadlines {answer.status}")
            if answer.status == 200:
                about = {"job": answer.headers.get("fnsf-job-id"), "deadline_ms": deadline}
                invariants.result_is_right(self.soak, job.case, "f32", answer.body, True, about)

    def flow_later(self) -> None:
        """A call that need not wait: it gets a job, or its flow where that is quick."""
        job = self.soak.ledger.new(self._case(self.pairs), self.dice.choice(WRITERS))
        prefer = self.dice.choice(("respond-async", "respond-async, wait=1"))
        answer = self.soak.call("POST", "/v1/flow", job.tenant, self.soak.body(job), headers={"Prefer": prefer})
        if invariants.answer_is_expected(self.soak, "flow later", answer, 200, 202):
            if answer.status == 202:
                self.soak.ledger.acknowledge(job, answer.json()["id"])
            else:
                about = {"job": answer.headers.get("fnsf-job-id")}
                invariants.result_is_right(self.soak, job.case, "npz", answer.body, False, about)

    def submit_pair(self) -> None:
        """A pair as a durable job; some are refused when they are estimated."""
        self._submit(self._case(self.pairs + self.refused), "/v1/jobs")

    def submit_sequence(self) -> None:
        """A sequence as a durable job."""
        self._submit(self._case(self.sequences), self.dice.choice(("/v1/jobs", "/v1/sequences")))

    def _submit(self, case: Case, path: str) -> None:
        job = self.soak.ledger.new(case, self.dice.choice(WRITERS))
        job.webhook = self.dice.random() < 0.4
        job.plan = self.dice.choices(("leave", "cancel", "requeue", "repeat", "remove"), (50, 8, 7, 20, 15))[0]
        if self.dice.random() < 0.12:
            job.deadline_ms = self.dice.choice((80, 400, 2000, 10_000))
        if job.plan == "repeat" or self.dice.random() < 0.3:
            job.key = f"soak-{self.soak.state.piece}-{job.number}"
            self._until_acknowledged(job, path)
            return
        try:
            self._send(job, path)
        except Unreachable:
            self.soak.later(8.0, lambda: self._adopt(job, 3))
            raise

    def _send(self, job: Job, path: str) -> bool:
        headers = {"Idempotency-Key": job.key} if job.key else {}
        answer = self.soak.call("POST", path, job.tenant, self.soak.body(job), headers=headers)
        if not invariants.answer_is_expected(self.soak, "submission", answer, 200, 202):
            return False
        job.next_look = time.time() + self.dice.uniform(0.0, 1.0)
        self.soak.ledger.acknowledge(job, answer.json()["id"])
        return True

    def _until_acknowledged(self, job: Job, path: str) -> None:
        """Submits under a key until it is acknowledged, as a client does whose server is restarted."""
        for _ in range(300):
            try:
                if self._send(job, path):
                    break
            except Unreachable:
                self.soak.state.count("calls cut off")
            if self.soak.is_over.is_set():
                return
            time.sleep(0.3)
        found = self.soak.found(job)
        if found is not None and (len(found) > 1 or any(view["id"] != job.id for view in found)):
            self.soak.state.violation("two jobs for one key", job=job.record(), found=[view["id"] for view in found])

    def _adopt(self, job: Job, turns: int) -> None:
        """Looks for a job whose acknowledgement was lost: it is there once or not at all."""
        try:
            found = self.soak.found(job)
        except Unreachable:
            found = None
        if found is None:
            if turns:
                self.soak.later(3.0, lambda: self._adopt(job, turns - 1))
        elif len(found) > 1:
            self.soak.state.violation("submission is there twice", job=job.record(), ids=[one["id"] for one in found])
        elif found:
            self.soak.state.count("jobs adopted after a lost acknowledgement")
            self.soak.ledger.acknowledge(job, found[0]["id"])

    def hang_up_waiting(self) -> None:
        """A caller that goes away while it waits for its flow."""
        job = self.soak.ledger.new(self._case(self.pairs), self.dice.choice(WRITERS))
        headers = headers_of(TENANT_KEYS[job.tenant], has_form=True)
        port, body = self.soak.node().port, self.soak.body(job)
        break_off(port, "/v1/flow", headers, body, 1.0, self.dice.expovariate(8))
        self.soak.state.count("hung up while waiting")
        self.soak.later(HANG_UP_SECONDS, lambda: self._is_dropped(job))

    def _is_dropped(self, job: Job) -> None:
        found = self.soak.found(job)
        for view in found or []:
            if view["state"] not in ENDS and not self.soak.times.kinds(time.time() - 15, time.time()):
                self.soak.state.violation("work for a caller that is gone", view=view)

    def hang_up_upload(self) -> None:
        """A caller that goes away in the middle of its upload. It leaves no job."""
        job = self.soak.ledger.new(self._case(self.pairs + self.sequences), self.dice.choice(WRITERS))
        headers = headers_of(TENANT_KEYS[job.tenant], has_form=True)
        share = self.dice.uniform(0.05, 0.95)
        break_off(self.soak.node().port, "/v1/jobs", headers, self.soak.body(job), share, self.dice.uniform(0, 0.3))
        self.soak.state.count("hung up in an upload")
        self.soak.later(5.0, lambda: self._is_absent(job))

    def _is_absent(self, job: Job) -> None:
        if self.soak.found(job):
            self.soak.state.violation("job of half an upload", job=job.record())

    def bad_file(self) -> None:
        """A file that cannot be read is the caller's fault."""
        name, (file, data) = self.dice.choice(self.bad)
        good = self._case(self.pairs).parts[0]
        parts = [("source", file, data)] + ([] if file.endswith(".npz") else [("target", good[1], good[2])])
        self.dice.shuffle(parts)
        path = self.dice.choice(("/v1/flow", "/v1/jobs"))
        answer = self.soak.call("POST", path, self.dice.choice(WRITERS).tenant, form(parts, None))
        invariants.answer_is_expected(self.soak, f"bad file: {name}", answer, 400, 413, 422)
        self.soak.state.count("bad files sent")

    def wrong_key(self) -> None:
        """Calls that a role or a tenant forbids."""
        case = self._case(self.pairs)
        answer = self.soak.call("POST", "/v1/jobs", "", form(case.parts, {}), key=READER.key)
        invariants.answer_is_expected(self.soak, "submission by a reader", answer, 403)
        answer = self.soak.call("GET", "/v1/jobs", "", key="no-key-of-this-server-1")
        invariants.answer_is_expected(self.soak, "unknown key", answer, 401)
        job = next(iter(list(self.soak.ledger.open.values())), None)
        if job:
            other = self.dice.choice([key.tenant for key in WRITERS if key.tenant != job.tenant])
            answer = self.soak.call("GET", f"/v1/jobs/{job.id}", other)
            invariants.answer_is_expected(self.soak, "job of another tenant", answer, 404)

    def list_jobs(self) -> None:
        """Pages of a list by label, as one of the tenants."""
        case, tenant, before = self.dice.choice(list(self.soak.cases)), self.dice.choice(WRITERS).tenant, ""
        for _ in range(3):
            path = f"/v1/jobs?label=case%3D{case}&limit=20" + (f"&before={before}" if before else "")
            answer = self.soak.call("GET", path, tenant)
            if not invariants.answer_is_expected(self.soak, "list", answer, 200):
                return
            page: dict[str, Any] = answer.json()
            if any(view["options"]["labels"]["case"] != case for view in page["jobs"]):
                self.soak.state.violation("list by label", label=case, jobs=[one["id"] for one in page["jobs"]])
            before = page["next"]
            if not before:
                return

    def look_around(self) -> None:
        """What a console asks for."""
        for path in ("/v1/queue", "/v1/info", "/v1/jobs?state=running", "/openapi.json"):
            invariants.answer_is_expected(self.soak, path, self.soak.call("GET", path, "gamma"), 200)

    def reused_key(self) -> None:
        """A key with another payload is refused."""
        job = next((job for job in list(self.soak.ledger.open.values()) if job.key and not job.ended), None)
        if job:
            other = form(self.soak.cases["default-npy"].parts, {"seed": 99, "labels": {"soak": str(job.number)}})
            answer = self.soak.call("POST", "/v1/jobs", job.tenant, other, headers={"Idempotency-Key": job.key})
            invariants.answer_is_expected(self.soak, "reused key", answer, 422)
