"""From where the recording vehicle saw an object: what no camera saw cannot be shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import Float
from ...scene import Camera, Scene
from ..playback import PlacedObject

VIEWS_MAX = 24
"""Recorded frames that are considered."""
DEPTH_MIN = 2.0


@dataclass(frozen=True, eq=False)
class Visibility:
    """How an object was seen over the recording.

    Attributes:
        direction: [3] towards the cameras, object frame, each view weighed by the solid angle the
            object took up; its length grows with how well it was seen.
        front, rear: solid angles of views that came from ahead and from behind, summed up.
    """

    direction: Float
    front: float
    rear: float

    @property
    def whole(self) -> float:
        """All views together."""
        return self.front + self.rear


def visibility_of(scene: Scene, subject: PlacedObject) -> Visibility:
    """How ``subject`` was seen by all cameras of the scene."""
    times = [int(t) for t in scene.frame_times_us if subject.trajectory.covers(int(t))]
    total, front, rear = np.zeros(3), 0.0, 0.0
    for t_us in times[:: max(len(times) // VIEWS_MAX, 1)]:
        pose, ego = subject.trajectory.transform(t_us), scene.ego.transform(t_us)
        for camera in scene.rig.cameras:
            if not in_view(camera, ego, pose[:3, 3], farthest=np.inf):
                continue
            eye = camera.pose(ego)[:3, 3]
            towards = (eye - pose[:3, 3]) @ pose[:3, :3]
            distance = float(np.linalg.norm(towards))
            angle = subject.scaled_size[1] * subject.scaled_size[2] / distance**2
            total += angle * towards / distance
            cosine = towards[0] / distance
            front, rear = front + angle * max(cosine, 0.0), rear + angle * max(-cosine, 0.0)
    return Visibility(total, front, rear)


def in_view(
    camera: Camera, T_world_vehicle: Float, point: Float, *, farthest: float, nearest: float = 0.0
) -> bool:
    """Whether a point of the world is on the camera's image, between two depths [m]."""
    x, y, z = (camera.viewmat(T_world_vehicle) @ np.append(point, 1.0))[:3]
    if not max(nearest, DEPTH_MIN) < z < farthest:
        return False
    u = camera.K[0, 0] * x / z + camera.K[0, 2]
    v = camera.K[1, 1] * y / z + camera.K[1, 2]
    return bool(0 < u < camera.width and 0 < v < camera.height)
