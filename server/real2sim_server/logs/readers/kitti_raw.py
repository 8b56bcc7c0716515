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

from ...geometry import Float
from ...scene import Trajectory
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LogError, ObjectTrack
from .common import FrameBox, build_tracks, select_sequence, upright_pose
from .files import read_lines, read_number_table
from .kitti_tracking import (
    KITTI_EGO_SIZE,
    KittiCalibration,
    KittiSource,
    calibration_from,
    check_line_count,
    numbered_files,
    oxts_poses,
    read_entries,
    read_rig,
    usable_frames,
    vehicle_poses,
)

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
        left_out = LeftOut()
        calibration_file, calibration = _read_calibration(drive, left_out)
        folders = {f"image_{i:02d}": drive / f"image_{i:02d}" / "data" for i in range(4)}
        files = numbered_files(folders, drive / "velodyne_points" / "data", digits=10)
        rig = read_rig(calibration_file, calibration, files.images, left_out)
        times_file, oxts = drive / MAIN / "timestamps.txt", drive / "oxts" / "data"
        times_us = _read_times(times_file, files.count, left_out)
        sensor_poses = _read_oxts(oxts, files.count, left_out)
        frames = usable_frames(times_us, sensor_poses, left_out, oxts)
        poses = vehicle_poses(sensor_poses, frames, calibration.T_vehicle_imu)
        tracks, keys = _read_tracklets(
            drive / "tracklet_labels.xml",
            poses @ calibration.T_vehicle_velo,
            times_us,
            frames,
            left_out,
        )
        chosen = times_us[frames].astype(np.int64)
        return DrivingLog(
            name=f"kitti_raw_{drive.name}",
            rig=rig,
            frame_times_us=chosen,
            ego=Trajectory.from_transforms(chosen, poses[frames]),
            tracks=tracks,
            source=KittiSource(rig, files, frames, calibration.T_vehicle_velo, poses),
            ego_size=KITTI_EGO_SIZE,
            provenance={
                "dataset": "KITTI raw",
                "sequence": drive.name,
                "licence": "CC BY-NC-SA 3.0 (Geiger et al. 2013)",
                "reader": self.name,
                "track_ids": keys,
            },
            left_out=left_out.told(),
        )


def _drives(path: Path) -> dict[str, Path]:
    if (path / MAIN / "data").is_dir():
        return {path.name: path}
    found = [*path.glob(f"*/{MAIN}/data"), *path.glob(f"*/*/{MAIN}/data")]
    return {p.parents[1].name: p.parents[1] for p in found}


def _read_calibration(drive: Path, left_out: LeftOut) -> tuple[Path, KittiCalibration]:
    folder = drive if (drive / "calib_cam_to_cam.txt").exists() else drive.parent
    cameras = folder / "calib_cam_to_cam.txt"
    given = read_entries(cameras, left_out, words=("calib_time",))
    entries = {f"P{i}": given[f"P_rect_{i:02d}"] for i in range(4) if f"P_rect_{i:02d}" in given}
    if "R_rect_00" not in given:
        raise LogError(f"{cameras}: has no usable line R_rect_00:")
    entries["R_rect"] = given["R_rect_00"]
    for key, name in (("Tr_velo_cam", "velo_to_cam"), ("Tr_imu_velo", "imu_to_velo")):
        path = folder / f"calib_{name}.txt"
        part = read_entries(path, left_out, words=("calib_time",))
        if part.get("R", np.zeros(0)).size != 9 or part.get("T", np.zeros(0)).size != 3:
            raise LogError(f"{path}: needs lines R: with 9 and T: with 3 numbers")
        entries[key] = np.concatenate([part["R"].reshape(3, 3), part["T"][:, None]], 1).ravel()
    return cameras, calibration_from(entries, cameras)


def _read_times(path: Path, count: int, left_out: LeftOut) -> NDArray[np.float64]:
    """Frame times [F] [us], NaN where a line is damaged. Raises LogError: see check_line_count."""
    lines = read_lines(path)
    check_line_count(path, len(lines), count)
    times = np.full(count, np.nan)
    for i, line in enumerate(lines):
        with left_out.damaged("lines"):
            where = f"{path} line {i + 1}"
            try:
                stamp = np.datetime64(line.strip().replace(" ", "T"), "ns")
            except ValueError as error:
                raise LogError(f"{where}: expected date and time, {error}") from error
            if np.isnat(stamp):
                raise LogError(f"{where}: is empty")
            times[i] = int(stamp.astype(np.int64)) // 1000
    return times


def _read_oxts(folder: Path, count: int, left_out: LeftOut) -> Float:
    """``T_any_imu`` [F, 4, 4], NaN for frames whose file is missing or damaged."""
    rows = np.full((count, 30), np.nan)
    for frame in range(count):
        path = folder / f"{frame:010d}.txt"
        with left_out.damaged("poses"):
            (rows[frame],) = read_number_table(
                path, columns=30, what="an OXTS record", left_out=left_out
            )[:1]
    return oxts_poses(rows)


def _read_tracklets(
    path: Path,
    T_world_velo: Float,
    times_us: NDArray[np.float64],
    frames: NDArray[np.intp],
    left_out: LeftOut,
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    """Tracks of ``tracklet_labels.xml``; poses refer to the centre of the box's bottom."""
    if not path.exists():
        return (), {}
    boxes, kept = [], set(frames.tolist())
    for number, item in enumerate(_tracklet_items(path)):
        with left_out.damaged("objects"):
            where = f"{path} tracklet {number}"
            kind = (item.findtext("objectType") or "other").strip().lower().replace(" ", "_")
            height, width, length = (_number(item, tag, where) for tag in "hwl")
            first = int(_number(item, "first_frame", where))
            for i, pose in enumerate(item.findall("poses/item")):
                with left_out.damaged("boxes"):
                    x, y, z, heading = (_number(pose, t, where) for t in ("tx", "ty", "tz", "rz"))
                    if first + i not in kept:
                        raise LogError(f"{where}: there is no usable frame {first + i}")
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
    return build_tracks(boxes, left_out)


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
