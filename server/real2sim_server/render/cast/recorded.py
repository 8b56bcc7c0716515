"""A sweep through a scene as it was recorded: everything moves along its own trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...geometry.rotation import Float, slerp
from ...geometry.transform import transform_from
from ...scene import GaussianCloud, Lidar, Scene, Trajectory
from ..types import Instance
from .call import checked_request, select_caster
from .types import CastRequest, Echo

Attributes = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SweepScene:
    """What rays may meet: one entry for each instance, as :func:`~.call.cast` takes them, and the
    ``incidence`` of all."""

    instances: tuple[Instance, ...]
    poses: tuple[Float | None, ...]
    attributes: tuple[Attributes | None, ...]
    incidence: float = 1.0

    def request(self, lidar: Lidar, T_world_lidar: ArrayLike) -> CastRequest:
        """A sweep through it. Raises RenderError as :func:`~.call.cast` does."""
        return checked_request(
            self.instances,
            lidar,
            T_world_lidar,
            object_poses=self.poses,
            attributes=self.attributes,
            incidence=self.incidence,
        )


def recorded_sweep(scene: Scene, lidar: Lidar, t_us: int, *, backend: str = "auto") -> Echo:
    """What ``lidar`` on the recording vehicle meets in the sweep about ``t_us`` [us].

    A scene's own set for LiDARs (``scene.lidar``) is met where there is one.
    """
    met = recorded_scene(scene, lidar, t_us)
    request = met.request(lidar, sensor_poses(scene.ego, lidar, t_us))
    return select_caster(backend).cast(request)


def recorded_scene(scene: Scene, lidar: Lidar, t_us: int) -> SweepScene:
    """Background and the objects that exist at ``t_us``, and how they move over the sweep."""
    times = t_us + lidar.beams.slots[0]
    cloud, attributes = met_by_lidar(scene, None)
    instances, known = [Instance(cloud)], [attributes]
    moved: list[Float | None] = [None]
    for index, (object_id, item) in enumerate(scene.objects.items()):
        if not item.trajectory.covers(t_us):
            continue
        cloud, attributes = met_by_lidar(scene, object_id)
        if item.figure is not None:
            cloud, attributes = item.posed_at(t_us, item.trajectory), None
        pose = item.trajectory.transform(t_us)
        instances.append(Instance(cloud, pose, instance_id=index + 1))
        moved.append(transforms_at(item.trajectory, times))
        known.append(attributes)
    return SweepScene(tuple(instances), tuple(moved), tuple(known), incidence_of(scene))


def met_by_lidar(scene: Scene, object_id: str | None) -> tuple[GaussianCloud, Attributes | None]:
    """Gaussians that a LiDAR meets of an object, or of the background, and their attributes."""
    if scene.lidar is not None:
        held = scene.lidar.background if object_id is None else scene.lidar.objects.get(object_id)
        if held is not None:
            return held.cloud, held.attributes.cpu().numpy()
    return (scene.background if object_id is None else scene.object(object_id).cloud), None


def incidence_of(scene: Scene) -> float:
    """Share of light that the surfaces of a scene send back however they face the sensor."""
    return 1.0 if scene.lidar is None else scene.lidar.incidence


def sensor_poses(ego: Trajectory, lidar: Lidar, t_us: int) -> Float:
    """``T_world_lidar`` [S, 4, 4] on a vehicle that drives along ``ego`` [T_world_vehicle]."""
    return transforms_at(ego, t_us + lidar.beams.slots[0]) @ lidar.T_vehicle_lidar


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
    quaternions = slerp(
        trajectory.quaternions[after - 1], trajectory.quaternions[after], np.clip(part, 0.0, 1.0)
    )
    return transform_from(positions, quaternions)
