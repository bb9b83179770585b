"""The PostgreSQL server of a fleet: a cluster in the state folder, on a Unix socket, that may be killed."""

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

PATIENCE = 60.0
SETTINGS = ("-c", "listen_addresses=", "-c", "max_connections=200")


def programs() -> Path | None:
    """The folder of `initdb` and `postgres`; Debian keeps them out of the path."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    folders += [Path(folder) for folder in os.environ.get("PATH", "").split(":")]
    return next((folder for folder in folders if (folder / "initdb").exists() and (folder / "postgres").exists()), None)


class Postgres:
    """A running PostgreSQL. Root may not run it: then the user `postgres` does."""

    def __init__(self, folder: Path) -> None:
        self.bin = programs()
        if self.bin is None:
            raise SystemExit("PostgreSQL is not installed: apt-get install postgresql")
        self.data, self.log = folder / "postgres", folder / "postgres.log"
        user = pwd.getpwnam("postgres") if os.geteuid() == 0 else None
        self.user = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []} if user else {}
        # A path of a socket has at most 107 bytes.
        self.socket = Path(tempfile.mkdtemp(prefix="soak-pg-"))
        self.data.mkdir(exist_ok=True)
        if user:
            os.chown(self.socket, user.pw_uid, user.pw_gid)
            os.chown(self.data, user.pw_uid, user.pw_gid)
        self.data.chmod(0o700)
        self.process: subprocess.Popen[bytes] | None = None
        if not (self.data / "PG_VERSION").exists():
            options = ["--auth=trust", "--username=fnsf", "--encoding=UTF8", "--no-locale", "--pgdata", self.data]
            subprocess.run(
                [self.bin / "initdb", *options], check=True, stdout=subprocess.DEVNULL, cwd=self.socket, **self.user
            )

    @property
    def url(self) -> str:
        """How nodes reach the database."""
        return f"host={self.socket} user=fnsf dbname=soak"

    def start(self) -> None:
        """Starts the server and waits until it answers. What a killed one has left may delay it.

        Raises `RuntimeError` where it does not start.
        """
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            if self.process is None or self.process.poll() is not None:
                with self.log.open("ab") as log:
                    self.process = subprocess.Popen(
                        [self.bin / "postgres", "-D", self.data, "-k", self.socket, *SETTINGS],
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=log,
                        process_group=0,
                        cwd=self.socket,
                        **self.user,
                    )
            if self.ask("SELECT 1", "postgres") == "1":
                if self.ask("SELECT count(*) FROM pg_database WHERE datname = 'soak'", "postgres") == "0":
                    self.ask("CREATE DATABASE soak", "postgres")
                return
            time.sleep(0.2)
        raise RuntimeError(f"PostgreSQL does not start: {self.log.read_text()[-1500:]}")

    def ask(self, statement: str, database: str = "soak") -> str | None:
        """What psql answers to a statement; `None` where the server is away."""
        done = subprocess.run(
            [self.bin / "psql", "-XqAt", "-U", "fnsf", "-d", database, "-h", self.socket, "-c", statement],
            capture_output=True,
            text=True,
        )
        return done.stdout.strip() if done.returncode == 0 else None

    def kill(self) -> None:
        """kill -9 of the postmaster; its other processes end when they notice."""
        if self.process:
            self.process.kill()
            self.process.wait()

    def stop(self) -> None:
        """A fast stop, and the end of the socket's folder."""
        if self.process and self.process.poll() is None:
            self.process.send_signal(2)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                self.process.send_signal(3)
                self.process.wait()
        shutil.rmtree(self.socket, ignore_errors=True)
