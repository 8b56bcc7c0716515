"""A sweep through a scene as it was recorded: everything moves along its own trajectory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float, slerp
from ...geometry.transform import transform_from
from ...scene import Lidar, Scene, Trajectory
from ..types import Instance
from .call import cast
from .types import Echo


def recorded_sweep(
    scene: Scene,
    lidar: Lidar,
    t_us: int,
    *,
    attributes: Sequence[NDArray[np.float32] | None] | None = None,
    backend: str = "auto",
) -> Echo:
    """What ``lidar`` on the recording vehicle meets in the sweep about ``t_us`` [us].

    Args:
        scene: gives Gaussians, trajectories and the vehicle's path.
        attributes: of the background and of each object in the order of ``scene.objects``; by
            default those of the scene's clouds.
        backend: see :func:`.cast`.
    """
    instances, poses, places = recorded_instances(scene, lidar, t_us)
    if attributes is not None:
        attributes = [attributes[place] for place in places]
    return cast(
        instances,
        lidar,
        sensor_poses(scene, lidar, t_us),
        object_poses=poses,
        attributes=attributes,
        backend=backend,
    )


def recorded_instances(
    scene: Scene, lidar: Lidar, t_us: int
) -> tuple[list[Instance], list[Float | None], list[int]]:
    """Background and the objects that exist at ``t_us``, their poses over the sweep, and where
    each stands in the list of the background and all objects."""
    times = t_us + lidar.beams.slots[0]
    instances, poses, places = [Instance(scene.background)], [None], [0]
    moved: list[Float | None] = list(poses)
    for index, item in enumerate(scene.objects.values()):
        if item.trajectory.covers(t_us):
            pose = item.trajectory.transform(t_us)
            instances.append(Instance(item.cloud, pose, instance_id=index + 1))
            moved.append(transforms_at(item.trajectory, times))
            places.append(index + 1)
    return instances, moved, places


def sensor_poses(scene: Scene, lidar: Lidar, t_us: int) -> Float:
    """``T_world_lidar`` [S, 4, 4] on the recording vehicle over the sweep about ``t_us``."""
    times = t_us + lidar.beams.slots[0]
    return transforms_at(scene.ego, times) @ lidar.T_vehicle_lidar


def transforms_at(trajectory: Trajectory, times_us: Float) -> Float:
    """``T_fixed_moving`` [S, 4, 4] at any times [us].

    Beyond its ends the path goes straight on with the speed it has there, for the parts of a sweep
    before the first and after the last box.
    """
    known = trajectory.times_us.astype(np.float64)
    if len(known) == 1:
        pose = transform_from(trajectory.positions[0], trajectory.quaternions[0])
        return np.broadcast_to(pose, (len(times_us), 4, 4))
    after = np.clip(np.searchsorted(known, times_us), 1, len(known) - 1)
    part = (times_us - known[after - 1]) / (known[after] - known[after - 1])
    first, last = trajectory.positions[after - 1], trajectory.positions[after]
    positions = first + part[:, None] * (last - first)
    turned = np.clip(part, 0.0, 1.0)
    quaternions = slerp(trajectory.quaternions[after - 1], trajectory.quaternions[after], turned)
    return transform_from(positions, quaternions)
