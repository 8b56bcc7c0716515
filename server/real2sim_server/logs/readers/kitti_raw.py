"""KITTI raw data: one folder per drive, below one folder per recording day.

Source: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the raw data's
development kit. World, vehicle frame and motion compensation are as in :mod:`.kitti_tracking`.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform
from ...scene import Trajectory
from ..driving_log import DrivingLog, LogError, ObjectTrack
from .common import FrameBox, build_tracks, select_sequence, upright_pose
from .files import check_frame_times, read_lines, read_number_table
from .kitti_tracking import (
    KITTI_EGO_SIZE,
    MISSING_SCANS,
    KittiCalibration,
    KittiSource,
    calibration_from,
    oxts_poses,
    read_entries,
    read_rig,
)

DRIVES_WITH_MISSING_SCANS = {"2011_09_26_drive_0009_sync": MISSING_SCANS["0001"]}
"""Sequence 0001 of the tracking set is this drive."""

MAIN = "image_02"
CATEGORIES = {"person_(sitting)": "pedestrian", "misc": "other"}


class KittiRawReader:
    """Reads a drive's folder, or one of several in a day's folder."""

    name = "kitti_raw"
    expects = (
        "[<drive>/]image_02/data/%010d.png with timestamps.txt, velodyne_points/data, oxts/data; "
        "calib_cam_to_cam.txt, calib_velo_to_cam.txt, calib_imu_to_velo.txt beside the drive"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there is an ``image_02/data``, here or in a drive's folder."""
        return bool(_drives(path))

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The drive ``sequence``; the only one by default.

        Poses come from the GPS/IMU unit, boxes from ``tracklet_labels.xml`` if it exists.

        Raises:
            LogError: see :class:`LogReader`.
        """
        drives = _drives(path)
        drive = drives[select_sequence(path, sorted(drives), sequence)]
        calibration_file, calibration = _read_calibration(drive)
        images = _image_files(drive)
        count = len(images[MAIN])
        rig = read_rig(calibration_file, calibration, images)
        times_us = _read_times(drive / MAIN / "timestamps.txt", count)
        scans = _scan_files(drive, count)
        poses = _vehicle_poses(drive / "oxts" / "data", count, calibration)
        tracks, keys = _read_tracklets(
            drive / "tracklet_labels.xml", poses @ calibration.T_vehicle_velo, times_us
        )
        return DrivingLog(
            name=f"kitti_raw_{drive.name}",
            rig=rig,
            frame_times_us=times_us,
            ego=Trajectory.from_transforms(times_us, poses),
            tracks=tracks,
            source=KittiSource(rig, images, scans, calibration.T_vehicle_velo, poses),
            ego_size=KITTI_EGO_SIZE,
            provenance={
                "dataset": "KITTI raw",
                "sequence": drive.name,
                "licence": "CC BY-NC-SA 3.0 (Geiger et al. 2013)",
                "reader": self.name,
                "track_ids": keys,
            },
        )


def _drives(path: Path) -> dict[str, Path]:
    if (path / MAIN / "data").is_dir():
        return {path.name: path}
    found = [*path.glob(f"*/{MAIN}/data"), *path.glob(f"*/*/{MAIN}/data")]
    return {p.parents[1].name: p.parents[1] for p in found}


def _read_calibration(drive: Path) -> tuple[Path, KittiCalibration]:
    folder = drive if (drive / "calib_cam_to_cam.txt").exists() else drive.parent
    cameras = folder / "calib_cam_to_cam.txt"
    given = read_entries(cameras, words=("calib_time",))
    entries = {f"P{i}": given[f"P_rect_{i:02d}"] for i in range(4) if f"P_rect_{i:02d}" in given}
    if "R_rect_00" not in given:
        raise LogError(f"{cameras}: has no line R_rect_00:")
    entries["R_rect"] = given["R_rect_00"]
    for key, name in (("Tr_velo_cam", "velo_to_cam"), ("Tr_imu_velo", "imu_to_velo")):
        path = folder / f"calib_{name}.txt"
        part = read_entries(path, words=("calib_time",))
        if part.get("R", np.zeros(0)).size != 9 or part.get("T", np.zeros(0)).size != 3:
            raise LogError(f"{path}: needs lines R: with 9 and T: with 3 numbers")
        entries[key] = np.concatenate([part["R"].reshape(3, 3), part["T"][:, None]], 1).ravel()
    return cameras, calibration_from(entries, cameras)


def _image_files(drive: Path) -> dict[str, list[Path]]:
    """Image files of each camera; all lists have the length of the longest."""
    folders = {f"image_{i:02d}": drive / f"image_{i:02d}" / "data" for i in range(4)}
    folders = {name: folder for name, folder in folders.items() if folder.is_dir()}
    suffixes = {n: ".jpg" if any(f.glob("*.jpg")) else ".png" for n, f in folders.items()}
    count = max(sum(1 for _ in f.glob(f"*{suffixes[n]}")) for n, f in folders.items())
    if count == 0:
        raise LogError(f"{folders[MAIN]}: holds no images %010d.png")
    return {n: [f / f"{i:010d}{suffixes[n]}" for i in range(count)] for n, f in folders.items()}


def _read_times(path: Path, count: int) -> NDArray[np.int64]:
    times = []
    for number, line in enumerate(read_lines(path), start=1):
        try:
            stamp = np.datetime64(line.strip().replace(" ", "T"), "ns")
        except ValueError as error:
            raise LogError(f"{path} line {number}: expected date and time, {error}") from error
        if np.isnat(stamp):
            raise LogError(f"{path} line {number}: is empty")
        times.append(int(stamp.astype(np.int64)) // 1000)
    if len(times) != count:
        raise LogError(f"{path}: holds {len(times)} times, but there are {count} images")
    return check_frame_times(np.array(times, dtype=np.int64), str(path))


def _scan_files(drive: Path, count: int) -> list[Path | None]:
    missing = DRIVES_WITH_MISSING_SCANS.get(drive.name, ())
    scans: list[Path | None] = []
    for frame in range(count):
        path = drive / "velodyne_points" / "data" / f"{frame:010d}.bin"
        scans.append(None if frame in missing and not path.is_file() else path)
    return scans


def _vehicle_poses(folder: Path, count: int, calibration: KittiCalibration) -> Float:
    rows = [
        read_number_table(folder / f"{frame:010d}.txt", columns=30, what="an OXTS record")
        for frame in range(count)
    ]
    poses = oxts_poses(np.concatenate(rows))
    motion = invert_transform(poses[0]) @ poses
    T_vehicle_imu = calibration.T_vehicle_imu
    return T_vehicle_imu @ motion @ invert_transform(T_vehicle_imu)


def _read_tracklets(
    path: Path, T_world_velo: Float, times_us: NDArray[np.int64]
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    """Tracks of ``tracklet_labels.xml``; poses refer to the centre of the box's bottom."""
    if not path.exists():
        return (), {}
    boxes = []
    for number, item in enumerate(_tracklet_items(path)):
        where = f"{path} tracklet {number}"
        kind = (item.findtext("objectType") or "other").strip().lower().replace(" ", "_")
        height, width, length = (_number(item, tag, where) for tag in "hwl")
        first = int(_number(item, "first_frame", where))
        for i, pose in enumerate(item.findall("poses/item")):
            x, y, z, heading = (_number(pose, t, where) for t in ("tx", "ty", "tz", "rz"))
            if not 0 <= first + i < len(times_us):
                raise LogError(f"{where}: frame {first + i} is not in 0 to {len(times_us) - 1}")
            local = upright_pose((x, y, z + height / 2), heading)
            boxes.append(
                FrameBox(
                    key=str(number),
                    category=CATEGORIES.get(kind, kind),
                    size=(length, width, height),
                    time_us=int(times_us[first + i]),
                    T_world_object=T_world_velo[first + i] @ local,
                    where=where,
                )
            )
    return build_tracks(boxes)


def _tracklet_items(path: Path) -> Sequence[ET.Element]:
    text = "\n".join(read_lines(path))
    # Entities could expand a small file until it fills the memory; tracklet files have none.
    if "<!ENTITY" in text:
        raise LogError(f"{path}: declares entities; tracklet files have none")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise LogError(f"{path}: is not an XML file ({error})") from error
    tracklets = root.find("tracklets")
    if tracklets is None:
        raise LogError(f"{path}: has no element <tracklets>")
    return tracklets.findall("item")


def _number(element: ET.Element, tag: str, where: str) -> float:
    text = element.findtext(tag)
    try:
        value = float(text or "")
    except ValueError as error:
        raise LogError(f"{where}: <{tag}> must be a number, not {text!r}") from error
    if not np.isfinite(value):
        raise LogError(f"{where}: <{tag}> is not finite")
    return value
