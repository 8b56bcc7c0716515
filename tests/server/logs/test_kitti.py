from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from real2sim_server.geometry import (
    apply_transform,
    invert_transform,
    matrix_to_quaternion,
    quaternion_yaw,
)
from real2sim_server.logs import DrivingLog, LogError, ObjectTrack, open_log
from real2sim_server.logs.images import write_image
from real2sim_server.logs.readers.kitti_tracking import EARTH_RADIUS
from real2sim_server.synthetic import SyntheticLog

from .reader_contract import told_about


@pytest.fixture(scope="module")
def jam(test_data: Path) -> DrivingLog:
    path = test_data / "kitti_jam"
    if not path.is_dir():
        pytest.skip(f"no sample drive at {path}")
    return open_log(path)


def test_poses_and_boxes_are_preserved(tiny_log: SyntheticLog, written_kitti: Path) -> None:
    log = open_log(written_kitti)
    assert (log.frame_times_us == tiny_log.frame_times_us).all()
    np.testing.assert_allclose(log.ego.positions, tiny_log.ego.positions, atol=1e-8)
    assert len(log.tracks) == len(tiny_log.tracks)
    for number, given in enumerate(tiny_log.tracks):
        read = next(t for t in log.tracks if t.object_id == f"{given.category}_{number}")
        assert read.size == pytest.approx(given.size)
        for t_us in log.frame_times_us:
            np.testing.assert_allclose(
                read.trajectory.transform(int(t_us)),
                given.trajectory.transform(int(t_us)),
                atol=1e-7,
            )


def test_projection_offsets_become_camera_positions(
    tiny_log: SyntheticLog, written_kitti: Path
) -> None:
    log = open_log(written_kitti)
    front, left = log.rig["image_00"], log.rig["image_02"]
    np.testing.assert_allclose(front.K, tiny_log.rig["front"].K, atol=1e-9)
    np.testing.assert_allclose(
        front.T_vehicle_camera, tiny_log.rig["front"].T_vehicle_camera, atol=1e-9
    )
    # Rectified projections only shift, so the side camera keeps its distance but not its rotation.
    turned = tiny_log.rig["front_left"].T_vehicle_camera
    offset = left.T_vehicle_camera[:3, 3] - front.T_vehicle_camera[:3, 3]
    expected = turned[:3, 3] - front.T_vehicle_camera[:3, 3]
    assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm(expected))


def test_ego_motion_is_compensated_in_sweeps(tiny_log: SyntheticLog, written_kitti: Path) -> None:
    read, given = open_log(written_kitti).lidar(1), tiny_log.lidar(1)
    np.testing.assert_allclose(read.points, given.points, atol=1e-3)
    # Raw scans have no times, so the reader derives them from azimuth.
    assert np.abs(read.offset_us - given.offset_us).max() <= 1


def test_uncompensated_points_are_wrong(tiny_log: SyntheticLog, written_kitti: Path) -> None:
    scan = np.fromfile(written_kitti / "training/velodyne/0007/000001.bin", np.float32)
    raw = scan.reshape(-1, 4)[:, :3] + tiny_log.lidar(1).origin
    assert np.abs(raw - tiny_log.lidar(1).points).max() > 0.2


def test_surround_boxes_supersede_labels(kitti_folder: Path) -> None:
    training = kitti_folder / "training"
    rows = (training / "label_02/0007.txt").read_text().splitlines()
    (training / "boxes_surround").mkdir()
    (training / "boxes_surround/0007.txt").write_text("\n".join(rows[:2]))
    assert len(open_log(kitti_folder).tracks) == 2


def test_old_calibration_keys_are_read(kitti_folder: Path) -> None:
    before = open_log(kitti_folder).rig["image_00"].T_vehicle_camera
    path = kitti_folder / "training/calib/0007.txt"
    text = path.read_text()
    for new, old in (
        ("R_rect ", "R0_rect: "),
        ("Tr_velo_cam ", "Tr_velo_to_cam: "),
        ("Tr_imu_velo ", "Tr_imu_to_velo: "),
    ):
        assert new in text
        text = text.replace(new, old)
    path.write_text(text)
    assert (open_log(kitti_folder).rig["image_00"].T_vehicle_camera == before).all()


def test_training_folder_itself_can_be_opened(kitti_folder: Path) -> None:
    assert open_log(kitti_folder / "training").frame_count == 3


def test_one_of_several_sequences_must_be_named(kitti_folder: Path) -> None:
    (kitti_folder / "training/image_02/0008").mkdir()
    with pytest.raises(LogError, match=r"\['0007', '0008'\]; name one"):
        open_log(kitti_folder)
    assert open_log(kitti_folder, sequence="0007").provenance["sequence"] == "0007"


def test_oxts_and_poses_give_the_same_trajectory(kitti_folder: Path) -> None:
    log = open_log(kitti_folder)
    training = kitti_folder / "training"
    (training / "poses/0007.txt").unlink()
    _write_oxts(training / "oxts/0007.txt", log)
    again = open_log(kitti_folder)
    assert again.provenance["poses"] == "oxts"
    np.testing.assert_allclose(again.ego.positions, log.ego.positions, atol=1e-3)
    np.testing.assert_allclose(again.ego.quaternions, log.ego.quaternions, atol=1e-6)


def _write_oxts(path: Path, log: DrivingLog) -> None:
    """Write latitude, longitude and yaw of the GPS unit, driving north-east."""
    latitude, longitude, course = 49.0, 8.4, 0.7
    meridian = np.pi / 180 * EARTH_RADIUS
    turn = np.array([[np.cos(course), -np.sin(course)], [np.sin(course), np.cos(course)]])
    rows = []
    for t_us in log.frame_times_us:
        pose = log.ego.transform(int(t_us))
        east, north = turn @ pose[:2, 3]
        # The unit is 0.32 m left of the scanner and of the centre line.
        yaw = course + float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
        east -= 0.32 * np.sin(yaw)
        north += 0.32 * np.cos(yaw)
        record = np.zeros(30)
        record[:3] = latitude + north / meridian, longitude, 115.0
        record[1] += east / (meridian * np.cos(np.radians(latitude)))
        record[5] = yaw
        rows.append(" ".join(f"{v:.12f}" for v in record))
    path.parent.mkdir()
    path.write_text("\n".join(rows))


def test_recorded_times_replace_default_times(kitti_folder: Path) -> None:
    times = kitti_folder / "training/times/0007.txt"
    times.parent.mkdir()
    times.write_text("0.0\n0.103\n0.205\n")
    assert open_log(kitti_folder).frame_times_us.tolist() == [0, 103_000, 205_000]


def _replace(path: str, old: str, new: str) -> Callable[[Path], None]:
    def change(training: Path) -> None:
        text = (training / path).read_text()
        assert old in text
        (training / path).write_text(text.replace(old, new, 1))

    return change


def _edit_row(path: str, row: int, edit: Callable[[list[str]], None]) -> Callable[[Path], None]:
    def change(training: Path) -> None:
        rows = (training / path).read_text().splitlines()
        words = rows[row].split()
        edit(words)
        rows[row] = " ".join(words)
        (training / path).write_text("\n".join(rows))

    return change


def _remove(path: str) -> Callable[[Path], None]:
    return lambda training: (training / path).unlink()


def _cut(path: str, size: int) -> Callable[[Path], None]:
    return lambda training: (training / path).write_bytes((training / path).read_bytes()[:size])


def _write_times(training: Path) -> None:
    (training / "times").mkdir()
    (training / "times/0007.txt").write_text("0.0\n0.2\n0.1\n")


BAD_LAYOUTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no calibration": (_remove("calib/0007.txt"), r"calib/0007\.txt: cannot be read"),
    "key missing": (_replace("calib/0007.txt", "Tr_velo_cam", "Tr"), "no line Tr_velo_cam: or"),
    "no projection": (_replace("calib/0007.txt", "P2:", "P9:"), "no line P2:"),
    "calibration of words": (_replace("calib/0007.txt", "R_rect 1", "R_rect x"), "no line R_rect"),
    "skewed calibration": (
        _replace("calib/0007.txt", "R_rect 1", "R_rect 3"), "not a rotation matrix"
    ),
    "no poses": (_remove("poses/0007.txt"), "neither .*poses.* nor .*oxts"),
    "empty poses": (_cut("poses/0007.txt", 0), r"poses/0007\.txt: is empty"),
    "pose too short": (_edit_row("poses/0007.txt", 1, lambda w: w.pop()), "line 2: expected 12"),
    "pose not finite": (
        _edit_row("poses/0007.txt", 1, lambda w: w.__setitem__(3, "nan")), "line 2: .*not finite"
    ),
    "pose, not a rotation": (
        _edit_row("poses/0007.txt", 2, lambda w: w.__setitem__(0, "2.0")), "3: .*not a rotation"
    ),
    "pose missing": (_edit_row("poses/0007.txt", 2, lambda w: w.clear()), "has 2 lines, but"),
    "no labels": (_remove("label_02/0007.txt"), r"label_02/0007\.txt: no such file"),
    "label too short": (_edit_row("label_02/0007.txt", 3, lambda w: w.pop()), "line 4: .*17 col"),
    "label without size": (
        _edit_row("label_02/0007.txt", 0, lambda w: w.__setitem__(11, "0")), "line 1: .*positive"
    ),
    "label outside": (
        _edit_row("label_02/0007.txt", 0, lambda w: w.__setitem__(0, "9")), "line 1: frame 9"
    ),
    "label not finite": (
        _edit_row("label_02/0007.txt", 0, lambda w: w.__setitem__(13, "inf")), "line 1: .*finite"
    ),
    "scan missing": (_remove("velodyne/0007/000001.bin"), r"000001\.bin: no such file"),
    "scan empty": (_cut("velodyne/0007/000001.bin", 0), r"000001\.bin: 0 bytes"),
    "scan cut": (_cut("velodyne/0007/000001.bin", 1001), r"000001\.bin: 1001 bytes.*16 bytes"),
    "no scans": (
        lambda t: (t / "velodyne").rename(t / "elsewhere"), "^$"
    ),
    "image missing": (_remove("image_02/0007/000001.png"), r"image_02/0007/000001\.png"),
    "image of another size": (
        lambda t: write_image(t / "image_02/0007/000001.png", np.zeros((9, 9, 3), np.uint8)),
        r"000001\.png: is 9x9, but the calibration says 120x80",
    ),
    "times unsorted": (_write_times, "frame 2 is at 100000 us, not after frame 1"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_LAYOUTS)
def test_damage_is_told_with_its_location(kitti_folder: Path, case: str) -> None:
    change, message = BAD_LAYOUTS[case]
    change(kitti_folder / "training")
    refused, told = told_about(kitti_folder)
    assert re.search(message, told)
    assert refused == (case in REFUSED)


REFUSED = {"no calibration", "key missing", "calibration of words", "skewed calibration",
           "no poses", "empty poses", "pose missing"}  # fmt: skip


def test_a_score_beyond_the_columns_of_a_label_is_ignored(kitti_folder: Path) -> None:
    before, labels = open_log(kitti_folder), kitti_folder / "training/label_02/0007.txt"
    labels.write_text("".join(f"{row} 0.87\n" for row in labels.read_text().splitlines()))
    after = open_log(kitti_folder)
    assert not after.left_out
    assert [t.object_id for t in after.tracks] == [t.object_id for t in before.tracks]


def test_the_most_frequent_class_of_a_track_counts(kitti_folder: Path) -> None:
    before, labels = open_log(kitti_folder), kitti_folder / "training/label_02/0007.txt"
    rows = labels.read_text().splitlines()
    number = rows[0].split()[1]
    own = [i for i, row in enumerate(rows) if row.split()[1] == number]
    rows[own[0]] = rows[own[0]].replace("Car", "Van")
    labels.write_text("\n".join(rows))
    after = open_log(kitti_folder)
    assert [t.object_id for t in after.tracks] == [t.object_id for t in before.tracks]
    (told,) = after.left_out["categories"]
    assert "is a car in most frames, and a van in 1" in told


def test_a_second_box_of_an_object_in_a_frame_is_left_out(kitti_folder: Path) -> None:
    before, labels = open_log(kitti_folder), kitti_folder / "training/label_02/0007.txt"
    rows = labels.read_text().splitlines()
    labels.write_text("\n".join([*rows, rows[0]]))
    after = open_log(kitti_folder)
    (told,) = after.left_out["boxes"]
    assert "has two boxes" in told
    assert (after.tracks[0].trajectory.positions == before.tracks[0].trajectory.positions).all()


def test_sample_drive_has_its_vehicles(jam: DrivingLog) -> None:
    sizes = {track.object_id: track.size for track in jam.tracks}
    assert len(sizes) == 14
    assert sizes["car_0"] == (4.70, 1.76, 1.50)
    assert {"truck_2", "truck_3", "van_5", "truck_11"} <= set(sizes)


def test_sample_boxes_stand_on_the_road(jam: DrivingLog) -> None:
    for name in ("car_0", "car_1", "truck_2", "truck_3"):
        track = _track(jam, name)
        bottom = track.trajectory.positions[:, 2] - track.size[2] / 2
        assert np.abs(bottom).max() < 0.12


def test_sample_points_in_a_box_project_into_its_2d_box(jam: DrivingLog) -> None:
    """The 2D boxes of the label file are independent of this reader."""
    folder = jam.source.files.images["image_02"][0].parents[2]  # type: ignore[attr-defined]
    rows = [r.split() for r in (folder / "label_02/0000.txt").read_text().splitlines()]
    camera, track = jam.rig["image_02"], _track(jam, "car_0")
    for frame in (0, 12, 38):
        left, top, right, bottom = next(
            np.array(r[6:10], float) for r in rows if r[:2] == [str(frame), "0"]
        )
        points = _points_of(jam, track, frame)
        u, v = _project(camera, points)
        assert len(points) > 800
        assert u.min() > left - 1.5
        assert u.max() < right + 1.5
        assert v.min() > top - 1.5
        assert v.max() < bottom + 1.5
        assert u.max() - u.min() > 0.8 * (right - left)


def _track(log: DrivingLog, object_id: str) -> ObjectTrack:
    return next(t for t in log.tracks if t.object_id == object_id)


def _points_of(log: DrivingLog, track: ObjectTrack, frame: int) -> np.ndarray:
    """Points [N, 3] of a sweep inside a box, vehicle frame, compensated for the box motion."""
    t_us = int(log.frame_times_us[frame])
    sweep = log.lidar(frame)
    world = apply_transform(log.ego.transform(t_us), sweep.points)
    world -= track.trajectory.velocity(t_us) * (sweep.offset_us * 1e-6)[:, None]
    local = apply_transform(invert_transform(track.trajectory.transform(t_us)), world)
    inside = (np.abs(local) < np.array(track.size) / 2).all(axis=1) & (
        local[:, 2] > 0.15 - track.size[2] / 2
    )
    return apply_transform(invert_transform(log.ego.transform(t_us)), world[inside])


def _project(camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y, z = apply_transform(invert_transform(camera.T_vehicle_camera), points).T
    k = camera.K
    # Labels use integer pixel centres.
    return k[0, 0] * x / z + k[0, 2] - 0.5, k[1, 1] * y / z + k[1, 2] - 0.5


@pytest.mark.parametrize("name", ["car_1", "truck_2", "car_0"])
def test_sample_vehicle_sweeps_align(jam: DrivingLog, name: str) -> None:
    track = _track(jam, name)
    clouds = []
    for frame in (0, 6, 12, 18):
        t_us = int(jam.frame_times_us[frame])
        to_object = invert_transform(track.trajectory.transform(t_us)) @ jam.ego.transform(t_us)
        clouds.append(apply_transform(to_object, _points_of(jam, track, frame)))
    rest = cKDTree(np.concatenate(clouds[1:]))
    distance, _ = rest.query(clouds[0])
    assert np.median(distance) < 0.035


def test_sample_road_is_level_along_the_path(jam: DrivingLog) -> None:
    last = jam.ego.positions[-1]
    heights = []
    for frame in range(0, jam.frame_count, 6):
        sweep = jam.lidar(frame)
        world = apply_transform(jam.ego.transform(int(jam.frame_times_us[frame])), sweep.points)
        near = (world[:, 0] > 2) & (world[:, 0] < last[0]) & (np.abs(world[:, 1]) < 1.0)
        heights.append(world[near & (world[:, 2] < 0.3), 2])
    road = np.concatenate(heights)
    assert len(road) > 1000
    assert np.abs(np.percentile(road, [5, 50, 95])).max() < 0.1
