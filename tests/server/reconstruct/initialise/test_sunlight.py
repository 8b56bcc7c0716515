"""The sun of a log, from the shadows of its moving vehicles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.reconstruct.initialise.sunlight import fit_sunlight
from real2sim_server.reconstruct.initialise.vehicle_body import fitted_body
from real2sim_server.scene import Ground
from real2sim_server.synthetic import SyntheticConfig, generate_log
from real2sim_server.synthetic.sensors import SUN


@pytest.fixture(scope="module")
def street():
    config = SyntheticConfig(
        frames=16, hz=4, width=240, height=160, samples=1, moving_cars=6, lidar_beams=0
    )
    return generate_log(config)


@pytest.fixture(scope="module")
def ground():
    return Ground(
        np.array([-100.0, -100.0]), 1.0, np.zeros((300, 200), np.float32), np.ones((300, 200), bool)
    )


def shapes(log) -> list[np.ndarray]:
    nothing = np.zeros((0, 3), np.float32)
    bodies = [fitted_body(nothing, track.size, track.category) for track in log.tracks]
    return [nothing if body is None else body.points.astype(np.float32) for body in bodies]


def test_shadows_of_moving_vehicles_give_the_sun(street, ground):
    found = fit_sunlight(street, ground, shapes(street))

    assert found.towards @ SUN / np.linalg.norm(SUN) > np.cos(np.deg2rad(4))
    assert (found.shade > 0.35).all()
    assert (found.shade < 0.75).all()
    # Shadows are blue: they get the light of the sky.
    assert (np.diff(found.shade) > 0).all()


def test_a_log_without_moving_vehicles_has_no_sun(street, ground):
    parked = tuple(track for track in street.tracks if not track.trajectory.moves)

    for tracks in (parked, ()):
        still = replace(street, tracks=tracks)
        assert fit_sunlight(still, ground, shapes(still)) is None


def test_an_overcast_log_has_no_sun(street, ground):
    class Flat:
        def image(self, camera, frame):
            rng = np.random.default_rng(frame)
            return rng.integers(90, 130, (160, 240, 3)).astype(np.uint8)

    overcast = replace(street, source=Flat())
    assert fit_sunlight(overcast, ground, shapes(overcast)) is None
