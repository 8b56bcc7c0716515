"""Scenarios: a scene and the edits made to it.

A handle sends the revision it knows with every edit. When somebody else has edited in between,
the edit is refused with :class:`~real2sim.errors.StaleRevisionError`, which names what was
missed; ``refresh()`` and decide again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import History, OperationResult, ScenarioInfo
from real2sim_proto.scenes import ObjectInfo

from . import _requests
from ._scenario_state import ObjectOperations, Objects, ScenarioState
from ._scenes import image_codec
from ._transport import Transport
from .images import Image


class Scenarios:
    """``client.scenarios``."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def create(self, *, scene: str, name: str = "") -> Scenario:
        """A new scenario without edits on a scene."""
        info = self._transport.send(_requests.create_scenario(scene, name))
        # The answer to a creation leaves trajectories out; a handle always has them.
        return Scenario(self._transport, info).refresh()

    def get(self, scenario_id: str) -> Scenario:
        """A handle of an existing scenario."""
        return Scenario(self._transport, self._transport.send(_requests.get_scenario(scenario_id)))

    def list(self) -> Sequence[ScenarioInfo]:
        """All scenarios of the worker."""
        return self._transport.send(_requests.list_scenarios()).scenarios

    def delete(self, scenario_id: str) -> None:
        """Remove a scenario and its history."""
        self._transport.send(_requests.delete_scenario(scenario_id))


class Scenario(ScenarioState):
    """One scenario as this client last saw it."""

    def __init__(self, transport: Transport, info: ScenarioInfo) -> None:
        super().__init__(info)
        self._transport = transport

    @property
    def objects(self) -> Objects[SceneObject]:
        """Handles by object id: ``scenario.objects["car_3"].translate(y=3.2)``."""
        return Objects({o.object_id: SceneObject(self, o) for o in self.info.objects})

    def apply(
        self, operations: Sequence[Operation | Mapping[str, Any]], *, dry_run: bool = False
    ) -> OperationResult:
        """Apply operations, all or none.

        Raises:
            StaleRevisionError: somebody else edited first.
            InvalidOperationError: an unknown object, or a result that is not allowed.
        """
        call = _requests.apply_operations(self.scenario_id, operations, self._etag, dry_run)
        return self._settle(self._transport.send(call))

    def undo(self) -> OperationResult:
        """Take the newest edit back."""
        return self._settle(self._transport.send(_requests.undo(self.scenario_id, self._etag)))

    def redo(self) -> OperationResult:
        """Make the edit again that was taken back last."""
        return self._settle(self._transport.send(_requests.redo(self.scenario_id, self._etag)))

    def history(self, *, after: int | None = None) -> History:
        """Edits, undos and redos after a revision, oldest first; default: all."""
        return self._transport.send(_requests.history(self.scenario_id, after))

    def refresh(self) -> Scenario:
        """See what the scenario is now; returns itself."""
        self._saw(self._transport.send(_requests.get_scenario(self.scenario_id)))
        return self

    def preview(
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
        return self._transport.send(_requests.preview(self.scenario_id, view))

    def _settle(self, result: OperationResult) -> OperationResult:
        self._made(result)
        if not result.dry_run:
            self.refresh()
        return result


class SceneObject(ObjectOperations):
    """An object of a scenario; each method is one edit. Metres, radians, wxyz."""

    def __init__(self, scenario: Scenario, info: ObjectInfo) -> None:
        super().__init__(info)
        self._scenario = scenario

    def translate(
        self, *, x: float = 0.0, y: float = 0.0, z: float = 0.0, frame: str = "world"
    ) -> OperationResult:
        """Shift the whole trajectory [m]; ``frame='object'`` counts along the object's axes."""
        return self._scenario.apply([self._translate(x, y, z, frame)])

    def rotate(
        self,
        *,
        angle: float,
        axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
        frame: str = "world",
    ) -> OperationResult:
        """Turn about the object's own centre [rad]."""
        return self._scenario.apply([self._rotate(angle, axis, frame)])

    def scale(
        self, *, x: float = 1.0, y: float = 1.0, z: float = 1.0, anchor: str = "bottom"
    ) -> OperationResult:
        """Multiply the size along the object's axes; ``anchor``: ``bottom`` or ``centre`` stays."""
        return self._scenario.apply([self._scale(x, y, z, anchor)])

    def set_pose(
        self,
        *,
        position: tuple[float, float, float],
        quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    ) -> OperationResult:
        """Place the object in the world [m], for the whole time range."""
        return self._scenario.apply([self._set_pose(position, quaternion)])

    def duplicate(
        self,
        *,
        new_id: str | None = None,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        frame: str = "world",
    ) -> SceneObject:
        """Add a copy, shifted [m], and return its handle."""
        options = {"new_id": new_id, "x": x, "y": y, "z": z, "frame": frame}
        result = self._scenario.apply([self._duplicate(options)])
        return self._scenario.objects[result.created[0]]

    def delete(self) -> OperationResult:
        """Remove the object; undo brings it back."""
        return self._scenario.apply([self._delete()])
