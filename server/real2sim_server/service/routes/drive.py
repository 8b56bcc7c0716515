"""Opens the drive socket; a handshake that fails is answered by HTTP."""

from __future__ import annotations

from fastapi import APIRouter, WebSocket

from real2sim_proto import SUPPORTED_SUBPROTOCOLS

from ..http.auth import secrets_equal, unauthorized
from ..http.problems import REQUEST_ID_KEY, ServiceError, problem_response
from ..sessions.connection import Connection
from ..sessions.messages import unsupported_protocol
from ..sessions.session import Session
from ..worker import Worker, WorkerOf

router = APIRouter(prefix="/v1/sessions", tags=["sessions"])


@router.websocket("/{session_id}/drive")
async def drive(socket: WebSocket, worker: WorkerOf, session_id: str) -> None:
    """Drive a session in lock step, or look on; see docs of the drive socket."""
    try:
        protocol = _common_protocol(socket)
        authorised = _carries_worker_token(socket, worker)
        session: Session = await worker.sessions.find(session_id)
    except ServiceError as error:
        request_id = socket.scope.get(REQUEST_ID_KEY)
        response = problem_response(error, path=socket.url.path, request_id=request_id)
        await socket.send_denial_response(response)
        return
    await socket.accept(subprotocol=protocol)
    secret = worker.settings.token
    await Connection(
        socket,
        session,
        worker.sessions,
        authorised=authorised,
        worker_token=secret.get_secret_value() if secret else None,
        ws_base=str(socket.base_url).rstrip("/"),
    ).serve()


def _common_protocol(socket: WebSocket) -> str:
    offered = list(socket.scope.get("subprotocols", []))
    for protocol in SUPPORTED_SUBPROTOCOLS:
        if protocol in offered:
            return protocol
    raise unsupported_protocol(offered)


def _carries_worker_token(socket: WebSocket, worker: Worker) -> bool:
    """Whether the handshake has the worker's token; hello may carry one instead.

    Raises:
        ServiceError: UNAUTHORIZED for a wrong one.
    """
    secret = worker.settings.token
    scheme, _, given = socket.headers.get("Authorization", "").partition(" ")
    if secret is None or scheme.lower() != "bearer":
        return False
    if not secrets_equal(given.strip(), secret.get_secret_value()):
        raise unauthorized("the bearer token is not this worker's")
    return True
