"""People as ray-cast meshes, refitted for every instant, and their ground truth."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..body.bicycle import CRANK, FRAME, RIM, SADDLE, SURFACES, TYRE, Ride
from ..body.model import vertex_normals
from ..geometry import Float, apply_transform, invert_transform
from .casting import Geometry, Instances, append_geometry, refit
from .materials import PLAIN
from .mesh import Mesh
from .sensors import RaycastWorld, trace
from .traffic import PlannedPerson, poses_at

BICYCLE_COLOURS = {
    TYRE: (0.02, 0.02, 0.02), RIM: (0.4, 0.4, 0.41), CRANK: (0.2, 0.2, 0.21),
    SADDLE: (0.03, 0.025, 0.02),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class PersonMesh:
    """A person's triangles, and their position in the world's arrays.

    Attributes:
        person: the person.
        triangles: [T, 3] vertices, body and bicycle.
        parts: [T] part of each triangle, see :func:`part_names`.
        order: [T] triangle at each position of the world's arrays from ``first`` on.
        first: row of the first triangle.
        nodes: rows of the hierarchy, from and to; the first is its root.
    """

    person: PlannedPerson
    triangles: NDArray[np.int64]
    parts: NDArray[np.int64]
    order: NDArray[np.int64]
    first: int
    nodes: tuple[int, int]


@dataclass(frozen=True, eq=False)
class PeopleCast:
    """The people of a street in the arrays for ray casting.

    The arrays change with time: cast rays only inside the context of :meth:`at`.
    """

    world: RaycastWorld
    meshes: tuple[PersonMesh, ...]
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _now: list[float] = field(default_factory=list)

    @contextmanager
    def at(self, t_us: float) -> Iterator[RaycastWorld]:
        """The world with all people posed at an instant [us]."""
        with self._lock:
            if self._now != [t_us]:
                for mesh in self.meshes:
                    self._move(mesh, mesh.person.vertices(np.array([t_us * 1e-6]))[0])
                self._now[:] = [t_us]
            yield self.world

    def over(self, times_us: Float) -> Iterator[RaycastWorld]:
        """Yield the world at instants [T] [us], one after the other."""
        with self._lock:
            self._now.clear()
            shapes = [mesh.person.vertices(times_us * 1e-6) for mesh in self.meshes]
            for i in range(len(times_us)):
                for mesh, vertices in zip(self.meshes, shapes, strict=True):
                    self._move(mesh, vertices[i])
                yield self.world

    def roots(self) -> NDArray[np.int64]:
        """Root node [P] of each person's hierarchy."""
        return np.array([mesh.nodes[0] for mesh in self.meshes], dtype=np.int64)

    def _move(self, mesh: PersonMesh, vertices: Float) -> None:
        normals = vertex_normals(vertices, mesh.triangles)
        world = self.world
        refit(
            world.bounds, world.children, world.counts, world.edges, world.normals,
            vertices, normals, mesh.triangles, mesh.order, mesh.first, *mesh.nodes,
        )  # fmt: skip


def part_names(person: PlannedPerson) -> tuple[str, ...]:
    """Names of parts: those of a body, then those of a bicycle."""
    return (*person.motion.body.model.part_names, *SURFACES)


def add_people(
    geometry: Geometry, people: tuple[PlannedPerson, ...], paints: list[tuple[float, ...]]
) -> tuple[Geometry, tuple[PersonMesh, ...]]:
    """Append people to the world's meshes, and their colours to ``paints``."""
    meshes, out = [], []
    for person in people:
        triangles, parts = person_triangles(person)
        vertices = person.vertices(np.array([0.4]))[0]
        normals = vertex_normals(vertices, triangles)
        mesh = Mesh(
            vertices[triangles],
            np.zeros((len(triangles), 3, 2)),
            normals[triangles],
            np.full(len(triangles), PLAIN, np.int32),
            _paint(person, parts, paints),
        )
        meshes.append(mesh)
        out.append((person, triangles, parts))
    geometry, places = append_geometry(geometry, meshes)
    return geometry, tuple(
        PersonMesh(person, triangles, parts, *place)
        for (person, triangles, parts), place in zip(out, places, strict=True)
    )


def person_triangles(person: PlannedPerson) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles [T, 3] and the part of each [T], see :func:`part_names`."""
    model = person.motion.body.model
    triangles = model.triangles[model.triangles_of(person.looks.groups)]
    parts = np.median(model.parts[triangles], axis=1).astype(np.int64)
    if isinstance(person.motion, Ride):
        bicycle = person.motion.bicycle
        triangles = np.concatenate([triangles, bicycle.triangles + len(model.vertices)])
        parts = np.concatenate([parts, bicycle.surfaces + len(model.part_names)])
    return triangles, parts


def _paint(
    person: PlannedPerson, parts: NDArray[np.int64], paints: list[tuple[float, ...]]
) -> NDArray[np.int32]:
    """Row of the paint table [T] of every triangle."""
    looks, names = person.looks, person.motion.body.model.part_names
    colours = [looks.colours[name] for name in names]
    colours += [{**BICYCLE_COLOURS, FRAME: looks.bicycle}[k] for k in range(len(SURFACES))]
    first = len(paints)
    paints += [(*colour, 0.0, 0.0, 0.0, 0.0, 0.0) for colour in colours]
    return (parts + first).astype(np.int32)


# Ground truth of people: joints, parts, and the flow of deforming surfaces.


@dataclass(frozen=True, eq=False)
class PeopleTruth:
    """All people at one instant.

    Attributes:
        tracks: [P] index into the log's tracks.
        joints: [P, 22, 3], names in ``body.JOINTS``, world frame [m].
        keypoints: [P, 17, 3] of COCO, names in ``body.model.KEYPOINTS``, world frame [m].
    """

    tracks: NDArray[np.int64]
    joints: Float
    keypoints: Float


def people_truth(people: Sequence[PlannedPerson], first: int, t_us: int) -> PeopleTruth:
    """Truth for people, with ``first`` as the track of the first one."""
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
    """Flow [H, W, 2] [px] from the first pose to the second, with people as at ``then`` [s]."""
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
