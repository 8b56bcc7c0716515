"""Ports for programs that tests start, and start again."""

from __future__ import annotations

import socket


def reserved_port() -> int:
    """A port of loopback that nobody else is given while this process lives.

    A socket that is bound and does not listen keeps it; a server can bind it beside that, since
    both set SO_REUSEADDR.
    """
    holder = socket.socket()
    holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    holder.bind(("127.0.0.1", 0))
    port: int = holder.getsockname()[1]
    holder.detach()
    return port
