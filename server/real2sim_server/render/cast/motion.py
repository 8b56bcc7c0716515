"""How the sensor and the bodies move over a sweep, in the frame of the sweep.

That frame is the sensor's own at the middle instant. Each body is placed in it where it stands
then; at other instants the body is taken as still and the sensor as moved instead, so that a ray
meets it as it stands at the ray's own instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from .types import CastRequest

STILL = 1e-9
"""Poses that differ by less are the same."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Ways in which the sensor moves against bodies.

    Attributes:
        of_body: for each instance the way; 0 is against what stands still.
        to_sensor: [ways, S, 4, 4], from the frame of the sweep to the sensor's at each instant.
        speed, turn: [ways], at most [m/s], [rad/s].
        linear, offset: for each instance [3, 3] and [3], from its cloud's frame to that of the
            sweep, scale included.
    """

    of_body: list[int]
    to_sensor: Float
    speed: Float
    turn: Float
    linear: list[Float]
    offset: list[Float]


def motions_of(request: CastRequest) -> Motion:
    """The ways of a request."""
    seconds = request.lidar.beams.slots[0] * 1e-6
    middle = len(seconds) // 2
    T_lidar_world = invert_transform(request.T_world_lidar)
    T_sweep_world, T_world_sweep = T_lidar_world[middle], request.T_world_lidar[middle]
    ways = [T_lidar_world @ T_world_sweep]
    of_body, linear, offset = [], [], []
    for instance, poses in zip(request.instances, request.object_poses, strict=True):
        placed, way = instance.T_world_object, 0
        T_world_object = np.eye(4) if placed is None else np.asarray(placed, dtype=np.float64)
        if poses is not None:
            T_world_object = poses[middle]
            if np.abs(poses - T_world_object).max() > STILL:
                way = len(ways)
                T_object_sweep = invert_transform(T_world_object) @ T_world_sweep
                ways.append(T_lidar_world @ poses @ T_object_sweep)
        T_sweep_object = T_sweep_world @ T_world_object
        of_body.append(way)
        linear.append(T_sweep_object[:3, :3] * np.asarray(instance.scale))
        offset.append(T_sweep_object[:3, 3])
    to_sensor = np.stack(ways)
    speed, turn = _rates(to_sensor, seconds)
    return Motion(of_body, to_sensor, speed, turn, linear, offset)


def _rates(to_sensor: Float, seconds: Float) -> tuple[Float, Float]:
    """Largest speed and turn of each way over its instants."""
    if len(seconds) < 2:
        return np.zeros(len(to_sensor)), np.zeros(len(to_sensor))
    places = invert_transform(to_sensor)
    steps = np.maximum(np.diff(seconds), 1e-9)
    moved = np.linalg.norm(np.diff(places[..., :3, 3], axis=1), axis=-1)
    turned = places[:, 1:, :3, :3].swapaxes(-1, -2) @ places[:, :-1, :3, :3]
    # |A - I| of a turn by a small angle is sqrt(2) times the angle.
    angle = np.linalg.norm(turned - np.eye(3), axis=(-2, -1)) / np.sqrt(2)
    speed, turn = (moved / steps).max(1), (angle / steps).max(1)
    return np.where(speed > 1e-6, speed, 0.0), np.where(turn > 1e-6, turn, 0.0)
