"""HAProxy in front of several workers, from the system package, configured by
``docker/haproxy.cfg``."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.waiting import LIMIT_S, wait_until

from ..ports import reserved_port

SHIPPED = Path(__file__).parents[3] / "docker" / "haproxy.cfg"


def configuration(port: int, workers: Mapping[str, int], agents: Mapping[str, int]) -> str:
    """The shipped configuration, for workers on local ports."""
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
    """Path of the HAProxy executable. Skips if HAProxy is not installed."""
    found = shutil.which("haproxy") or shutil.which("haproxy", path="/usr/sbin")
    if found is None:
        pytest.skip("there is no haproxy")
    return found


@contextmanager
def running_haproxy(
    folder: Path, workers: Mapping[str, int], agents: Mapping[str, int]
) -> Iterator[str]:
    """Run a proxy for workers given by name, port and agent port. Yields its address."""
    haproxy, port = program(), reserved_port()
    file = folder / "haproxy.cfg"
    file.write_text(configuration(port, workers, agents))
    with (folder / "haproxy.log").open("w") as log:
        process = subprocess.Popen([haproxy, "-db", "-f", str(file)], stderr=log)

    def listens() -> bool:
        assert process.poll() is None, (folder / "haproxy.log").read_text()
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    try:
        wait_until(listens, "haproxy to listen")
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(LIMIT_S)
