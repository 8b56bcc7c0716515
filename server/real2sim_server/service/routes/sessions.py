"""Sessions over REST: the same world as the drive socket, for scripts."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier
from real2sim_proto.episode import ResetSpec, SensorSpec
from real2sim_proto.jobs import DriveRequest, JobInfo
from real2sim_proto.sessions import (
    SessionClock,
    SessionCreate,
    SessionEdit,
    SessionEdited,
    SessionInfo,
    SessionList,
    SessionRender,
    SessionState,
    StepRequest,
)

from ...edit import EditOutcome
from ...world import Event, World
from ..drives import Seat
from ..http.auth import (
    SESSION_SCHEME,
    TokenRoute,
    act_for,
    bearer_token,
    check_token,
    require_token,
    unauthorized,
)
from ..http.requests import ClientName, IdempotencyKey, IdempotentRequest, base_url
from ..http.responses import ServiceError, choose_among, etag, info_response, large_response
from ..jobs import accepted_headers
from ..renderer import CODEC_OF, choose_media_type
from ..sessions.pipeline import StepPipeline
from ..sessions.recording import RECORDING, recording_of
from ..sessions.registry import check_not_closed, created_headers
from ..sessions.sensors import ranging_for_render
from ..sessions.session import (
    Session,
    opens_session,
    session_edited,
    session_info,
    session_state,
    shown_state,
)
from ..sessions.step import MakeReply
from ..storage.store import StoredReply
from ..worker import Worker, WorkerOf

_bearer = HTTPBearer(
    auto_error=False,
    scheme_name=SESSION_SCHEME,
    description=(
        "`Authorization: Bearer` with the token of one session: `token` in the answer "
        "of `POST /v1/sessions` or `.../fork`, which is sent only once. Calls of a "
        "session need it even if the worker has no tokens; a token of the worker works "
        "as well."
    ),
)


STATE_CHECK_S = 0.03
EXACTLY_ONE = "that the session runs on; give exactly one of `scene` and `scenario`"


class SessionRoute(TokenRoute):
    """A route of a session, accessible with its token or the worker's."""

    async def check(self, request: Request) -> None:
        """Raises ServiceError: UNAUTHORIZED, UNKNOWN_SESSION or SESSION_CLOSED."""
        session_id = request.path_params.get("session_id")
        if session_id is None:
            check_token(request)
        else:
            await _check_session_token(request, session_id)


async def _check_session_token(request: Request, session_id: str) -> None:
    worker: Worker = request.app.state.worker
    given, accounts = bearer_token(request), worker.accounts
    if accounts.needs_token and (account := accounts.of_token(given)) is not None:
        act_for(request, account)
        return
    row = None
    if given is not None or not accounts.needs_token:
        # Check the row only, to avoid rebuilding sessions for unauthorised requests.
        row = check_not_closed(await worker.sessions.row(session_id))
    if row is None or not opens_session(given, row):
        worker.metrics.auth_failures.labels("http").inc()
        error = unauthorized("this call wants the session's token or the worker's")
        error.hint = "send 'Authorization: Bearer <token>'; POST /v1/sessions gave the token"
        raise error
    act_for(request, accounts.of_owner(row.owner))


router = APIRouter(prefix="/v1/sessions", tags=["sessions"], route_class=SessionRoute)


async def _session_of(
    worker: WorkerOf,
    session_id: str,
    _credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
) -> Session:
    """The session; its route has checked the token.

    Raises:
        ServiceError: UNKNOWN_SESSION or SESSION_CLOSED.
    """
    session = await worker.sessions.find(session_id)
    session.touch()
    return session


SessionOf = Annotated[Session, Depends(_session_of)]


@router.post("", status_code=201, response_model=SessionInfo, dependencies=[Depends(require_token)])
async def create(  # noqa: PLR0917, one parameter for each part of the request
    worker: WorkerOf,
    request: Request,
    body: SessionCreate | None = None,
    scene: Annotated[Identifier | None, Query(description=EXACTLY_ONE)] = None,
    scenario: Annotated[Identifier | None, Query(description=EXACTLY_ONE)] = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Create a session on a scene or a scenario, exactly one of them; a body starts the first
    episode immediately. The response has the session's token, which its other calls and its drive
    socket require. The token is only returned here."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.sessions.create(
            scene=scene,
            scenario=scenario,
            spec=body.reset if body else None,
            idempotent=idempotent,
            ws_base=_ws_base(request),
        )
        return info_response(info, status=201, headers=created_headers(info))


@router.get("", dependencies=[Depends(require_token)])
async def list_sessions(worker: WorkerOf, request: Request) -> SessionList:
    """All open sessions, without their tokens."""
    ws_base = _ws_base(request)
    return SessionList(sessions=[session_info(s, ws_base=ws_base) for s in worker.sessions])


@router.get("/{session_id}")
async def describe(session: SessionOf, request: Request) -> SessionInfo:
    """One session."""
    return session_info(session, ws_base=_ws_base(request))


@router.delete("/{session_id}", status_code=204, response_class=Response)
async def delete(worker: WorkerOf, session: SessionOf) -> Response:
    """End a session; connections to it are closed."""
    await worker.sessions.close(session, reason="deleted")
    return Response(status_code=204)


@router.post("/{session_id}/reset", response_model=SessionState)
async def reset(
    worker: WorkerOf,
    session: SessionOf,
    request: Request,
    body: ResetSpec | None = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Start a new episode from the session's scene or scenario; refused while a controller is
    connected."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        async with session.lock:
            session.check_open()
            session.check_no_controller()
            reply = _state_reply(session, idempotent)
            await worker.sessions.stepper.restart(session, body or ResetSpec(), reply=reply)
            world = session.running_world()
    return await large_response(lambda: session_state(session.session_id, world, ()))


@router.post("/{session_id}/step", response_model=SessionState)
async def step(
    worker: WorkerOf,
    session: SessionOf,
    request: Request,
    body: StepRequest,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Advance the clock; stops at the end of the episode. Refused while a controller is
    connected."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        async with session.lock:
            session.check_open()
            session.check_no_controller()
            if body.dt_us not in {None, session.running_world().spec.dt_us}:
                raise ServiceError(
                    ErrorCode.INVALID_REQUEST,
                    f"dt_us {body.dt_us} is not that of the episode, {session.spec.dt_us}",
                    hint="leave dt_us out, or reset the session with another one",
                )
            reply = _state_reply(session, idempotent)
            await worker.sessions.stepper.step(session, body.n, body.plan, reply=reply)
            world, events = session.running_world(), session.take_events()
    return await large_response(lambda: session_state(session.session_id, world, events))


@router.post("/{session_id}/operations", response_model=SessionEdited)
async def edit(
    worker: WorkerOf,
    session: SessionOf,
    request: Request,
    body: SessionEdit,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Edit the running world before its next step: add road users (`spawn`), remove them (`delete`)
    or move objects. Also possible while a controller drives; its next observation has the event
    `edited`."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)

        def stored(world: World, outcome: EditOutcome) -> StoredReply | None:
            if idempotent.key is None:
                return None
            return idempotent.reply(session_edited(session.session_id, world, outcome), status=200)

        async with session.lock:
            session.check_open()
            outcome = await worker.sessions.stepper.edit(
                session, body.operations, base_rev=body.base_rev, reply=stored
            )
            made = session_edited(session.session_id, session.running_world(), outcome)
    return info_response(made)


@router.get("/{session_id}/state", response_model=SessionState)
async def state(
    session: SessionOf,
    after: Annotated[
        int | None, Query(ge=0, description="wait until the clock is past this step")
    ] = None,
    wait_s: Annotated[float, Query(ge=0, le=30, description="longest wait")] = 10.0,
) -> Response:
    """Current poses of all objects, and the newest plan; `after` waits for the next step. Also
    available while a controller is connected."""
    if after is not None:
        await _left(session, after, wait_s)
    return await large_response(lambda: shown_state(session))


async def _left(session: Session, step: int, seconds: float) -> None:
    """Wait until the clock has passed a step, the episode ends, or the timeout."""
    give_up = time.monotonic() + seconds
    while time.monotonic() < give_up:
        session.check_open()
        world = session.world
        if world is not None and (world.steps != step or world.over):
            return
        await asyncio.sleep(STATE_CHECK_S)


@router.put("/{session_id}/clock")
async def clock(
    worker: WorkerOf, session: SessionOf, request: Request, body: SessionClock
) -> SessionInfo:
    """Hold the clock of a connected controller, run it for some steps or freely, at a given pace or
    as fast as possible, or end the episode. The controller's actions wait while the clock is
    held."""
    match body.state:
        case "running":
            session.hold.release(pace=body.pace)
        case "held":
            session.hold.hold(after=body.steps or 0)
        case "ended":
            await worker.sessions.end_episode(session)
    return session_info(session, ws_base=_ws_base(request))


@router.post("/{session_id}/drive", status_code=202, response_model=JobInfo)
async def drive(  # noqa: PLR0917, one parameter for each part of the request
    worker: WorkerOf,
    session: SessionOf,
    request: Request,
    body: DriveRequest,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Let a planner drive the session, from a reset to the end, and store a recording.

    The response is a job. Once it has succeeded: `GET /v1/jobs/{id}/files/playback.json` (poses,
    scores, plans and events of every step), `recording.r2e`, and `GET /v1/jobs/{id}/preview`. The
    session stays open and can be forked from any of its steps.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        session.check_no_controller()
        token = bearer_token(request) or ""
        seat = Seat(session, url=_own_url(request), token=token)
        info = await worker.drives.start(seat, body, who=who, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))


@router.post("/{session_id}/fork", status_code=201, response_model=SessionInfo)
async def fork(
    worker: WorkerOf,
    session: SessionOf,
    request: Request,
    step: Annotated[
        int | None,
        Query(ge=0, description="step of the running episode; default: the current step"),
    ] = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Create a session that continues from the current or an earlier step of this one."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        async with session.lock:
            session.check_open()
            ws_base = _ws_base(request)
            info = await worker.sessions.fork(
                session, ws_base=ws_base, idempotent=idempotent, step=step
            )
        return info_response(info, status=201, headers=created_headers(info))


@router.get(
    "/{session_id}/recording",
    response_class=Response,
    responses={200: {"content": {RECORDING: {"schema": {"type": "string", "format": "binary"}}}}},
)
async def recording(
    worker: WorkerOf,
    session: SessionOf,
    frames: Annotated[bool, Query(description="also render and keep the images")] = False,
) -> Response:
    """The current episode as a file, for replay and scoring: `real2sim replay`."""
    made = await recording_of(worker.sessions, session, frames=frames)
    name = f"{session.session_id}.r2e"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(made, media_type=RECORDING, headers=headers)


@router.post(
    "/{session_id}/render",
    response_class=Response,
    responses={
        200: {
            "description": "application/msgpack with all frames and clouds; or one frame as a file",
            "content": {
                media_type: {"schema": {"type": "string", "format": "binary"}}
                for media_type in ("application/msgpack", "image/jpeg", "image/png")
            },
        }
    },
)
async def render(
    worker: WorkerOf,
    session: SessionOf,
    body: SessionRender,
    accept: Annotated[str | None, Header()] = None,
) -> Response:
    """Images, sweeps and scans of the current step; time does not advance."""
    pipeline, world = worker.sessions.pipeline, session.running_world()
    return await view_response(pipeline, world, body, accept)


def _state_reply(session: Session, idempotent: IdempotentRequest) -> MakeReply:
    """The reply to store under a request's key after the step."""

    def reply(world: World, events: Sequence[Event]) -> StoredReply | None:
        if idempotent.key is None:
            return None
        return idempotent.reply(session_state(session.session_id, world, events), status=200)

    return reply


def _own_url(request: Request) -> str:
    """Address of the worker for processes on this machine, independent of the request's route."""
    host, port = request.scope.get("server") or ("127.0.0.1", 8600)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def _ws_base(request: Request) -> str:
    return base_url(request).replace("http", "ws", 1)


MSGPACK = "application/msgpack"


async def view_response(
    pipeline: StepPipeline, world: World, asked: SessionRender, accept: str | None
) -> Response:
    """All frames and clouds as msgpack; a single image also as a file, if ``accept`` prefers
    that.

    In msgpack, each frame has the codec of its sensor.

    Raises:
        ServiceError: NOT_ACCEPTABLE, or as StepPipeline.view().
    """
    sensors: Sequence[SensorSpec] = asked.sensors
    ranging = await ranging_for_render(world, asked)
    single = not ranging and len(sensors) == 1 and len(sensors[0].modalities) == 1
    if single:
        media_type = choose_media_type(accept, sensors[0].modalities[0])
    else:
        media_type = choose_among([MSGPACK], accept, of="clouds, or more than one image")
    if media_type != MSGPACK:
        sensors = [sensors[0].model_copy(update={"codec": CODEC_OF[media_type]})]
    observation = await pipeline.view(world, sensors, ranging=ranging)
    timing = ", ".join(f"{stage};dur={ms:.2f}" for stage, ms in observation.timing_ms.items())
    headers = {
        "Server-Timing": timing,
        "Vary": "Accept",
        "Cache-Control": "no-store",
        "X-Real2Sim-Revision": etag(world.revision),
    }
    if media_type == MSGPACK:
        content = await pipeline.on_world_thread(observation.message.joined)
    else:
        content = bytes(observation.frames[0].data)
    return Response(content, media_type=media_type, headers=headers)
