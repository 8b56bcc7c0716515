"""Truth that only people have: joints, parts, and the flow of surfaces that deform."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.transform import Float, apply_transform, invert_transform
from .casting import Instances
from .people import PlannedPerson
from .people_casting import PersonMesh
from .sensors import trace
from .shading import RaycastWorld
from .traffic import poses_at


@dataclass(frozen=True, eq=False)
class PeopleTruth:
    """Everybody at one instant.

    Attributes:
        tracks: [P] index into the log's tracks.
        joints: [P, 22, 3], names in ``body.JOINTS``, world frame [m].
        keypoints: [P, 17, 3] of COCO, names in ``body.model.KEYPOINTS``, world frame [m].
    """

    tracks: NDArray[np.int64]
    joints: Float
    keypoints: Float


def people_truth(people: Sequence[PlannedPerson], first: int, t_us: int) -> PeopleTruth:
    """Of people whose first is track ``first``."""
    joints, keypoints = np.zeros((len(people), 22, 3)), np.zeros((len(people), 17, 3))
    for i, person in enumerate(people):
        pose = poses_at(person.trajectory, np.array([float(t_us)]))[0]
        own, seen = person.joints(np.array([t_us * 1e-6]))
        joints[i], keypoints[i] = apply_transform(pose, own[0]), apply_transform(pose, seen[0])
    return PeopleTruth(first + np.arange(len(people)), joints, keypoints)


def trace_parts(  # noqa: PLR0917 - a view of people
    world: RaycastWorld,
    instances: Instances,
    meshes: Sequence[PersonMesh],
    T_world_camera: Float,
    k: Float,
    size: tuple[int, int],
) -> NDArray[np.uint8]:
    """1 + part of a person [H, W], 0 elsewhere."""
    triangle, instance, _ = _trace(world, instances, T_world_camera, k, size)
    out = np.zeros(len(triangle), np.uint8)
    first = len(instances.radius) - len(meshes)
    for i, mesh in enumerate(meshes):
        own = instance == first + i
        out[own] = 1 + mesh.parts[mesh.order[triangle[own] - mesh.first]]
    return out.reshape(size[1], size[0])


def trace_flow(  # noqa: PLR0917 - two views of one world
    world: RaycastWorld,
    places: tuple[Instances, Instances],
    meshes: Sequence[PersonMesh],
    poses: tuple[Float, Float],
    k: Float,
    size: tuple[int, int],
    then: float,
) -> NDArray[np.float32]:
    """Flow [H, W, 2] [px] from the first pose to the second, where people are at ``then`` [s]."""
    triangle, instance, place = _trace(world, places[0], poses[0], k, size)
    width, height = size
    v, u = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], axis=-1)
    rays *= (place[:, 2] / np.linalg.norm(rays, axis=1))[:, None]
    points = apply_transform(poses[0], np.where(triangle[:, None] < 0, 0.0, rays))
    first = len(places[0].radius) - len(meshes)
    for i in range(len(places[0].radius)):
        own = np.flatnonzero(instance == i)
        if i < first:
            local = _apply(places[0].to_object[i], points[own])
        else:
            mesh = meshes[i - first]
            corners = mesh.triangles[mesh.order[triangle[own] - mesh.first]]
            moved = mesh.person.vertices(np.array([then]))[0][corners]
            a, b = place[own, :1], place[own, 1:2]
            local = moved[:, 0] * (1 - a - b) + moved[:, 1] * a + moved[:, 2] * b
        points[own] = _apply(places[1].to_world[i], local)
    seen = apply_transform(invert_transform(poses[1]), points)
    depth = seen[:, 2]
    there = (
        seen[:, :2] / np.where(depth > 0, depth, np.nan)[:, None] * [k[0, 0], k[1, 1]] + k[:2, 2]
    )
    flow = np.where(triangle[:, None] < 0, np.nan, there - np.stack([u, v], axis=-1))
    return flow.astype(np.float32).reshape(height, width, 2)


def _trace(
    world: RaycastWorld, instances: Instances, pose: Float, k: Float, size: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    triangle, instance, place = trace(
        world,
        instances,
        np.ascontiguousarray(pose, dtype=np.float64),
        np.ascontiguousarray(k, dtype=np.float64),
        *size,
    )
    return triangle, instance, place


def _apply(transform: Float, points: Float) -> Float:
    """A transform [3, 4] of points [N, 3]."""
    return points @ transform[:, :3].T + transform[:, 3]
