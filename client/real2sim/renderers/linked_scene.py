"""Pictures of one scene, asked for in another simulator's frame, time and names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from real2sim_proto.base import Pose
from real2sim_proto.scenes import SceneInfo

from .._poses import Matrix, quaternion_of
from ..errors import Real2SimError
from .scene_link import SceneLink, frame_of, object_ids

if TYPE_CHECKING:
    from .._sync.client import Client
    from ..images import Frame

MAX_CAMERAS = 16
"""Of one request to a worker."""


@dataclass(frozen=True)
class CameraView:
    """One picture that somebody wants.

    Attributes:
        width, height: [px].
        K: [3, 3] intrinsics [px].
        pose: [4, 4] of the camera in their world; x right, y down, z forward.
        codec: ``raw``, ``jpeg`` or ``png``.
        quality: of jpeg.
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
            views: all of one instant.
            their_us: that instant on their clock [us].
            poses: [4, 4] of box centres in their world, by the scene's object ids.
            others: as of ``client.scenes.view``.

        Raises:
            Real2SimError: as ``client.scenes.view`` does.
            ValueError: a size that no worker draws.
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
