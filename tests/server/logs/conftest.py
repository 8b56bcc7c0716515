"""Small drives in every supported layout."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from real2sim_server.geometry import apply_transform, invert_transform
from real2sim_server.logs import DrivingLog, write_native_log
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log

from .waymo_v2_writer import write_waymo_v2

TINY = SyntheticConfig(
    seed=5,
    frames=3,
    width=120,
    height=80,
    moving_cars=3,
    parked_cars=8,
    lidar_beams=24,
    lidar_columns=360,
)
VELO_IN_IMU = np.array([0.9, -0.32, 0.80])


@pytest.fixture(scope="session")
def tiny_log() -> SyntheticLog:
    return generate_log(TINY)


def _layout(name: str) -> ModuleType:
    """Import a module of ``layouts``, since test folders are not packages."""
    path = Path(__file__).parent / "layouts" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"log_layouts_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_layout(name: str, log: DrivingLog, folder: Path) -> Path:
    """Write a log in the layout of a reader. Returns the folder to open."""
    if name == "native":
        return write_native_log(log, folder / "drive")
    if name == "kitti":
        _write_kitti_layout(log, folder / "root/training", sequence="0007")
        return folder / "root"
    if name == "kitti_raw":
        tracking = write_layout("kitti", log, folder / "tracking")
        _layout(name).write(log, tracking, folder / "raw")
        return folder / "raw"
    if name == "waymo_v2":
        return write_waymo_v2(log, folder / "root", segment="tiny_0_20")
    if name == "waymo_v1":
        _layout(name).write(log, folder / "tiny.tfrecord")
        return folder
    target = folder / {"argoverse2": "7fab2350", "street_gaussians": "002", "drivestudio": "023",
                       "nuscenes": "set"}[name]  # fmt: skip
    _layout(name).write(log, target)
    return target


def _written(name: str) -> Any:
    def write(tiny_log: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_layout(name, tiny_log, tmp_path_factory.mktemp(name))

    return pytest.fixture(scope="session", name=f"written_{name}")(write)


written_native = _written("native")
written_kitti = _written("kitti")
written_kitti_raw = _written("kitti_raw")
written_waymo_v1 = _written("waymo_v1")
written_waymo_v2 = _written("waymo_v2")
written_argoverse2 = _written("argoverse2")
written_nuscenes = _written("nuscenes")
written_street_gaussians = _written("street_gaussians")
written_drivestudio = _written("drivestudio")


@pytest.fixture(scope="session")
def waymo_v1() -> ModuleType:
    return _layout("waymo_v1")


@pytest.fixture
def native_folder(written_native: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_native, tmp_path / "native"))


@pytest.fixture
def kitti_folder(written_kitti: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written_kitti, tmp_path / "kitti"))


def _write_kitti_layout(log: DrivingLog, root: Path, *, sequence: str) -> None:
    """Write the KITTI tracking layout. Rectified cam0 is the log's first camera."""
    cam0 = log.rig["front"].T_vehicle_camera
    names = {"image_00": "front", "image_02": "front_left"}
    scanner = log.lidar(0).origin.astype(np.float64)
    poses = np.array([log.ego.transform(int(t)) for t in log.frame_times_us])
    _write_calibration(log, root, sequence, names, scanner)
    for name, camera in names.items():
        folder = root / name / sequence
        folder.mkdir(parents=True)
        for frame in range(log.frame_count):
            cv2.imwrite(str(folder / f"{frame:06d}.png"), log.image(camera, frame)[..., ::-1])
    scans = root / "velodyne" / sequence
    scans.mkdir(parents=True)
    for frame in range(log.frame_count):
        _raw_scan(log, frame, scanner).tofile(scans / f"{frame:06d}.bin")
    in_cam0 = invert_transform(cam0) @ invert_transform(poses[0]) @ poses @ cam0
    rows = [" ".join(f"{v:.12e}" for v in pose[:3].ravel()) for pose in in_cam0]
    _write(root / "poses" / f"{sequence}.txt", rows)
    _write(root / "label_02" / f"{sequence}.txt", _label_rows(log, poses, cam0))


def _write(path: Path, rows: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def _write_calibration(
    log: DrivingLog, root: Path, sequence: str, names: dict[str, str], scanner: np.ndarray
) -> None:
    cam0 = log.rig["front"].T_vehicle_camera
    rows = []
    for name, camera in names.items():
        lens = log.rig[camera]
        # Rectified cameras have the same orientation, so all are shifts of cam0.
        shift = invert_transform(lens.T_vehicle_camera)[:3, :3] @ (
            cam0[:3, 3] - lens.T_vehicle_camera[:3, 3]
        )
        k = lens.K.copy()
        k[:2, 2] -= 0.5
        projection = np.concatenate([k, (k @ shift)[:, None]], axis=1)
        rows.append(f"P{name[-1]}: " + " ".join(f"{v:.12e}" for v in projection.ravel()))
    velo_in_vehicle = np.eye(4)
    velo_in_vehicle[:3, 3] = scanner
    velo_to_cam = invert_transform(cam0) @ velo_in_vehicle
    imu_to_velo = np.eye(4)
    imu_to_velo[:3, 3] = -VELO_IN_IMU
    for key, matrix in (("Tr_velo_cam", velo_to_cam), ("Tr_imu_velo", imu_to_velo)):
        rows.append(f"{key} " + " ".join(f"{v:.12e}" for v in matrix[:3].ravel()))
    rows.append("R_rect " + " ".join(f"{v:.12e}" for v in np.eye(3).ravel()))
    _write(root / "calib" / f"{sequence}.txt", rows)


def _raw_scan(log: DrivingLog, frame: int, scanner: np.ndarray) -> np.ndarray:
    """The uncompensated sweep: each point relative to the sensor pose at its own time."""
    sweep, times = log.lidar(frame), log.frame_times_us
    t_us = int(times[frame])
    here = log.ego.transform(t_us)
    raw = np.empty((len(sweep.points), 4), np.float32)
    raw[:, 3] = sweep.intensity
    for offset in np.unique(sweep.offset_us):
        at = sweep.offset_us == offset
        motion = invert_transform(_moved_ego(log, frame, int(offset))) @ here
        raw[at, :3] = apply_transform(motion, sweep.points[at]) - scanner
    return raw


def _moved_ego(log: DrivingLog, frame: int, offset_us: int) -> np.ndarray:
    """Ego pose, extrapolated at constant velocity outside the log."""
    t_us = int(log.frame_times_us[frame]) + offset_us
    edge = min(max(t_us, log.ego.start_us), log.ego.end_us)
    pose = log.ego.transform(edge)
    pose[:3, 3] += log.ego.velocity(edge) * (t_us - edge) * 1e-6
    return pose


def _label_rows(log: DrivingLog, poses: np.ndarray, cam0: np.ndarray) -> list[str]:
    rows = []
    for frame, t_us in enumerate(log.frame_times_us):
        T_cam0_world = invert_transform(poses[frame] @ cam0)
        for number, track in enumerate(log.tracks):
            pose = T_cam0_world @ track.trajectory.transform(int(t_us))
            length, width, height = track.size
            x, y, z = pose[:3, 3] + [0, height / 2, 0]
            heading = np.arctan2(-pose[2, 0], pose[0, 0])
            rows.append(
                f"{frame} {number} {track.category.capitalize()} 0 0 -10 0 0 1 1 "
                f"{height} {width} {length} {x:.9f} {y:.9f} {z:.9f} {heading:.9f}"
            )
    rows.append("0 -1 DontCare -1 -1 -10 0 0 1 1 -1 -1 -1 -1000 -1000 -1000 -10")
    return rows
