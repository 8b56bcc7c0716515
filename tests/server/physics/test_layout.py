"""What block-based backends consider near: the same distances as in the kernels."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import Box, Capsule, Cylinder, HeightField, Plane, TriangleMesh
from real2sim_server.physics.backends.layout import distances
from real2sim_server.physics.contact import collider_distance
from real2sim_server.physics.model import pack_colliders

from .shapes import half_pipe

TURNED = np.array([[0.6, -0.8, 0, 1.0], [0.8, 0.6, 0, -0.5], [0, 0, 1, 0.2], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    "collider",
    [
        Plane(name="slope", point=(0, 0, 0.3), normal=(0.3, 0, 1)),
        Box(name="box", T_world_box=TURNED, size=(0.5, 3.0, 1.0)),
        HeightField(
            name="hills",
            heights=np.sin(np.arange(42.0)).reshape(6, 7),
            origin=(-1.0, -1.5),
            spacing=0.4,
        ),
    ],
    ids=lambda c: c.name,
)
def test_batched_distances_equal_single_ones(collider):
    flat = HeightField(name="flat", heights=np.zeros((3, 3)))
    rows, heights = pack_colliders([flat, collider], 0.1)
    points = np.random.default_rng(1).uniform(-2, 2, (60, 3))
    each = [collider_distance(rows[1], heights, *p)[0] for p in points]
    assert min(each) < 0 < max(each)
    found = distances(collider, rows[1], heights, points)
    assert found == pytest.approx(np.array(each), abs=1e-12)


@pytest.mark.parametrize(
    "solid",
    [
        Cylinder(name="post", T_world_cylinder=TURNED, radius=0.3, height=1.5),
        Capsule(name="rod", T_world_capsule=TURNED, radius=0.3, length=1.5),
        TriangleMesh(name="pipe", T_world_mesh=TURNED, surface=half_pipe(0.8, 1.5)),
    ],
    ids=lambda c: c.name,
)
def test_solids_are_never_nearer_than_the_search_distance(solid):
    rows, data = pack_colliders([solid], 0.1)
    points = np.random.default_rng(1).uniform(-2, 2, (60, 3))
    each = np.array([collider_distance(rows[0], data, *p)[0] for p in points])
    assert (distances(solid, rows[0], data, points) <= each + 1e-12).all()
