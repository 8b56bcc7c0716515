from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial import cKDTree

from real2sim_server.logs import DrivingLog, LogError, open_log
from real2sim_server.synthetic import SyntheticLog

from .reader_contract import told_about
from .waymo_v2_writer import RangeGrid, write_waymo_v2

POINT_TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def log(written_waymo_v2: Path) -> DrivingLog:
    return open_log(written_waymo_v2)


def test_times_and_poses_round_trip_exactly(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    assert (log.frame_times_us == tiny_log.frame_times_us).all()
    np.testing.assert_allclose(log.ego.positions, tiny_log.ego.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(log.ego.quaternions, tiny_log.ego.quaternions, rtol=0, atol=1e-15)


def test_calibrations_round_trip_exactly(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    assert log.rig.names == tiny_log.rig.names
    for one, two in zip(log.rig, tiny_log.rig, strict=True):
        assert (one.width, one.height) == (two.width, two.height)
        assert (one.K == two.K).all()
        np.testing.assert_allclose(one.T_vehicle_camera, two.T_vehicle_camera, rtol=0, atol=1e-15)


def test_boxes_round_trip_exactly(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    names = log.provenance["track_ids"]
    read = {names[t.object_id]: t for t in log.tracks}
    assert set(read) == {t.object_id for t in tiny_log.tracks}
    for track in tiny_log.tracks:
        assert read[track.object_id].size == track.size
        for t_us in log.frame_times_us.tolist():
            np.testing.assert_allclose(
                read[track.object_id].trajectory.transform(t_us),
                track.trajectory.transform(t_us),
                rtol=0,
                atol=1e-12,
            )


def test_images_round_trip_exactly(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    for camera in log.rig.names:
        assert (log.image(camera, 2) == tiny_log.image(camera, 2)).all()


def test_points_round_trip_within_range_image_rounding(
    log: DrivingLog, tiny_log: SyntheticLog
) -> None:
    for frame in range(log.frame_count):
        read, given = log.lidar(frame), tiny_log.lidar(frame)
        distance, nearest = cKDTree(given.points).query(read.points)
        assert len(np.unique(nearest)) == len(read.points) == len(given.points)
        assert distance.max() < POINT_TOLERANCE
        assert (read.intensity == given.intensity[nearest]).all()
        assert np.abs(read.offset_us - given.offset_us[nearest]).max() <= 1
        assert (read.origin == given.origin).all()


def test_points_off_the_grid_are_refused(tiny_log: SyntheticLog, tmp_path: Path) -> None:
    grid = RangeGrid(np.linspace(-0.4, 0.1, 32), 512)
    with pytest.raises(LogError, match="do not lie on the beams"):
        write_waymo_v2(tiny_log, tmp_path / "out", grid=grid)
    assert not (tmp_path / "out").exists()


def test_segment_with_lidar_only_opens(folder: Path) -> None:
    for component in ("camera_image", "camera_calibration", "lidar_box", "lidar_pose"):
        shutil.rmtree(folder / component)
    log = open_log(folder)
    assert (len(log.rig), len(log.tracks), log.frame_count) == (0, 0, 3)
    assert len(log.lidar(0).points) > 1000


@pytest.mark.parametrize("lost", ["row", "image", "laser"])
def test_a_frame_without_a_sweep_keeps_its_images(
    folder: Path, tiny_log: SyntheticLog, lost: str
) -> None:
    if lost == "image":
        for i in (1, 2):
            _set(folder, "lidar", f"[LiDARComponent].range_image_return{i}.shape", 1, [0, 0, 4])
            _set(folder, "lidar", f"[LiDARComponent].range_image_return{i}.values", 1, [])
    elif lost == "row":
        start_us = _column(folder, "lidar", "key.frame_timestamp_micros")[1]
        _keep_rows(folder, "lidar", lambda row: row["key.frame_timestamp_micros"] != start_us)
    else:
        _set(folder, "lidar", "key.laser_name", 1, 2)  # another laser than in the other frames
        path = next((folder / "lidar_calibration").glob("*.parquet"))
        table = pq.read_table(path)
        pq.write_table(pa.concat_tables([table, table]), path)
        _set(folder, "lidar_calibration", "key.laser_name", 1, 2)
    log = open_log(folder)
    assert log.absent_sweeps == {1}
    for frame in range(3):
        kept = len(tiny_log.lidar(frame).points) if frame != 1 else 0
        assert len(log.lidar(frame).points) == kept
        assert (log.image("front", frame) == tiny_log.image("front", frame)).all()
    (told,) = log.left_out["sweeps"]
    assert "the frame of 50000 us has no sweep of the TOP laser" in told


def test_camera_without_images_is_omitted_and_named(folder: Path) -> None:
    _keep_rows(folder, "camera_image", lambda row: row["key.camera_name"] != 3)
    log = open_log(folder)
    assert log.rig.names == ("front", "front_left")
    (told,) = log.left_out["cameras"]
    assert "camera 'front_right' has no images" in told


def test_real_segment_poses_open(test_data: Path) -> None:
    """199 float32 poses, 15 km from the world origin."""
    path = test_data / "waymo/v2"
    if not path.is_dir():
        pytest.skip(f"no sample poses at {path}")
    log = open_log(path)
    assert log.frame_count == 199
    steps = np.linalg.norm(np.diff(log.ego.positions, axis=0), axis=1)
    assert steps.max() < 2.5
    assert np.abs(log.ego.positions[:, 2]).max() < 20


def _column(folder: Path, component: str, column: str) -> list:
    path = next((folder / component).glob("*.parquet"))
    return pq.read_table(path, columns=[column]).column(column).to_pylist()


def _keep_rows(folder: Path, component: str, keep: Callable[[dict], bool]) -> None:
    path = next((folder / component).glob("*.parquet"))
    table = pq.read_table(path)
    rows = [i for i, row in enumerate(table.to_pylist()) if keep(row)]
    pq.write_table(table.take(rows), path)


def _set(folder: Path, component: str, column: str, row: int, value: object) -> None:
    path = next((folder / component).glob("*.parquet"))
    table = pq.read_table(path)
    values = table.column(column).to_pylist()
    values[row] = value
    index = table.schema.get_field_index(column)
    changed = pa.array(values, table.schema.field(column).type)
    pq.write_table(table.set_column(index, column, changed), path)


def _cut(folder: Path, component: str) -> None:
    path = next((folder / component).glob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-50])


def _swap_poses(folder: Path) -> None:
    path = next((folder / "camera_image").glob("*.parquet"))
    path.unlink()
    path = next((folder / "vehicle_pose").glob("*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.take([1, 0, 2]), path)


POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
BAD_SEGMENTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "poses cut off": (lambda f: _cut(f, "vehicle_pose"), r"vehicle_pose/tiny_0_20\.parquet: can"),
    "images cut off": (lambda f: _cut(f, "camera_image"), r"camera_image/.*: cannot be read as"),
    "pose not finite": (
        lambda f: _set(f, "vehicle_pose", POSE, 1, [float("nan")] * 16),
        r"vehicle_pose.*pose at \d+ us: holds a value that is not finite",
    ),
    "pose empty": (lambda f: _set(f, "vehicle_pose", POSE, 1, None), r"pose at \d+ us: holds a"),
    "box without size": (
        lambda f: _set(f, "lidar_box", "[LiDARBoxComponent].box.size.x", 2, 0.0),
        r"lidar_box/.* row 2: the box of '.*' needs a positive length",
    ),
    "box not finite": (
        lambda f: _set(f, "lidar_box", "[LiDARBoxComponent].box.center.x", 2, float("nan")),
        r"lidar_box/.* row 2: the pose of .* is not finite",
    ),
    "image missing": (
        lambda f: _keep_rows(
            f,
            "camera_image",
            lambda r: r["key.camera_name"] != 2 or r["key.frame_timestamp_micros"] > 0,
        ),
        "camera 'front_left' has no usable image in the frame of -50000 us",
    ),
    "pose of a frame missing": (
        lambda f: _keep_rows(f, "vehicle_pose", lambda r: r["key.frame_timestamp_micros"] > 0),
        r"vehicle_pose/.*: has no pose for the frame of -50000 us",
    ),
    "no calibration": (
        lambda f: shutil.rmtree(f / "camera_calibration"), r"camera_calibration/.*: no such file"
    ),
}  # fmt: skip


@pytest.fixture
def folder(written_waymo_v2: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_waymo_v2, tmp_path / "waymo"))


@pytest.mark.parametrize("case", BAD_SEGMENTS)
def test_damage_is_told_with_its_location(folder: Path, case: str) -> None:
    change, message = BAD_SEGMENTS[case]
    change(folder)
    refused, told = told_about(folder)
    assert re.search(message, told)
    assert refused == (case in REFUSED)


REFUSED = {"poses cut off", "images cut off", "no calibration"}


def test_broken_image_is_named(folder: Path) -> None:
    path = next((folder / "camera_image").glob("*.parquet"))
    image = pq.read_table(path).column("[CameraImageComponent].image")[0].as_py()
    _set(folder, "camera_image", "[CameraImageComponent].image", 0, image[: len(image) // 2])
    (told,) = open_log(folder).left_out["images"]
    assert re.search(r"camera_image/.* row 0 \(front, frame 0\): .*cut off", told)
