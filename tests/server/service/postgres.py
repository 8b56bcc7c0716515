"""A local PostgreSQL server for tests, from the system package."""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import subprocess
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import sqlalchemy as sa

from ..ports import reserved_port

USER = "real2sim"


@dataclass(frozen=True)
class Postgres:
    """A running server."""

    port: int
    data: Path
    control: Callable[..., None]

    def start(self) -> None:
        """Start or restart the server."""
        options = f"-p {self.port} -h 127.0.0.1 -k {self.data.parent} -F"
        self.control("-l", self.data.parent / "log", "-w", "-o", options, "start")

    def stop(self) -> None:
        """Stop the server immediately. Open connections break."""
        self.control("-m", "immediate", "stop")

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Freeze the server inside the block: connections stay open but get no answers."""
        server = int((self.data / "postmaster.pid").read_text().split()[0])
        listed = Path(f"/proc/{server}/task/{server}/children").read_text()
        processes = [server, *map(int, listed.split())]
        for process in processes:
            os.kill(process, signal.SIGSTOP)
        try:
            yield
        finally:
            for process in processes:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGCONT)

    def url(self, database: str) -> str:
        return f"postgresql+pg8000://{USER}@127.0.0.1:{self.port}/{database}"

    def new_database(self) -> str:
        """SQLAlchemy URL of a new, empty database."""
        name = f"test_{uuid.uuid4().hex}"
        engine = sa.create_engine(self.url("postgres"), isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.execute(sa.text(f"CREATE DATABASE {name}"))
        engine.dispose()
        return self.url(name)


@contextmanager
def running_postgres(folder: Path) -> Iterator[Postgres]:
    """Run a server in ``folder`` on a free local port. Skips if PostgreSQL is not installed."""
    programs = _programs()
    data = folder / "data"
    unprivileged: list[str] = []
    if getpass.getuser() == "root":
        # The server refuses to run as root.
        if shutil.which("runuser") is None:
            pytest.skip("PostgreSQL does not run as root, and there is no runuser")
        shutil.chown(folder, "nobody")
        unprivileged = ["runuser", "-u", "nobody", "--"]

    def call(*command: str | Path) -> None:
        # Outside the test folders, which other users may not be able to enter.
        done = subprocess.run(
            [*unprivileged, *map(str, command)],
            capture_output=True,
            text=True,
            check=False,
            cwd=folder,
        )
        if done.returncode:
            pytest.skip(f"PostgreSQL does not start here: {done.stderr.strip()[-300:]}")

    call(programs / "initdb", "-D", data, "-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync")
    server = Postgres(reserved_port(), data, partial(call, programs / "pg_ctl", "-D", data))
    server.start()
    try:
        yield server
    finally:
        server.stop()


def _programs() -> Path:
    pytest.importorskip("pg8000", reason="the driver is not installed: pip install 'real2sim[dev]'")
    found = shutil.which("initdb")
    places = [Path(found).resolve().parent] if found else []
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    for place in places:
        if (place / "initdb").is_file() and (place / "pg_ctl").is_file():
            return place
    pytest.skip("no PostgreSQL here: apt-get install postgresql")
