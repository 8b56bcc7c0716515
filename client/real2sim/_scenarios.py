"""Scenarios: a scene and the edits made to it.

A handle sends the revision it knows with every edit. When somebody else has edited in between,
the edit is refused with :class:`~real2sim.errors.StaleRevisionError`, which names what was
missed; ``refresh()`` and decide again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from real2sim_proto.jobs import SimulateRequest
from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import History, OperationResult, ScenarioDocument, ScenarioInfo
from real2sim_proto.scenes import ObjectInfo

from . import _requests
from ._call import ViewRequest, checked
from ._jobs import Job
from ._object_edits import (
    UPRIGHT,
    ObjectEdits,
    Quaternion,
    ScenarioEdits,
    Vector,
    insertion,
)
from ._scenario_state import Objects, ScenarioState
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

    def import_document(self, document: ScenarioDocument | Mapping[str, Any]) -> Scenario:
        """A new scenario from what :meth:`Scenario.export` gave, here or elsewhere."""
        checked = ScenarioDocument.model_validate(document)
        info = self._transport.send(_requests.import_scenario(checked))
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


class Scenario(ScenarioState, ScenarioEdits[OperationResult]):
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

    def insert(
        self,
        asset: str,
        *,
        position: Vector,
        quaternion: Quaternion = UPRIGHT,
        size: Vector | None = None,
        object_id: str | None = None,
        snap: bool = True,
    ) -> SceneObject:
        """Add an object from the asset library, and return its handle.

        Args:
            asset: id in the library.
            position, quaternion: where its box is, for the whole time range.
            size: box to fit [m]; default: the asset's own.
            object_id: default: the asset's id with a number.
            snap: put it onto the ground, whatever z is.
        """
        operation = insertion(
            asset,
            position=position,
            quaternion=quaternion,
            size=size,
            object_id=object_id,
            snap=snap,
        )
        result = self.apply([operation])
        return self.objects[result.created[0]]

    def simulate(
        self,
        *,
        start_us: int | None = None,
        end_us: int | None = None,
        frame_us: int = 50_000,
        objects: Sequence[str] | None = None,
        preset: str = "vehicle",
        backend: str = "auto",
    ) -> Job:
        """Start a physics rollout of the scenario as it is now.

        Args:
            start_us, end_us: default: the scenario's span.
            frame_us: from one kept frame to the next.
            objects: what the physics moves; default: what has a velocity or physics of its own.
            preset: how objects become bodies: ``vehicle`` or ``paper``.
            backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        """
        body = checked(
            SimulateRequest,
            start_us=start_us,
            end_us=end_us,
            frame_us=frame_us,
            objects=None if objects is None else list(objects),
            preset=preset,
            backend=backend,
        )
        info = self._transport.send(_requests.simulate(self.scenario_id, body))
        return Job(self._transport, info)

    def fork(self, *, name: str | None = None, revision: int | None = None) -> Scenario:
        """A new scenario with the same history, up to a revision."""
        call = _requests.fork_scenario(self.scenario_id, name, revision)
        return Scenario(self._transport, self._transport.send(call)).refresh()

    def export(self) -> ScenarioDocument:
        """The whole scenario as one document; ``model_dump_json()`` makes a file of it."""
        return self._transport.send(_requests.export_scenario(self.scenario_id))

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
        view = ViewRequest(camera, t_us, width, modality, codec)
        return self._transport.send(_requests.preview(self.scenario_id, view))

    def _edit(self, operation: Operation) -> OperationResult:
        return self.apply([operation])

    def _settle(self, result: OperationResult) -> OperationResult:
        self._made(result)
        if not result.dry_run:
            self.refresh()
        return result


class SceneObject(ObjectEdits[OperationResult]):
    """An object of a scenario; each method is one edit. Metres, radians, wxyz."""

    def __init__(self, scenario: Scenario, info: ObjectInfo) -> None:
        super().__init__(info)
        self._scenario = scenario

    def duplicate(
        self,
        *,
        new_id: str | None = None,
        x: float = 0.0,
        y: float = 0.0,
        z: float = 0.0,
        frame: str = "world",
        snap: bool = False,
    ) -> SceneObject:
        """Add a copy, shifted [m], and return its handle; ``snap`` puts it onto the ground."""
        result = self._scenario.apply([self._duplicate(new_id, (x, y, z), frame, snap)])
        return self._scenario.objects[result.created[0]]

    def _edit(self, operation: Operation) -> OperationResult:
        return self._scenario.apply([operation])
