"""A client of the service over gRPC: pairs, sequences and durable jobs.

    client = fnsf.Client("localhost:8080", api_key="...")
    flow = client.flow(pc1, pc2, deadline=2.0)
    job = client.submit([pc1, pc2], labels={"drive": "7"})
    flow = client.result(client.wait(job.id).id)

Needs grpcio and protobuf: `pip install './clients/python[client]'` in a checkout of the project.
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any, Literal, TypeVar

import grpc
import numpy.typing as npt

from . import _arrays, _native, _options, _protocol
from ._arrays import Mask, Matrix, Points
from ._dense import DenseCloud
from ._flow import Flow, Progress
from ._native import Error

T = TypeVar("T")
ENDED = frozenset({"succeeded", "failed", "cancelled", "expired"})
"""The states of a job that has ended."""
LATE = 10.0
"""Seconds after a deadline within which its flow may arrive over a slow line."""
RETRIED = ("GetJob", "ListJobs", "CancelJob", "GetTracks", "DownloadResult", "WatchJob")
"""The calls that gRPC itself repeats: they have no effect, or the same one."""


class ServerError(Error):
    """The server refused a call, or could not be reached.

    Attributes:
        code: the server's own stable code, such as `unauthenticated` or `server_full`; None where no server answered.
        status: gRPC's code, such as `UNAVAILABLE`.
        retry_after: seconds after which to try again, where waiting helps.
    """

    def __init__(self, code: str | None, status: str, message: str, retry_after: float | None) -> None:
        again = "" if retry_after is None else f" (try again in {retry_after:g} s)"
        super().__init__(f"{code or 'no answer'} [{status}]: {message}{again}")
        self.code, self.status, self.retry_after = code, status, retry_after
        self._message = message

    def __reduce__(self) -> tuple[Any, ...]:
        return ServerError, (self.code, self.status, self._message, self.retry_after)


@dataclass(frozen=True)
class Job:
    """A job of a server."""

    id: str
    state: Literal["queued", "running", "succeeded", "failed", "cancelled", "expired"]
    kind: Literal["pair", "sequence"]
    created_at: datetime
    """UTC; so are the other times."""
    started_at: datetime | None
    finished_at: datetime | None
    attempt: int
    stop_reason: Literal["completed", "converged", "max_iterations", "deadline"] | None
    done: int
    """Iterations or clusters that are done, of `total`."""
    total: int
    error: str | None
    """`code: message` of a job that failed."""
    pair_ids: tuple[str, ...]
    """The jobs of the pairs of a sequence, in order."""
    pairs: int
    pairs_left: int
    labels: Mapping[str, str]
    trace_id: str
    result_uri: str | None
    """Where the result is written to, where the job was submitted with `result_uri`."""
    delivery: Literal["pending", "delivered", "given_up"] | None
    """How far that is."""
    ahead: int | None
    """Jobs that start before this one, where `job` and `submit` find it queued; None where there are 10,000 or more."""
    starts_in: float | None
    """Predicted seconds until it starts, where `job` and `submit` find it queued."""

    @property
    def ended(self) -> bool:
        """Whether the job has ended."""
        return self.state in ENDED


@dataclass(frozen=True, eq=False)
class PairFlow:
    """The flow of two consecutive sweeps of a sequence, or why there is none."""

    index: int
    """From 0."""
    source: str
    """The name of the earlier sweep."""
    target: str
    """The name of the later sweep."""
    flow: Flow | None
    error: str | None


@dataclass(frozen=True, eq=False)
class NamedSweep:
    """A sweep of a sequence, with what is known of it."""

    points: Any
    """N x 3, metres."""
    name: str = ""
    """Comes back with the flows of `sequence`. Timestamps in names give the time between sweeps, and numbers in names
    must not turn back."""
    ground: Any = None
    """N flags: ground points. Presets that keep the ground use them with `ground="mask"` alone."""
    pose: Any = None
    """4 x 4 world_from_sensor. All sweeps have one, or none."""


def _service_config() -> str:
    policy = {
        "maxAttempts": 5,
        "initialBackoff": "0.2s",
        "maxBackoff": "5s",
        "backoffMultiplier": 2,
        "retryableStatusCodes": ["UNAVAILABLE"],
    }
    names = [{"service": _protocol.SERVICE, "method": method} for method in RETRIED]
    return json.dumps({"methodConfig": [{"name": names, "retryPolicy": policy}]})


def _job(message: Any) -> Job:
    def moment(name: str) -> Any:
        return getattr(message, name).ToDatetime(timezone.utc) if message.HasField(name) else None

    error = f"{message.error.code}: {message.error.message}" if message.HasField("error") else None
    delivery = message.delivery if message.HasField("delivery") else None
    wait = message.wait if message.HasField("wait") else None
    return Job(
        id=message.id,
        state=_protocol.plain(message, "state"),
        kind=_protocol.plain(message, "kind"),
        created_at=moment("created_at"),
        started_at=moment("started_at"),
        finished_at=moment("finished_at"),
        attempt=message.attempt,
        stop_reason=_protocol.plain(message, "stop_reason"),
        done=message.progress.done,
        total=message.progress.total,
        error=error,
        pair_ids=tuple(message.pair_ids),
        pairs=message.pairs,
        pairs_left=message.pairs_left,
        labels=dict(message.labels),
        trace_id=message.trace_id,
        result_uri=delivery.uri if delivery else None,
        delivery=_protocol.plain(delivery, "state") if delivery else None,
        ahead=wait.ahead if wait and wait.HasField("ahead") else None,
        starts_in=wait.seconds if wait else None,
    )


def _limit(deadline: float | None, options: dict[str, Any]) -> float | None:
    """Puts the deadline of a call into its options. Returns the time limit of the call, which is later."""
    if deadline is None:
        return None
    if "deadline_ms" in options:
        raise TypeError("give deadline or deadline_ms, not both")
    if not 0.0 < deadline < float("inf"):
        raise _native.InputError(f"deadline is {deadline}: a positive number of seconds is needed")
    options["deadline_ms"] = max(1, round(1000.0 * deadline))
    return deadline + LATE


def _refusal(error: grpc.RpcError) -> ServerError:
    about: dict[str, Any] = dict(error.trailing_metadata() or ())  # type: ignore[arg-type]
    pause = about.get("grpc-retry-pushback-ms")
    after = int(pause) / 1000 if pause is not None else None
    return ServerError(about.get("fnsf-code"), error.code().name, error.details() or "", after)


class Client:
    """Calls of one server. Safe to use from several threads, not across a fork.

    Args:
        server: `host:port`.
        api_key: the key, where the server has keys.
        tls: True for a certificate that this machine trusts, or the PEM bytes of the authority.
        timeout: seconds for calls that send and answer little; None for no limit.
    """

    def __init__(
        self,
        server: str,
        *,
        api_key: str | None = None,
        tls: bool | bytes = False,
        timeout: float | None = 60.0,
    ) -> None:
        settings = [
            ("grpc.service_config", _service_config()),
            ("grpc.max_receive_message_length", 8 << 20),
            # A server whose machine is gone says nothing.
            ("grpc.keepalive_time_ms", 30_000),
            ("grpc.keepalive_timeout_ms", 10_000),
            # Also in a call that only waits.
            ("grpc.http2.max_pings_without_data", 0),
        ]
        if tls:
            trusted = grpc.ssl_channel_credentials(tls if isinstance(tls, bytes) else None)
            self._channel = grpc.secure_channel(server, trusted, settings)
        else:
            self._channel = grpc.insecure_channel(server, settings)
        self._metadata = [("authorization", f"Bearer {api_key}")] if api_key else []
        self._timeout = timeout

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection."""
        self._channel.close()

    def _stream(self, method: str, request: Any, timeout: float | None) -> Iterator[Any]:
        """The answers of a call. `request` is a message, or an iterator of messages."""
        about = _protocol.METHODS[method]
        answer = _protocol.message_class(about.output_type)
        incoming, outgoing = isinstance(request, Iterator), about.server_streaming
        kind = f"{'stream' if incoming else 'unary'}_{'stream' if outgoing else 'unary'}"
        call = getattr(self._channel, kind)(
            f"/{_protocol.SERVICE}/{method}",
            request_serializer=lambda message: message.SerializeToString(),
            response_deserializer=answer.FromString,
        )
        broken: list[BaseException] = []
        sent = _watched(request, broken) if incoming else request
        try:
            answers = call(sent, timeout=timeout, metadata=self._metadata)
            if outgoing:
                yield from answers
            else:
                yield answers
        except grpc.RpcError as error:
            if broken:
                raise broken[0] from None
            raise _refusal(error) from None

    def _call(self, method: str, request: Any) -> Any:
        return next(self._stream(method, request, self._timeout))

    def flow(
        self,
        pc1: Any,
        pc2: Any,
        *,
        ground: Literal["auto", "keep", "mask"] | tuple[Any, Any] | None = None,
        deadline: float | None = None,
        progress: Progress | None = None,
        **options: Any,
    ) -> Flow:
        """The motion of every point of `pc1` to `pc2`, as `fnsf.flow`, computed by the server.

        The work is cancelled if the call is interrupted. With `deadline`, seconds, the best flow reached in time comes
        back. `options` are those of `Options`, and `priority`, `device`.
        """
        source, target = _arrays.points("pc1", pc1), _arrays.points("pc2", pc2)
        masks: list[Mask | None] = [None, None]
        if isinstance(ground, tuple):
            masks = [
                _arrays.mask(f"the ground mask of pc{place}", mask, len(cloud))
                for place, (mask, cloud) in enumerate(zip(ground, (source, target), strict=True), 1)
            ]
            ground = _options.of_masks(options.get("preset"))
        limit = _limit(deadline, options)
        message = _protocol.options_message({"ground": ground, **options})
        request = _protocol.MESSAGES["EstimateFlowRequest"]
        begin = _protocol.nested("EstimateFlowRequest", "Begin")
        piece = _protocol.nested("EstimateFlowRequest", "CloudChunk")

        def requests() -> Iterator[Any]:
            yield request(begin=begin(options=message, progress_ms=200 if progress else 0))
            for number, (cloud, mask) in enumerate(zip((source, target), masks, strict=True), 1):
                for chunk in _protocol.chunks(cloud, mask):
                    yield request(cloud=piece(cloud=number, chunk=chunk))

        header: Any = None
        pieces: list[Any] = []
        for answer in self._stream("EstimateFlow", requests(), limit):
            part = answer.WhichOneof("part")
            if part == "progress" and progress:
                progress(answer.progress.done, answer.progress.total, answer.progress.loss)
            elif part == "header":
                header = answer.header
            elif part == "chunk":
                pieces.append(answer.chunk)
        return _protocol.flow(header, pieces, source)

    def sequence(self, sweeps: Iterable[Any], *, deadline: float | None = None, **options: Any) -> Iterator[PairFlow]:
        """Yields the flow of each two consecutive sweeps, as soon as it is there.

        `sweeps` yields arrays, N x 3 metres, or `NamedSweep`. It is read from another thread, no faster than the server
        takes them. With `deadline`, seconds, the best flows reached in time come back. Pairs that were not begun have
        an error.
        """
        limit = _limit(deadline, options)
        message = _protocol.options_message(options)
        request = _protocol.MESSAGES["EstimateSequenceRequest"]
        begin = _protocol.nested("EstimateSequenceRequest", "Begin")
        head = _protocol.nested("EstimateSequenceRequest", "Sweep")
        sources: dict[int, Points] = {}

        def requests() -> Iterator[Any]:
            yield request(begin=begin(options=message))
            for index, sweep in enumerate(sweeps):
                points, mask, pose, name = _sweep(index, sweep)
                sources[index] = points
                yield request(sweep=head(name=name, points=len(points), pose=pose))
                for chunk in _protocol.chunks(points, mask):
                    yield request(chunk=chunk)

        pair: Any = None
        pieces: list[Any] = []
        rows = 0
        for answer in self._stream("EstimateSequence", requests(), limit):
            if answer.WhichOneof("part") == "pair":
                pair, pieces, rows = answer.pair, [], 0
            else:
                pieces.append(answer.chunk)
                rows += len(answer.chunk.flags)
            if pair.WhichOneof("outcome") == "error":
                sources.pop(pair.index, None)
                reason = f"{pair.error.code}: {pair.error.message}"
                yield PairFlow(pair.index, pair.source, pair.target, None, reason)
            elif rows == pair.header.points:
                flow = _protocol.flow(pair.header, pieces, sources.pop(pair.index, None))
                yield PairFlow(pair.index, pair.source, pair.target, flow, None)

    def submit(
        self,
        sweeps: Iterable[Any],
        *,
        idempotency_key: str | None = None,
        retry_for: float = 60.0,
        **options: Any,
    ) -> Job:
        """Submits a pair or a sequence as a job, and returns when it is safe on the server's disk.

        A call that the server cannot take now is repeated for `retry_for` seconds with the same idempotency key, so
        that the work is done once.

        Args:
            sweeps: two for a pair, more for a sequence: arrays, N x 3 metres, `NamedSweep`, or texts, the URIs of
                files that the server fetches.
            idempotency_key: a repeated submission with the same key finds the first one's job.
            retry_for: seconds.
            options: those of `Options`, and `priority`, `device`, `deadline_ms`, `labels`, `webhook`, `result_uri`,
                `densify`.
        """
        key = idempotency_key or str(uuid.uuid4())
        taken = [sweep if isinstance(sweep, str) else _sweep(index, sweep) for index, sweep in enumerate(sweeps)]
        message = _protocol.options_message(options)
        request = _protocol.MESSAGES["SubmitJobRequest"]
        begin = _protocol.nested("SubmitJobRequest", "Begin")
        following = _protocol.nested("SubmitJobRequest", "NextCloud")

        def requests() -> Iterator[Any]:
            yield request(begin=begin(options=message, idempotency_key=key))
            for one in taken:
                if isinstance(one, str):
                    yield request(next=following(uri=one))
                    continue
                points, mask, pose, name = one
                yield request(next=following(pose=pose, name=name))
                for chunk in _protocol.chunks(points, mask):
                    yield request(chunk=chunk)

        return _job(_repeated(lambda: next(self._stream("SubmitJob", requests(), None)), retry_for))

    def job(self, id: str) -> Job:
        """A job."""
        return _job(self._call("GetJob", _protocol.MESSAGES["GetJobRequest"](id=id)))

    def jobs(self, *, state: str | None = None, label: str | None = None) -> Iterator[Job]:
        """The jobs, the latest first, of a state or with a label, as `name=value`."""
        request = _protocol.MESSAGES["ListJobsRequest"](label=label or "")
        if state is not None:
            request.state = (
                request.DESCRIPTOR.fields_by_name["state"]
                .enum_type.values_by_name[_protocol.word("state", state)]
                .number
            )
        while True:
            page = self._call("ListJobs", request)
            yield from map(_job, page.jobs)
            if not page.next_page_token:
                return
            request.page_token = page.next_page_token

    def watch(self, id: str) -> Iterator[Job]:
        """Follows a job to its end: its state, and its progress while it runs."""
        yield from map(_job, self._stream("WatchJob", _protocol.MESSAGES["WatchJobRequest"](id=id), None))

    def wait(self, id: str, *, timeout: float | None = None) -> Job:
        """Waits for the end of a job, through restarts of the server.

        Raises:
            TimeoutError: the job has not ended after `timeout` seconds.
        """
        until = None if timeout is None else time.monotonic() + timeout
        request = _protocol.MESSAGES["WatchJobRequest"](id=id)
        while True:
            left = None if until is None else max(0.001, until - time.monotonic())
            try:
                for message in self._stream("WatchJob", request, left):
                    if (job := _job(message)).ended:
                        return job
            except ServerError as error:
                if until is not None and time.monotonic() >= until:
                    raise TimeoutError(f"job {id} has not ended after {timeout} s") from None
                if error.status != "UNAVAILABLE":
                    raise
                time.sleep(error.retry_after or 0.2)

    def result(self, id: str) -> Flow | DenseCloud:
        """The flow of a pair that succeeded, or the dense cloud of a sequence."""
        request = _protocol.MESSAGES["DownloadResultRequest"](id=id)
        header: Any = None
        pieces: list[Any] = []
        is_dense = False
        for answer in self._stream("DownloadResult", request, None):
            part = answer.WhichOneof("part")
            if part in ("header", "dense_header"):
                header, is_dense = getattr(answer, part), part == "dense_header"
            else:
                pieces.append(getattr(answer, part))
        return _protocol.dense(pieces) if is_dense else _protocol.flow(header, pieces, None)

    def tracks(self, id: str) -> npt.NDArray[Any]:
        """The tracks of a sequence's moving objects, in the form of `Sequence.tracks`."""
        request = _protocol.MESSAGES["GetTracksRequest"](id=id)
        found: npt.NDArray[Any] = _protocol.tracks(self._stream("GetTracks", request, None))
        return found

    def cancel(self, id: str) -> Job:
        """Ends a job: at once if it waits, within an iteration if it runs."""
        return _job(self._call("CancelJob", _protocol.MESSAGES["CancelJobRequest"](id=id)))

    def requeue(self, id: str) -> Job:
        """Queues a job again that failed, expired or was cancelled."""
        return _job(self._call("RequeueJob", _protocol.MESSAGES["RequeueJobRequest"](id=id)))

    def delete(self, id: str) -> None:
        """Removes a job that has ended, with its sweeps and its result."""
        self._call("DeleteJob", _protocol.MESSAGES["DeleteJobRequest"](id=id))


def _sweep(index: int, sweep: Any) -> tuple[Points, Mask | None, list[float], str]:
    """The points, mask, pose and name of a sweep."""
    known = sweep if isinstance(sweep, NamedSweep) else NamedSweep(sweep)
    points = _arrays.points(f"sweep {index}", known.points)
    given = known.ground
    mask = None if given is None else _arrays.mask(f"the ground mask of sweep {index}", given, len(points))
    pose: list[float] = []
    if known.pose is not None:
        matrix: Matrix = _arrays.matrix(f"the pose of sweep {index}", known.pose)
        pose = matrix.ravel().tolist()
    return points, mask, pose, known.name


def _watched(requests: Iterator[T], broken: list[BaseException]) -> Iterator[T]:
    """The requests. gRPC ends a call without saying why they broke off, so the reason is kept."""
    try:
        yield from requests
    except BaseException as error:
        broken.append(error)
        raise


def _repeated(call: Callable[[], T], seconds: float) -> T:
    """Repeats a call while the server says that waiting helps, or does not answer."""
    until, pause = time.monotonic() + seconds, 0.2
    while True:
        try:
            return call()
        except ServerError as error:
            waiting_helps = error.status == "UNAVAILABLE" or error.retry_after is not None
            wait = error.retry_after or pause
            if not waiting_helps or time.monotonic() + wait > until:
                raise
            time.sleep(wait)
            pause = min(2 * pause, 5.0)
