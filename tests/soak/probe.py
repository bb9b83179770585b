"""Asks the admin ports for their health, in a process of its own, and measures the machine's own delay beside it.

    python3 probe.py NODE=PORT...

Each answer is a JSON line on stdout. `control_ms` is the longest round trip at that time to a process that only echoes
a byte: where that is long too, the machine is overloaded and not the server at fault. Ends with its stdin.
"""

import http.client
import json
import os
import sys
import threading
import time
from collections import deque

PERIOD = 0.1
# Each `READY_EVERY`th question is for /readyz, the others for /livez.
READY_EVERY = 10
CONTROL_PERIOD = 0.02
# A pause of the server is shorter.
TIMEOUT = 25.0

Round = tuple[float, float]


def echo() -> tuple[int, int]:
    """Forks a process that echoes bytes. Returns the ends of its pipes."""
    to_child, from_parent = os.pipe()
    to_parent, from_child = os.pipe()
    if os.fork() == 0:
        os.close(from_parent)
        os.close(to_parent)
        while byte := os.read(to_child, 1):
            os.write(from_child, byte)
        os._exit(0)
    os.close(to_child)
    os.close(from_child)
    return from_parent, to_parent


def control(pipes: tuple[int, int], rounds: deque[Round]) -> None:
    """Appends round trips, start and end. The last one may be under way: its end is infinite."""
    while True:
        began = time.time()
        rounds.append((began, float("inf")))
        os.write(pipes[0], b"x")
        os.read(pipes[1], 1)
        rounds[-1] = (began, time.time())
        time.sleep(CONTROL_PERIOD)


def longest(rounds: deque[Round], since: float, until: float) -> float:
    """The longest round trip or gap between round trips that overlaps a time, ms."""
    now = time.time()
    worst, before = 0.0, None
    for began, ended in list(rounds):
        ended = min(ended, now)
        if ended >= since and began <= until:
            gap = began - before - CONTROL_PERIOD if before else 0.0
            worst = max(worst, ended - began, gap)
        before = ended
    return worst * 1e3


def ask(port: int, path: str) -> tuple[int, str]:
    """The status of an answer, 0 with the error where there is none."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        body = answer.read()
        return answer.status, "" if answer.status == 200 else body.decode(errors="replace")[:200]
    except (OSError, http.client.HTTPException) as error:
        return 0, f"{type(error).__name__}: {error}"
    finally:
        connection.close()


def follow(node: str, port: int, rounds: deque[Round]) -> None:
    """Asks one node again and again."""
    turn = 0
    while True:
        path = "/readyz" if turn % READY_EVERY == 0 else "/livez"
        turn += 1
        began = time.time()
        status, error = ask(port, path)
        ended = time.time()
        time.sleep(PERIOD)
        line = {"node": node, "path": path, "at": began, "ms": (ended - began) * 1e3, "status": status}
        line |= {"error": error, "control_ms": longest(rounds, began - 0.05, ended + 0.05)}
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def main() -> None:
    rounds: deque[Round] = deque(maxlen=1500)
    threading.Thread(target=control, args=(echo(), rounds), daemon=True).start()
    for named in sys.argv[1:]:
        node, port = named.split("=")
        threading.Thread(target=follow, args=(node, int(port), rounds), daemon=True).start()
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()
