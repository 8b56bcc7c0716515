"""Async twin of :mod:`real2sim._scenarios`, method by method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import History, OperationResult, ScenarioInfo
from real2sim_proto.scenes import ObjectInfo

from . import _requests
from ._scenario_state import ObjectOperations, Objects, ScenarioState
from ._scenes import image_codec
from ._transport import AsyncTransport
from .images import Image


class AsyncScenarios:
    """``client.scenarios`` of the async client; see :class:`~real2sim._scenarios.Scenarios`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def create(self, *, scene: str, name: str = "") -> AsyncScenario:
        """A new scenario without edits on a scene."""
        info = await self._transport.send(_requests.create_scenario(scene, name))
        return await AsyncScenario(self._transport, info).refresh()

    async def get(self, scenario_id: str) -> AsyncScenario:
        """A handle of an existing scenario."""
        return AsyncScenario(
            self._transport, await self._transport.send(_requests.get_scenario(scenario_id))
        )

    async def list(self) -> Sequence[ScenarioInfo]:
        """All scenarios of the worker."""
        return (await self._transport.send(_requests.list_scenarios())).scenarios

    async def delete(self, scenario_id: str) -> None:
        """Remove a scenario and its history."""
        await self._transport.send(_requests.delete_scenario(scenario_id))


class AsyncScenario(ScenarioState):
    """One scenario as this client last saw it."""

    def __init__(self, transport: AsyncTransport, info: ScenarioInfo) -> None:
        super().__init__(info)
        self._transport = transport

    @property
    def objects(self) -> Objects[AsyncSceneObject]:
        """Handles by object id: ``await scenario.objects["car_3"].translate(y=3.2)``."""
        return Objects({o.object_id: AsyncSceneObject(self, o) for o in self.info.objects})

    async def apply(
        self, operations: Sequence[Operation | Mapping[str, Any]], *, dry_run: bool = False
    ) -> OperationResult:
        """Apply operations, all or none.

        Raises:
            StaleRevisionError: somebody else edited first.
            InvalidOperationError: an unknown object, or a result that is not allowed.
        """
        call = _requests.apply_operations(self.scenario_id, operations, self._etag, dry_run)
        return await self._settle(await self._transport.send(call))

    async def undo(self) -> OperationResult:
        """Take the newest edit back."""
        return await self._settle(
            await self._transport.send(_requests.undo(self.scenario_id, self._etag))
        )

    async def redo(self) -> OperationResult:
        """Make the edit again that was taken back last."""
        return await self._settle(
            await self._transport.send(_requests.redo(self.scenario_id, self._etag))
        )

    async def history(self, *, after: int | None = None) -> History:
        """Edits, undos and redos after a revision, oldest first; default: all."""
        return await self._transport.send(_requests.history(self.scenario_id, after))

    async def refresh(self) -> AsyncScenario:
        """See what the scenario is now; returns itself."""
        self._saw(await self._transport.send(_requests.get_scenario(self.scenario_id)))
        return self

    async def preview(
        self,
        *,
        camera: str,
        t_us: int | None = None,
        width: int | None = None,
        modality: str = "rgb",
        codec: str = "auto",
    ) -> Image:
        """What a recorded camera would see now; arguments as of :meth:`Scenes.render`."""
        codec = image_codec(self._transport.target, codec, modality)
        view = _requests.ViewRequest(camera, t_us, width, modality, codec)
        return await self._transport.send(_requests.preview(self.scenario_id, view))

    async def _settle(self, result: OperationResult) -> OperationResult:
        self._made(result)
        if not result.dry_run:
            await self.refresh()
        return result


class AsyncSceneObject(ObjectOperations):
    """An object of a scenario; each method is one edit. Metres, radians, wxyz."""

    def __init__(self, scenario: AsyncScenario, info: ObjectInfo) -> None:
        super().__init__(info)
        self._scenario = scenario

    async def translate(
        self, *, x: float = 0.0, y: float = 0.0, z: float = 0.0, frame: str = "world"
    ) -> OperationResult:
        """Shift the whole trajectory [m]; ``frame='object'`` counts along the object's axes."""
        return await self._scenario.apply([self._translate(x, y, z, frame)])

    async def rotate(
        self,
        *,
        angle: float,
        axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
        frame: str = "world",
    ) -> OperationResult:
        """Turn about the object's own centre [rad]."""
        return await self._scenario.apply([self._rotate(angle, axis, frame)])

    async def scale(
        self, *, x: float = 1.0, y: float = 1.0, z: float = 1.0, anchor: str = "bottom"
    ) -> OperationResult:
        """Multiply the size along the object's axes; ``anchor``: ``bottom`` or ``centre`` stays."""
        return await self._scenario.apply([self._scale(x, y, z, anchor)])

    async def set_pose(
        self,
        *,
        position: tuple[float, float, float],
        quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    ) -> OperationResult:
        """Place the object in the world [m], for the whole time range."""
        return await self._scenario.apply([self._set_pose(position, quaternion)])

    async def duplicate(
        self,
        *,
        new_id: str | None = None,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        frame: str = "world",
    ) -> AsyncSceneObject:
        """Add a copy, shifted [m], and return its handle."""
        options = {"new_id": new_id, "x": x, "y": y, "z": z, "frame": frame}
        result = await self._scenario.apply([self._duplicate(options)])
        return self._scenario.objects[result.created[0]]

    async def delete(self) -> OperationResult:
        """Remove the object; undo brings it back."""
        return await self._scenario.apply([self._delete()])
