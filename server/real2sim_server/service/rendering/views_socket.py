"""What a browser sees of a scenario: the latest question is answered, older ones are dropped."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from fastapi import WebSocket, WebSocketDisconnect
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError

from real2sim_proto.base import Identifier, Microseconds, Model
from real2sim_proto.episode import SensorSpec
from real2sim_proto.operations import Operation

from ...edit import EditError, instances_at, replay_operations
from ...render import Instance, RenderError
from ...scene import Scene, SceneError
from ..http.problems import ServiceError
from ..worker import Worker
from .engine import QueueFullError
from .renderer import RenderRequest

WATCH_S = 1.0
"""How often an idle view looks whether somebody else changed the scenario."""
PICK_WIDTH = 640

Share = Annotated[float, Field(ge=0, le=1)]


class Look(Model):
    """A question of the browser.

    Attributes:
        seq: comes back with the answer.
        T_world_camera: 16 values, row by row: a free camera with the intrinsics of ``camera``;
            None for the recorded place.
        operations: applied to this picture alone: the preview of an edit in the making.
        job: finished simulation to show instead of the scenario.
        pick: (across, down) in shares of the picture: ask for the object there instead.
    """

    seq: int = 0
    camera: Identifier
    t_us: Microseconds
    width: int = Field(default=640, ge=16, le=1920)
    T_world_camera: list[float] | None = Field(default=None, min_length=16, max_length=16)
    operations: list[Operation] = Field(default_factory=list, max_length=16)
    job: Identifier | None = None
    pick: tuple[Share, Share] | None = None


LOOK: TypeAdapter[Look] = TypeAdapter(Look)


class View:
    """One browser's view of one scenario.

    The reader keeps one picture and one pick that wait; a newer one takes the place of the older,
    so a slow drawing never leaves a queue behind it.
    """

    def __init__(self, socket: WebSocket, worker: Worker, scenario_id: str) -> None:
        self._socket = socket
        self._worker = worker
        self._scenario_id = scenario_id
        self._waiting: dict[str, Look] = {}
        self._asked = asyncio.Event()
        self._told = -1

    async def serve(self) -> None:
        """Answer until the browser leaves."""
        reader = asyncio.create_task(self._read())
        answerer = asyncio.create_task(self._answer())
        tasks = {reader, answerer}
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            # Not gather(): cancelled itself, it would pass on the cancellation of its tasks.
            await asyncio.wait(tasks)
        for task in tasks:
            error = None if task.cancelled() else task.exception()
            if error is not None and not isinstance(error, WebSocketDisconnect):
                raise error

    async def _read(self) -> None:
        while True:
            text = await self._socket.receive_text()
            try:
                look = LOOK.validate_json(text)
            except ValidationError as error:
                first = error.errors()[0]
                where = ".".join(str(part) for part in first["loc"])
                await self._tell("error", code="INVALID_REQUEST", detail=f"{where}: {first['msg']}")
                continue
            self._waiting["pick" if look.pick else "picture"] = look
            self._asked.set()

    async def _answer(self) -> None:
        while True:
            try:
                await asyncio.wait_for(self._asked.wait(), WATCH_S)
            except TimeoutError:
                await self._watch()
                continue
            self._asked.clear()
            for kind in ("pick", "picture"):
                look = self._waiting.pop(kind, None)
                if look is not None:
                    await self._answer_one(look)

    async def _answer_one(self, look: Look) -> None:
        try:
            await self._show(look)
        except ServiceError as error:
            detail = {"code": error.code, "detail": error.detail, "hint": error.hint}
            await self._tell("error", seq=look.seq, **detail)
        except (EditError, SceneError, RenderError, QueueFullError) as error:
            await self._tell("error", seq=look.seq, code="REFUSED", detail=str(error))

    async def _watch(self) -> None:
        view = await self._worker.scenarios.view(self._scenario_id)
        if self._told not in (-1, view.revision):
            await self._tell("changed", revision=view.revision)
        self._told = view.revision

    async def _show(self, look: Look) -> None:
        view = await self._worker.scenarios.view(self._scenario_id)
        if look.job is None:
            scene = await self._worker.residency.get(view.row.scene)

            def instances() -> Sequence[Instance]:
                state = (
                    replay_operations(view.state, look.operations)
                    if look.operations
                    else view.state
                )
                return instances_at(scene, state, look.t_us)
        else:
            film = await self._worker.simulations.film(look.job)
            scene = film.scene

            def instances() -> Sequence[Instance]:
                return film.instances(look.t_us)

        shot = await asyncio.to_thread(lambda: _shot(scene, instances(), look))
        pictured = await self._worker.pictures.take(shot, stream="view")
        frame = pictured.frames[0]
        if look.pick is not None:
            ids = np.frombuffer(frame.data, np.uint16).reshape(frame.shape[0], frame.shape[1])
            picked = instance_at(ids, look.pick)
            names = {o.instance_id: o.object_id for o in view.state.visible}
            await self._tell("picked", seq=look.seq, object_id=names.get(picked))
            return
        header: dict[str, Any] = {
            "type": "frame",
            "seq": look.seq,
            "revision": view.revision,
            "camera": look.camera,
            "t_us": look.t_us,
            "width": frame.shape[1],
            "height": frame.shape[0],
            "T_world_camera": np.asarray(frame.T_world_sensor).ravel().tolist(),
            "K": np.asarray(frame.K).ravel().tolist(),
            "timing_ms": {k: round(v, 2) for k, v in pictured.timing_ms.items()},
        }
        self._told = view.revision
        await self._socket.send_bytes(packed(header, bytes(frame.data)))

    async def _tell(self, kind: str, **values: Any) -> None:
        await self._socket.send_text(json.dumps({"type": kind, **values}))


def instance_at(ids: NDArray[np.uint16], place: tuple[float, float], *, reach: int = 3) -> int:
    """Id under a pointer; near the rim of an object the object, not the background.

    Args:
        ids: [H, W] instance image.
        place: (across, down) in shares of the picture.
        reach: how far beside the pointer an object may be [px].
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


def packed(header: dict[str, Any], data: bytes) -> bytes:
    """One binary message: length of the header (uint32, little endian), header as JSON, data."""
    head = json.dumps(header, separators=(",", ":")).encode()
    return struct.pack("<I", len(head)) + head + data


def _shot(scene: Scene, instances: Sequence[Instance], look: Look) -> RenderRequest:
    """Raises SceneError for a time or camera that the scene does not have."""
    vehicle = scene.ego.transform(look.t_us)
    if look.T_world_camera is not None:
        camera = next((c for c in scene.rig if c.name == look.camera), None)
        if camera is not None:
            T_world_camera = np.asarray(look.T_world_camera, np.float64).reshape(4, 4)
            vehicle = T_world_camera @ np.linalg.inv(camera.T_vehicle_camera)
    sensor = SensorSpec(
        camera=look.camera,
        modalities=["instance" if look.pick else "rgb"],
        width=PICK_WIDTH if look.pick else look.width,
        codec="raw" if look.pick else "jpeg",
    )
    return RenderRequest(scene, instances, vehicle, look.t_us, (sensor,))
