"""What a handle of a scenario knows, whoever waits for the worker."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from real2sim_proto.guidance import advice
from real2sim_proto.scenarios import OperationResult, ScenarioInfo
from real2sim_proto.storyboard import Storyboard

from ._guidance import Handle

H = TypeVar("H")


class ScenarioState(Handle):
    """The newest state of a scenario that this client has seen."""

    _instead: ClassVar = {
        "add": "scenario.insert(asset, position=(x, y, z))",
        "close": "nothing: a scenario stays on its worker until client.scenarios.delete(scenario)",
        "delete": "client.scenarios.delete(scenario)",
        "drive": "client.session(scenario=scenario)",
        "export_video": "client.jobs.export_video(scenario=scenario, camera='front')",
        "get_object": "scenario.objects['car_6']",
        "id": "scenario.scenario_id",
        "name": "scenario.info.name",
        "render": "scenario.preview(camera='front')",
        "save": "scenario.export(), for a file; every edit is stored by the worker already",
        "session": "client.session(scenario=scenario)",
        "video": "client.jobs.export_video(scenario=scenario, camera='front')",
    }

    def __init__(self, info: ScenarioInfo) -> None:
        self._info = info
        self._etag = info.etag
        self._revision = info.revision

    @property
    def info(self) -> ScenarioInfo:
        """Name, scene, objects, whether undo and redo are possible."""
        return self._info

    @property
    def scenario_id(self) -> str:
        """Id of the scenario on its worker."""
        return self._info.scenario_id

    @property
    def scene(self) -> str:
        """Name of the scene that is edited."""
        return self._info.scene

    @property
    def revision(self) -> int:
        """Revision that the next edit is sent against."""
        return self._revision

    @property
    def storyboard(self) -> Storyboard | None:
        """What happens in sessions that bring no storyboard of their own; None: nothing."""
        return self._info.storyboard

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.scenario_id!r}, scene={self.scene!r}, "
            f"revision={self.revision})"
        )

    def _update(self, info: ScenarioInfo) -> None:
        self._info, self._etag, self._revision = info, info.etag, info.revision

    def _record(self, result: OperationResult) -> None:
        if not result.dry_run:
            self._etag, self._revision = result.etag, result.revision


class Objects(Mapping[str, H], Generic[H]):
    """Handles of a scenario's objects, by id."""

    def __init__(self, handles: Mapping[str, H]) -> None:
        self._handles = handles

    def __getitem__(self, object_id: str) -> H:
        try:
            return self._handles[object_id]
        except KeyError:
            if not isinstance(object_id, str):
                raise KeyError(
                    f"{object_id!r} is no id; write list(scenario.objects.values())[{object_id!r}]"
                ) from None
            raise KeyError(
                f"the scenario has no object {object_id!r} among {len(self)}; "
                f"{advice(object_id, self._handles)} refresh() shows what other clients have added"
            ) from None

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_"):
                raise AttributeError(f"'Objects' object has no attribute {name!r}")
            raise AttributeError(f"Objects has no {name!r}; write scenario.objects[{name!r}]")

    def __delitem__(self, object_id: str) -> None:
        raise TypeError(f"write scenario.objects[{object_id!r}].delete()")

    def __iter__(self) -> Iterator[str]:
        return iter(self._handles)

    def __len__(self) -> int:
        return len(self._handles)

    def __repr__(self) -> str:
        return f"Objects({', '.join(self._handles)})"
