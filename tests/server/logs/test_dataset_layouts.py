"""Round trips through dataset layouts, and details of the smaller readers."""

from __future__ import annotations

import json
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.logs import DrivingLog, ObjectTrack, open_log
from real2sim_server.synthetic import SyntheticLog

from .reader_contract import told_about

CAMERAS = {
    "kitti_raw": {"image_00": "front"},
    "nuscenes": {"cam_front": "front", "cam_front_left": "front_left"},
    "street_gaussians": {"front": "front", "front_left": "front_left"},
    "drivestudio": {"front": "front", "front_left": "front_left"},
}
EGO_TOLERANCE = {"kitti_raw": 2e-4}
"""Position tolerance [m]. Latitudes have twelve digits, and the Mercator projection distorts."""


@pytest.fixture(params=CAMERAS)
def layout(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture
def log(layout: str, request: pytest.FixtureRequest) -> DrivingLog:
    return open_log(request.getfixturevalue(f"written_{layout}"))


def test_ego_trajectory_is_preserved(log: DrivingLog, layout: str, tiny_log: SyntheticLog) -> None:
    assert (np.diff(log.frame_times_us) == np.diff(tiny_log.frame_times_us)).all()
    read = [log.ego.transform(int(t)) for t in log.frame_times_us]
    given = [tiny_log.ego.transform(int(t)) for t in tiny_log.frame_times_us]
    np.testing.assert_allclose(read, given, atol=EGO_TOLERANCE.get(layout, 1e-9))


def test_cameras_are_preserved(log: DrivingLog, layout: str, tiny_log: SyntheticLog) -> None:
    for name, given in CAMERAS[layout].items():
        np.testing.assert_allclose(log.rig[name].K, tiny_log.rig[given].K, atol=1e-9)
        np.testing.assert_allclose(
            log.rig[name].T_vehicle_camera, tiny_log.rig[given].T_vehicle_camera, atol=1e-9
        )


def test_boxes_are_preserved(log: DrivingLog, layout: str, tiny_log: SyntheticLog) -> None:
    shift = int(log.frame_times_us[0])
    assert len(log.tracks) == len(tiny_log.tracks)
    for given in tiny_log.tracks:
        read = _nearest(log, given, shift)
        assert read.size == pytest.approx(given.size)
        for t_us in tiny_log.frame_times_us.tolist():
            np.testing.assert_allclose(
                read.trajectory.transform(t_us + shift),
                given.trajectory.transform(t_us),
                atol=max(EGO_TOLERANCE.get(layout, 0), 1e-7),
            )


def _nearest(log: DrivingLog, given: ObjectTrack, shift: int) -> ObjectTrack:
    place = given.trajectory.positions[0]
    return min(
        log.tracks,
        key=lambda t: float(np.linalg.norm(t.trajectory.pose(shift)[0] - place)),
    )


def test_points_are_preserved(log: DrivingLog, layout: str, tiny_log: SyntheticLog) -> None:
    read, given = log.lidar(1), tiny_log.lidar(1)
    tolerance = 2e-3 if layout == "kitti_raw" else 1e-4
    np.testing.assert_allclose(read.points, given.points, atol=tolerance)


def test_late_sweeps_have_an_offset(written_nuscenes: Path) -> None:
    log = open_log(written_nuscenes)
    # 12 ms late, minus half a revolution of 50 ms.
    assert (log.lidar(0).offset_us == 12_000 - 25_000).all()


def test_vehicles_keep_their_class(written_nuscenes: Path, tiny_log: SyntheticLog) -> None:
    read, given = open_log(written_nuscenes).tracks, tiny_log.tracks
    for category in ("truck", "bus"):
        assert sum(t.category == category for t in read) == sum(
            t.category == category for t in given
        )


def test_image_times_of_a_scene_are_kept(copied: Callable[[str], Path]) -> None:
    folder = copied("nuscenes")
    table = folder / "v1.0-mini/sample_data.json"
    rows = json.loads(table.read_text())
    row = next(r for r in rows if r["token"] == "d1_CAM_FRONT_LEFT")
    row["timestamp"] += 9000
    table.write_text(json.dumps(rows))
    log = open_log(folder)
    assert log.image_time_us("cam_front_left", 1) == log.frame_times_us[1] + 9000


def test_pickles_with_code_are_refused_without_running_it(
    copied: Callable[[str], Path], tmp_path: Path
) -> None:
    folder, proof = copied("street_gaussians"), tmp_path / "proof"
    evil = np.array({"0": _Evil(proof)}, dtype=object)
    np.savez(folder / "pointcloud.npz", pointcloud=evil)
    _, told = told_about(folder)
    assert re.search(r"pointcloud\.npz.*contains .*, which is not an array", told)
    assert not proof.exists()


class _Evil:
    """An object whose pickle writes a file when loaded with ``pickle``."""

    def __init__(self, proof: Path) -> None:
        self._proof = proof

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (self._proof,)  # type: ignore[return-value]


def test_the_malicious_pickle_runs_with_pickle(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(_Evil(tmp_path / "proof")))
    assert (tmp_path / "proof").exists()


@pytest.fixture
def copied(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[str], Path]:
    def copy(layout: str) -> Path:
        written = request.getfixturevalue(f"written_{layout}")
        return Path(shutil.copytree(written, tmp_path / written.name))

    return copy


DRIVE = "2011_09_26/2011_09_26_drive_0042_sync"


def _replace(file: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, 1))

    return change


def _remove(file: str) -> Callable[[Path], None]:
    return lambda folder: (folder / file).unlink()


def _cut(file: str, size: int) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:size])


def _edit(table: str, row: int, **values: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "v1.0-mini" / f"{table}.json"
        rows = json.loads(path.read_text())
        rows[row].update(values)
        path.write_text(json.dumps(rows))

    return change


def _instance(**values: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "instances/instances_info.json"
        content = json.loads(path.read_text())
        content["0"]["frame_annotations"].update(values)
        path.write_text(json.dumps(content))

    return change


BAD_FOLDERS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "image missing": (
        "kitti_raw", _remove(f"{DRIVE}/image_02/data/0000000001.png"), r"0000000001\.png"
    ),
    "scan missing": (
        "kitti_raw",
        _remove(f"{DRIVE}/velodyne_points/data/0000000001.bin"),
        r"0000000001\.bin: no such file",
    ),
    "scan cut": (
        "kitti_raw", _cut(f"{DRIVE}/velodyne_points/data/0000000001.bin", 99), "99 bytes"
    ),
    "pose missing": (
        "kitti_raw", _remove(f"{DRIVE}/oxts/data/0000000002.txt"), r"0000000002\.txt: cannot"
    ),
    "times unsorted": (
        "kitti_raw",
        _replace(f"{DRIVE}/image_02/timestamps.txt", "13:02:25.69", "13:02:25.09"),
        r"frame 1 is at .* us, not after frame 0",
    ),
    "time of words": (
        "kitti_raw",
        _replace(f"{DRIVE}/image_02/timestamps.txt", "2011-09-26", "yesterday"),
        r"timestamps\.txt line 1: expected date and time",
    ),
    "tracklets with entities": (
        "kitti_raw",
        _replace(
            f"{DRIVE}/tracklet_labels.xml",
            "<!DOCTYPE boost_serialization>",
            '<!DOCTYPE b [<!ENTITY a "b">]>',
        ),
        r"tracklet_labels\.xml: declares entities",
    ),
    "tracklets cut": (
        "kitti_raw", _cut(f"{DRIVE}/tracklet_labels.xml", 500), r"labels\.xml: is not an XML"
    ),
    "tracklet without size": (
        "kitti_raw",
        _replace(f"{DRIVE}/tracklet_labels.xml", "<w>", "<w>0</w><w>"),
        r"tracklet_labels\.xml tracklet 0: the box of '0' needs a positive",
    ),
    "tracklet not finite": (
        "kitti_raw",
        _replace(f"{DRIVE}/tracklet_labels.xml", "<tx>", "<tx>nan</tx><tx>"),
        "tracklet 0: <tx> is not finite",
    ),
    "not a rotation": (
        "kitti_raw",
        _replace("2011_09_26/calib_velo_to_cam.txt", "R:", "Q:"),
        r"calib_velo_to_cam\.txt: needs lines R",
    ),
    "token unknown": (
        "nuscenes", _edit("sample_data", 0, ego_pose_token="x"), r"ego_pose\.json: has no row with"
    ),
    "key missing": (
        "nuscenes",
        _replace("v1.0-mini/ego_pose.json", '"translation"', '"t"'),
        r"ego_pose\.json: row 'e_.*' has no 'translation'",
    ),
    "ego not finite": (
        "nuscenes",
        _edit("ego_pose", 0, translation=[float("nan"), 0, 0]),
        r"ego_pose\.json: '.*': the pose is not finite",
    ),
    "box of no size": (
        "nuscenes",
        _edit("sample_annotation", 0, size=[0, 4, 1]),
        r"sample_annotation\.json: 'a0_.*': the box of .* needs a positive",
    ),
    "table no JSON": (
        "nuscenes", _cut("v1.0-mini/instance.json", 20), r"instance\.json: is not a JSON"
    ),
    "front image missing": (
        "nuscenes",
        _remove("samples/CAM_FRONT/n008__CAM_FRONT__1.jpg"),
        r"n008__CAM_FRONT__1\.jpg: cannot be read",
    ),
    "sweep cut": (
        "nuscenes",
        _cut("sweeps/LIDAR_TOP/n008__LIDAR_TOP__1.pcd.bin", 30),
        r"LIDAR_TOP__1\.pcd\.bin: 30 bytes",
    ),
    "street pose missing": (
        "street_gaussians", _remove("ego_pose/000001.txt"), r"ego_pose/000001\.txt: cannot be read"
    ),
    "street image missing": (
        "street_gaussians", _remove("images/000001_2.png"), r"images/000001_2\.png"
    ),
    "street box of no size": (
        "street_gaussians",
        _replace("track/track_info.txt", "0 0 vehicle 0 ", "0 0 vehicle 0 0.0 1 1 "),
        r"track_info\.txt line 2: the box of '0' needs a positive",
    ),
    "street time missing": (
        "street_gaussians",
        _replace("timestamps.json", '"000001"', '"100001"'),
        r"timestamps\.json: 'FRAME' has no time of frame 000001",
    ),
    "studio pose missing": (
        "drivestudio", _remove("ego_pose/001.txt"), r"ego_pose/001\.txt: cannot be read"
    ),
    "studio sweep of another data set": (
        "drivestudio", _cut("lidar/001.bin", 16 * 100), r"lidar/001\.bin: 1600 bytes.*Waymo"
    ),
    "studio box of no size": (
        "drivestudio",
        _instance(box_size=[[0, 1, 1]] * 3),
        r"instances_info\.json: instance '0', frame 0: the box of '0' needs a positive",
    ),
    "studio box outside": (
        "drivestudio", _instance(frame_idx=[0, 1, 9]), "'0', frame 9: there is no usable frame"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_FOLDERS)
def test_damage_is_told_with_its_location(copied: Callable[[str], Path], case: str) -> None:
    layout, change, message = BAD_FOLDERS[case]
    folder = copied(layout)
    change(folder)
    refused, told = told_about(folder)
    assert re.search(message, told)
    assert refused == (case in REFUSED)


REFUSED = {"tracklets with entities", "tracklets cut", "not a rotation", "table no JSON"}
