"""LiDAR detection: noise, losses and velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.render.cast import CastRequest, Echo, detect
from real2sim_server.render.cast.sensors import drop_probability, normal, uniform
from real2sim_server.render.types import Instance
from real2sim_server.scene import Beams, Detection, GaussianCloud, Lidar

ROWS, COLUMNS = 8, 512


def lidar(**changes: object) -> Lidar:
    beams = Beams.spinning(np.radians(np.linspace(-5, 5, ROWS)), columns=COLUMNS)
    sensor = Lidar("any", beams, detection=Detection(softness=1e-3), max_range=200.0)
    return replace(sensor, **changes)  # type: ignore[arg-type]


def echo(distance: float, intensity: float = 0.8) -> Echo:
    def filled(value: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return np.full((ROWS, COLUMNS), value, np.float32)

    return Echo(
        range=filled(distance),
        expected=filled(distance),
        opacity=filled(1),
        intensity=filled(intensity),
        drop=filled(0),
        instance=np.ones((ROWS, COLUMNS), np.uint16),
        member=np.zeros((ROWS, COLUMNS), np.int32),
    )


def test_noise_has_the_standard_deviation_of_the_sensor() -> None:
    sweep = detect(echo(20.0), lidar(range_noise=0.03))
    assert sweep.hit.all()
    assert np.std(sweep.range) == pytest.approx(0.03, rel=0.05)
    assert np.mean(sweep.range) == pytest.approx(20.0, abs=2e-3)


def test_noise_depends_only_on_the_seed() -> None:
    sensor = lidar(range_noise=0.03)
    first, again, other = (detect(echo(20.0), sensor, seed=seed).range for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_draws_of_a_ray_do_not_depend_on_other_rays() -> None:
    assert np.array_equal(uniform(3, 1000, 0)[:10], uniform(3, 10, 0))
    assert np.array_equal(normal(3, 1000)[:10], normal(3, 10))


def test_a_surface_at_the_range_limit_is_lost_half_of_the_time() -> None:
    sensor = lidar(detection=Detection(range_m=100.0, reflectivity=0.1))
    assert np.allclose(drop_probability(echo(100.0, 0.1), sensor), 0.5, atol=1e-3)


def test_power_falls_with_the_square_of_the_distance() -> None:
    sensor = lidar(detection=Detection(range_m=100.0, reflectivity=0.1, softness=1e-3))
    assert detect(echo(49.0, 0.025), sensor).hit.all()
    assert not detect(echo(51.0, 0.025), sensor).hit.any()


def test_sensor_loss_is_added() -> None:
    sensor = lidar(detection=Detection(loss=0.2))
    assert detect(echo(5.0), sensor).hit.mean() == pytest.approx(0.8, abs=0.03)


def test_lost_returns_have_no_values() -> None:
    sweep = detect(echo(5.0), lidar(detection=Detection(loss=1.0)))
    assert not sweep.hit.any()
    for values in (sweep.range, sweep.intensity, sweep.instance, sweep.points):
        assert not values.any()


def test_points_lie_along_their_rays() -> None:
    sweep = detect(echo(20.0), lidar())
    assert np.allclose(np.linalg.norm(sweep.points, axis=-1), sweep.range, rtol=1e-5)


def test_moving_objects_have_their_velocity() -> None:
    sensor = lidar()
    seconds = sensor.beams.slots[0] * 1e-6
    poses = np.broadcast_to(np.eye(4), (len(seconds), 4, 4)).copy()
    poses[:, 0, 3] = 10 + 7 * seconds
    one = GaussianCloud(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.ones(1, 3),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )
    still = np.broadcast_to(np.eye(4), (len(seconds), 4, 4))
    request = CastRequest((Instance(one),), sensor, still, (poses,), (None,))
    sweep = detect(echo(20.0), sensor, request=request)
    assert sweep.velocity is not None
    assert np.allclose(sweep.velocity[sweep.hit], [7, 0, 0], atol=1e-3)
