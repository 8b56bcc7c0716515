"""The drive socket and the view socket. Failed handshakes are answered over HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import structlog
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError
from structlog.contextvars import bound_contextvars

from real2sim_proto import SUPPORTED_SUBPROTOCOLS, ErrorCode
from real2sim_proto.base import Identifier, Microseconds, Model, invalid_reason
from real2sim_proto.episode import SensorSpec
from real2sim_proto.operations import Operation

from ...edit import EditError, instances_at, replay_operations
from ...geometry import Float
from ...render import Instance, RenderError
from ...render.frame import UNCERTAINTY, uncertainty_picture
from ...render.images import encode_rgb
from ...scene import Scene, SceneError
from ..accounts import Account, RevokedError, admit_message, owner_name
from ..engine import QueueFullError
from ..frames import EncodedFrame
from ..http.auth import act_for, bearer_token, unauthorized
from ..http.connections import close_quietly, receive_text
from ..http.requests import base_url
from ..http.responses import REQUEST_ID_KEY, ServiceError, problem_response, service_error
from ..renderer import RenderRequest
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

# --- Drive ----------------------------------------------------------------------------------------

router = APIRouter(prefix="/v1/sessions", tags=["sessions"])

log = structlog.get_logger(__name__)


@router.websocket("/{session_id}/drive")
async def drive(socket: WebSocket, worker: WorkerOf, session_id: str) -> None:
    """Drive a session in lockstep, or observe it; see the drive socket's documentation."""
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
            await _serve_drive(socket, worker, row, account)
        except WebSocketDisconnect:
            log.info("drive socket left before its welcome")
        except FatalError as error:
            if error.error.code is ErrorCode.UNAUTHORIZED:
                worker.metrics.auth_failures.labels("drive").inc()
            log.info("drive socket refused", code=error.error.code.value)
            await close_with_error(socket, error.error, message_id=error.message_id)


async def _serve_drive(
    socket: WebSocket, worker: Worker, row: SessionRow, account: Account | None
) -> None:
    """Process hello, open the session, then process its messages."""
    hello = await receive_hello(
        socket,
        row,
        authorised=account is not None,
        opens_worker=lambda token: account_of_token(worker, token) is not None,
        resume_token=worker.sessions.resume_token(row),
    )
    try:
        # A client with only the session's token drives on behalf of its owner.
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
    connection = Connection(socket, session, worker.sessions, ws_base=base_url(socket))
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
    """The common subprotocol. Raises ServiceError: UNSUPPORTED_PROTOCOL."""
    offered = list(socket.scope.get("subprotocols", []))
    for protocol in SUPPORTED_SUBPROTOCOLS:
        if protocol in offered:
            return protocol
    raise unsupported_protocol(offered)


def account_of_handshake(socket: WebSocket, worker: Worker) -> Account | None:
    """The account of the worker's token in the handshake; hello may send the token instead.

    Raises:
        ServiceError: UNAUTHORIZED for a wrong token.
    """
    given = bearer_token(socket)
    if given is None or not worker.accounts.needs_token:
        return None
    account = worker.accounts.of_token(given)
    if account is None:
        worker.metrics.auth_failures.labels("drive").inc()
        raise unauthorized("the bearer token is not this worker's")
    return account


def account_of_token(worker: Worker, token: str | None) -> Account | None:
    """The account of a worker's token; None for other tokens."""
    return worker.accounts.of_token(token) if worker.accounts.needs_token else None


@contextlib.contextmanager
def ended_when_revoked(connection: Connection, account: Account) -> Iterator[None]:
    """End the connection when the token of its account is removed."""
    revoked = partial(_end, connection, account)
    account.on_revoked.add(revoked)
    try:
        yield
    finally:
        account.on_revoked.discard(revoked)


def _end(connection: Connection, account: Account) -> None:
    """Disconnect a client whose token was removed, without waiting for a slow reader."""
    ending = asyncio.ensure_future(connection.end(service_error(RevokedError(account.name))))
    _ending.add(ending)
    ending.add_done_callback(_ending.discard)


_ending: set[asyncio.Future[None]] = set()


# --- View -----------------------------------------------------------------------------------------

# Browsers cannot send headers, so the first message carries the token. Only the latest request is
# answered; older ones are dropped.

REVISION_CHECK_S = 1.0
"""Interval at which an idle view checks its scenario's revision [s]."""
PICK_WIDTH = 640

Fraction = Annotated[float, Field(ge=0, le=1)]


class ViewRequest(Model):
    """A request of the browser.

    Attributes:
        seq: returned with the answer.
        T_world_camera: 16 values, row-major: a free camera with the intrinsics of ``camera``;
            None for the recorded pose.
        operations: applied to this picture only, to preview an unfinished edit.
        job: finished simulation to show instead of the scenario.
        shows: modality of the picture; ``uncertainty`` is coloured, see uncertainty_picture.
        pick: (across, down) in fractions of the picture: query the object there instead.
    """

    seq: int = 0
    camera: Identifier
    t_us: Microseconds
    width: int = Field(default=640, ge=16, le=1920)
    T_world_camera: list[float] | None = Field(default=None, min_length=16, max_length=16)
    operations: list[Operation] = Field(default_factory=list, max_length=16)
    job: Identifier | None = None
    shows: Literal["rgb", "uncertainty"] = "rgb"
    pick: tuple[Fraction, Fraction] | None = None


VIEW_REQUEST: TypeAdapter[ViewRequest] = TypeAdapter(ViewRequest)


class ViewConnection:
    """One browser's view of one scenario.

    The reader buffers one picture and one pick request; a newer one replaces the older, so slow
    rendering never builds up a queue.
    """

    def __init__(self, socket: WebSocket, worker: Worker, scenario_id: str) -> None:
        self._socket = socket
        self._worker = worker
        self._scenario_id = scenario_id
        self._pending: dict[str, ViewRequest] = {}
        self._request_received = asyncio.Event()
        self._sent_revision = -1
        self._revoked = asyncio.Event()

    def end(self) -> None:
        """Disconnect the browser after its token was removed."""
        self._revoked.set()

    async def serve(self) -> None:
        """Answer until the browser leaves. Raises RevokedError if its token is removed."""
        reader = asyncio.create_task(self._read())
        answerer = asyncio.create_task(self._answer_requests())
        tasks = {reader, answerer, asyncio.create_task(self._until_revoked())}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            # Not gather(): if it is cancelled, it cancels its tasks.
            await asyncio.wait(tasks)
        for task in tasks:
            error = None if task.cancelled() else task.exception()
            if error is not None and not isinstance(error, WebSocketDisconnect):
                raise error

    async def _until_revoked(self) -> None:
        await self._revoked.wait()
        raise RevokedError(owner_name())

    async def _read(self) -> None:
        while True:
            try:
                request = VIEW_REQUEST.validate_json(await receive_text(self._socket))
            except ServiceError as error:
                await self._send_event("error", code=error.code, detail=error.detail)
                continue
            except ValidationError as error:
                first = error.errors()[0]
                where = ".".join(str(part) for part in first["loc"])
                await self._send_event(
                    "error", code="INVALID_REQUEST", detail=f"{where}: {invalid_reason(first)}"
                )
                continue
            self._pending["pick" if request.pick else "picture"] = request
            self._request_received.set()

    async def _answer_requests(self) -> None:
        while True:
            try:
                await asyncio.wait_for(self._request_received.wait(), REVISION_CHECK_S)
            except TimeoutError:
                await self._check_revision()
                continue
            self._request_received.clear()
            for kind in ("pick", "picture"):
                request = self._pending.pop(kind, None)
                if request is not None:
                    await self._answer_one(request)

    async def _answer_one(self, request: ViewRequest) -> None:
        try:
            admit_message()
            await self._answer_view(request)
        except WebSocketDisconnect:
            raise
        except (EditError, SceneError, RenderError, QueueFullError) as error:
            await self._send_event("error", seq=request.seq, code="REFUSED", detail=str(error))
        except Exception as error:
            failure = service_error(error, log_unexpected=True)
            detail = {"code": failure.code, "detail": failure.detail, "hint": failure.hint}
            await self._send_event("error", seq=request.seq, **detail)

    async def _check_revision(self) -> None:
        view = await self._worker.scenarios.view(self._scenario_id)
        if self._sent_revision not in (-1, view.revision):
            await self._send_event("changed", revision=view.revision)
        self._sent_revision = view.revision

    async def _answer_view(self, request: ViewRequest) -> None:
        view = await self._worker.scenarios.view(self._scenario_id)
        if request.job is None:
            scene = await self._worker.scene_cache.get(view.row.scene)
            vehicle_at = scene.ego.transform

            def instances() -> Sequence[Instance]:
                state = (
                    replay_operations(view.state, request.operations)
                    if request.operations
                    else view.state
                )
                return instances_at(scene, state, request.t_us)
        else:
            video_source = await self._worker.video_source(request.job)
            scene = video_source.scene
            vehicle_at = video_source.T_world_vehicle

            def instances() -> Sequence[Instance]:
                show = video_source.instances
                if request.T_world_camera is not None:
                    show = video_source.outside or show
                return show(request.t_us)

        render_request = await asyncio.to_thread(
            lambda: _render_request(scene, instances(), request, vehicle_at)
        )
        rendered = await self._worker.renderer.render(render_request, stream="view")
        frame = rendered.frames[0]
        if request.pick is not None:
            ids = np.frombuffer(frame.data, np.uint16).reshape(frame.shape[0], frame.shape[1])
            picked = instance_at(ids, request.pick)
            names = {o.instance_id: o.object_id for o in view.state.visible}
            await self._send_event("picked", seq=request.seq, object_id=names.get(picked))
            return
        header: dict[str, Any] = {
            "type": "frame",
            "seq": request.seq,
            "revision": view.revision,
            "camera": request.camera,
            "t_us": request.t_us,
            "width": frame.shape[1],
            "height": frame.shape[0],
            "T_world_camera": np.asarray(frame.header.fields["T_world_sensor"]).ravel().tolist(),
            "K": np.asarray(frame.header.fields["K"]).ravel().tolist(),
            "timing_ms": {k: round(v, 2) for k, v in rendered.timing_ms.items()},
        }
        self._sent_revision = view.revision
        data = bytes(frame.data)
        if request.shows == UNCERTAINTY:
            data = await asyncio.to_thread(_in_colours, frame)
        await self._socket.send_bytes(pack_frame_message(header, data))

    async def _send_event(self, kind: str, **values: Any) -> None:
        await self._socket.send_text(json.dumps({"type": kind, **values}))


def instance_at(ids: NDArray[np.uint16], place: tuple[float, float], *, reach: int = 3) -> int:
    """Id of the object under a pointer; near an edge, the object takes precedence.

    Args:
        ids: [H, W] instance image.
        place: (across, down) in fractions of the picture.
        reach: maximum distance of an object from the pointer [px].
    """
    height, width = ids.shape
    column = min(int(place[0] * width), width - 1)
    row = min(int(place[1] * height), height - 1)
    if ids[row, column]:
        return int(ids[row, column])
    top, left = max(row - reach, 0), max(column - reach, 0)
    near = ids[top : row + reach + 1, left : column + reach + 1]
    rows, columns = np.nonzero(near)
    if not len(rows):
        return 0
    nearest = np.argmin((rows + top - row) ** 2 + (columns + left - column) ** 2)
    return int(near[rows[nearest], columns[nearest]])


def _in_colours(frame: EncodedFrame) -> bytes:
    """The jpeg of a raw uncertainty image."""
    pixels = np.frombuffer(frame.data, "<f4").reshape(frame.shape)
    return encode_rgb(uncertainty_picture(pixels), "jpeg")


def pack_frame_message(header: dict[str, Any], data: bytes) -> bytes:
    """One binary message: length of the header (uint32, little endian), header as JSON, data."""
    head = json.dumps(header, separators=(",", ":")).encode()
    return struct.pack("<I", len(head)) + head + data


def _render_request(
    scene: Scene,
    instances: Sequence[Instance],
    request: ViewRequest,
    vehicle_at: Callable[[int], Float],
) -> RenderRequest:
    """Raises SceneError for a time or camera that the scene does not have."""
    vehicle = vehicle_at(request.t_us)
    if request.T_world_camera is not None:
        camera = next((c for c in scene.rig if c.name == request.camera), None)
        if camera is not None:
            T_world_camera = np.asarray(request.T_world_camera, np.float64).reshape(4, 4)
            vehicle = T_world_camera @ np.linalg.inv(camera.T_vehicle_camera)
    shows = "instance" if request.pick else request.shows
    sensor = SensorSpec(
        camera=request.camera,
        modalities=[shows],
        width=PICK_WIDTH if request.pick else request.width,
        codec="jpeg" if shows == "rgb" else "raw",
    )
    return RenderRequest(scene, instances, vehicle, request.t_us, (sensor,))


HANDSHAKE_TIMEOUT_S = 10.0
CLOSED_BAD_MESSAGE, CLOSED_UNAUTHORIZED, CLOSED_NOT_FOUND = 4400, 4401, 4404
CLOSED_TIMEOUT, CLOSED_OVER_LIMIT, CLOSED_FAILED = 4408, 4429, 4500
"""Close codes of the socket."""
CLOSED_BY = {
    ErrorCode.UNKNOWN_SCENARIO: CLOSED_NOT_FOUND,
    ErrorCode.UNAUTHORIZED: CLOSED_UNAUTHORIZED,
    ErrorCode.TOO_MANY_REQUESTS: CLOSED_OVER_LIMIT,
}

# Not json.loads(): it overflows its stack on deep nesting and accepts lone surrogates.
_HELLO: TypeAdapter[dict[str, object]] = TypeAdapter(dict[str, object])


view_router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"])


class NoHelloError(Exception):
    """An invalid first message.

    Args:
        code: close code of the socket.
        reason: sent with it.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code


@view_router.websocket("/{scenario_id}/view")
async def view(socket: WebSocket, worker: WorkerOf, scenario_id: str) -> None:
    """Frames and picks of a scenario for one browser; newer requests replace older ones."""
    await socket.accept()
    try:
        with worker.metrics.open_socket("view"):
            account = await _check_hello(socket, worker)
            await worker.scenarios.view(scenario_id)
            await socket.send_text(json.dumps({"type": "welcome"}))
            await _serve_view(socket, worker, scenario_id, account)
    except NoHelloError as error:
        log.info("view socket refused", code=error.code, reason=str(error))
        await close_quietly(socket, error.code, str(error))
    except WebSocketDisconnect:
        return
    except Exception as error:
        failure = service_error(error, log_unexpected=True)
        code = CLOSED_BY.get(failure.code, CLOSED_FAILED)
        await close_quietly(socket, code, failure.detail)


async def _serve_view(
    socket: WebSocket, worker: Worker, scenario_id: str, account: Account
) -> None:
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
    """Read `{"type": "hello", "token": ...}`; returns the token's account.

    Raises:
        NoHelloError: the token is wrong.
        OverLimitError: the account's request limit is reached.
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
