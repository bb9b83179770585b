"""HTTP calls to the server: forms, downloads, event streams, and calls that the client breaks off."""

import http.client
import json
import random
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

HOST = "127.0.0.1"
BOUNDARY = "soak-7d1f0c2b9a"


class Unreachable(Exception):
    """No complete answer arrived: the server is away, or was killed in between."""


@dataclass
class Answer:
    """A complete answer. Header names are in lower case."""

    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> Any:
        """The body as JSON; an empty object where it is none."""
        try:
            return json.loads(self.body)
        except ValueError:
            return {}

    @property
    def code(self) -> str:
        """The stable code of an error."""
        view = self.json() if self.status >= 400 else {}
        return str(view.get("code", "")) if isinstance(view, dict) else ""


def form(parts: list[tuple[str, str, bytes]], options: dict[str, Any] | None) -> bytes:
    """A multipart body, options first. A part is its name, the name of its file and its bytes."""
    pieces = []
    if options is not None:
        pieces.append(f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="options"\r\n\r\n'.encode())
        pieces.append(json.dumps(options).encode() + b"\r\n")
    for name, file, data in parts:
        about = f'Content-Disposition: form-data; name="{name}"; filename="{file}"'
        pieces.append(f"--{BOUNDARY}\r\n{about}\r\nContent-Type: application/octet-stream\r\n\r\n".encode())
        pieces.append(data + b"\r\n")
    pieces.append(f"--{BOUNDARY}--\r\n".encode())
    return b"".join(pieces)


def headers_of(key: str, more: dict[str, str] | None = None, has_form: bool = False) -> dict[str, str]:
    """The headers of a call with a key; an empty key sends none."""
    headers = dict(more or {})
    if key:
        headers["Authorization"] = f"Bearer {key}"
    if has_form:
        headers["Content-Type"] = f"multipart/form-data; boundary={BOUNDARY}"
    return headers


def call(
    port: int, method: str, path: str, headers: dict[str, str], body: bytes | None = None, timeout: float = 60.0
) -> Answer:
    """One call on a connection of its own.

    Raises `Unreachable` where no complete answer came.
    """
    connection = http.client.HTTPConnection(HOST, port, timeout=timeout)
    try:
        connection.request(method, path, body=body, headers=headers)
        answer = connection.getresponse()
        return Answer(answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read())
    except (OSError, http.client.HTTPException) as error:
        raise Unreachable(f"{type(error).__name__}: {error}") from error
    finally:
        connection.close()


def events(port: int, path: str, headers: dict[str, str], seconds: float) -> Iterator[tuple[str, Any]]:
    """The events of a stream, name and data, until it ends or the time is over.

    Raises `Unreachable` where the stream breaks, and `http.client.HTTPException` never.
    """
    connection = http.client.HTTPConnection(HOST, port, timeout=20.0)
    until = time.monotonic() + seconds
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        if answer.status != 200:
            yield ("refused", answer.status)
            return
        name = ""
        while time.monotonic() < until:
            line = answer.readline()
            if not line:
                return
            if line.startswith(b"event:"):
                name = line[6:].strip().decode()
            elif line.startswith(b"data:"):
                yield (name, json.loads(line[5:]))
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise Unreachable(f"{type(error).__name__}: {error}") from error
    finally:
        connection.close()


def break_off(port: int, path: str, headers: dict[str, str], body: bytes, share: float, wait: float) -> None:
    """Sends this share of a call, waits, and hangs up: half of the times with a reset.

    Raises `Unreachable` where the server is away.
    """
    lines = [f"POST {path} HTTP/1.1", f"Host: {HOST}:{port}", f"Content-Length: {len(body)}"]
    lines += [f"{name}: {value}" for name, value in headers.items()]
    try:
        with socket.create_connection((HOST, port), timeout=10) as line:
            line.sendall("\r\n".join(lines).encode() + b"\r\n\r\n" + body[: int(len(body) * share)])
            time.sleep(wait)
            if random.random() < 0.5:
                line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    except OSError as error:
        raise Unreachable(str(error)) from error
