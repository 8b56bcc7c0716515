"""One batch socket: a message steps the worlds of many sessions.

Each session stays what it is: same lock step, same log, same recordings, same calls of REST. What
is wrong with one is said in its place, and the others go on.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any, assert_never

from starlette.websockets import WebSocket, WebSocketDisconnect

from real2sim_proto import DRIVE_SUBPROTOCOL, ErrorCode
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES
from real2sim_proto.drive_batch import (
    BATCH_CLIENT_MESSAGE,
    MAX_WORLDS,
    BatchAction,
    BatchBye,
    BatchClientMessage,
    BatchHello,
    BatchReset,
)
from real2sim_proto.episode import ResetSpec

from ...world import Observation, metrics_version
from ..accounts import admit_message
from ..http.problems import ServiceError, service_error
from ..http.websocket import send_parts
from ..rendering.frames import EncodedFrame
from .batch_obs import pack_batch_obs, pack_errors
from .batch_plans import ReadPlan, check_for_batch, numbers_of, read_plans, steps_of
from .connection import NORMAL_CLOSURE, Connection
from .describe import result_fields
from .gathered_calls import MOST_TOGETHER
from .handshake import (
    CLOSE_TIMEOUT_S,
    FatalError,
    close_with_error,
    error_message,
    receive_as,
)
from .image_limits import MAX_IMAGE_BYTES, raw_image_bytes
from .messages import BadMessageError, bad_message, read_as
from .registry import Sessions
from .session import Session, controller_taken
from .step import DueAction
from .wire import EncodedMessage, PhaseTimer, pack_message

Frames = dict[int, Sequence[EncodedFrame]]
"""Images by number of the world, of those that have any."""

Errors = dict[int, tuple[ServiceError, int | None]]
"""What went wrong by number of the world, and the step that it is at."""

read_batch_message = partial(read_as, BATCH_CLIENT_MESSAGE)


class BatchConnection:
    """An accepted batch socket, whose client may control all of its sessions.

    Args:
        socket: whose hello was right.
        members: the sessions, by number of the world.
        resuming: which of them are taken over from another connection that has them.
        sessions: their registry.
    """

    def __init__(
        self,
        socket: WebSocket,
        members: Sequence[Session],
        sessions: Sessions,
        *,
        resuming: Sequence[bool],
    ) -> None:
        self._socket = socket
        self._members = members
        self._resuming = resuming
        self._sessions = sessions
        self._sending = asyncio.Lock()

    async def serve(self, hello: BatchHello) -> None:
        """Serve until one of both leaves. A client that vanishes is no error."""
        try:
            async with self._as_controller(hello):
                await self._send(pack_message("batch_welcome", self._welcome()), hello.id)
                await self._serve_messages()
        except WebSocketDisconnect:
            pass
        except FatalError as error:
            await self.end(error.error, message_id=error.message_id)

    async def end(self, error: ServiceError, *, message_id: int = 0) -> None:
        """Tell the client why, and leave it; one that does not read is left alone."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT_S), self._sending:
                await close_with_error(self._socket, error, message_id=message_id)

    # --- welcome ------------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def _as_controller(self, hello: BatchHello) -> AsyncIterator[None]:
        """Control of all sessions, or of none."""
        for session, resuming in zip(self._members, self._resuming, strict=True):
            if session.controller is not None and not resuming:
                raise FatalError(controller_taken(session.session_id), message_id=hello.id)
        try:
            for session in self._members:
                old, session.controller = session.controller, self
                session.close_callbacks.add(self._session_closed)
                if isinstance(old, Connection):
                    await old.yield_control()
            yield
        finally:
            for session in self._members:
                if session.controller is self:
                    session.controller = None
                session.close_callbacks.discard(self._session_closed)
                session.touch()

    async def _session_closed(self, error: ServiceError) -> None:
        """A session has ended from elsewhere: the next message about its world says so."""

    def _welcome(self) -> dict[str, Any]:
        return {
            "protocol": DRIVE_SUBPROTOCOL,
            "versions": {"server": version("real2sim"), "metrics": metrics_version()},
            "limits": {
                "max_image_bytes": MAX_IMAGE_BYTES,
                "max_message_bytes": MAX_CLIENT_MESSAGE_BYTES,
                "max_sessions_per_socket": MAX_WORLDS,
            },
            "worlds": [_world_info(session) for session in self._members],
        }

    # --- messages -----------------------------------------------------------------------------

    async def _serve_messages(self) -> None:
        """Answer every message with one message, in order, until bye."""
        while True:
            try:
                message = await receive_as(read_batch_message, self._socket)
            except BadMessageError as error:
                if error.fatal:
                    raise FatalError(error.error, message_id=error.message_id) from error
                await self._send(error_message(error.error), error.message_id)
                continue
            await self._send(await self._answer(message), message.id)
            if isinstance(message, BatchBye):
                await self._socket.close(NORMAL_CLOSURE)
                return

    async def _answer(self, message: BatchClientMessage) -> EncodedMessage:
        try:
            admit_message()
            match message:
                case BatchAction():
                    return await self._act(message)
                case BatchReset():
                    return await self._reset(message)
                case BatchBye():
                    return await self._finish()
                case BatchHello():
                    raise bad_message("batch_hello has been said already")
                case _:
                    assert_never(message)
        except Exception as error:
            return error_message(service_error(error, log_unexpected=True))

    async def _act(self, message: BatchAction) -> EncodedMessage:
        """One step of each world that is ready for it."""
        arrived, timer = time.perf_counter(), PhaseTimer()
        steps = steps_of(message)
        numbers = numbers_of(message.worlds, len(steps), len(self._members))
        plans = await read_plans(message.plans)
        async with self._held(numbers):
            due: dict[int, DueAction] = {}
            again: list[int] = []
            errors: Errors = {}
            for number, step, given in zip(numbers, steps, plans, strict=True):
                try:
                    action = self._due(number, step, given)
                except Exception as error:
                    errors[number] = self._error(number, error)
                    continue
                if action is None:
                    again.append(number)
                else:
                    due[number] = action
            self._check_image_bytes({n: self._members[n].spec for n in (*due, *again)})
            timer.stage("check")
            blind = {n: action for n, action in due.items() if not action.session.cameras}
            seen = await self._taken(blind, errors)
            timer.stage("world")
            frames = await self._drawn({n: due[n] for n in due if n not in blind}, errors)
            frames |= await self._drawn_again(again, errors)
            shown = dict.fromkeys((*frames, *again))
            seen |= await self._present([n for n in shown if n not in errors])
            timer.stage("render")
        seconds = time.perf_counter() - arrived
        for _ in due.keys() - errors.keys():
            self._sessions.metrics.steps.observe(seconds)
        return await self._packed(numbers, (seen, frames), errors, timer)

    def _due(self, number: int, step: int, given: ReadPlan | ServiceError) -> DueAction | None:
        """The action of a world; None where it was taken already, and is asked for again.

        Raises:
            ServiceError: the session is over, or not this client's, or the action out of step.
        """
        session = self._controlled(number)
        check_for_batch(session.spec)
        if isinstance(given, ServiceError):
            raise given
        if session.lockstep.cached_answer(step, given.payload) is not None:
            return None
        return DueAction(session, given.plan, given.payload)

    async def _taken(self, due: Mapping[int, DueAction], errors: Errors) -> dict[int, Observation]:
        """Take due actions, a few at once; other sessions get their turn between."""
        seen: dict[int, Observation] = {}
        numbers = list(due)
        for first in range(0, len(numbers), MOST_TOGETHER):
            piece = numbers[first : first + MOST_TOGETHER]
            try:
                outcomes = await self._sessions.stepper.act_together([due[n] for n in piece])
            except Exception as error:
                outcomes = [error] * len(piece)
            for number, outcome in zip(piece, outcomes, strict=True):
                if isinstance(outcome, Exception):
                    errors[number] = self._error(number, outcome)
                else:
                    seen[number] = outcome.observation
        return seen

    async def _drawn(self, due: Mapping[int, DueAction], errors: Errors) -> Frames:
        """Take due actions of worlds with sensors, all drawn in one go; their images."""
        outcomes = await self._sessions.stepper.act_seeing(list(due.values())) if due else []
        frames: Frames = {}
        for number, outcome in zip(due, outcomes, strict=True):
            if isinstance(outcome, Exception):
                errors[number] = self._error(number, outcome)
            else:
                frames[number] = outcome.frames
        return frames

    async def _drawn_again(self, numbers: Sequence[int], errors: Errors) -> Frames:
        """Images of worlds that have moved already, once more."""
        frames: Frames = {}
        for number in numbers:
            world = self._members[number].running_world()
            if sensors := world.due_sensors():
                try:
                    frames[number] = (await self._sessions.pipeline.view(world, sensors)).frames
                except Exception as error:
                    errors[number] = self._error(number, error)
        return frames

    async def _reset(self, message: BatchReset) -> EncodedMessage:
        timer = PhaseTimer()
        numbers = numbers_of(message.worlds, None, len(self._members))
        check_for_batch(message.spec)
        specs = [message.spec] * len(numbers)
        for name, values in (("seed", message.seeds), ("start_us", message.start_us)):
            if values is not None:
                if len(values) != len(numbers):
                    raise bad_message(f"{len(values)} of {name} for {len(numbers)} worlds")
                specs = [s.model_copy(update={name: v}) for s, v in zip(specs, values, strict=True)]
        self._check_image_bytes(dict(zip(numbers, specs, strict=True)))
        stepper = self._sessions.stepper
        async with self._held(numbers):
            begun, errors = await self._each(
                numbers,
                [partial(stepper.reset_seen, spec=spec) for spec in specs],
            )
            seen = await self._present(list(begun))
        frames = {number: observation.frames for number, observation in begun.items()}
        timer.stage("world")
        return await self._packed(numbers, (seen, frames), errors, timer)

    async def _finish(self) -> EncodedMessage:
        """The results; every session ends."""
        numbers = list(range(len(self._members)))
        results, errors = await self._each(numbers, [self._ended] * len(numbers))
        fields = [{"world": n, "type": "result", **result} for n, result in results.items()]
        return pack_message("batch_result", {"results": fields, "errors": pack_errors(errors)})

    async def _ended(self, session: Session) -> dict[str, Any]:
        scores = await self._sessions.scores(session)
        await self._sessions.close(session, reason="its controller said bye")
        return result_fields(session.world, scores)

    # --- worlds -------------------------------------------------------------------------------

    def _controlled(self, number: int) -> Session:
        """The session of a world. Raises ServiceError where this client may not drive it."""
        session = self._members[number]
        session.check_open()
        if session.controller is not self:
            raise controller_taken(session.session_id)
        session.touch()
        return session

    async def _each(
        self, numbers: Sequence[int], calls: Sequence[Callable[[Session], Awaitable[Any]]]
    ) -> tuple[dict[int, Any], Errors]:
        """A call for each session: results, and what failed."""

        async def called(number: int, call: Callable[[Session], Awaitable[Any]]) -> Any:
            return await call(self._controlled(number))

        outcomes = await asyncio.gather(
            *(called(n, call) for n, call in zip(numbers, calls, strict=True)),
            return_exceptions=True,
        )
        results: dict[int, Any] = {}
        errors: Errors = {}
        for number, outcome in zip(numbers, outcomes, strict=True):
            if isinstance(outcome, Exception):
                errors[number] = self._error(number, outcome)
            elif isinstance(outcome, BaseException):
                raise outcome
            else:
                results[number] = outcome
        return results, errors

    async def _present(self, numbers: Sequence[int]) -> dict[int, Observation]:
        """What is seen of worlds as they are."""
        if not numbers:
            return {}
        worlds = [self._members[number].running_world() for number in numbers]
        found = await self._sessions.pipeline.on_world_thread(
            lambda: [world.observe() for world in worlds]
        )
        return dict(zip(numbers, found, strict=True))

    async def _packed(
        self,
        numbers: Sequence[int],
        shown: tuple[Mapping[int, Observation], Frames],
        errors: Errors,
        timer: PhaseTimer,
    ) -> EncodedMessage:
        seen, images = shown
        ordered = {number: seen[number] for number in numbers if number in seen}
        frames = {number: images[number] for number in ordered if images.get(number)}
        pack = partial(pack_batch_obs, ordered, errors, timer.timing_ms, frames=frames)
        return await self._sessions.pipeline.on_world_thread(pack)

    def _check_image_bytes(self, specs: Mapping[int, ResetSpec]) -> None:
        """Raises ServiceError: INVALID_REQUEST for raw images that no one message holds."""
        size = 0
        for number, spec in specs.items():
            if spec.sensors:
                rig = self._members[number].start.scene.rig
                known = [sensor for sensor in spec.sensors if sensor.camera in rig.names]
                cameras = [rig[s.camera].resized(s.width or rig[s.camera].width) for s in known]
                size += raw_image_bytes(known, cameras)
        if size > MAX_IMAGE_BYTES:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"{size} bytes of raw images in one message; readers allow {MAX_IMAGE_BYTES}",
                hint="name fewer worlds in a message, or ask for smaller images or codec 'jpeg'",
            )

    def _error(self, number: int, error: Exception) -> tuple[ServiceError, int | None]:
        step = self._members[number].lockstep.step
        return service_error(error, log_unexpected=True), step

    @contextlib.asynccontextmanager
    async def _held(self, numbers: Sequence[int]) -> AsyncIterator[None]:
        """The locks of sessions, always taken in the same order."""
        locks = [self._members[number].lock for number in sorted(numbers)]
        held: list[asyncio.Lock] = []
        try:
            for lock in locks:
                await lock.acquire()
                held.append(lock)
            yield
        finally:
            for lock in held:
                lock.release()

    async def _send(self, message: EncodedMessage, message_id: int = 0) -> None:
        async with self._sending:
            await send_parts(self._socket, message.parts(message_id))


def _world_info(session: Session) -> dict[str, Any]:
    start, world = session.start, session.world
    return {
        "session_id": session.session_id,
        "scene": session.row.scene,
        "step": world.steps if world else None,
        "revision": world.revision if world else 0,
        "resume_token": session.resume_token,
        "ego_size": list(start.scene.ego_size),
        "start_us": start.scene.start_us,
        "end_us": start.scene.end_us,
    }
