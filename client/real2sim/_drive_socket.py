"""Opening and losing the drive socket, whoever waits for it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import websockets

from real2sim_proto import DRIVE_SUBPROTOCOL

from ._protocol import MAX_MESSAGE_BYTES
from ._replies import Reply, error_from_reply
from ._target import Target
from .errors import (
    ConnectionLostError,
    ProtocolMismatchError,
    ReplyTimeoutError,
    UnreachableError,
)


def socket_options(target: Target, session_id: str) -> dict[str, Any]:
    """Arguments of a connection: no compression, large frames, time limits on."""
    return {
        "uri": target.drive_url(session_id),
        "subprotocols": [DRIVE_SUBPROTOCOL],
        "additional_headers": target.headers,
        "compression": None,
        "max_size": MAX_MESSAGE_BYTES,
        "open_timeout": target.timeout,
        "close_timeout": min(target.timeout, 5.0),
        "proxy": None if target.loopback else True,
    }


def check_subprotocol(chosen: str | None) -> None:
    """Refuse a worker that did not choose our subprotocol. Raises ProtocolMismatchError."""
    if chosen != DRIVE_SUBPROTOCOL:
        raise ProtocolMismatchError(
            f"the worker chose drive protocol {chosen or 'none'}; this client speaks "
            f"{DRIVE_SUBPROTOCOL}",
            hint="install a client and a worker of the same major version",
        )


@contextlib.contextmanager
def handshake_errors(target: Target) -> Iterator[None]:
    """What goes wrong while the socket opens, as errors of the SDK."""
    try:
        yield
    except websockets.exceptions.InvalidStatus as error:
        response = error.response
        headers = {name.lower(): value for name, value in response.headers.raw_items()}
        reply = Reply(response.status_code, headers, bytes(response.body or b""))
        raise error_from_reply(reply) from error
    except TimeoutError:
        raise ReplyTimeoutError(
            f"answer to the drive socket's handshake from {target.url}", target.timeout
        ) from None
    except websockets.exceptions.NegotiationError as error:
        raise ProtocolMismatchError(
            f"the worker did not agree to drive protocol {DRIVE_SUBPROTOCOL}: {error}",
            hint="install a client and a worker of the same major version",
        ) from error
    except (OSError, websockets.exceptions.WebSocketException) as error:
        raise UnreachableError(
            f"the drive socket at {target.url} did not open: {error}",
            hint="is the worker up? see `real2sim status`",
        ) from None


@contextlib.contextmanager
def lost_connection(target: Target, awaited: str) -> Iterator[None]:
    """A socket that closes while an answer is awaited, as ConnectionLostError."""
    try:
        yield
    except websockets.exceptions.ConnectionClosed as error:
        close = error.rcvd
        said = f"{close.code} {close.reason}".strip() if close else "without a close frame"
        leaving = close is not None and close.code in {1001, 1012}
        raise ConnectionLostError(
            f"the worker at {target.url} closed the drive socket ({said}) while "
            f"{awaited} was awaited",
            hint="the worker is shutting down or restarting" if leaving else None,
        ) from error
