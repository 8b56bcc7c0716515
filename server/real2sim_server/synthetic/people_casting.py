"""People as meshes that rays meet: one hierarchy each, its boxes fitted anew for every instant."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..body.bicycle import CRANK, FRAME, RIM, SADDLE, SURFACES, TYRE, Ride
from ..body.skinning import vertex_normals
from ..geometry.transform import Float
from .bvh import Geometry, append_geometry, refit
from .materials import PLAIN
from .mesh import Mesh
from .people import PlannedPerson
from .shading import RaycastWorld

BICYCLE_COLOURS = {
    TYRE: (0.02, 0.02, 0.02), RIM: (0.4, 0.4, 0.41), CRANK: (0.2, 0.2, 0.21),
    SADDLE: (0.03, 0.025, 0.02),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class PersonMesh:
    """Somebody's triangles and where they lie in the world's arrays.

    Attributes:
        person: whose they are.
        triangles: [T, 3] vertices, body and bicycle.
        parts: [T] what they belong to, see :func:`part_names`.
        order: [T] triangle at each place of the world's arrays from ``first`` on.
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
    """The people of a street in the arrays that rays are cast at.

    The arrays change with time, so whoever casts holds them by :meth:`at`.
    """

    world: RaycastWorld
    meshes: tuple[PersonMesh, ...]
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _now: list[float] = field(default_factory=list)

    @contextmanager
    def at(self, t_us: float) -> Iterator[RaycastWorld]:
        """The world with everybody in the pose of an instant [us]."""
        with self._lock:
            if self._now != [t_us]:
                for mesh in self.meshes:
                    self._move(mesh, mesh.person.vertices(np.array([t_us * 1e-6]))[0])
                self._now[:] = [t_us]
            yield self.world

    def over(self, times_us: Float) -> Iterator[RaycastWorld]:
        """The world at instants [T] [us], one after the other; to be used up."""
        with self._lock:
            self._now.clear()
            shapes = [mesh.person.vertices(times_us * 1e-6) for mesh in self.meshes]
            for i in range(len(times_us)):
                for mesh, vertices in zip(self.meshes, shapes, strict=True):
                    self._move(mesh, vertices[i])
                yield self.world

    def roots(self) -> NDArray[np.int64]:
        """Root node [P] of everybody's hierarchy."""
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
    """Put people behind the world's other meshes; ``paints`` gets their colours."""
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
    """Triangles [T, 3] and what each belongs to [T], see :func:`part_names`."""
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
