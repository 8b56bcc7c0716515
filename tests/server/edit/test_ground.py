from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from real2sim_server.edit.ground import RecordedGround
from real2sim_server.geometry.rotation import yaw_quaternion
from real2sim_server.scene import Trajectory

LEVEL = np.tile([1.0, 0, 0, 0], (50, 1))


def path(slope: float = 0.0) -> Trajectory:
    x = np.linspace(0, 49, 50)
    positions = np.stack([x, np.zeros(50), slope * x], axis=1)
    pitch = -np.arctan(slope) / 2
    turned = np.tile([np.cos(pitch), 0, np.sin(pitch), 0], (50, 1))
    return Trajectory(np.arange(50) * 100_000, positions, turned)


def box(x: float, y: float, bottom: float) -> SimpleNamespace:
    track = Trajectory(np.array([0]), np.array([[x, y, bottom + 0.75]]), yaw_quaternion(0.3)[None])
    return SimpleNamespace(size=(4.0, 2.0, 1.5), trajectory=track)


def test_a_hill_rises_beside_the_path_as_on_it():
    ground = RecordedGround.of(path(slope=0.1), [])

    heights = ground(np.array([[10.0, 0], [30.0, 0], [30.0, 5.0]]))
    np.testing.assert_allclose(heights, [1, 3, 3], atol=1e-6)


def test_boxes_tell_of_a_raised_pavement_beside_the_road():
    kerb = [box(x, 6.0, 0.15) for x in (10, 15, 20, 25)]
    ground = RecordedGround.of(path(), kerb)

    on_road, on_pavement = ground(np.array([[17.0, 0.0], [17.0, 6.5]]))
    assert abs(on_road) < 0.03
    assert 0.1 < on_pavement < 0.16


def test_what_hangs_in_the_air_tells_nothing():
    ground = RecordedGround.of(path(), [box(20, 4, 3.0)])

    np.testing.assert_allclose(ground(np.array([[20.0, 4.0]])), 0, atol=1e-9)


def test_far_from_everything_the_rim_holds():
    tilted = RecordedGround(
        path=np.array([[0.0, 0, 0]]),
        normals=np.array([[0.0, -0.1, 0.995]]) / np.hypot(0.1, 0.995),
        spots=np.zeros((0, 2)),
        offsets=np.zeros(0),
    )
    heights = tilted(np.array([[0.0, 10], [0.0, 1000]]))

    np.testing.assert_allclose(heights[1], heights[0])


def test_many_points_give_the_same_bits_as_few():
    ground = RecordedGround.of(path(0.05), [box(10, 5, 0.6)])
    points = np.random.default_rng(0).uniform(-5, 55, (700, 2))

    assert (ground(points)[300:320] == ground(points[300:320])).all()
