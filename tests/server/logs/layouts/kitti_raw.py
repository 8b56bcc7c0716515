"""A KITTI raw drive, derived from the tracking layout of the same log."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from real2sim_server.geometry import (
    invert_transform,
    matrix_to_quaternion,
    quaternion_yaw,
)
from real2sim_server.logs import DrivingLog
from real2sim_server.logs.readers.kitti_tracking import EARTH_RADIUS

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0042_sync"
LATITUDE, LONGITUDE, COURSE = 49.0, 8.4, 0.7
UNIT_LEFT = 0.32
"""Offset of the GPS/IMU unit to the left of the vehicle's centre line [m]."""


def write(log: DrivingLog, tracking: Path, folder: Path) -> None:
    training, drive = tracking / "training", folder / DAY / DRIVE
    for name in ("image_00", "image_02"):
        _renumber(training / name / "0007", drive / name / "data")
        _write_times(drive / name / "timestamps.txt", log)
    _renumber(training / "velodyne/0007", drive / "velodyne_points/data")
    _write_times(drive / "velodyne_points/timestamps.txt", log)
    _write_calibration(training / "calib/0007.txt", folder / DAY)
    _write_oxts(drive / "oxts/data", log)
    _write_tracklets(drive / "tracklet_labels.xml", log)


def _renumber(source: Path, target: Path) -> None:
    target.mkdir(parents=True)
    for path in source.iterdir():
        shutil.copy(path, target / f"{int(path.stem):010d}{path.suffix}")


def _write_times(path: Path, log: DrivingLog) -> None:
    start = np.datetime64("2011-09-26T13:02:25.594360375", "ns")
    stamps = [start + np.timedelta64(int(t), "us") for t in log.frame_times_us]
    path.write_text("".join(f"{str(s).replace('T', ' ')}\n" for s in stamps))


def _write_calibration(tracking: Path, folder: Path) -> None:
    given = {}
    for line in tracking.read_text().splitlines():
        key, _, values = line.replace(":", " ").partition(" ")
        given[key] = values.strip()
    rows = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.95e-02"]
    rows += [f"R_rect_00: {given['R_rect']}"]
    rows += [f"P_rect_0{i}: {given[f'P{i}']}" for i in (0, 2)]
    (folder / "calib_cam_to_cam.txt").write_text("\n".join(rows) + "\n")
    for key, name in (("Tr_velo_cam", "velo_to_cam"), ("Tr_imu_velo", "imu_to_velo")):
        matrix = np.array(given[key].split(), float).reshape(3, 4)
        lines = ["calib_time: 25-May-2012 16:47:16"]
        lines += [f"{n}: " + " ".join(f"{v:.12e}" for v in m.ravel()) for n, m in _parts(matrix)]
        (folder / f"calib_{name}.txt").write_text("\n".join(lines) + "\n")


def _parts(matrix: np.ndarray) -> list[tuple[str, np.ndarray]]:
    return [("R", matrix[:, :3]), ("T", matrix[:, 3])]


def _write_oxts(folder: Path, log: DrivingLog) -> None:
    folder.mkdir(parents=True)
    meridian = np.pi / 180 * EARTH_RADIUS
    turn = np.array([[np.cos(COURSE), -np.sin(COURSE)], [np.sin(COURSE), np.cos(COURSE)]])
    for frame, t_us in enumerate(log.frame_times_us):
        pose = log.ego.transform(int(t_us))
        east, north = turn @ pose[:2, 3]
        yaw = COURSE + float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
        east -= UNIT_LEFT * np.sin(yaw)
        north += UNIT_LEFT * np.cos(yaw)
        record = np.zeros(30)
        record[:3] = LATITUDE + north / meridian, LONGITUDE, 115.0
        record[1] += east / (meridian * np.cos(np.radians(LATITUDE)))
        record[5] = yaw
        (folder / f"{frame:010d}.txt").write_text(" ".join(f"{v:.12f}" for v in record))


def _write_tracklets(path: Path, log: DrivingLog) -> None:
    scanner = np.eye(4)
    scanner[:3, 3] = log.lidar(0).origin
    items = []
    for track in log.tracks:
        length, width, height = track.size
        poses = []
        for t_us in log.frame_times_us:
            T_velo_world = invert_transform(log.ego.transform(int(t_us)) @ scanner)
            pose = T_velo_world @ track.trajectory.transform(int(t_us))
            x, y, z = pose[:3, 3] - [0, 0, height / 2]
            heading = float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
            poses.append(
                f"<item><tx>{x:.9f}</tx><ty>{y:.9f}</ty><tz>{z:.9f}</tz>"
                f"<rx>0</rx><ry>0</ry><rz>{heading:.9f}</rz><state>2</state></item>"
            )
        items.append(
            f"<item><objectType>{track.category.capitalize()}</objectType>"
            f"<h>{height}</h><w>{width}</w><l>{length}</l><first_frame>0</first_frame>"
            f"<poses><count>{len(poses)}</count>{''.join(poses)}</poses></item>"
        )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        f"<boost_serialization><tracklets><count>{len(items)}</count>{''.join(items)}"
        "</tracklets></boost_serialization>\n"
    )
