"""The nodes under test: configuration, start, kill, orderly stop and pause of their processes."""

import os
import random
import signal
import socket
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from state import State
from timeline import START_SECONDS, WAKE_SECONDS, Timeline

START_TIMEOUT = 60.0
# Longer than `shutdown.timeout_seconds` of the configuration below.
STOP_TIMEOUT = 40.0
FAULTS = ("panicked at", "a request broke", "a result is lost")

RETENTION_SECONDS = 150
SYNC_RETENTION_SECONDS = 30
# Some pauses are longer.
LEASE_SECONDS = 10
WEBHOOK_SECRET = "c29hay1zb2FrLXNvYWstc29hay1zb2FrLXNvYWs="


@dataclass(frozen=True)
class Key:
    """A key of a tenant."""

    tenant: str
    role: str
    key: str


WRITERS = [
    Key("alpha", "write", "soak-alpha-write-0001"),
    Key("beta", "write", "soak-beta-write-00002"),
    Key("gamma", "operate", "soak-gamma-operate-03"),
]
READER = Key("alpha", "read", "soak-alpha-read-00004")


def free_port() -> int:
    """A free port below those of outgoing connections, so that it stays free while a node is down."""
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as tried:
            try:
                tried.bind(("127.0.0.1", port))
                return port
            except OSError:
                continue


def configuration(data: Path, ports: tuple[int, int], hooks: str, devices: str, queue: str, is_shared: bool) -> str:
    """A server with short retention, several tenants, and limits that suit small clouds."""
    keys = "".join(
        f'[[keys]]\ntenant = "{key.tenant}"\nrole = "{key.role}"\nkey = "{key.key}"\n' for key in [*WRITERS, READER]
    )
    return f"""listen = "127.0.0.1:{ports[0]}"
admin_listen = "127.0.0.1:{ports[1]}"
data_dir = "{data}"
data_dir_is_shared = {str(is_shared).lower()}
devices = {devices}
[limits]
max_points = 20000
max_upload_mib = 64
max_total_upload_mib = 256
max_answers_mib = 128
min_free_disk_mib = 256
min_free_inodes = 0
[queue]
{queue}retention_seconds = {RETENTION_SECONDS}
sync_result_retention_seconds = {SYNC_RETENTION_SECONDS}
snapshot_interval_ms = 200
lease_seconds = {LEASE_SECONDS}
max_crashes = 1000
[remote]
webhooks = ["{hooks}"]
webhook_secret = "whsec_{WEBHOOK_SECRET}"
allow_private_addresses = true
[shutdown]
timeout_seconds = 15
{keys}"""


class Node:
    """A server process on fixed ports, which is started again and again on the same data."""

    def __init__(self, name: str, binary: Path, config: str, ports: tuple[int, int], state: State, times: Timeline):
        self.name, self.binary, self.state, self.times = name, binary, state, times
        self.port, self.admin = ports
        self.config = state.folder / f"{name}.toml"
        self.config.write_text(config)
        self.log = state.folder / f"{name}.log"
        self.lock = threading.RLock()
        self.process: subprocess.Popen[str] | None = None
        self.started = 0.0
        self.life = 0
        self._down = None
        self._read = self.log.stat().st_size if self.log.exists() else 0

    @property
    def pid(self) -> int | None:
        """The id of the process while it runs."""
        process = self.process
        return process.pid if process and process.poll() is None else None

    def start(self) -> None:
        """Starts the process and waits for its line about the ports.

        Raises `RuntimeError` where it does not start.
        """
        with self.lock:
            began = time.time()
            # A process group of its own: Ctrl-C on the terminal is not for it. The session is that of the probe,
            # because the scheduler of Linux shares the cores among sessions.
            with self.log.open("a") as log:
                self.process = subprocess.Popen(
                    [self.binary, "serve", "--config", self.config],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    process_group=0,
                )
            said: list[str] = []
            assert self.process.stdout is not None
            reader = threading.Thread(target=lambda: said.append(self.process.stdout.readline()), daemon=True)
            reader.start()
            reader.join(START_TIMEOUT)
            if not said or "serves" not in said[0]:
                self.state.violation("start", node=self.name, status=self.process.poll(), log=self.last_lines())
                raise RuntimeError(f"{self.name} does not start: {self.last_lines()}")
            self.started = time.time()
            self.life = self.state.count("lives")
            self.state.write("starts", {"node": self.name, "life": self.life, "seconds": self.started - began})
            if self._down:
                self.times.end(self._down)
            self.times.end(self.times.begin(self.name, "starting"), START_SECONDS)

    def kill(self) -> None:
        """kill -9. The node is down until `start`."""
        with self.lock:
            self._down = self.times.begin(self.name, "down")
            self.times.shock()
            if self.process:
                self.process.kill()
                self.process.wait()
                self.process.stdout.close()

    def stop(self) -> None:
        """An orderly stop by SIGTERM. Its status and its duration are an invariant."""
        with self.lock:
            if not self.pid:
                return
            span = self.times.begin(self.name, "stopping")
            self.times.shock()
            began = time.time()
            self.process.send_signal(signal.SIGTERM)
            try:
                status = self.process.wait(STOP_TIMEOUT)
                if status != 0:
                    self.state.violation("stop", node=self.name, status=status, log=self.last_lines())
            except subprocess.TimeoutExpired:
                self.state.violation("stop", node=self.name, seconds=STOP_TIMEOUT, log=self.last_lines())
                self.process.kill()
                self.process.wait()
            self.process.stdout.close()
            self.state.write("stops", {"node": self.name, "seconds": time.time() - began})
            self._down = self.times.begin(self.name, "down")
            self.times.end(span)

    def pause(self, seconds: float, until: threading.Event) -> None:
        """SIGSTOP, and SIGCONT after some seconds."""
        with self.lock:
            if not self.pid:
                return
            span = self.times.begin(self.name, "paused")
            self.times.shock()
            os.kill(self.process.pid, signal.SIGSTOP)
            until.wait(seconds)
            os.kill(self.process.pid, signal.SIGCONT)
            self.times.end(span, WAKE_SECONDS)

    def revive(self) -> None:
        """Starts the process again if it has ended by itself, which is a violation."""
        if self.process is None or self.process.poll() is None or not self.lock.acquire(blocking=False):
            return
        try:
            if self.process.poll() is not None:
                status = self.process.poll()
                self.state.violation("ended by itself", node=self.name, status=status, log=self.last_lines())
                self._down = self.times.begin(self.name, "down")
                self.start()
        finally:
            self.lock.release()

    def last_lines(self) -> str:
        """The end of the log."""
        return self.log.read_text(errors="replace")[-1500:] if self.log.exists() else ""

    def read_log(self) -> None:
        """Looks in what is new of the log for lines that tell of a fault of the program."""
        with self.log.open(errors="replace") as log:
            log.seek(self._read)
            for line in log:
                if any(fault in line for fault in FAULTS):
                    self.state.violation("log", node=self.name, line=line[:1000])
            self._read = log.tell()
