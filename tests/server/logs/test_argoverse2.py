from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from real2sim_server.datasets.labels import points_in_boxes
from real2sim_server.geometry import apply_transform
from real2sim_server.logs import DrivingLog, open_log
from real2sim_server.synthetic import SyntheticLog

from .reader_contract import told_about


@pytest.fixture(scope="module")
def log(written_argoverse2: Path) -> DrivingLog:
    return open_log(written_argoverse2)


@pytest.fixture(scope="module")
def sample(test_data: Path) -> DrivingLog:
    path = test_data / "argoverse2"
    if not path.is_dir():
        pytest.skip(f"no sample drive at {path}")
    return open_log(path)


@pytest.fixture
def folder(written_argoverse2: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_argoverse2, tmp_path / "log"))


def test_poses_are_shifted_to_the_ground(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    np.testing.assert_allclose(log.ego.positions, tiny_log.ego.positions, atol=1e-9)
    for name, given in (("ring_front_center", "front"), ("ring_front_left", "front_left")):
        np.testing.assert_allclose(log.rig[name].K, tiny_log.rig[given].K, atol=1e-9)
        np.testing.assert_allclose(
            log.rig[name].T_vehicle_camera, tiny_log.rig[given].T_vehicle_camera, atol=1e-9
        )


def test_boxes_have_their_poses(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    names = log.provenance["track_ids"]
    read = {names[t.object_id]: t for t in log.tracks}
    shift = int(log.frame_times_us[0])
    for track in tiny_log.tracks:
        assert read[track.object_id].size == pytest.approx(track.size)
        for t_us in tiny_log.frame_times_us.tolist():
            np.testing.assert_allclose(
                read[track.object_id].trajectory.transform(t_us + shift),
                track.trajectory.transform(t_us),
                atol=1e-8,
            )


def test_points_round_trip_within_half_precision(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    read, given = log.lidar(1), tiny_log.lidar(1)
    np.testing.assert_allclose(read.points, given.points, rtol=6e-4, atol=6e-4)
    assert (read.offset_us == given.offset_us + 50_000).all()


def test_camera_without_images_is_omitted_and_named(log: DrivingLog) -> None:
    (told,) = log.left_out["cameras"]
    assert "ring_rear_left" in told
    assert log.rig.names == ("ring_front_center", "ring_front_left")


def test_a_frame_may_lack_an_image(folder: Path) -> None:
    _images(folder)[0].unlink()
    log = open_log(folder)
    assert log.frame_count == 3
    assert log.absent_images == {("ring_front_center", 0)}


def test_nearest_image_is_used_with_its_time(folder: Path) -> None:
    path = _images(folder)[1]
    path.rename(path.with_stem(str(int(path.stem) + 17_000_000)))
    log = open_log(folder)
    assert log.image_time_us("ring_front_center", 1) == log.frame_times_us[1] + 17_000
    assert log.image_time_us("ring_front_left", 1) == log.frame_times_us[1]


def test_sample_has_its_points_in_every_box(sample: DrivingLog, test_data: Path) -> None:
    """Point counts match ``num_interior_pts`` of the data set."""
    path = next((test_data / "argoverse2").glob("*/annotations.feather"))
    rows = feather.read_table(path).to_pylist()
    names = {key: object_id for object_id, key in sample.provenance["track_ids"].items()}
    tracks = {t.object_id: t for t in sample.tracks}
    sums = []
    for frame, t_us in enumerate(sample.frame_times_us.tolist()):
        to_world = sample.ego.transform(t_us)
        points = apply_transform(to_world, sample.lidar(frame).points.astype(np.float64))
        here = [r for r in rows if r["timestamp_ns"] // 1000 == t_us]
        poses = [tracks[names[row["track_uuid"]]].trajectory.transform(t_us) for row in here]
        sizes = [[row["length_m"], row["width_m"], row["height_m"]] for row in here]
        counts = points_in_boxes(points, poses, sizes)
        assert counts == [r["num_interior_pts"] for r in here]
        sums.append(sum(counts))
    assert sums == [9399, 9289]


def test_sample_without_images_opens_for_lidar_and_boxes(sample: DrivingLog) -> None:
    assert sample.frame_count == 2
    assert len(sample.rig) == 0
    assert len(sample.left_out["cameras"]) == 7
    assert len(sample.lidar(1).points) > 90_000


def test_sample_road_is_at_zero(sample: DrivingLog) -> None:
    x, y, z = sample.lidar(0).points.T
    road = z[(np.hypot(x, y) < 10) & (np.abs(y) < 1.5) & (np.abs(z) < 0.4)]
    assert abs(np.median(road)) < 0.1


def _images(folder: Path) -> list[Path]:
    return sorted((folder / "sensors/cameras/ring_front_center").iterdir())


def _set(path: Path, column: str, row: int, value: object) -> None:
    table = feather.read_table(path)
    values = table.column(column).to_pylist()
    values[row] = value
    index = table.schema.get_field_index(column)
    changed = pa.array(values, table.schema.field(column).type)
    feather.write_feather(table.set_column(index, column, changed), str(path))


def _first_sweep(folder: Path) -> Path:
    return min((folder / "sensors/lidar").iterdir())


BAD_LOGS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no sweeps": (lambda f: shutil.rmtree(f / "sensors/lidar"), "sensors/lidar: holds no sweeps"),
    "sweep of another name": (
        lambda f: _first_sweep(f).rename(f / "sensors/lidar/first.feather"), "should be a time"
    ),
    "poses cut off": (
        lambda f: (f / "city_SE3_egovehicle.feather").write_bytes(b"ARROW1"),
        r"city_SE3_egovehicle\.feather: cannot be read",
    ),
    "pose not finite": (
        lambda f: _set(f / "city_SE3_egovehicle.feather", "tx_m", 1, float("nan")),
        r"city_SE3_egovehicle\.feather row 1: the pose is not finite",
    ),
    "poses too short": (
        lambda f: _set(f / "city_SE3_egovehicle.feather", "timestamp_ns", 2, 315966253660357500),
        r"city_SE3_egovehicle\.feather: ego poses cover",
    ),
    "box without size": (
        lambda f: _set(f / "annotations.feather", "width_m", 3, 0.0),
        r"annotations\.feather row 3: the box of .* needs a positive length",
    ),
    "box not finite": (
        lambda f: _set(f / "annotations.feather", "tz_m", 3, float("inf")),
        r"annotations\.feather row 3: the pose is not finite",
    ),
    "box without pose": (
        lambda f: _set(f / "annotations.feather", "timestamp_ns", 3, 1),
        r"annotations\.feather row 3: there is no ego pose",
    ),
    "sensor without mount": (
        lambda f: _set(f / "calibration/egovehicle_SE3_sensor.feather", "sensor_name", 0, "x"),
        r"egovehicle_SE3_sensor\.feather: has no pose of camera 'ring_front_center'",
    ),
    "image missing in the middle": (
        lambda f: _images(f)[1].unlink(), "'ring_front_center' recorded nothing within"
    ),
    "image of another size": (
        lambda f: _set(f / "calibration/intrinsics.feather", "width_px", 0, 99),
        r"\.jpg: is 120x80, but the calibration says 99x80",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_LOGS)
def test_damage_is_told_with_its_location(folder: Path, case: str) -> None:
    change, message = BAD_LOGS[case]
    change(folder)
    refused, told = told_about(folder)
    assert re.search(message, told)
    assert refused == (case in REFUSED)


REFUSED = {"no sweeps", "poses cut off"}


def test_broken_sweep_is_named(folder: Path) -> None:
    path = _first_sweep(folder)
    path.write_bytes(path.read_bytes()[:200])
    log = open_log(folder)
    assert log.absent_sweeps == {0}
    assert f"{path.name}: cannot be read as a Feather" in log.left_out["sweeps"][0]
