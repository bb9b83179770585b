"""What the tests share: a simulated street, the program, and a server."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import fnsf

REPOSITORY = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="session")
def street():
    """Six sweeps of a small simulated street."""
    return fnsf.simulate(6, beams=32, azimuth_steps=1000)


@pytest.fixture(scope="session")
def pair(street):
    return street.pair(0)


@pytest.fixture(scope="session")
def program():
    """The `fnsf` program: FNSF_PROGRAM, or the repository's release build."""
    path = os.environ.get("FNSF_PROGRAM") or REPOSITORY / "target/release/fnsf"
    if not Path(path).is_file():
        if os.environ.get("FNSF_REQUIRE_PROGRAM") == "1":
            pytest.fail(f"{path} is not there: cargo build --release")
        pytest.skip(f"{path} is not there: cargo build --release")
    return str(path)


class Server:
    """A server on free ports, with one key."""

    KEY = "the-key-of-the-tests-1234"

    def __init__(self, program, folder):
        self.program, self.folder = program, folder
        self.address = "127.0.0.1:0"
        self.start()

    def start(self):
        """Starts the server; the ports of an earlier start are kept."""
        settings = self.folder / "fnsf.toml"
        settings.write_text(f'[[keys]]\ntenant = "tests"\nrole = "write"\nkey = "{self.KEY}"\n')
        command = [self.program, "serve", "--config", settings, "--data-dir", self.folder / "data"]
        command += ["--listen", self.address, "--admin-listen", "127.0.0.1:0"]
        quiet = {**os.environ, "FNSF_SERVE_DEVICES": '["cpu"]'}
        with (self.folder / "log").open("a") as log:
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, env=quiet)
        said = self.process.stdout.readline()
        found = re.search(r"gRPC on (127\.0\.0\.1:\d+)", said)
        assert found, f"the server said {said!r} and {(self.folder / 'log').read_text()}"
        self.address = found.group(1)

    def client(self, **more):
        return fnsf.Client(self.address, **{"api_key": self.KEY, **more})

    def kill(self):
        self.process.kill()
        self.process.wait()

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.kill()


@pytest.fixture
def server(program, tmp_path):
    started = Server(program, tmp_path)
    yield started
    started.stop()


@pytest.fixture
def python():
    """Runs a script in an interpreter of its own, and returns what it prints."""

    def run(script, *, timeout=120):
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=timeout)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture
def real_data():
    """The folder with real pairs, FNSF_REAL_DATA."""
    folder = os.environ.get("FNSF_REAL_DATA")
    if not folder:
        if os.environ.get("FNSF_REQUIRE_REAL_DATA") == "1":
            pytest.fail("FNSF_REAL_DATA is not set")
        pytest.skip("FNSF_REAL_DATA is not set")
    return Path(folder)
