"""A worker in its own process, as a user would start it."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

START_S = 180.0


class WorkerStartError(RuntimeError):
    """A worker that did not start."""


@dataclass(frozen=True)
class WorkerProcess:
    """A running `real2sim serve`.

    Attributes:
        url: where it listens.
        process: that runs it.
        log_file: what it prints.
    """

    url: str
    process: subprocess.Popen[bytes]
    log_file: Path

    def wait_listening(self, seconds: float = START_S) -> None:
        """Wait for the port to open; whether the worker is ready is for it to say.

        Raises:
            WorkerStartError: it ended, or did not listen in time; with the last line of its log.
        """
        port = int(self.url.rsplit(":", 1)[1])
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self.process.poll() is not None:
                raise self._failed(f"ended with exit code {self.process.returncode}")
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                return
            time.sleep(0.1)
        raise self._failed(f"did not listen within {seconds:.0f} s")

    def _failed(self, what: str) -> WorkerStartError:
        lines = self.log_file.read_text(errors="replace").strip().splitlines()
        last = lines[-1] if lines else "it printed nothing"
        return WorkerStartError(f"the worker {what}: {last} (see {self.log_file})")


@contextlib.contextmanager
def worker_process(*, scenes: Path, data: Path, log_file: Path) -> Iterator[WorkerProcess]:
    """Start ``real2sim serve`` on a free loopback port and wait until it listens there; it is
    stopped when the block ends. Arguments as of :func:`starting_worker`.

    Raises:
        WorkerStartError: it ended, or did not listen in time; with the last line of its log.
    """
    with starting_worker(scenes=scenes, data=data, log_file=log_file) as worker:
        worker.wait_listening()
        yield worker


@contextlib.contextmanager
def starting_worker(*, scenes: Path, data: Path, log_file: Path) -> Iterator[WorkerProcess]:
    """Like :func:`worker_process`, without waiting: something else can be done meanwhile.

    Args:
        scenes: folder of scene bundles.
        data: folder for its scenarios and sessions.
        log_file: takes what the worker prints.
    """
    port = _free_port()
    command = [sys.executable, "-m", "real2sim", "serve", "--port", str(port)]
    command += ["--scenes", str(scenes), "--data", str(data)]
    log_file.parent.mkdir(parents=True, exist_ok=True)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("REAL2SIM_")}
    with log_file.open("wb") as output:
        process = subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, env=environment
        )
        try:
            yield WorkerProcess(f"http://127.0.0.1:{port}", process, log_file)
        finally:
            _stop(process)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _stop(process: subprocess.Popen[bytes]) -> None:
    # As Ctrl-C: at SIGTERM a worker first lets proxies see that it is on its way out.
    process.send_signal(signal.SIGINT)
    try:
        process.wait(timeout=15)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
