"""Opens the drive socket; a handshake that fails is answered by HTTP."""

from __future__ import annotations

import time

import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from structlog.contextvars import bound_contextvars

from real2sim_proto import SUPPORTED_SUBPROTOCOLS, ErrorCode

from ..http.auth import secrets_equal, unauthorized
from ..http.problems import REQUEST_ID_KEY, problem_response, service_error
from ..sessions.connection import Connection
from ..sessions.handshake import FatalError, close_with_error, receive_hello, with_progress
from ..sessions.messages import unsupported_protocol
from ..sessions.registry import check_not_closed
from ..sessions.session import Session
from ..storage.store import SessionRow
from ..worker import Worker, WorkerOf

router = APIRouter(prefix="/v1/sessions", tags=["sessions"])

log = structlog.get_logger(__name__)


@router.websocket("/{session_id}/drive")
async def drive(socket: WebSocket, worker: WorkerOf, session_id: str) -> None:
    """Drive a session in lock step, or look on; see docs of the drive socket."""
    try:
        protocol = _common_protocol(socket)
        authorised = _carries_worker_token(socket, worker)
        row = check_not_closed(await worker.sessions.row(session_id))
    except Exception as error:
        failure = service_error(error, log_unexpected=True)
        request_id = socket.scope.get(REQUEST_ID_KEY)
        response = problem_response(failure, path=socket.url.path, request_id=request_id)
        await socket.send_denial_response(response)
        return
    await socket.accept(subprotocol=protocol)
    with worker.metrics.open_socket("drive"), bound_contextvars(session_id=row.session_id):
        try:
            await _serve(socket, worker, row, authorised=authorised)
        except WebSocketDisconnect:
            log.info("drive socket left before its welcome")
        except FatalError as error:
            if error.error.code is ErrorCode.UNAUTHORIZED:
                worker.metrics.auth_failures.labels("drive").inc()
            log.info("drive socket refused", code=error.error.code.value)
            await close_with_error(socket, error.error, message_id=error.message_id)


async def _serve(socket: WebSocket, worker: Worker, row: SessionRow, *, authorised: bool) -> None:
    """Hello, the session, then its messages."""
    secret = worker.settings.token
    hello = await receive_hello(
        socket,
        row,
        authorised=authorised,
        worker_token=secret.get_secret_value() if secret else None,
        resume_token=worker.sessions.resume_token(row),
    )
    try:
        session = await with_progress(
            socket, worker.sessions.find(row.session_id), hello, phase="loading the session"
        )
    except WebSocketDisconnect:
        raise
    except Exception as error:
        raise FatalError(service_error(error, log_unexpected=True), message_id=hello.id) from error
    started, first = time.perf_counter(), _steps(session)
    log.info("drive socket opened", role=hello.role)
    ws_base = str(socket.base_url).rstrip("/")
    try:
        await Connection(socket, session, worker.sessions, ws_base=ws_base).serve(hello)
    finally:
        log.info(
            "drive socket closed",
            role=hello.role,
            steps=max(0, _steps(session) - first),
            seconds=round(time.perf_counter() - started, 1),
            session_over=session.closed is not None,
        )


def _steps(session: Session) -> int:
    return session.world.steps if session.world else 0


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
        worker.metrics.auth_failures.labels("drive").inc()
        raise unauthorized("the bearer token is not this worker's")
    return True
