"""When each node was down, started, stopped in order or paused. Other modules excuse what these times explain."""

import threading
import time
from dataclasses import dataclass

# After the ports answer, the devices are tested and queued jobs start at once.
START_SECONDS = 3.0
# After a pause the process works off what has waited. A node that was taken for dead joins again in about a second.
WAKE_SECONDS = 3.0


@dataclass
class Span:
    """A time of trouble on a node, seconds since 1970. An open one has no end yet."""

    node: str
    kind: str
    began: float
    ended: float = float("inf")


class Timeline:
    """Spans of the kinds `down`, `starting`, `stopping`, `paused` and `database`."""

    def __init__(self) -> None:
        self._spans: list[Span] = []
        self._shocks: list[float] = []
        self._lock = threading.Lock()

    def begin(self, node: str, kind: str) -> Span:
        """Opens a span now."""
        span = Span(node, kind, time.time())
        with self._lock:
            self._spans = [old for old in self._spans if old.ended > span.began - 900]
            self._spans.append(span)
        return span

    @staticmethod
    def end(span: Span, after: float = 0.0) -> None:
        """Ends a span now, or some seconds later."""
        span.ended = time.time() + after

    def shock(self) -> None:
        """Notes a kill, a restart, a pause or a crash of the database, by which notices may come twice."""
        with self._lock:
            self._shocks.append(time.time())

    def shocks(self, since: float, until: float) -> int:
        """The number of shocks in a time."""
        with self._lock:
            return sum(since <= at <= until for at in self._shocks)

    def kinds(self, since: float, until: float, node: str | None = None) -> set[str]:
        """The kinds of trouble in a time, on one node or on any."""
        with self._lock:
            return {
                span.kind
                for span in self._spans
                if span.began <= until and since <= span.ended and (node is None or span.node in (node, "database"))
            }
