"""Opens the view socket: browsers cannot send headers, so the first message has the token."""

from __future__ import annotations

import json
from urllib.parse import urlsplit

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from ..http.auth import secrets_equal
from ..http.hosts import FOREIGN_HOST
from ..http.problems import ServiceError
from ..worker import Worker, WorkerOf
from .view_connection import ViewConnection

CLOSED_UNAUTHORIZED, CLOSED_NOT_FOUND = 4401, 4404
"""Codes with which the socket is closed."""

router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"])


@router.websocket("/{scenario_id}/view")
async def view(socket: WebSocket, worker: WorkerOf, scenario_id: str) -> None:
    """Frames and picks of a scenario for one browser; the latest question wins."""
    if not same_origin(socket.headers.get("Origin"), socket.headers.get("Host")):
        await socket.close(code=FOREIGN_HOST, reason="pages of other sites may not look")
        return
    await socket.accept()
    try:
        if not await _authenticate(socket, worker):
            await socket.close(CLOSED_UNAUTHORIZED, "the token is not this worker's")
            return
        await worker.scenarios.view(scenario_id)
        await socket.send_text(json.dumps({"type": "welcome"}))
        await ViewConnection(socket, worker, scenario_id).serve()
    except ServiceError as error:
        await socket.close(CLOSED_NOT_FOUND, error.detail[:100])
    except WebSocketDisconnect:
        return


def same_origin(origin: str | None, host: str | None) -> bool:
    """Whether a page of this worker asks, or no page at all."""
    return origin is None or urlsplit(origin).netloc == host


async def _authenticate(socket: WebSocket, worker: Worker) -> bool:
    """Read `{"type": "hello", "token": ...}`; whether the token is right, or none is needed."""
    try:
        hello = json.loads(await socket.receive_text())
    except ValueError:
        return False
    secret = worker.settings.token
    if secret is None:
        return isinstance(hello, dict)
    given = hello.get("token") if isinstance(hello, dict) else None
    return isinstance(given, str) and secrets_equal(given, secret.get_secret_value())
