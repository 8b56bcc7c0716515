"""Opens the view socket: browsers cannot send headers, so the first message has the token."""

from __future__ import annotations

import asyncio
import json
import time

import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import TypeAdapter, ValidationError

from real2sim_proto import ErrorCode

from ..accounts import Account
from ..http.auth import act_for
from ..http.connections import close_quietly, receive_text
from ..http.problems import ServiceError, service_error
from ..worker import Worker, WorkerOf
from .view_connection import ViewConnection

HANDSHAKE_TIMEOUT_S = 10.0
CLOSED_BAD_MESSAGE, CLOSED_UNAUTHORIZED, CLOSED_NOT_FOUND = 4400, 4401, 4404
CLOSED_TIMEOUT, CLOSED_OVER_LIMIT, CLOSED_FAILED = 4408, 4429, 4500
"""Codes with which the socket is closed."""
CLOSED_BY = {
    ErrorCode.UNKNOWN_SCENARIO: CLOSED_NOT_FOUND,
    ErrorCode.UNAUTHORIZED: CLOSED_UNAUTHORIZED,
    ErrorCode.TOO_MANY_REQUESTS: CLOSED_OVER_LIMIT,
}

# Not json.loads(): it follows nesting until the stack ends, and lets lone surrogates pass.
_HELLO: TypeAdapter[dict[str, object]] = TypeAdapter(dict[str, object])

log = structlog.get_logger(__name__)

router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"])


class NoHelloError(Exception):
    """A first message that lets nobody in.

    Args:
        code: with which the socket is closed.
        reason: sent with it.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


@router.websocket("/{scenario_id}/view")
async def view(socket: WebSocket, worker: WorkerOf, scenario_id: str) -> None:
    """Frames and picks of a scenario for one browser; the latest question wins."""
    await socket.accept()
    try:
        with worker.metrics.open_socket("view"):
            account = await _check_hello(socket, worker)
            await worker.scenarios.view(scenario_id)
            await socket.send_text(json.dumps({"type": "welcome"}))
            await _serve(socket, worker, scenario_id, account)
    except NoHelloError as error:
        log.info("view socket refused", code=error.code, reason=str(error))
        await close_quietly(socket, error.code, str(error))
    except WebSocketDisconnect:
        return
    except Exception as error:
        failure = service_error(error, log_unexpected=True)
        code = CLOSED_BY.get(failure.code, CLOSED_FAILED)
        await close_quietly(socket, code, failure.detail)


async def _serve(socket: WebSocket, worker: Worker, scenario_id: str, account: Account) -> None:
    started = time.perf_counter()
    log.info("view socket opened", scenario_id=scenario_id)
    connection = ViewConnection(socket, worker, scenario_id)
    account.on_revoked.add(connection.end)
    try:
        await connection.serve()
    finally:
        account.on_revoked.discard(connection.end)
        seconds = round(time.perf_counter() - started, 1)
        log.info("view socket closed", scenario_id=scenario_id, seconds=seconds)


async def _check_hello(socket: WebSocket, worker: Worker) -> Account:
    """Read `{"type": "hello", "token": ...}`; whose token it is.

    Raises:
        NoHelloError: the token is not right.
        OverLimitError: its holder has had their requests.
    """
    try:
        async with asyncio.timeout(HANDSHAKE_TIMEOUT_S):
            hello = _HELLO.validate_json(await receive_text(socket))
    except TimeoutError as error:
        reason = f"no hello within {HANDSHAKE_TIMEOUT_S:g} s"
        raise NoHelloError(CLOSED_TIMEOUT, reason) from error
    except (ValidationError, ServiceError) as error:
        raise NoHelloError(CLOSED_BAD_MESSAGE, "the first message must be a hello") from error
    given = hello.get("token")
    account = worker.accounts.of_token(given if isinstance(given, str) else None)
    if account is None:
        worker.metrics.auth_failures.labels("view").inc()
        raise NoHelloError(CLOSED_UNAUTHORIZED, "the token is not this worker's")
    act_for(socket, account)
    return account
