"""HAProxy before several workers, from the system's package, set up as the documentation has it."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[3] / "docs" / "operations.md"


def documented_configuration(port: int, workers: Mapping[str, int]) -> str:
    """The example of the documentation, for workers on ports of this machine."""
    (example,) = re.findall(r"```haproxy\n(.*?)```", DOCS.read_text(), re.S)
    lines = [line for line in example.splitlines() if not line.startswith("  server ")]
    lines += [f"  server {name} 127.0.0.1:{at}" for name, at in workers.items()]
    defaults = ["defaults", "  mode http", "  timeout connect 1s"]
    defaults += ["  timeout client 1h", "  timeout server 1h"]
    return "\n".join([*defaults, *lines, ""]).replace("bind :8600", f"bind 127.0.0.1:{port}")


@contextmanager
def running_haproxy(folder: Path, workers: Mapping[str, int]) -> Iterator[str]:
    """A proxy before workers (names and ports), and its address; skips where there is none."""
    program = shutil.which("haproxy") or shutil.which("haproxy", path="/usr/sbin")
    if program is None:
        pytest.skip("there is no haproxy")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    configuration = folder / "haproxy.cfg"
    configuration.write_text(documented_configuration(port, workers))
    with (folder / "haproxy.log").open("w") as log:
        process = subprocess.Popen([program, "-db", "-f", str(configuration)], stderr=log)
    try:
        deadline = time.monotonic() + 10
        while process.poll() is None and time.monotonic() < deadline:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                break
            time.sleep(0.05)
        assert process.poll() is None, (folder / "haproxy.log").read_text()
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(10)
