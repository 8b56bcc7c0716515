"""What backends on blocks find near: the same distances as kernels have."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.physics import Box, HeightField, Plane
from real2sim_server.physics.backends.base import pack_colliders
from real2sim_server.physics.backends.layout import distances
from real2sim_server.physics.contact.collider_distance import collider_distance

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
def test_distances_of_many_points_are_those_of_each(collider):
    flat = HeightField(name="flat", heights=np.zeros((3, 3)))
    rows, heights = pack_colliders([flat, collider], 0.1)
    points = np.random.default_rng(1).uniform(-2, 2, (60, 3))
    each = [collider_distance(rows[1], heights, *p)[0] for p in points]
    assert min(each) < 0 < max(each)
    assert distances(rows[1], heights, points) == pytest.approx(np.array(each), abs=1e-12)
