"""KITTI tracking layout, with poses from ``poses/`` (odometry format) or ``oxts/``.

World frame: the vehicle frame of frame 0 (x forward, y left, z up, rear axle on the ground).
Source: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the development
kit of the tracking benchmark.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....geometry.rotation import Float
from ....geometry.transform import apply_transform, invert_transform
from ....scene import Camera, CameraRig, Trajectory
from ...driving_log import DrivingLog, LidarSweep, LogError, ObjectTrack
from ...images import check_image_file, image_size, read_image
from ..formats.point_files import count_rows, read_rows
from ..selection import select_sequence
from ..sweep_motion import compensate_sweep
from .files import (
    KittiCalibration,
    KittiLabel,
    read_calibration,
    read_labels,
    read_oxts,
    read_poses,
    read_times,
)

SWEEP_US = 100_000
COLUMNS = 4
"""Of a scan's points: x, y, z, reflectance."""
MISSING_SCANS = {"0001": range(177, 181)}
"""Scans that the published data set lacks, by sequence; these frames get an empty sweep."""

KITTI_EGO_SIZE = (4.77, 1.82, 1.50)
"""VW Passat B6 Variant, the recording car [m]."""


class KittiReader:
    """Reads the KITTI tracking layout."""

    name = "kitti"
    expects = (
        "[training/]image_02/<seq>/%06d.png (and image_00, 01, 03), velodyne/<seq>/%06d.bin, "
        "calib/<seq>.txt, label_02/<seq>.txt, poses/<seq>.txt or oxts/<seq>.txt"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there are ``image_02`` and ``calib``, here or in ``training``."""
        root = _training_folder(path)
        return (root / "image_02").is_dir() and (root / "calib").is_dir()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The drive ``sequence`` under the data set's root or its ``training`` folder.

        Cameras are named after their folders (``image_02``); the baselines in P0 to P3 are part
        of ``T_vehicle_camera``. Boxes come from ``boxes_surround`` (all vehicles in every frame)
        where that exists, else from ``label_02``. Sweeps are brought to image time with the
        vehicle's own motion: the scanner turns clockwise and looks ahead when images are taken,
        so a point at azimuth a was measured ``-a / (2 pi) * 0.1 s`` later.

        Raises:
            LogError: see :class:`LogReader`.
        """
        root = _training_folder(path)
        sequence = _select_sequence(root, sequence)
        calibration = read_calibration(root / "calib" / f"{sequence}.txt")
        images = _image_files(root, sequence)
        frame_count = len(images["image_02"])
        rig = read_rig(root / "calib" / f"{sequence}.txt", calibration, images)
        scans = _scan_files(root / "velodyne" / sequence, sequence, frame_count)
        times_us = read_times(root / "times" / f"{sequence}.txt", frame_count)
        vehicle_poses, pose_source = _vehicle_poses(root, sequence, frame_count, calibration)
        labels, label_source = _labels(root, sequence, frame_count)
        return DrivingLog(
            name=f"kitti_{sequence}",
            rig=rig,
            frame_times_us=times_us,
            ego=Trajectory.from_transforms(times_us, vehicle_poses),
            tracks=_tracks(labels, vehicle_poses @ calibration.T_vehicle_cam0, times_us),
            source=KittiSource(rig, images, scans, calibration.T_vehicle_velo, vehicle_poses),
            ego_size=KITTI_EGO_SIZE,
            provenance={
                "dataset": "KITTI tracking layout",
                "sequence": sequence,
                "licence": "CC BY-NC-SA 3.0 (Geiger et al. 2013)",
                "reader": self.name,
                "poses": pose_source,
                "boxes": label_source,
            },
        )


def _training_folder(path: Path) -> Path:
    return path / "training" if (path / "training").is_dir() else path


def _select_sequence(root: Path, sequence: str | None) -> str:
    folder = root / "image_02"
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; expected {KittiReader.expects}")
    known = sorted(p.name for p in folder.iterdir() if p.is_dir())
    return select_sequence(folder, known, sequence)


def _image_files(root: Path, sequence: str) -> dict[str, list[Path]]:
    """Files of every camera; as many for each as the camera with the most images has."""
    folders, suffixes, frame_count = {}, {}, 0
    for folder in (root / f"image_{i:02d}" / sequence for i in range(4)):
        if folder.is_dir():
            name = folder.parent.name
            folders[name] = folder
            suffixes[name] = ".jpg" if (folder / "000000.jpg").exists() else ".png"
            count = sum(p.suffix == suffixes[name] for p in folder.iterdir())
            frame_count = max(frame_count, count)
    if frame_count == 0:
        raise LogError(f"{root / 'image_02' / sequence}: holds no images %06d.png")
    return {
        name: [folder / f"{f:06d}{suffixes[name]}" for f in range(frame_count)]
        for name, folder in folders.items()
    }


def read_rig(path: Path, calibration: KittiCalibration, images: dict[str, list[Path]]) -> CameraRig:
    """Cameras by name ``image_NN``; ``path`` is the calibration, for errors."""
    cameras = []
    for name, files in images.items():
        index = int(name[-2:])
        if index not in calibration.projections:
            raise LogError(f"{path}: has no line P{index}: with 12 values, needed for {name}")
        projection = calibration.projections[index]
        k = projection[:, :3].copy()
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise LogError(f"{path}: P{index} needs positive focal lengths, not {projection}")
        T_camera_cam0 = np.eye(4)
        T_camera_cam0[:3, 3] = np.linalg.solve(k, projection[:, 3])
        # KITTI puts pixel centres on whole numbers, a Camera at +0.5.
        k[:2, 2] += 0.5
        pose = calibration.T_vehicle_cam0 @ invert_transform(T_camera_cam0)
        width, height = image_size(files[0])
        cameras.append(Camera(name, width, height, k, pose))
    return CameraRig(tuple(cameras))


def _scan_files(folder: Path, sequence: str, frame_count: int) -> list[Path | None]:
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder; expected {frame_count} scans %06d.bin")
    scans: list[Path | None] = []
    for frame in range(frame_count):
        path = folder / f"{frame:06d}.bin"
        if not path.exists() and frame in MISSING_SCANS.get(sequence, ()):
            scans.append(None)
            continue
        scans.append(path)
    return scans


def _vehicle_poses(
    root: Path, sequence: str, frame_count: int, calibration: KittiCalibration
) -> tuple[Float, str]:
    poses_file, oxts_file = (root / folder / f"{sequence}.txt" for folder in ("poses", "oxts"))
    if poses_file.exists():
        path, poses, T_vehicle_sensor = (
            poses_file,
            read_poses(poses_file),
            calibration.T_vehicle_cam0,
        )
    elif oxts_file.exists():
        path, poses, T_vehicle_sensor = oxts_file, read_oxts(oxts_file), calibration.T_vehicle_imu
    else:
        raise LogError(f"no ego poses: neither {poses_file} nor {oxts_file} exists")
    if len(poses) != frame_count:
        raise LogError(f"{path}: holds {len(poses)} poses, but there are {frame_count} images")
    motion = invert_transform(poses[0]) @ poses
    return T_vehicle_sensor @ motion @ invert_transform(T_vehicle_sensor), path.parent.name


def _labels(root: Path, sequence: str, frame_count: int) -> tuple[list[KittiLabel], str | None]:
    for folder in ("boxes_surround", "label_02"):
        path = root / folder / f"{sequence}.txt"
        if path.exists():
            return read_labels(path, frame_count), folder
    if (root / "label_02").is_dir():
        raise LogError(f"{root / 'label_02' / sequence}.txt: no such file; it holds the boxes")
    return [], None


def _tracks(
    labels: list[KittiLabel], T_world_cam0: Float, times_us: NDArray[np.int64]
) -> tuple[ObjectTrack, ...]:
    by_object: dict[tuple[int, str], dict[int, KittiLabel]] = defaultdict(dict)
    for label in labels:
        by_object[label.track_id, label.category][label.frame] = label
    tracks = []
    for (track_id, category), boxes in sorted(by_object.items()):
        frames = sorted(boxes)
        transforms = [T_world_cam0[f] @ boxes[f].T_cam0_object for f in frames]
        length, width, height = np.median([boxes[f].size for f in frames], axis=0)
        tracks.append(
            ObjectTrack(
                object_id=f"{category}_{track_id}",
                category=category,
                size=(float(length), float(width), float(height)),
                trajectory=Trajectory.from_transforms(times_us[frames], np.array(transforms)),
            )
        )
    return tuple(tracks)


@dataclass(frozen=True, eq=False)
class KittiSource:
    """Files of a KITTI drive, and what it takes to bring scans to image time."""

    rig: CameraRig
    images: dict[str, list[Path]]
    scans: list[Path | None]
    T_vehicle_velo: Float
    vehicle_poses: Float

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """RGB [H, W, 3]; see :class:`FrameSource`."""
        return read_image(self.images[camera][frame])

    def check_image(self, camera: str, frame: int) -> None:
        """See :class:`ChecksFiles`."""
        lens = self.rig[camera]
        check_image_file(self.images[camera][frame], (lens.width, lens.height))

    def check_sweep(self, frame: int) -> int:
        """See :class:`ChecksFiles`."""
        path = self.scans[frame]
        return 0 if path is None else count_rows(path, COLUMNS)

    def lidar(self, frame: int) -> LidarSweep:
        """The compensated scan; see :class:`FrameSource`."""
        scan = self._raw_scan(frame)
        points = scan[:, :3].astype(np.float64)
        offset = -np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        in_vehicle = apply_transform(self.T_vehicle_velo, points)
        return LidarSweep(
            points=compensate_sweep(in_vehicle, offset, self.vehicle_poses, frame),
            intensity=np.clip(scan[:, 3], 0, 1),
            offset_us=np.round(offset * SWEEP_US).astype(np.int32),
            origin=self.T_vehicle_velo[:3, 3].astype(np.float32),
        )

    def _raw_scan(self, frame: int) -> NDArray[np.float32]:
        path = self.scans[frame]
        if path is None:
            return np.zeros((0, COLUMNS), dtype=np.float32)
        scan = read_rows(path, COLUMNS)
        return scan[np.isfinite(scan).all(axis=1)]
