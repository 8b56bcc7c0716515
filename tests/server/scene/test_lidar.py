"""LiDAR definitions: beams, catalogue and validation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.scene import Beams, Detection, Lidar, LidarError
from real2sim_server.scene.range_sensors import (
    MAX_RAYS,
    MAX_SLOTS,
    catalogue_lidar,
    find_lidar,
    lidar_from_values,
    lidar_names,
    read_lidar,
)

BEAMS = {"kind": "spinning", "elevation_deg": [-5.0, 0.0, 5.0], "columns": 8}


def test_a_spinning_sensor_faces_ahead_at_its_timestamp() -> None:
    beams = Beams.spinning([0.0], columns=1000, rate_hz=10.0)
    ahead = np.abs(beams.azimuth[0]).argmin()
    assert abs(beams.time_us[0, ahead]) < 60
    assert beams.time_us.min() == pytest.approx(-49_950)
    # Clockwise: the left side is seen before the front.
    assert beams.time_us[0, np.abs(beams.azimuth[0] - np.pi / 2).argmin()] < -24_000


def test_azimuth_offsets_shift_rows() -> None:
    beams = Beams.spinning([0.0, 0.1], columns=8, azimuth_offset=[0.0, 0.05])
    assert np.allclose(beams.azimuth[1] - beams.azimuth[0], 0.05)


def test_directions_have_unit_length() -> None:
    assert np.allclose(np.linalg.norm(catalogue_lidar("rosette").beams.directions, axis=-1), 1)


def test_firing_times_are_quantised_to_slots() -> None:
    times = np.linspace(-50_000, 50_000, 5000)
    instants, slots = Beams(np.zeros(5000), np.zeros(5000), times).slots
    assert len(instants) == MAX_SLOTS
    assert np.abs(instants[slots] - times).max() <= 0.5 * 100_000 / MAX_SLOTS + 1e-6


@pytest.mark.parametrize("name", lidar_names())
def test_every_catalogue_lidar_has_a_source(name: str) -> None:
    lidar = catalogue_lidar(name)
    assert lidar.name == name
    assert lidar.source
    assert 10_000 <= lidar.beams.count <= MAX_RAYS


def test_the_catalogue_has_common_sensors() -> None:
    wanted = {"hdl-64e", "vlp-16", "vlp-32c", "pandar64", "os1-128", "waymo-top"}
    assert wanted | {"solid-state", "rosette"} <= set(lidar_names())
    assert catalogue_lidar("pandar64").shape == (64, 1800)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(LidarError, match=r"no LiDAR 'hdl64'.*hdl-64e.*vlp-16"):
        find_lidar("hdl64")


def test_a_user_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"name": "mine", "beams": BEAMS, "range_m": [1, 50]}))
    lidar = find_lidar(str(file))
    assert (lidar.name, lidar.shape, lidar.max_range) == ("mine", (3, 8), 50.0)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"beams": {**BEAMS, "elevation_deg": [float("nan")]}}, "elevation_deg.*finite"),
        ({"beams": {**BEAMS, "columns": 1_000_000}}, "3 rows of 1,000,000 columns; allowed"),
        ({"beams": {**BEAMS, "columns": 0}}, "allowed are 1 to"),
        ({"beams": {**BEAMS, "azimuth_offset_deg": [1.0]}}, "1 azimuth_offset_deg for 3"),
        ({"beams": {**BEAMS, "elevation_deg": [95.0]}}, "allowed are -90 to 90"),
        ({"beams": {**BEAMS, "rate_hz": 0}}, "rate_hz must be from 0.1"),
        ({"beams": {"kind": "wheel"}}, "beams.*spinning"),
        ({"range_m": [50, 1]}, "must be below max_range"),
        ({"divergence_mrad": [900, 0]}, "divergence must be from 0"),
        ({"returns": 4}, "returns must be 1, 2 or 3"),
        ({"colour": "red"}, "colour"),
        ({"T_vehicle_lidar": [[1, 0, 0, 0]]}, "four rows of four"),
    ],
)
def test_invalid_lidars_are_refused_with_the_reason(values: dict[str, object], reason: str) -> None:
    with pytest.raises(LidarError, match=reason):
        lidar_from_values({"name": "bad", "beams": BEAMS, **values})


def test_tables_of_different_lengths_are_refused() -> None:
    table = {"kind": "table", "azimuth_deg": [0, 1], "elevation_deg": [0], "time_us": [0, 1]}
    with pytest.raises(LidarError, match="one shape"):
        lidar_from_values({"name": "bad", "beams": table})


def test_a_file_that_is_not_json_is_named(tmp_path: Path) -> None:
    file = tmp_path / "broken.json"
    file.write_text("{")
    with pytest.raises(LidarError, match=r"broken\.json: no readable JSON"):
        read_lidar(file)


def test_a_million_rays_are_refused() -> None:
    zeros = np.zeros(1_000_000)
    with pytest.raises(LidarError, match=r"1,000,000 rays; allowed are 1 to"):
        Beams(zeros, zeros, zeros)


def test_non_finite_values_are_counted() -> None:
    with pytest.raises(LidarError, match="2 of 3 values of elevation are not finite"):
        Beams(np.zeros(3), np.array([0, np.nan, np.inf]), np.zeros(3))


def test_a_non_rigid_pose_is_refused() -> None:
    with pytest.raises(LidarError, match="not a rigid transform"):
        Lidar("x", Beams.spinning([0.0], columns=4), np.full((4, 4), np.nan))


def test_a_detector_out_of_range_is_refused() -> None:
    with pytest.raises(LidarError, match="detection reflectivity must be from"):
        Detection(reflectivity=2.0)
