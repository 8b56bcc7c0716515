"""A scene as another simulator sees it: in its frame, its clock and its names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from real2sim_proto.base import Pose
from real2sim_proto.scenes import SceneInfo

from .._calls import describe
from .._session_state import Matrix, quaternion_of
from ..errors import Real2SimError

if TYPE_CHECKING:
    from .._sync.client import Client
    from ..images import Frame


# The link: frame, clock and names.

Row = tuple[float, float, float, float]
IDENTITY: tuple[Row, Row, Row, Row] = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)


class SceneLink(BaseModel):
    """Mapping between a scene of the worker and another simulator.

    Attributes:
        scene: name of the worker's scene.
        T_world_theirs: transform from their world to the scene's; None: from the scene's metadata,
            else the identity.
        offset_us: their time minus the scene's [us].
        cameras: the scene's cameras by their names.
        objects: the scene's objects by their ids, in addition to the ids from the scene's log.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str = Field(min_length=1)
    T_world_theirs: tuple[Row, Row, Row, Row] | None = None
    offset_us: int = 0
    cameras: dict[str, str] = Field(default_factory=dict)
    objects: dict[str, str] = Field(default_factory=dict)

    @field_validator("T_world_theirs")
    @classmethod
    def _is_rigid(cls, rows: Any) -> Any:
        if rows is not None:
            R, last = np.array(rows)[:3, :3], rows[3]
            turns = np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0
            if not turns or last != IDENTITY[3]:
                raise ValueError("T_world_theirs is not a rigid transform [4, 4]")
        return rows


def read_links(path: Path) -> dict[str, SceneLink]:
    """Read links by their scene id from a JSON file.

    Raises:
        ValueError: the file has other content.
        OSError: it cannot be read.
    """
    try:
        return TypeAdapter(dict[str, SceneLink]).validate_json(path.read_bytes())
    except ValidationError as error:
        raise ValueError(f"{path}: {describe(error)}") from error


def frame_of(link: SceneLink, info: SceneInfo) -> Matrix:
    """``T_world_theirs`` [4, 4], from the link or from the metadata that log readers write."""
    rows = link.T_world_theirs or info.provenance.get("T_world_dataset") or IDENTITY
    return np.array(rows, dtype=np.float64)


def object_ids(link: SceneLink, info: SceneInfo) -> dict[str, str]:
    """The scene's objects by their external ids: the ids of the log and of the link."""
    there = [found.object_id for found in info.objects]
    keys = info.provenance.get("track_ids")
    named = {str(key): name for name, key in _pairs(keys) if name in there}
    return {name: name for name in there} | named | dict(link.objects)


def camera_names(link: SceneLink, wanted: Iterable[str], info: SceneInfo) -> dict[str, str]:
    """The link's names, and those of ``wanted`` that differ from a camera's only in case."""
    by_case = {camera.name.lower(): camera.name for camera in info.cameras}
    alike = {name: by_case[name.lower()] for name in wanted if name.lower() in by_case}
    return alike | dict(link.cameras)


def _pairs(keys: Any) -> Iterable[tuple[str, Any]]:
    return keys.items() if isinstance(keys, Mapping) else ()


MAX_CAMERAS = 16
"""Maximum number of cameras in a request to a worker."""


@dataclass(frozen=True)
class CameraView:
    """A requested image.

    Attributes:
        width, height: [px].
        K: [3, 3] intrinsics [px].
        pose: [4, 4] pose of the camera in their world; x right, y down, z forward.
        codec: ``raw``, ``jpeg`` or ``png``.
        quality: quality of jpeg.
    """

    width: int
    height: int
    K: Matrix
    pose: Matrix
    codec: Literal["raw", "jpeg", "png"] = "raw"
    quality: int = 90


class LinkedScene:
    """A scene of a worker behind a link.

    Attributes:
        info: the scene as the worker describes it.
        objects: its objects by their ids.
    """

    def __init__(self, client: Client, link: SceneLink) -> None:
        self._client, self.link = client, link
        self.info: SceneInfo = client.scenes.get(link.scene)
        if self.info.reason:
            raise Real2SimError(f"scene {link.scene!r} is broken: {self.info.reason}")
        self.objects = object_ids(link, self.info)
        limits = client.server().limits
        self._max_cameras = min(limits.max_cameras_per_step, MAX_CAMERAS)
        self._max_pixels = limits.max_pixels_per_step
        self._T_world_theirs = frame_of(link, self.info)

    def to_theirs(self, T_world_x: Matrix) -> Matrix:
        """A pose [..., 4, 4] of this scene in their world."""
        found: Matrix = np.linalg.inv(self._T_world_theirs) @ T_world_x
        return found

    def their_time(self, t_us: int) -> int:
        """A time of this scene on their clock [us]."""
        return t_us + self.link.offset_us

    def pictures(
        self,
        views: Sequence[CameraView],
        *,
        their_us: int,
        poses: Mapping[str, Matrix],
        others: Literal["recorded", "parked", "none"],
    ) -> list[Frame]:
        """The frames of ``views``, in order, in as few requests as the worker allows.

        Args:
            views: requested images, all at the same time.
            their_us: that time on their clock [us].
            poses: [4, 4] poses of box centres in their world, by the scene's object ids.
            others: as in ``client.scenes.view``.

        Raises:
            Real2SimError: as ``client.scenes.view`` does.
            ValueError: a size that workers do not support.
        """
        placed = {name: self._pose(pose) for name, pose in poses.items()}
        frames: list[Frame] = []
        for part in self._parts(views):
            names = [f"camera_{k}" for k in range(len(part))]
            cameras = [self._camera(name, wanted) for name, wanted in zip(names, part, strict=True)]
            view = self._client.scenes.view(
                self.info.scene,
                cameras,
                t_us=their_us - self.link.offset_us,
                objects=placed,
                others=others,
            )
            frames += [view.frames[name]["rgb"] for name in names]
        return frames

    def _parts(self, views: Sequence[CameraView]) -> list[list[CameraView]]:
        parts: list[list[CameraView]] = []
        room = 0
        for wanted in views:
            pixels = wanted.width * wanted.height
            if not parts or pixels > room or len(parts[-1]) == self._max_cameras:
                parts.append([])
                room = self._max_pixels
            parts[-1].append(wanted)
            room -= pixels
        return parts

    def _camera(self, name: str, wanted: CameraView) -> dict[str, object]:
        fields = {name: getattr(wanted, name) for name in ("width", "height", "codec", "quality")}
        return fields | {"name": name, "K": wanted.K.tolist(), "pose": self._pose(wanted.pose)}

    def _pose(self, theirs: Matrix) -> Pose:
        pose = self._T_world_theirs @ theirs
        return Pose(position=tuple(pose[:3, 3].tolist()), quaternion=quaternion_of(pose[:3, :3]))
