from __future__ import annotations

import numpy as np

from real2sim_server.reconstruct.initialise.points import PointSet
from real2sim_server.reconstruct.initialise.vehicle_body import (
    GLASS,
    RED_LAMP,
    TYRE,
    faced,
    fitted_body,
)

from ..conftest import painted_log

SALOON, ESTATE = (4.7, 1.82, 1.46), (4.65, 1.84, 1.68)


def near(body, place) -> np.ndarray:
    """Colour of the part nearest to a place; nan for paint."""
    colour, is_part = body.part_colours(np.array([place], np.float32))
    return colour[0] if is_part[0] else np.full(3, np.nan)


def test_measured_points_choose_the_shape_of_a_car():
    wagon = fitted_body(np.zeros((0, 3), np.float32), ESTATE, "car")
    rear = wagon.points[wagon.points[:, 0] < -1.0].astype(np.float32)
    # In a box as long and as low as a saloon's, still its own roof line.
    squeezed = (rear * np.array(SALOON) / ESTATE).astype(np.float32)
    found = fitted_body(squeezed, SALOON, "car")
    other = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    behind = np.array([-0.44 * SALOON[0], 0, 0.4 * SALOON[2]])
    gap = [np.linalg.norm(b.points - behind, axis=1).min() for b in (found, other)]
    assert gap[0] < 0.15 < gap[1]


def test_glass_tyres_and_lamps_are_no_paint():
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    np.testing.assert_allclose(near(body, (0.3, 0.75, 0.35)), GLASS, atol=1e-6)
    np.testing.assert_allclose(near(body, (0.3 * 4.7, 0.9, -0.45 + 0.02)), TYRE, atol=0.5)
    np.testing.assert_allclose(near(body, (-2.3, 0.75, 0.0)), RED_LAMP, atol=1e-6)
    assert np.isnan(near(body, (0.0, 0.9, -0.1))).all()


def test_other_categories_and_odd_boxes_have_no_body():
    assert fitted_body(np.zeros((0, 3), np.float32), (0.6, 0.6, 1.7), "pedestrian") is None
    assert fitted_body(np.zeros((0, 3), np.float32), (9.0, 1.8, 1.5), "car") is None


def test_a_body_fills_where_nothing_was_measured():
    from real2sim_server.reconstruct.initialise.object_shape import complete_body

    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    tail = body.points[body.points[:, 0] < -2.2]
    measured = PointSet.measured(tail, np.full(len(tail), 0.3, np.float32))
    completed = complete_body(measured, SALOON, "car", body=body)
    ahead = completed.points[completed.points[:, 0] > 0]
    assert len(ahead) > 1000
    assert np.abs(ahead[:, 1]).max() < SALOON[1] / 2


def test_of_a_box_ahead_only_the_side_towards_the_camera_is_faced():
    log = painted_log()
    track = log.tracks[0]
    half = np.array(track.size) / 2
    points = np.array([[-half[0], 0, 0], [0, half[1], 0], [half[0], 0, 0], [0, 0, half[2]]])
    normals = np.array([[-1.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]])
    found = faced(log, track, points, normals, [log.frame_count // 2])
    assert found.tolist() == [True, False, False, False]
