"""Opens the drive socket; a handshake that fails is answered by HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator
from functools import partial

import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from structlog.contextvars import bound_contextvars

from real2sim_proto import SUPPORTED_SUBPROTOCOLS, ErrorCode

from ..accounts import Account, RevokedError
from ..http.auth import act_for, bearer_token, unauthorized
from ..http.responses import REQUEST_ID_KEY, problem_response, service_error
from ..sessions.connection import Connection
from ..sessions.messages import (
    FatalError,
    close_with_error,
    receive_hello,
    unsupported_protocol,
    with_progress,
)
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
        protocol = common_protocol(socket)
        account = account_of_handshake(socket, worker)
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
            await _serve(socket, worker, row, account)
        except WebSocketDisconnect:
            log.info("drive socket left before its welcome")
        except FatalError as error:
            if error.error.code is ErrorCode.UNAUTHORIZED:
                worker.metrics.auth_failures.labels("drive").inc()
            log.info("drive socket refused", code=error.error.code.value)
            await close_with_error(socket, error.error, message_id=error.message_id)


async def _serve(
    socket: WebSocket, worker: Worker, row: SessionRow, account: Account | None
) -> None:
    """Hello, the session, then its messages."""
    hello = await receive_hello(
        socket,
        row,
        authorised=account is not None,
        opens_worker=lambda token: account_of_token(worker, token) is not None,
        resume_token=worker.sessions.resume_token(row),
    )
    try:
        # Who has the session's token alone drives for whoever made it.
        account = account or account_of_token(worker, hello.token)
        account = account or worker.accounts.of_owner(row.owner)
        act_for(socket, account)
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
    connection = Connection(socket, session, worker.sessions, ws_base=ws_base)
    try:
        with ended_when_revoked(connection, account):
            await connection.serve(hello)
    finally:
        log.info(
            "drive socket closed",
            role=hello.role,
            account=account.name,
            steps=max(0, _steps(session) - first),
            seconds=round(time.perf_counter() - started, 1),
            session_over=session.closed is not None,
        )


def _steps(session: Session) -> int:
    return session.world.steps if session.world else 0


def common_protocol(socket: WebSocket) -> str:
    """The subprotocol that both sides speak. Raises ServiceError: UNSUPPORTED_PROTOCOL."""
    offered = list(socket.scope.get("subprotocols", []))
    for protocol in SUPPORTED_SUBPROTOCOLS:
        if protocol in offered:
            return protocol
    raise unsupported_protocol(offered)


def account_of_handshake(socket: WebSocket, worker: Worker) -> Account | None:
    """Whose token of the worker the handshake has; hello may carry one instead.

    Raises:
        ServiceError: UNAUTHORIZED for a wrong one.
    """
    given = bearer_token(socket)
    if given is None or not worker.accounts.wants_token:
        return None
    account = worker.accounts.of_token(given)
    if account is None:
        worker.metrics.auth_failures.labels("drive").inc()
        raise unauthorized("the bearer token is not this worker's")
    return account


def account_of_token(worker: Worker, token: str | None) -> Account | None:
    """Whose token of the worker it is; None where the worker has none."""
    return worker.accounts.of_token(token) if worker.accounts.wants_token else None


@contextlib.contextmanager
def ended_when_revoked(connection: Connection, account: Account) -> Iterator[None]:
    """The connection ends when the token of its account is no more."""
    revoked = partial(_end, connection, account)
    account.on_revoked.add(revoked)
    try:
        yield
    finally:
        account.on_revoked.discard(revoked)


def _end(connection: Connection, account: Account) -> None:
    """Leave a client whose token is no more; not awaited, for it may be slow to read."""
    ending = asyncio.ensure_future(connection.end(service_error(RevokedError(account.name))))
    _ending.add(ending)
    ending.add_done_callback(_ending.discard)


_ending: set[asyncio.Future[None]] = set()
