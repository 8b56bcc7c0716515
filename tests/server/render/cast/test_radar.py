"""Radar detections in cases with known results."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.conventions import SEMANTIC_CLASSES
from real2sim_proto.sensors import RadarModel
from real2sim_server.render.cast.sensors import (
    CLUTTER_KIND,
    GHOST_KIND,
    REFERENCE_RCS,
    Patches,
    patch_rcs,
    poisson,
    radar_detections,
)
from real2sim_server.scene import Radar

EXACT = {"range_noise_m": 0, "azimuth_noise_deg": 0, "velocity_noise_mps": 0, "clutter_rate": 0}
CAR = SEMANTIC_CLASSES["car"]


def radar(**model):
    return Radar("front", RadarModel(**EXACT | model), np.eye(4))


def patches(*targets, semantic=CAR, incidence=0.0):
    """One patch for each (range, azimuth [deg], velocity)."""
    values = np.array(targets, dtype=float).reshape(-1, 3).T
    count = values.shape[1]
    return Patches(
        range=values[0],
        azimuth=np.radians(values[1]),
        elevation=np.zeros(count),
        velocity=values[2],
        incidence=np.full(count, incidence),
        semantic=np.full(count, semantic, np.uint8),
        instance=np.arange(1, count + 1, dtype=np.uint16),
    )


NEAR = (8.1, 0.3, -12.0)


def test_a_target_has_its_range_azimuth_and_velocity():
    found = radar_detections(patches(NEAR), radar())
    assert len(found) == 1
    assert found.range[0] == pytest.approx(8.1)
    assert np.degrees(found.azimuth[0]) == pytest.approx(0.3)
    assert found.velocity[0] == pytest.approx(-12.0)
    np.testing.assert_allclose(np.linalg.norm(found.points, axis=1), found.range)


@pytest.mark.parametrize(
    ("other", "count"),
    [
        ((8.15, 0.3, -12.0), 1),  # in the same cell
        ((9.1, 0.3, -12.0), 2),  # separated in range
        ((8.1, 2.3, -12.0), 2),  # separated in azimuth
        ((8.1, 0.3, -11.5), 2),  # separated in velocity only
    ],
)
def test_resolution_separates_or_merges_two_targets(other, count):
    found = radar_detections(patches(NEAR, other), radar())
    assert len(found) == count


def test_merged_targets_add_their_power_and_average_their_range():
    one = radar_detections(patches(NEAR), radar())
    two = radar_detections(patches(NEAR, (8.15, 0.3, -12.0)), radar())
    assert two.rcs[0] - one.rcs[0] == pytest.approx(3.0, abs=0.1)
    assert 8.1 < two.range[0] < 8.15


def test_rcs_falls_with_incidence_to_a_floor():
    angles = np.radians([0.0, 5.0, 10.0, 20.0, 40.0, 80.0])
    values = [patch_rcs(patches(NEAR, incidence=a), 1e-4)[0] for a in angles]
    assert all(np.diff(values) < 0)
    assert values[0] / values[-1] == pytest.approx(12.5, rel=0.01)


def test_rcs_depends_on_the_class():
    of = {
        name: patch_rcs(patches(NEAR, semantic=SEMANTIC_CLASSES[name]), 1e-4)[0]
        for name in ("truck", "car", "person", "ground")
    }
    assert of["truck"] > of["car"] > of["person"] > of["ground"]


def test_a_reference_target_is_detected_up_to_the_detection_range():
    sensor = radar(detection_range_m=100.0)
    solid = sensor.solid_angle

    def target(distance):
        # Enough patches in one cell to reach the reference RCS.
        one = patch_rcs(patches((distance, 0.3, 0.0)), solid)[0]
        return patches(*[(distance, 0.3, 0.0)] * round(REFERENCE_RCS / one))

    assert len(radar_detections(target(90.1), sensor)) == 1
    assert len(radar_detections(target(110.1), sensor)) == 0
    found = radar_detections(target(90.1), sensor)
    assert found.rcs[0] == pytest.approx(10.0, abs=0.5)
    assert found.snr[0] == pytest.approx(40 * np.log10(100 / 90.1), abs=0.5)


def test_targets_below_the_minimum_rcs_are_not_reported():
    near = patches((2.1, 0.3, -12.0))
    assert len(radar_detections(near, radar(min_rcs_dbsm=-40))) == 1
    assert len(radar_detections(near, radar(min_rcs_dbsm=-20))) == 0


def test_velocities_beyond_the_maximum_are_aliased():
    found = radar_detections(patches((8.1, 0.3, -25.0)), radar(max_velocity_mps=20.0))
    assert found.velocity[0] == pytest.approx(15.0)


def test_clutter_is_poisson_and_depends_on_the_seed():
    sensor, nothing = radar(clutter_rate=3.0), patches()
    counts = [len(radar_detections(nothing, sensor, seed=k)) for k in range(400)]
    assert np.mean(counts) == pytest.approx(3.0, abs=0.3)
    assert np.var(counts) == pytest.approx(3.0, abs=0.8)
    first, again = (radar_detections(nothing, sensor, seed=7) for _ in range(2))
    np.testing.assert_array_equal(first.points, again.points)
    assert set(first.kind) <= {CLUTTER_KIND}
    assert len(radar_detections(nothing, radar())) == 0


def test_ghosts_are_optional_and_appear_at_twice_the_range():
    assert set(radar_detections(patches(NEAR), radar()).kind) == {0}
    found = radar_detections(patches(NEAR), radar(ghost_rate=1.0))
    ghost = found.kind == GHOST_KIND
    assert found.range[ghost] == pytest.approx([16.2])
    assert found.velocity[ghost] == pytest.approx([-24.0])


def test_range_noise_matches_the_model_and_is_reproducible():
    sensor = radar(range_noise_m=0.1, velocity_resolution_mps=0.02, detection_range_m=500.0)
    many = patches(*[(30.1, 0.3, 0.05 * k) for k in range(300)])
    found = radar_detections(many, sensor, seed=3)
    assert np.std(found.range - 30.1) == pytest.approx(0.1, abs=0.02)
    again = radar_detections(many, sensor, seed=3)
    np.testing.assert_array_equal(found.range, again.range)


def test_poisson_draws_at_both_ends_of_the_rate():
    assert poisson(0.0, 0.999) == 0
    assert poisson(5000.0, 0.5) == pytest.approx(5000, abs=2)
