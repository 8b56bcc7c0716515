"""The procedural street of the render bench as a scene to drive through."""

from __future__ import annotations

import numpy as np

from ..geometry.transform import matrix_to_quaternion
from ..scene import CameraRig, Scene, SceneObject, Trajectory
from .gaussian_street import CAR_SIZE, StreetScene, street_scene

SPEED = 8.0
SECONDS = 20
PERIOD_US = 100_000


def street(name: str, *, gaussians: int, width: int, height: int) -> Scene:
    """A straight street with parked cars; the ego drives along it at 8 m/s for 20 s.

    Args:
        name: of the scene.
        gaussians: in all, parked cars included.
        width, height: of its one camera, ``front`` [px].
    """
    made = street_scene(gaussians, width=width, height=height)
    times = np.arange(0, SECONDS * 1_000_000 + 1, PERIOD_US)
    positions = np.zeros((len(times), 3))
    positions[:, 0] = SPEED * times * 1e-6
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    return Scene(
        name=name,
        background=made.instances[0].cloud,
        objects={o.object_id: o for o in _parked_cars(made, times[[0, -1]])},
        sky=made.sky,
        rig=CameraRig((made.camera,)),
        ego=Trajectory(times, positions, upright),
        frame_times_us=times,
        provenance={"source": "procedural street of the benches"},
    )


def _parked_cars(made: StreetScene, times: np.ndarray) -> list[SceneObject]:
    cars = []
    for instance in made.instances[1:]:
        pose = instance.T_world_object
        assert pose is not None
        quaternion = matrix_to_quaternion(pose[None, :3, :3])
        trajectory = Trajectory(times, np.tile(pose[:3, 3], (2, 1)), np.tile(quaternion, (2, 1)))
        length, width, height = CAR_SIZE.tolist()
        name = f"car_{instance.instance_id}"
        cars.append(SceneObject(name, "car", (length, width, height), instance.cloud, trajectory))
    return cars
