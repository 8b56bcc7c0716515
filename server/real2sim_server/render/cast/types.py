"""Inputs and outputs of cast(), and the motion of sensor and bodies over a sweep."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...scene import Lidar
from ..types import Instance

TRANSMITTANCE_MIN = 1e-3
"""Transmittance at which a ray ends."""
HALF_LIGHT = 0.5
"""Transmittance that defines a surface: a ray hits it where it falls to this or below."""
ECHO_MIN = 0.05
"""Minimum fraction of the light for an echo to be a return."""

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CastRequest:
    """A validated cast() call. A sweep has S instants, see ``Beams.slots``.

    Attributes:
        instances: instances in the scene; ``T_world_object`` is the pose at the timestamp of the
            sweep.
        lidar: the sensor.
        T_world_lidar: [S, 4, 4] float64 at each instant.
        object_poses: for each instance [S, 4, 4] float64, or None if stationary.
        attributes: for each instance [N, 2] float32, reflectivity and fraction of lost rays of its
            Gaussians, or None if unknown.
    """

    instances: tuple[Instance, ...]
    lidar: Lidar
    T_world_lidar: Float
    object_poses: tuple[Float | None, ...]
    attributes: tuple[NDArray[np.float32] | None, ...]


@dataclass(frozen=True, eq=False)
class Return:
    """One of several returns of each ray.

    Attributes:
        range: along the ray [m]; 0 without a return.
        power: fraction of the ray's light returned from there (two-way), 0 to 1.
        intensity: reflectivity there.
    """

    range: Image
    power: Image
    intensity: Image


@dataclass(frozen=True, eq=False)
class Echo:
    """The light of each ray before detection. All arrays have the LiDAR's shape.

    Attributes:
        range: median range, where transmittance falls to one half [m]; 0 if it never does.
        expected: mean range over the absorbed light [m]; 0 if none is absorbed.
        opacity: fraction of absorbed light, 0 to 1.
        intensity: reflectivity, mean over the absorbed light.
        drop: fraction of lost rays, the same mean.
        instance: uint16, instance_id at the median; 0 if there is none.
        member: int32, index of the Gaussian at the median, counted over all instances in order; -1
            if there is none.
        returns: ``first`` and ``last``, plus ``strongest`` for three returns; empty for one return.
        timing_ms: milliseconds by stage.
    """

    range: Image
    expected: Image
    opacity: Image
    intensity: Image
    drop: Image
    instance: NDArray[np.uint16]
    member: NDArray[np.int32]
    returns: dict[str, Return] = field(default_factory=dict)
    timing_ms: dict[str, float] = field(default_factory=dict)

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Whether each ray loses at least half of its light."""
        return self.range > 0


@dataclass(frozen=True, eq=False)
class RayHits:
    """Gaussians hit by rays, from near to far.

    Attributes:
        begins: [R + 1] int64, start of the hits of each ray among all M.
        members: [M] int32, indices of the Gaussians, counted over all instances in order.
        alpha: [M] float32, absorbed fraction of the arriving light.
        tau: [M] float32, range [m].
    """

    begins: NDArray[np.int64]
    members: NDArray[np.int32]
    alpha: Image
    tau: Image


class CastBackend(Protocol):
    """A ray casting backend. All backends give the same echoes within rounding."""

    name: str

    def cast(self, request: CastRequest) -> Echo:
        """Trace all rays of the request."""
        ...


# Motion in the frame of the sweep, which is the sensor frame at the middle instant. Bodies are
# placed in it at that instant. For other instants the relative motion is applied to the sensor, so
# a ray hits a body at its pose at the time of the ray.

STILL = 1e-9
"""Poses that differ by less are considered equal."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Relative motions of the sensor and the bodies.

    Attributes:
        of_body: index of the motion of each instance; 0 is relative to stationary bodies.
        to_sensor: [motions, S, 4, 4], sweep frame to sensor frame at each instant.
        speed, turn: [motions], maximum speed [m/s] and angular speed [rad/s].
        linear, offset: [3, 3] and [3] of each instance, cloud frame to sweep frame, including
            scale.
    """

    of_body: list[int]
    to_sensor: Float
    speed: Float
    turn: Float
    linear: list[Float]
    offset: list[Float]


def motions_of(request: CastRequest) -> Motion:
    """The relative motions of a request."""
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
    """Maximum linear and angular speed of each motion over its instants."""
    if len(seconds) < 2:
        return np.zeros(len(to_sensor)), np.zeros(len(to_sensor))
    places = invert_transform(to_sensor)
    steps = np.maximum(np.diff(seconds), 1e-9)
    moved = np.linalg.norm(np.diff(places[..., :3, 3], axis=1), axis=-1)
    turned = places[:, 1:, :3, :3].swapaxes(-1, -2) @ places[:, :-1, :3, :3]
    # |A - I| of a small rotation is sqrt(2) times its angle.
    angle = np.linalg.norm(turned - np.eye(3), axis=(-2, -1)) / np.sqrt(2)
    speed, turn = (moved / steps).max(1), (angle / steps).max(1)
    return np.where(speed > 1e-6, speed, 0.0), np.where(turn > 1e-6, turn, 0.0)


# Velocities of hit points


def point_velocities(request: CastRequest, echo: Echo, hit: NDArray[np.bool_]) -> Image:
    """Velocity [..., 3] [m/s], world frame, of the point that each ray hits; 0 without a hit.

    Computed from the body's poses at the instants before and after the ray.
    """
    lidar = request.lidar
    times, slots = lidar.beams.slots
    velocity = np.zeros((*lidar.shape, 3), np.float32)
    if len(times) < 2:
        return velocity
    before = np.clip(slots - 1, 0, len(times) - 1)
    after = np.clip(slots + 1, 0, len(times) - 1)
    firsts = np.cumsum([0, *(len(i.cloud) for i in request.instances)])
    for index, poses in enumerate(request.object_poses):
        if poses is None:
            continue
        of_body = (echo.member >= firsts[index]) & (echo.member < firsts[index + 1]) & hit
        if not of_body.any():
            continue
        slot = slots[of_body]
        ray = (lidar.beams.directions * echo.range[..., None])[of_body]
        world = _each(request.T_world_lidar[slot], ray)
        local = _each(invert_transform(poses[slot]), world)
        moved = _each(poses[after[of_body]], local) - _each(poses[before[of_body]], local)
        seconds = (times[after[of_body]] - times[before[of_body]]) * 1e-6
        velocity[of_body] = moved / seconds[:, None]
    return velocity


def _each(transforms: Float, points: Float) -> Float:
    """Transform points [N, 3], each by its own transform [N, 4, 4]."""
    moved: Float = apply_transform(transforms, points[:, None])[:, 0]
    return moved
