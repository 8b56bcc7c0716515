"""HAProxy before several workers, from the system's package, set up as ``docker/haproxy.cfg``."""

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

SHIPPED = Path(__file__).parents[3] / "docker" / "haproxy.cfg"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def configuration(port: int, workers: Mapping[str, int], agents: Mapping[str, int]) -> str:
    """The file that is shipped, for workers on ports of this machine."""
    text = SHIPPED.read_text().partition("\nresolvers dns")[0]
    lines = [line for line in text.splitlines() if not line.startswith("  server ")]
    lines += [
        f"  server {name} 127.0.0.1:{at} agent-port {agents[name]}" for name, at in workers.items()
    ]
    text = "\n".join([*lines, ""])
    text = re.sub(r"(?m)^  log .*\n|^  option httplog\n", "", text)
    text = text.replace("maxconn 20000", "maxconn 1000")
    return text.replace("bind :8600", f"bind 127.0.0.1:{port}")


def program() -> str:
    """The program; skips where there is none."""
    found = shutil.which("haproxy") or shutil.which("haproxy", path="/usr/sbin")
    if found is None:
        pytest.skip("there is no haproxy")
    return found


@contextmanager
def running_haproxy(
    folder: Path, workers: Mapping[str, int], agents: Mapping[str, int]
) -> Iterator[str]:
    """A proxy before workers, by their names, ports and their agents' ports; its address."""
    haproxy, port = program(), free_port()
    file = folder / "haproxy.cfg"
    file.write_text(configuration(port, workers, agents))
    with (folder / "haproxy.log").open("w") as log:
        process = subprocess.Popen([haproxy, "-db", "-f", str(file)], stderr=log)
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
