"""The door of the view socket: browsers cannot send headers, so the first message has the token."""

from __future__ import annotations

import json
from urllib.parse import urlsplit

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from ..http.auth import same_secret
from ..http.hosts import FOREIGN
from ..http.problems import ServiceError
from ..rendering.views_socket import View
from ..worker import Worker, WorkerOf

UNAUTHORIZED, REFUSED = 4401, 4404
"""Codes with which the socket is closed."""

router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"])


@router.websocket("/{scenario_id}/view")
async def view(socket: WebSocket, worker: WorkerOf, scenario_id: str) -> None:
    """Frames and picks of a scenario for one browser; the latest question wins."""
    if not same_origin(socket.headers.get("Origin"), socket.headers.get("Host")):
        await socket.close(code=FOREIGN, reason="pages of other sites may not look")
        return
    await socket.accept()
    try:
        if not await _introduced(socket, worker):
            await socket.close(UNAUTHORIZED, "the token is not this worker's")
            return
        await worker.scenarios.view(scenario_id)
        await socket.send_text(json.dumps({"type": "welcome"}))
        await View(socket, worker, scenario_id).serve()
    except ServiceError as error:
        await socket.close(REFUSED, error.detail[:100])
    except WebSocketDisconnect:
        return


def same_origin(origin: str | None, host: str | None) -> bool:
    """Whether a page of this worker asks, or no page at all."""
    return origin is None or urlsplit(origin).netloc == host


async def _introduced(socket: WebSocket, worker: Worker) -> bool:
    """Read `{"type": "hello", "token": ...}`; whether the token is right, or none is needed."""
    try:
        hello = json.loads(await socket.receive_text())
    except ValueError:
        return False
    secret = worker.settings.token
    if secret is None:
        return isinstance(hello, dict)
    given = hello.get("token") if isinstance(hello, dict) else None
    return isinstance(given, str) and same_secret(given, secret.get_secret_value())
