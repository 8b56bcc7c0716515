from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from real2sim_server.reconstruct.initialise.accumulate import PointSet
from real2sim_server.reconstruct.initialise.vehicle_body import (
    FINE_SPACING,
    body_colours,
    faced,
    fitted_body,
)
from real2sim_server.reconstruct.initialise.vehicle_parts import LIGHT, Part, wheel_parts
from real2sim_server.scene import GaussianCloud
from real2sim_server.scene.cloud import SH_C0
from real2sim_server.synthetic.vehicles import SHAPES

from ..conftest import painted_log

SALOON, ESTATE = (4.7, 1.82, 1.46), (4.65, 1.84, 1.68)


def near(body, place) -> Part:
    """The part nearest to a position."""
    return Part(body.parts_near(np.array([place], np.float32))[1][0])


def painted(scene, body, points, colours):
    """Colours of a body for a vehicle with these points, in even light."""
    count = len(points)
    cloud = GaussianCloud(
        torch.as_tensor(points, dtype=torch.float32),
        torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        torch.full((count, 3), 0.05),
        torch.full((count,), 0.9),
        (torch.as_tensor(colours, dtype=torch.float32)[:, None] - 0.5) / SH_C0,
    )
    item = replace(next(iter(scene.objects.values())), cloud=cloud)
    even = {"reconstruction": {LIGHT: [0.0, 0.0, 0.0]}}
    return body_colours(body, item, replace(scene, provenance=even, content_hash=""))


def test_measured_points_determine_the_car_shape():
    wagon = fitted_body(np.zeros((0, 3), np.float32), ESTATE, "car")
    rear = wagon.points[wagon.points[:, 0] < -1.0].astype(np.float32)
    # Squeezed into a saloon's box, the rear keeps its estate roof line.
    squeezed = (rear * np.array(SALOON) / ESTATE).astype(np.float32)
    found = fitted_body(squeezed, SALOON, "car")
    other = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    behind = np.array([-0.44 * SALOON[0], 0, 0.4 * SALOON[2]])
    gap = [np.linalg.norm(b.points - behind, axis=1).min() for b in (found, other)]
    assert gap[0] < 0.15 < gap[1]


def test_glass_tyres_and_lamps_are_separate_parts():
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    assert near(body, (0.3, 0.75, 0.35)) is Part.GLASS
    assert near(body, (0.3 * 4.7, 0.9, -0.73 + 0.03)) is Part.TYRE
    assert near(body, (-2.3, 0.75, 0.0)) is Part.RED_LAMP
    assert near(body, (0.0, 0.9, -0.1)) is Part.PAINT


def test_side_windows_have_dark_pillars():
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    window = (body.points[:, 1] > 0.6) & (np.abs(body.points[:, 2] - 0.36) < 0.1)
    along = np.round(body.points[window, 0] / 0.1) * 0.1
    dark = [(body.parts[window][along == x] == Part.TRIM).mean() for x in np.unique(along)]
    inner = np.unique(along)
    pillars = [x for x, share in zip(inner, dark, strict=True) if share > 0.3 and -1.2 < x < 0.6]
    # Two pillars, at one and two thirds of the glass.
    glass = np.array([-0.31, 0.19]) * SALOON[0]
    for k in (1, 2):
        assert np.abs(np.array(pillars) - (glass[0] + k * np.diff(glass)[0] / 3)).min() < 0.1


def test_wheels_have_a_tyre_and_a_rim_with_spokes():
    angle = np.linspace(0, 2 * np.pi, 200)
    ring = wheel_parts(0.45 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    changes = (ring != np.roll(ring, 1)).sum()
    assert changes == 10
    assert set(wheel_parts(np.array([[0.9, 0.0], [0.0, 0.1]]))) == {Part.TYRE, Part.RIM}


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
def test_normals_point_outwards(shape):
    body = fitted_body(np.zeros((0, 3), np.float32), shape.size, shape.category)
    outer = body.points / (np.array(shape.size) / 2)
    # Surfaces on the outside of the box, away from its edges, face outwards.
    on_side = (np.abs(outer[:, 1]) > 0.93) & (np.abs(outer[:, 2]) < 0.5)
    wheel = (body.parts == Part.TYRE) | (body.parts == Part.RIM)
    hub = wheel & (np.abs(outer[:, 1]) > 0.95)
    assert on_side.sum() > 100
    assert (np.sign(body.normals[on_side, 1]) == np.sign(outer[on_side, 1])).mean() > 0.9
    assert (np.sign(body.normals[hub, 1]) == np.sign(outer[hub, 1])).mean() > 0.9


def test_sparse_wide_discs_leave_no_gaps():
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    drawn = body.drawn > 0
    assert drawn.mean() < 0.65
    np.testing.assert_allclose(np.unique(body.drawn[drawn]), [0.033, 0.05, 0.12])
    distance = cKDTree(body.points[drawn]).query(body.points)[0]
    assert distance.max() < 0.15
    # All points are drawn where parts meet, to keep edges sharp.
    lamp = body.parts == Part.RED_LAMP
    assert (drawn & (body.drawn <= np.float32(0.05)))[lamp].mean() > 0.7


def test_truck_cargo_has_its_own_colour(tiny_scene):
    truck = next(s for s in SHAPES if s.category == "truck")
    body = fitted_body(np.zeros((0, 3), np.float32), truck.size, "truck")
    behind, ahead = (-0.15 * truck.size[0], 1.19, 0.5), (0.31 * truck.size[0], 1.1, -0.5)
    assert near(body, behind) is Part.CARGO
    assert near(body, ahead) is Part.PAINT
    points = body.points.astype(np.float32)
    shown = np.where((body.parts == Part.CARGO)[:, None], (0.6, 0.1, 0.1), (0.1, 0.1, 0.6))
    colours = painted(tiny_scene, body, points, shown)
    for part, paint in ((Part.CARGO, (0.6, 0.1, 0.1)), (Part.PAINT, (0.1, 0.1, 0.6))):
        mine = colours[body.parts == part]
        np.testing.assert_allclose(mine, np.tile(paint, (len(mine), 1)), atol=0.02)


def test_the_dark_underside_does_not_affect_the_paint(tiny_scene):
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    few = body.points[body.is_paint][::40].astype(np.float32)
    plate = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * (2.2, 0.8, 0) - (0, 0, 1.2)
    colours = np.concatenate([np.full((len(few), 3), 0.6), np.full((len(plate), 3), 0.05)])
    found = painted(tiny_scene, body, np.concatenate([few, plate]), colours)
    np.testing.assert_allclose(found[body.is_paint], 0.6, atol=0.02)


def test_other_categories_and_unusual_boxes_have_no_body():
    assert fitted_body(np.zeros((0, 3), np.float32), (0.6, 0.6, 1.7), "pedestrian") is None
    assert fitted_body(np.zeros((0, 3), np.float32), (9.0, 1.8, 1.5), "car") is None


def test_a_body_fills_unmeasured_parts():
    from real2sim_server.reconstruct.initialise.vehicle_body import complete_body

    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    tail = body.points[body.points[:, 0] < -2.2]
    measured = PointSet.measured(tail, np.full(len(tail), 0.3, np.float32))
    completed = complete_body(measured, SALOON, "car", body=body)
    ahead = completed.points[completed.points[:, 0] > 0]
    assert len(ahead) > 1000
    assert np.abs(ahead[:, 1]).max() < SALOON[1] / 2


def test_only_surfaces_towards_the_camera_are_faced():
    log = painted_log()
    track = log.tracks[0]
    half = np.array(track.size) / 2
    points = np.array([[-half[0], 0, 0], [0, half[1], 0], [half[0], 0, 0], [0, 0, half[2]]])
    normals = np.array([[-1.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]])
    found = faced(log, track, points, normals, [log.frame_count // 2])
    assert found.tolist() == [True, False, False, False]


def test_borders_of_parts_are_drawn_finer_than_the_middle_of_a_door():
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    flank = np.abs(body.unit_normals()[:, 1]) > 0.7
    drawn, paint = flank & (body.drawn > 0), body.parts == Part.PAINT
    to_other, _ = cKDTree(body.points[body.parts != Part.PAINT]).query(body.points)
    beside, apart = drawn & paint & (to_other < 0.03), drawn & paint & (to_other > 0.15)
    np.testing.assert_allclose(body.drawn[beside], FINE_SPACING)
    assert (body.drawn[apart] > FINE_SPACING).all()
    assert beside.sum() > 100 < apart.sum()
