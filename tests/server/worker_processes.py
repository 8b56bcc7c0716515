"""Programs in processes of their own that need not load the worker's modules again.

They are forked from one process that has loaded them once: a new interpreter takes some six seconds
of processor time to get as far. Nothing runs in that process, no kernel and no thread.
"""

from __future__ import annotations

import contextlib
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

from .ports import free_port

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
        environment: variables besides those of this process that are no settings.
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


def printed_url(process: BaseProcess, log_file: Path, seconds: float = 60) -> str:
    """The address that a starting worker prints."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and process.is_alive():
        if log_file.exists() and (url := LOOPBACK_URL.search(log_file.read_text())):
            return url.group()
        time.sleep(0.05)
    raise AssertionError(f"no address was printed: {log_file.read_text()}")


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
    process.join(120)
    assert process.exitcode is not None, log_file.read_text()
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
        self.port = free_port()
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

    def wait_listening(self, seconds: float = 60) -> None:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            assert self.process is not None
            assert self.process.is_alive(), self._log_file.read_text()
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port)):
                return
            time.sleep(0.05)
        raise AssertionError(f"not listening: {self._log_file.read_text()}")

    def wait_ready(self, seconds: float = 60) -> None:
        """Return once it takes work."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{self.url}/readyz"):
                return
            time.sleep(0.1)
        raise AssertionError(f"not ready: {self._log_file.read_text()}")

    def stop(self, seconds: float) -> None:
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
            self.process.join(30)
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
