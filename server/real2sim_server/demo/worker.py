"""A worker in its own process, as a user would start it."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Worker:
    """A running `real2sim serve`."""

    url: str
    process: subprocess.Popen[bytes]


@contextlib.contextmanager
def own_worker(*, scenes: Path, data: Path, log_file: Path) -> Iterator[Worker]:
    """Start ``real2sim serve`` on a free loopback port; it is stopped when the block ends.

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
            yield Worker(url=f"http://127.0.0.1:{port}", process=process)
        finally:
            _stop(process)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=15)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
