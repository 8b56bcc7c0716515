"""Opens the batch socket, whose messages step the worlds of many sessions."""

from __future__ import annotations

import asyncio
import time

import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from real2sim_proto import SUPPORTED_SUBPROTOCOLS, ErrorCode
from real2sim_proto.drive_batch import BatchHello, BatchMember

from ..accounts import Account
from ..http.accounting import begin_paying
from ..http.auth import secrets_equal, unauthorized
from ..http.problems import REQUEST_ID_KEY, ServiceError, problem_response, service_error
from ..sessions.batch_connection import BatchConnection, read_batch_message
from ..sessions.handshake import (
    HANDSHAKE_TIMEOUT_S,
    FatalError,
    close_with_error,
    receive_as,
    with_progress,
)
from ..sessions.messages import BadMessageError, bad_message, unsupported_protocol
from ..sessions.registry import check_not_closed
from ..sessions.session import Session, opens_session
from ..storage.store import SessionRow
from ..worker import Worker, WorkerOf
from .drive import account_of_handshake, account_of_token, common_protocol, ended_when_revoked

router = APIRouter(prefix="/v1/sessions", tags=["sessions"])

log = structlog.get_logger(__name__)


@router.websocket("/batch/drive")
async def drive_batch(socket: WebSocket, worker: WorkerOf) -> None:
    """Drive many sessions, one message a step of all; see docs of the batch socket."""
    try:
        protocol = common_protocol(socket)
        account = account_of_handshake(socket, worker)
    except Exception as error:
        failure = service_error(error, log_unexpected=True)
        request_id = socket.scope.get(REQUEST_ID_KEY)
        response = problem_response(failure, path=socket.url.path, request_id=request_id)
        await socket.send_denial_response(response)
        return
    await socket.accept(subprotocol=protocol)
    with worker.metrics.open_socket("drive"):
        try:
            await _serve(socket, worker, account)
        except WebSocketDisconnect:
            log.info("batch socket left before its welcome")
        except FatalError as error:
            if error.error.code is ErrorCode.UNAUTHORIZED:
                worker.metrics.auth_failures.labels("drive").inc()
            log.info("batch socket refused", code=error.error.code.value)
            await close_with_error(socket, error.error, message_id=error.message_id)


async def _serve(socket: WebSocket, worker: Worker, account: Account | None) -> None:
    """Hello, the sessions, then messages."""
    hello = await _hello(socket)
    try:
        account = account or account_of_token(worker, hello.token)
        rows = [check_not_closed(await worker.sessions.row(m.session_id)) for m in hello.sessions]
        for member, row in zip(hello.sessions, rows, strict=True):
            _check_member(member, row, worker, authorised=account is not None)
        account = account or worker.accounts.of_owner(rows[0].owner)
        begin_paying(socket, account)
        members = await with_progress(
            socket, _found(worker, rows), hello, phase="loading the sessions"
        )
    except WebSocketDisconnect:
        raise
    except Exception as error:
        raise FatalError(service_error(error, log_unexpected=True), message_id=hello.id) from error
    started = time.perf_counter()
    log.info("batch socket opened", sessions=len(members))
    resuming = [
        _is_resuming(member, worker, row) for member, row in zip(hello.sessions, rows, strict=True)
    ]
    connection = BatchConnection(socket, members, worker.sessions, resuming=resuming)
    try:
        with ended_when_revoked(connection, account):
            await connection.serve(hello)
    finally:
        seconds = round(time.perf_counter() - started, 1)
        log.info("batch socket closed", account=account.name, seconds=seconds)


async def _hello(socket: WebSocket) -> BatchHello:
    """The first message. Raises FatalError: anything else came, or nothing in time."""
    try:
        async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
            message = await receive_as(read_batch_message, socket)
    except TimeoutError as error:
        detail = f"no batch_hello within {HANDSHAKE_TIMEOUT_S:g} s"
        raise FatalError(ServiceError(ErrorCode.TIMEOUT, detail)) from error
    except BadMessageError as error:
        raise FatalError(error.error, message_id=error.message_id) from error
    if not isinstance(message, BatchHello):
        wrong_type = bad_message(f"the first message must be batch_hello, not {message.type}")
        raise FatalError(wrong_type, message_id=message.id)
    if not set(message.protocols) & set(SUPPORTED_SUBPROTOCOLS):
        raise FatalError(unsupported_protocol(message.protocols), message_id=message.id)
    ids = [member.session_id for member in message.sessions]
    if len(set(ids)) < len(ids):
        raise FatalError(bad_message("a session is named twice"), message_id=message.id)
    return message


def _check_member(
    member: BatchMember, row: SessionRow, worker: Worker, *, authorised: bool
) -> None:
    """Raises ServiceError: UNAUTHORIZED without a token that opens the session."""
    if not (authorised or opens_session(member.token, row) or _is_resuming(member, worker, row)):
        refused = unauthorized(f"no token for session {member.session_id!r}")
        refused.hint = "the answer to POST /v1/sessions has the session's token"
        raise refused


def _is_resuming(member: BatchMember, worker: Worker, row: SessionRow) -> bool:
    given = member.resume_token
    return given is not None and secrets_equal(given, worker.sessions.resume_token(row))


async def _found(worker: Worker, rows: list[SessionRow]) -> list[Session]:
    return [await worker.sessions.find(row.session_id) for row in rows]
