"""Programs in processes of their own that need not load the worker's modules again.

They are forked from one process that has loaded them once: a new interpreter takes some six seconds
of processor time to get as far. Nothing runs in that process, no kernel and no thread.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import re
import socket
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from tests.waiting import LIMIT_S, wait_until

from .ports import reserved_port

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["real2sim.cli", "real2sim_server.service.serve"])

LOOPBACK_URL = re.compile(r"http://127\.0\.0\.1:\d+(?=\D)")

# Given as source, because a function of a test module cannot be imported over there.
REAL2SIM = """
import os, sys
output = os.open(log_file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
os.dup2(output, 1)
os.dup2(output, 2)
os.environ.clear()
os.environ.update(environment)
exec(before)
sys.argv = ["real2sim", *arguments]
from real2sim.cli import main
main()
"""


def start_real2sim(
    arguments: Sequence[str],
    *,
    log_file: Path,
    environment: Mapping[str, str] | None = None,
    before: str = "",
) -> BaseProcess:
    """Start the command ``real2sim``.

    Args:
        arguments: of the command.
        log_file: what it prints is appended here.
        environment: variables besides those of this process that are not settings.
        before: Python code that runs first, in the process.
    """
    kept = {k: v for k, v in os.environ.items() if not k.startswith("REAL2SIM_")}
    given = {
        "arguments": list(arguments),
        "environment": kept | dict(environment or {}),
        "log_file": str(log_file),
        "before": before,
    }
    process = FORKS.Process(target=exec, args=(REAL2SIM, given), daemon=True)
    process.start()
    return process


def printed_url(process: BaseProcess, log_file: Path) -> str:
    """The address that a starting worker prints."""

    def found() -> re.Match[str] | None:
        alive = process.is_alive()  # Asked first: what it printed before it ended counts.
        printed = log_file.read_text() if log_file.exists() else ""
        url = LOOPBACK_URL.search(printed)
        assert url or alive, f"it ended without printing an address: {printed}"
        return url

    return wait_until(found, lambda: f"an address in {log_file.read_text()!r}").group()


def json_lines(log_file: Path) -> list[dict[str, Any]]:
    """The JSON objects among the lines that a process has finished writing."""
    if not log_file.exists():
        return []
    lines = log_file.read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("\n")]


@dataclass(frozen=True)
class Finished:
    """How a command ended, and all that it printed."""

    exit_code: int
    printed: str


def run_real2sim(
    arguments: Sequence[str],
    *,
    log_file: Path,
    environment: Mapping[str, str] | None = None,
    before: str = "",
) -> Finished:
    """Run the command ``real2sim`` to its end; arguments as of :func:`start_real2sim`."""
    process = start_real2sim(arguments, log_file=log_file, environment=environment, before=before)
    process.join()
    assert process.exitcode is not None
    return Finished(process.exitcode, log_file.read_text())


class KillableWorker:
    """``real2sim serve`` on a port that stays the same however often it is killed.

    Attributes:
        url, port: where it listens.
        scenes: folder of its scenes.
        process: the latest.
    """

    def __init__(
        self,
        *,
        scenes: Path,
        data: Path,
        log_file: Path,
        settings: Mapping[str, str] | None = None,
        before: str = "",
    ) -> None:
        self.port = reserved_port()
        self.scenes = scenes
        self._folders = ["--scenes", str(scenes), "--data", str(data)]
        self._log_file = log_file
        self._settings = dict(settings or {})
        self._before = before
        self.url = f"http://127.0.0.1:{self.port}"
        self.process: BaseProcess | None = None

    def start(self) -> None:
        """Start it; :meth:`wait_listening` returns once requests are answered."""
        assert self.process is None
        self.process = start_real2sim(
            ["serve", "--port", str(self.port), *self._folders],
            log_file=self._log_file,
            environment={"REAL2SIM_LOG_LEVEL": "error", "REAL2SIM_BACKEND": "cpu"} | self._settings,
            before=self._before,
        )

    def wait_listening(self, seconds: float = LIMIT_S) -> None:
        def listens() -> bool:
            assert self.process is not None
            assert self.process.is_alive(), self._log_file.read_text()
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port)):
                return True
            return False

        wait_until(listens, lambda: f"a listener: {self._log_file.read_text()}", seconds=seconds)

    def wait_ready(self, seconds: float = LIMIT_S) -> None:
        """Return once it takes work."""

        def is_ready() -> bool:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{self.url}/readyz"):
                return True
            return False

        wait_until(is_ready, lambda: f"readiness: {self._log_file.read_text()}", seconds=seconds)

    def stop(self, seconds: float = LIMIT_S) -> None:
        """Ask it to end, by SIGTERM, and wait until it has."""
        assert self.process is not None
        self.process.terminate()
        self.process.join(seconds)
        assert self.process.exitcode is not None, self._log_file.read_text()
        self.process = None

    def kill(self) -> None:
        """End it as it is, by SIGKILL."""
        if self.process is not None:
            self.process.kill()
            self.process.join(LIMIT_S)
            self.process = None

    def kill_and_start(self, delay: float = 0.0) -> None:
        """Kill it after ``delay`` [s], and start the next."""
        time.sleep(delay)
        self.kill()
        self.start()


@contextlib.contextmanager
def killable_worker(*, scenes: Path, data: Path, log_file: Path) -> Iterator[KillableWorker]:
    """A worker that listens, and is killed at the end of the block."""
    worker = KillableWorker(scenes=scenes, data=data, log_file=log_file)
    worker.start()
    try:
        worker.wait_listening()
        yield worker
    finally:
        worker.kill()
