from __future__ import annotations

import re
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial import cKDTree

from real2sim_server.geometry import apply_transform, invert_transform
from real2sim_server.logs import DrivingLog, LogError, ObjectTrack, open_log
from real2sim_server.logs.readers.waymo_v1 import (
    ProtoMessage,
    list_records,
    masked_crc32c,
    read_record,
)
from real2sim_server.scene.errors import LeftOut
from real2sim_server.synthetic import SyntheticLog


@pytest.fixture(scope="module")
def log(written_waymo_v1: Path) -> DrivingLog:
    return open_log(written_waymo_v1)


@pytest.fixture(scope="module")
def sample(test_data: Path) -> DrivingLog:
    path = test_data / "waymo"
    if not (path / "one_frame.tfrecord").is_file():
        pytest.skip(f"no sample frame at {path}")
    return open_log(path, format="waymo_v1")


@pytest.fixture
def folder(written_waymo_v1: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_waymo_v1, tmp_path / "waymo"))


def test_checksum_matches_rfc_3720() -> None:
    # RFC 3720, B.4: CRC-32C of 32 zero bytes is 0x8a9136aa. TFRecord rotates it, adds a constant.
    crc = 0x8A9136AA
    turned = (crc >> 15 | crc << 17) & 0xFFFFFFFF
    assert masked_crc32c(bytes(32)) == (turned + 0xA282EAD8) & 0xFFFFFFFF


def test_large_world_coordinates_keep_precision(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    assert (log.frame_times_us == tiny_log.frame_times_us).all()
    np.testing.assert_allclose(log.ego.positions, tiny_log.ego.positions, atol=1e-10)


def test_width_and_length_are_not_swapped(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    names = log.provenance["track_ids"]
    sizes = {names[t.object_id]: t.size for t in log.tracks}
    assert sizes == {t.object_id: t.size for t in tiny_log.tracks}
    assert all(length > width for length, width, _ in sizes.values())


def test_boxes_have_their_poses(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    names = log.provenance["track_ids"]
    read = {names[t.object_id]: t.trajectory for t in log.tracks}
    for track in tiny_log.tracks:
        for t_us in log.frame_times_us.tolist():
            np.testing.assert_allclose(
                read[track.object_id].transform(t_us), track.trajectory.transform(t_us), atol=1e-9
            )


def test_points_round_trip_within_a_range_pixel(log: DrivingLog, tiny_log: SyntheticLog) -> None:
    read, given = log.lidar(1), tiny_log.lidar(1)
    distance, nearest = cKDTree(given.points).query(read.points)
    far = np.linalg.norm(given.points[nearest] - given.origin, axis=1)
    # Half a row is 0.25 degrees.
    assert (distance < 0.005 * far).all()
    assert len(read.points) > 0.95 * len(given.points)
    azimuth = np.arctan2(read.points[:, 1], read.points[:, 0] - read.origin[0])
    np.testing.assert_allclose(read.offset_us, -azimuth / (2 * np.pi) * 1e5, atol=1)


def test_rolling_shutter_readout_is_in_the_provenance(log: DrivingLog) -> None:
    shutter = log.provenance["rolling_shutter"]["front"]
    assert shutter["direction"] == "left_to_right"
    assert shutter["readout_us"] == pytest.approx(40_000, abs=1)


def test_sample_has_its_cameras_and_boxes(sample: DrivingLog) -> None:
    sizes = {c.name: (c.width, c.height) for c in sample.rig}
    assert sizes == {
        "front": (1920, 1280),
        "front_left": (1920, 1280),
        "front_right": (1920, 1280),
        "side_left": (1920, 886),
        "side_right": (1920, 886),
    }
    assert len(sample.tracks) == 75
    counts = {c: sum(t.category == c for t in sample.tracks) for c in ("car", "pedestrian", "sign")}
    trucks = sum(t.category == "truck" for t in sample.tracks)
    # Statistics of the file: 37 vehicles, 12 pedestrians, 25 signs, 1 cyclist.
    assert counts["car"] + trucks == 37
    assert (counts["pedestrian"], counts["sign"]) == (12, 25)


def test_sample_frame_time_is_the_middle_of_the_revolution(sample: DrivingLog) -> None:
    assert sample.image_time_us("front", 0) == sample.frame_times_us[0]
    offsets = {c: sample.image_time_us(c, 0) - sample.frame_times_us[0] for c in sample.rig.names}
    assert offsets["side_left"] == pytest.approx(-30_000, abs=10)
    assert offsets["side_right"] == pytest.approx(20_000, abs=10)
    assert len(sample.lidar(0).points) == 0


def test_sample_images_are_undistorted(sample: DrivingLog) -> None:
    """The undistorted image samples each direction where the distortion model projects it."""
    lens = sample.source.cameras["front"].lens  # type: ignore[attr-defined]
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = 0.4, -0.25
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = lens.K[0, 0] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + lens.K[0, 2]
    v = lens.K[1, 1] * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + lens.K[1, 2]
    pinhole = sample.rig["front"].K @ [x, y, 1]
    np.testing.assert_allclose(lens.distort(pinhole[:2]), [u, v], atol=1e-9)
    assert np.hypot(*(pinhole[:2] - [u, v])) > 5
    image = sample.image("front", 0)
    assert (image[[0, -1]].max(axis=(1, 2)) > 0).all()


def test_sample_boxes_project_like_the_dataset_labels(sample: DrivingLog, test_data: Path) -> None:
    """Projected boxes match the 2D bounds stored in the frame."""
    compared = 0
    for camera, key, bounds in _published_bounds(test_data / "waymo/one_frame.tfrecord"):
        names = {v: k for k, v in sample.provenance["track_ids"].items()}
        track = next(t for t in sample.tracks if t.object_id == names[key])
        lens = sample.source.cameras[camera].lens  # type: ignore[attr-defined]
        corners = _corners_in_camera(sample, camera, track)
        level = corners[:, :2] / corners[:, 2:]
        # Beyond this angle the distortion polynomial is not monotonic.
        if (corners[:, 2] < 0.5).any() or np.linalg.norm(level, axis=1).max() > 0.9:
            continue
        pinhole = level * np.diag(sample.rig[camera].K)[:2] + sample.rig[camera].K[:2, 2]
        pixels = np.clip(lens.distort(pinhole), 0, [lens.width, lens.height])
        found = [*pixels.min(axis=0), *pixels.max(axis=0)]
        np.testing.assert_allclose(found, bounds, rtol=0, atol=0.35)
        compared += 1
    assert compared >= 55


def _published_bounds(path: Path) -> list[tuple[str, str, list[float]]]:
    """Camera, track and bounds (left, top, right, bottom) of ``projected_lidar_labels``."""
    names = {1: "front", 2: "front_left", 3: "front_right", 4: "side_left", 5: "side_right"}
    frame = ProtoMessage(read_record(path, list_records(path, LeftOut())[0]), "frame")
    found = []
    for camera in frame.messages(9, "labels"):
        for label in camera.messages(2, "label"):
            box, name = label.message(1, "box"), names[camera.integer(1)]
            x, y, high, wide = (box.number(i) for i in (1, 2, 4, 5))
            bounds = [x - wide / 2, y - high / 2, x + wide / 2, y + high / 2]
            found.append((name, label.text(4).removesuffix(f"_{name.upper()}"), bounds))
    return found


def _corners_in_camera(log: DrivingLog, camera: str, track: ObjectTrack) -> np.ndarray:
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    pose = track.trajectory.transform(track.trajectory.start_us)
    to_camera = invert_transform(log.rig[camera].T_vehicle_camera) @ pose
    return apply_transform(to_camera, signs * np.array(track.size))


def test_a_frame_without_a_sweep_keeps_its_images(
    waymo_v1: ModuleType, tiny_log: SyntheticLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    laser = waymo_v1._laser
    monkeypatch.setattr(waymo_v1, "_laser", lambda log, f: b"" if f == 1 else laser(log, f))
    waymo_v1.write(tiny_log, tmp_path / "tiny.tfrecord")
    log = open_log(tmp_path)
    assert log.absent_sweeps == {1}
    for frame in range(3):
        assert (len(log.lidar(frame).points) > 1000) == (frame != 1)
        assert (log.image("front", frame) == tiny_log.image("front", frame)).all()
    (told,) = log.left_out["sweeps"]
    assert "has no sweep of the TOP laser" in told


def test_broken_record_is_named(folder: Path) -> None:
    path = folder / "tiny.tfrecord"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    log = open_log(folder)
    assert log.frame_count == 2
    (told,) = log.left_out["frames"]
    assert re.search(r"tiny\.tfrecord: the record at byte \d+ is broken", told)


def test_truncated_file_is_named(folder: Path) -> None:
    path = folder / "tiny.tfrecord"
    path.write_bytes(path.read_bytes()[:-100])
    log = open_log(folder)
    assert log.frame_count == 2
    (told,) = log.left_out["ends of files"]
    assert re.search(r"tiny\.tfrecord at byte \d+: .*cut off", told)


def test_unrelated_file_is_named(folder: Path) -> None:
    (folder / "tiny.tfrecord").write_bytes(b"nothing of the kind, but long enough")
    with pytest.raises(LogError, match=r"tiny\.tfrecord at byte 0: .*not a TFRecord"):
        open_log(folder)


def test_invalid_message_is_named() -> None:
    with pytest.raises(LogError, match="here: is not a protocol-buffer message"):
        ProtoMessage(b"\x0a\xff\x01", "here")


def test_truncated_packed_numbers_are_refused():
    message = ProtoMessage(b"\x1a\x02\x01\x80", "segment")
    with pytest.raises(LogError, match="segment: field 3 is cut off"):
        message.integers(3)
