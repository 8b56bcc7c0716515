"""KITTI raw data: a drive a clip and camera, with GPS/IMU records and tracklets.

Source: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the raw data's
development kit. Camera, scanner and scans are as in :mod:`.kitti`; the GPS/IMU unit is the ego's
origin. Boxes turn about the scanner's vertical axis only.
"""

from __future__ import annotations

import datetime
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from ...scene import Camera
from ..clips import Clip
from .kitti import (
    CLASSES,
    VELODYNE,
    numbers,
    shift,
    vehicle_in_ego,
    velodyne_in_camera,
    write_scan,
)
from .writer import LabelledDrive, write_json

DAY = "2011_09_26"
LATITUDE, LONGITUDE, ALTITUDE = 49.0, 8.4, 110.0
"""Where the world of the scene begins: any place will do."""
EARTH_RADIUS = 6_378_137.0


class KittiRawWriter:
    """Writes ``<day>/<day>_drive_NNNN_sync`` and the calibration of each."""

    name = "kitti_raw"
    holds = "a drive a clip and camera: image_02, velodyne_points, oxts, tracklet_labels.xml, calib"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        drives: dict[str, dict[str, str]] = {}
        for clip in drive.clips:
            for camera in drive.cameras:
                name = f"{DAY}_drive_{len(drives):04d}_sync"
                drives[name] = {"clip": clip.name, "camera": camera.name, "split": clip.split}
                _write_drive(folder / DAY / name, clip, camera)
        write_json(folder / "drives.json", drives)


def _write_drive(folder: Path, clip: Clip, camera: Camera) -> None:
    for part in ("image_02", "velodyne_points", "oxts"):
        (folder / part / "data").mkdir(parents=True)
        stamps = "".join(f"{_stamp(frame['t_us'])}\n" for frame in clip.frames)
        (folder / part / "timestamps.txt").write_text(stamps)
    world = np.array([frame["T_world_ego"] for frame in clip.frames]) @ vehicle_in_ego(camera)
    for k, frame in enumerate(clip.frames):
        image = clip.file("rgb", camera.name, frame["index"])
        shutil.copyfile(image, folder / "image_02" / "data" / f"{k:010d}.png")
        write_scan(folder / "velodyne_points" / "data" / f"{k:010d}.bin", clip, camera, k)
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(_oxts(world[k]) + "\n")
    _write_calibration(folder, camera)
    (folder / "tracklet_labels.xml").write_text(_tracklets(clip, camera), encoding="utf-8")


def _stamp(t_us: int) -> str:
    """Since the day's noon, as a date and time with nanoseconds."""
    noon = datetime.datetime(2011, 9, 26, 12)
    return f"{noon + datetime.timedelta(microseconds=t_us):%Y-%m-%d %H:%M:%S.%f}000"


def _oxts(pose: Float) -> str:
    """A GPS/IMU record: Mercator projection, scaled for LATITUDE as the development kit does."""
    scale = math.cos(math.radians(LATITUDE)) * EARTH_RADIUS
    rise = math.log(math.tan(math.radians(90 + LATITUDE) / 2)) + pose[1, 3] / scale
    latitude = math.degrees(2 * math.atan(math.exp(rise))) - 90
    longitude = LONGITUDE + math.degrees(pose[0, 3] / scale)
    roll, pitch = math.atan2(pose[2, 1], pose[2, 2]), -math.asin(np.clip(pose[2, 0], -1, 1))
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    found = [latitude, longitude, ALTITUDE + pose[2, 3], roll, pitch, yaw]
    return " ".join([*(f"{value:.15g}" for value in found), *["0"] * 24])


def _write_calibration(folder: Path, camera: Camera) -> None:
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    projection = np.concatenate([K, np.zeros((3, 1))], axis=1)
    cameras = [f"calib_time: {DAY}", f"R_rect_00: {numbers(np.eye(3).ravel())}"]
    cameras += [f"P_rect_{k:02d}: {numbers(projection.ravel())}" for k in range(4)]
    lines = {
        "cam_to_cam": cameras,
        "velo_to_cam": _rigid_lines(velodyne_in_camera(camera)),
        "imu_to_velo": _rigid_lines(invert_transform(shift(VELODYNE))),
    }
    for name, rows in lines.items():
        (folder / f"calib_{name}.txt").write_text("".join(f"{row}\n" for row in rows))


def _rigid_lines(transform: Float) -> list[str]:
    turn, place = transform[:3, :3].ravel(), transform[:3, 3]
    return [f"calib_time: {DAY}", f"R: {numbers(turn)}", f"T: {numbers(place)}"]


def _tracklets(clip: Clip, camera: Camera) -> str:
    to_velo = invert_transform(shift(VELODYNE)) @ invert_transform(vehicle_in_ego(camera))
    items = [line for run in _runs(clip) for line in _tracklet(run, to_velo)]
    count = sum(line == "<item>" for line in items)
    head = [
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>',
        '<boost_serialization signature="serialization::archive" version="9">',
        '<tracklets class_id="0" tracking_level="0" version="0">',
        f"<count>{count}</count><item_version>1</item_version>",
    ]
    return "\n".join([*head, *items, "</tracklets>", "</boost_serialization>"]) + "\n"


def _runs(clip: Clip) -> Iterator[list[tuple[int, Mapping[str, Any]]]]:
    """Frames in which an object is there, one after the other, for each object."""
    at_hand: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    for k, frame in enumerate(clip.frames):
        present = {subject["object_id"]: subject for subject in frame["objects"]}
        for gone in [name for name in at_hand if name not in present]:
            yield at_hand.pop(gone)
        for name, subject in present.items():
            at_hand.setdefault(name, []).append((k, subject))
    yield from at_hand.values()


def _tracklet(run: Sequence[tuple[int, Mapping[str, Any]]], to_velo: Float) -> Iterator[str]:
    first, subject = run[0]
    length, width, height = subject["size"]
    kind = CLASSES.get(subject["category"], "Misc")
    yield "<item>"
    yield f"<objectType>{escape(kind)}</objectType>"
    yield f"<h>{height!r}</h><w>{width!r}</w><l>{length!r}</l><first_frame>{first}</first_frame>"
    yield f"<poses><count>{len(run)}</count><item_version>2</item_version>"
    for _, seen in run:
        pose = to_velo @ np.array(seen["T_ego_object"])
        heading = math.atan2(pose[1, 0], pose[0, 0])
        place = pose[:3, 3] - [0.0, 0.0, height / 2]
        tags = dict(zip(("tx", "ty", "tz"), place.tolist(), strict=True))
        tags |= {"rx": 0.0, "ry": 0.0, "rz": heading}
        cells = "".join(f"<{tag}>{value!r}</{tag}>" for tag, value in tags.items())
        flags = "<state>2</state><occlusion>0</occlusion><truncation>0</truncation>"
        yield f"<item>{cells}{flags}</item>"
    yield "</poses>"
    yield "<finished>1</finished></item>"
