"""What must hold of jobs and results. Each function reports what does not as a violation, with its evidence."""

import base64
import io
import json
import math
import time
import zipfile
from array import array
from typing import Any

from cases import Case, differences, digest
from client import Answer
from context import TENANT_KEYS, Soak
from ledger import Job
from server import RETENTION_SECONDS

# Back-off of a notice that was refused, kills in between, and a loaded machine.
TOLD_SECONDS = 120.0
# A deadline is a target: it may be missed by this on a loaded machine before it is counted as late.
LATE_SECONDS = 2.0


def end_is_legitimate(soak: Soak, job: Job, view: dict[str, Any]) -> None:
    """A job succeeds, unless its deadline, a cancellation or its input explains another end."""
    state, error = view["state"], view.get("error") or {}
    refusal = soak.cases[job.case].error
    allowed = {"failed" if refusal else "succeeded"}
    if job.cancel_asked:
        allowed.add("cancelled")
    if job.deadline_ms:
        # A pair of two scenes may not be noticed in time.
        allowed |= {"expired", "succeeded"}
    codes = {"failed": refusal, "expired": "deadline_in_queue"}
    if state not in allowed or error.get("code") != codes.get(state, error.get("code")):
        soak.state.violation("end", job=job.record(), view=view)
    if job.is_cancelled and state != "cancelled":
        soak.state.violation("cancelled job went on", job=job.record(), view=view)
    if view.get("dead_letter") and not refusal:
        soak.state.violation("dead letter", job=job.record(), view=view)


def end_is_the_same(soak: Soak, job: Job, view: dict[str, Any]) -> None:
    """A job ends once: what was seen of its end does not change."""
    found = {name: view[name] for name in job.end}
    if found != job.end:
        soak.state.violation("end changed", job=job.record(), before=job.end, now=found)


def end_of(view: dict[str, Any]) -> dict[str, Any]:
    """What must not change of an ended job."""
    return {name: view[name] for name in ("state", "finished_at", "attempt", "stop_reason", "error")}


def result_is_right(soak: Soak, name: str, form: str, body: bytes, is_exempt: bool, about: dict[str, Any]) -> None:
    """A result is that of the undisturbed computation, bit for bit. With a deadline every row is finite."""
    case = soak.cases[name]
    soak.state.count("results compared" if not is_exempt else "results with deadlines")
    if is_exempt:
        if not is_finite(case, form, body):
            soak.state.violation("row without a finite flow", case=name, format=form, **about)
        return
    try:
        wrong = differences(soak.references[name][form], digest(form, body))
    except Exception as error:  # A file that cannot be read is another result.
        wrong = [f"unreadable: {error}"]
    if wrong:
        kept = soak.state.folder / f"wrong-{name}-{soak.state.count('wrong results')}.{form}"
        kept.write_bytes(body)
        soak.state.violation("another result", case=name, format=form, parts=wrong[:20], file=kept.name, **about)


def is_finite(case: Case, form: str, body: bytes) -> bool:
    """Whether every row is finite: of a flow as f32, of the flows in an archive, of the points of a dense cloud."""
    if form == "f32":
        return len(body) == case.rows * 12 and all(map(math.isfinite, array("f", body)))
    with zipfile.ZipFile(io.BytesIO(body)) as archive:
        if form == "zip":
            flows = [archive.read(name) for name in archive.namelist()]
            rows = [len(points) // 3 for points in case.points[:-1]]
            return len(flows) == len(rows) and all(
                is_array_finite(flow, count, "flow") for flow, count in zip(flows, rows, strict=True)
            )
    return is_array_finite(body, sum(map(len, case.points)) // 3, "points")


def is_array_finite(npz: bytes, rows: int, name: str) -> bool:
    """Whether an array of an npz has three finite values for each row."""
    with zipfile.ZipFile(io.BytesIO(npz)) as archive:
        data = archive.read(f"{name}.npy")
    values = array("f", data[len(data) - rows * 12 :] if len(data) > rows * 12 else b"")
    return len(values) == rows * 3 and all(map(math.isfinite, values))


def answer_is_expected(soak: Soak, what: str, answer: Answer, *expected: int) -> bool:
    """Whether an answer is one of these. A server that is full or stopping may refuse; anything else is a violation."""
    if answer.status in expected:
        return True
    if answer.status in (429, 503, 507):
        soak.state.count(f"refused: {answer.code}")
        return False
    soak.state.violation("answer", what=what, status=answer.status, body=answer.body[:500].decode(errors="replace"))
    return False


def job_may_be_gone(job: Job) -> bool:
    """Whether retention or a removal explains that a job is not known."""
    since = job.ended or job.seen
    return job.removal_asked or time.time() - since > RETENTION_SECONDS - 30


def is_told(soak: Soak, job: Job) -> bool:
    """Whether the webhook of an ended job has told its end; too late is a violation and counts as told."""
    notices = soak.receiver.of(job.id)
    taken = {notice.notice for notice in notices if notice.is_taken}
    # A notice that was refused is repeated: that of a requeued job's first end may come after its second.
    kinds = {notice.kind for notice in notices if notice.is_taken}
    if f"job.{job.end['state']}" in kinds:
        if len({notice.notice for notice in notices}) > 1 + job.requeues:
            soak.state.violation("end told under several ids", job=job.record(), notices=[str(n) for n in notices])
        return True
    if time.time() - job.ended > TOLD_SECONDS:
        soak.state.violation("end not told", job=job.record(), end=job.end, taken=len(taken), kinds=sorted(kinds))
        return True
    return False


def notices_are_few(soak: Soak, is_last: bool) -> None:
    """A notice that was taken comes again only where a kill, a stop or a pause explains it."""
    for job, notices in list(soak.receiver.heard.items()):
        if not is_last and notices and time.time() - notices[-1].at < 300:
            continue
        for name in {notice.notice for notice in notices}:
            taken = [notice.at for notice in notices if notice.notice == name and notice.is_taken]
            if len(taken) < 2:
                continue
            again, shocks = len(taken) - 1, soak.times.shocks(taken[0] - 2, taken[-1])
            soak.state.count("webhooks told again", again)
            if again > shocks:
                soak.state.violation("told too often", job=job, notice=name, taken=taken, shocks=shocks)
        soak.receiver.forget(job)


def list_is_known(soak: Soak) -> None:
    """The server's list has no job that nobody asked for, and none twice."""
    last = soak.state.counts.get("submissions", 0)
    seen: dict[int, str] = {}
    for tenant in TENANT_KEYS:
        before = ""
        while before is not None:
            answer = soak.call("GET", f"/v1/jobs?limit=500{before and '&before=' + before}", tenant)
            if answer.status != 200:
                return
            page = answer.json()
            for view in page["jobs"]:
                number = int(view["options"].get("labels", {}).get("soak", 0))
                if number == 0 and view["options"].get("labels", {}).get("reference"):
                    continue
                if not 0 < number <= last + 100:
                    soak.state.violation("job that nobody asked for", view=view)
                elif number in seen and seen[number] != view["id"]:
                    soak.state.violation("submission is there twice", ids=[seen[number], view["id"]], number=number)
                seen[number] = view["id"]
            before = page["next"]
    soak.state.count("lists compared")


def sweep_is_right(soak: Soak, job: Job, body: bytes) -> None:
    """Sweep 0 comes back as it was sent."""
    case = soak.cases[job.case]
    if body != case.points[0].tobytes():
        text = base64.b64encode(body[:60]).decode()
        soak.state.violation("another sweep", job=job.record(), bytes=len(body), begin=text)


def tracks_are_whole(soak: Soak, job: Job, answer: Answer) -> None:
    """Tracks of an ended sequence are finite numbers."""
    if answer.status == 200 and "NaN" in json.dumps(answer.json()):
        soak.state.violation("tracks", job=job.record(), body=answer.body[:500].decode())
