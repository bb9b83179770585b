"""A receiver of webhooks: checks signatures, fails now and then, and counts what it was told."""

import base64
import hashlib
import hmac
import json
import threading
import time
import zlib
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from server import WEBHOOK_SECRET
from state import State

# One notice in ten is answered with 503 at first.
FAILS_ONE_IN = 10


@dataclass
class Notice:
    """One arrival of a notice."""

    at: float
    notice: str
    kind: str
    is_taken: bool


class Receiver:
    """An HTTP server on 127.0.0.1 that takes notices below `/hooks/`."""

    def __init__(self, state: State, port: int) -> None:
        self.state = state
        self.heard: dict[str, list[Notice]] = {}
        self._lock = threading.Lock()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                self.send_response(receiver.take(dict(self.headers.items()), body))
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{port}/hooks/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def take(self, headers: dict[str, str], body: bytes) -> int:
        """Notes a notice and returns the status of its answer."""
        named = {name.lower(): value for name, value in headers.items()}
        notice, stamp = named.get("webhook-id", ""), named.get("webhook-timestamp", "")
        signed = f"{notice}.{stamp}.".encode() + body
        right = base64.b64encode(hmac.new(base64.b64decode(WEBHOOK_SECRET), signed, hashlib.sha256).digest()).decode()
        view = json.loads(body)
        if named.get("webhook-signature") != f"v1,{right}" or abs(time.time() - float(stamp or 0)) > 60:
            self.state.violation("webhook signature", headers=named, body=body.decode())
        with self._lock:
            before = self.heard.setdefault(view["data"]["id"], [])
            is_first = all(other.notice != notice for other in before)
            fails = is_first and zlib.crc32(notice.encode()) % FAILS_ONE_IN == 0
            before.append(Notice(time.time(), notice, view["type"], not fails))
        self.state.count("webhooks refused on purpose" if fails else "webhooks taken")
        return 503 if fails else 204

    def of(self, job: str) -> list[Notice]:
        """What was told of a job."""
        with self._lock:
            return list(self.heard.get(job, []))

    def forget(self, job: str) -> None:
        """Drops what was told of a job that is checked."""
        with self._lock:
            self.heard.pop(job, None)

    def close(self) -> None:
        """Ends the receiver."""
        self._server.shutdown()
        self._server.server_close()
