"""What both twins of a scenario handle know and build."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from typing import Any, Generic, TypeVar

from real2sim_proto.base import Pose
from real2sim_proto.operations import (
    Delete,
    Duplicate,
    Operation,
    Rotate,
    Scale,
    SetPose,
    Translate,
)
from real2sim_proto.scenarios import OperationResult, ScenarioInfo
from real2sim_proto.scenes import ObjectInfo

from ._requests import checked

H = TypeVar("H")


class ScenarioState:
    """The newest state of a scenario that this client has seen."""

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
        return self._info.scenario_id

    @property
    def scene(self) -> str:
        return self._info.scene

    @property
    def revision(self) -> int:
        """Revision that the next edit is sent against."""
        return self._revision

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.scenario_id!r}, scene={self.scene!r}, "
            f"revision={self.revision})"
        )

    def _saw(self, info: ScenarioInfo) -> None:
        self._info, self._etag, self._revision = info, info.etag, info.revision

    def _made(self, result: OperationResult) -> None:
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
            close = difflib.get_close_matches(object_id, self._handles, n=3)
            instead = f"; did you mean {', '.join(close)}?" if close else ""
            raise KeyError(
                f"the scenario has no object {object_id!r} among {len(self)}{instead}"
                " refresh() shows what other clients have added"
            ) from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._handles)

    def __len__(self) -> int:
        return len(self._handles)

    def __repr__(self) -> str:
        return f"Objects({', '.join(self._handles)})"


class ObjectOperations:
    """Builds the operations that an object's handle applies."""

    def __init__(self, info: ObjectInfo) -> None:
        self.info = info

    @property
    def object_id(self) -> str:
        return self.info.object_id

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.object_id!r}, category={self.info.category!r})"

    def _translate(self, x: float, y: float, z: float, frame: str) -> Operation:
        return checked(Translate, object_id=self.object_id, x=x, y=y, z=z, frame=frame)

    def _rotate(self, angle: float, axis: tuple[float, float, float], frame: str) -> Operation:
        return checked(Rotate, object_id=self.object_id, angle=angle, axis=axis, frame=frame)

    def _scale(self, x: float, y: float, z: float, anchor: str) -> Operation:
        return checked(Scale, object_id=self.object_id, x=x, y=y, z=z, anchor=anchor)

    def _set_pose(
        self,
        position: tuple[float, float, float],
        quaternion: tuple[float, float, float, float],
    ) -> Operation:
        pose = checked(Pose, position=position, quaternion=quaternion)
        return checked(SetPose, object_id=self.object_id, pose=pose)

    def _duplicate(self, options: Mapping[str, Any]) -> Operation:
        return checked(Duplicate, object_id=self.object_id, **options)

    def _delete(self) -> Operation:
        return checked(Delete, object_id=self.object_id)
