"""Ports for programs that tests start."""

from __future__ import annotations

import random
import socket
from pathlib import Path

RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")
LOWEST = 10_000


def free_port() -> int:
    """A port that is free, and that the system gives to no connection: a server that is started
    again finds it free as well."""
    above = int(RANGE.read_text().split()[0]) if RANGE.exists() else 32_768
    choose = random.SystemRandom()
    while True:
        port = choose.randrange(LOWEST, max(above, LOWEST + 1000))
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
