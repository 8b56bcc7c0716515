"""Connections of clients: how many there may be, and how long one may keep the worker waiting.

Nothing here runs on the way of a request but two assignments: a sweep looks at all connections once
a second. Where there are too many, those make room that have been silent for longest while it was
their turn to send; sockets and requests in progress stay.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

import structlog

from real2sim_proto import HTTP_STATUS, PROBLEM_MEDIA_TYPE, ErrorCode

from .problems import ServiceError, problem_of
from .responses import SECURITY_HEADERS

if TYPE_CHECKING:
    from .metrics import Metrics

SWEEP_S = 1.0
SLOWEST_BYTES_PER_S = 10_000
"""Whoever sends or reads faster is waited for, however long it takes."""
NEAR, FAR = 0.8, 0.6
"""Shares of the limit at which a warning is given, and below which it may be given again."""
RESERVED_DESCRIPTORS = 256
"""Kept for the store, scene files, uploads and the pipes of jobs."""
CLIENTS_NAMED = 5

log = structlog.get_logger(__name__)


class DropReason(StrEnum):
    """Why a connection was closed by the worker."""

    HEAD_TIMEOUT = "head_timeout"
    BODY_TIMEOUT = "body_timeout"
    WRITE_TIMEOUT = "write_timeout"
    CROWDED_OUT = "crowded_out"
    REFUSED = "refused"


@dataclass(frozen=True)
class ConnectionLimits:
    """What a connection may take.

    Attributes:
        most: connections at a time.
        head_s: from the first byte of a request, or from the beginning, to the end of its headers.
        body_s: for the body, beside the time that it takes at the slowest rate allowed.
        write_s: for a client to read what it was sent, beside the time at that rate.
    """

    most: int
    head_s: float
    body_s: float
    write_s: float


class WatchedConnection(Protocol):
    """A connection as the sweep sees it."""

    client: tuple[str, int] | None

    def overdue(self, now: float) -> DropReason | None:
        """Why it has to go, if it has to; ``now`` in seconds of the monotonic clock."""

    def drop(self, reason: DropReason) -> None:
        """Close it, with an answer where one can be given."""


class Connections:
    """All connections of a worker. Belongs to the event loop.

    Args:
        limits: how many, and how slow.
        metrics: counts what was dropped.
    """

    def __init__(self, limits: ConnectionLimits, metrics: Metrics) -> None:
        self.limits = limits
        self._metrics = metrics
        self._open: set[WatchedConnection] = set()
        # Those whose turn it is to send; the one that was silent for longest comes first.
        self._silent: dict[WatchedConnection, None] = {}
        self._dropped: Counter[DropReason] = Counter()
        self._dropped_clients: list[str] = []
        self._warned = False
        metrics.watch(metrics.connections, lambda: len(self._open))
        metrics.connection_limit.set(limits.most)

    def __len__(self) -> int:
        return len(self._open)

    def admit(self, connection: WatchedConnection) -> None:
        """A new connection, of which nothing is known yet; it may be dropped at once."""
        if len(self._open) >= self.limits.most:
            silent = next(iter(self._silent), None)
            if silent is None:
                self._drop(connection, DropReason.REFUSED)
                return
            self._drop(silent, DropReason.CROWDED_OUT)
        self._open.add(connection)
        self._silent[connection] = None
        self._warn_when_near()

    def heard(self, connection: WatchedConnection, *, more: bool) -> None:
        """Something came from a connection; ``more``: it is still its turn."""
        if connection in self._open:
            self._silent.pop(connection, None)
            if more:
                self._silent[connection] = None

    def forget(self, connection: WatchedConnection) -> None:
        """A connection has ended, or goes on as another one."""
        self._open.discard(connection)
        self._silent.pop(connection, None)

    async def watch(self) -> None:
        """Drop what is overdue, until cancelled."""
        while True:
            await asyncio.sleep(SWEEP_S)
            self.sweep()

    def sweep(self) -> None:
        """Drop what is overdue now, and tell the log what was dropped since the last time."""
        now = time.monotonic()
        for connection in list(self._open):
            if (reason := connection.overdue(now)) is not None:
                self._drop(connection, reason)
        if self._dropped:
            log.warning(
                "connections dropped",
                reasons={reason.value: count for reason, count in self._dropped.items()},
                clients=self._dropped_clients,
                open=len(self._open),
                limit=self.limits.most,
            )
            self._dropped.clear()
            self._dropped_clients = []

    def _drop(self, connection: WatchedConnection, reason: DropReason) -> None:
        # It stays among the open ones until its end: a client that does not read holds it.
        self._silent.pop(connection, None)
        if reason is DropReason.CROWDED_OUT:
            self._open.discard(connection)
        self._dropped[reason] += 1
        self._metrics.dropped_connections.labels(reason.value).inc()
        client = connection.client[0] if connection.client else "unknown"
        if client not in self._dropped_clients and len(self._dropped_clients) < CLIENTS_NAMED:
            self._dropped_clients.append(client)
        connection.drop(reason)

    def _warn_when_near(self) -> None:
        share = len(self._open) / self.limits.most
        if share >= NEAR and not self._warned:
            log.warning(
                "connections near their limit",
                open=len(self._open),
                limit=self.limits.most,
                hint="raise REAL2SIM_MAX_CONNECTIONS and the limit of descriptors (ulimit -n), "
                "or look for clients that leave connections open",
            )
        self._warned = share >= (FAR if self._warned else NEAR)


class Backlog:
    """What a client has not read yet, as the sweep sees it.

    Args:
        allowed_s: without reading at :data:`SLOWEST_BYTES_PER_S`.
    """

    def __init__(self, allowed_s: float) -> None:
        self._allowed_s = allowed_s
        self._since = 0.0
        self._bytes = 0
        self._read = 0

    def overdue(self, transport: asyncio.Transport, now: float) -> bool:
        """Whether the client reads too slowly, or not at all."""
        size = transport.get_write_buffer_size()
        if self._bytes == 0:
            self._since, self._read = now, 0
        self._read += max(0, self._bytes - size)
        self._bytes = size
        return size > 0 and now - self._since > self._allowed_s + self._read / SLOWEST_BYTES_PER_S

    def cleared(self) -> None:
        """The client has read all but what the transport takes without asking."""
        self._bytes = 0


def connection_limit(wanted: int) -> int:
    """Connections that the limit of descriptors leaves room for, ``wanted`` at most."""
    try:
        import resource
    except ImportError:  # not on this system
        return wanted
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return wanted
    return min(wanted, max(soft - RESERVED_DESCRIPTORS, soft // 4, 1))


def last_answer(reason: DropReason, limits: ConnectionLimits) -> bytes:
    """A whole HTTP answer for a connection that is closed with it."""
    failure = _FAILURES[reason](limits)
    problem = problem_of(failure, path="", request_id=None)
    body = json.dumps(problem.model_dump(mode="json", exclude_none=True)).encode()
    return _whole_answer(failure, body)


def bad_request_answer() -> bytes:
    """The same for bytes that are no HTTP."""
    failure = ServiceError(ErrorCode.BAD_MESSAGE, "what was sent is no HTTP request")
    problem = problem_of(failure, path="", request_id=None)
    return _whole_answer(failure, problem.model_dump_json(exclude_none=True).encode())


def _whole_answer(failure: ServiceError, body: bytes) -> bytes:
    phrase = {400: "Bad Request", 408: "Request Timeout", 503: "Service Unavailable"}
    headers = {
        "Content-Type": PROBLEM_MEDIA_TYPE,
        "Content-Length": str(len(body)),
        "Connection": "close",
        **failure.headers,
        **SECURITY_HEADERS,
    }
    status = HTTP_STATUS[failure.code]
    lines = [f"HTTP/1.1 {status} {phrase[status]}", *(f"{k}: {v}" for k, v in headers.items())]
    return "\r\n".join([*lines, "", ""]).encode() + body


def _crowded(limits: ConnectionLimits) -> ServiceError:
    return ServiceError(
        ErrorCode.TOO_MANY_CONNECTIONS,
        f"all {limits.most} connections of this worker are taken",
        hint="send it again after Retry-After seconds, and use one connection for many requests",
    )


_FAILURES = {
    DropReason.HEAD_TIMEOUT: lambda limits: ServiceError(
        ErrorCode.REQUEST_TIMEOUT,
        f"the headers of the request were not complete within {limits.head_s:g} s",
        hint="send a request whole",
    ),
    DropReason.BODY_TIMEOUT: lambda limits: ServiceError(
        ErrorCode.REQUEST_TIMEOUT,
        f"the body came more slowly than {SLOWEST_BYTES_PER_S} bytes a second, and "
        f"{limits.body_s:g} s more",
        hint="send it again, whole",
    ),
    DropReason.CROWDED_OUT: _crowded,
    DropReason.REFUSED: _crowded,
}
