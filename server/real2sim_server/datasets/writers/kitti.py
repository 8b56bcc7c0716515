"""KITTI: the object and tracking benchmarks, and raw data."""

from __future__ import annotations

import datetime
import itertools
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform, wrapped
from ...logs.readers.common import compensate_sweep
from ...scene import Camera
from ..clips import Clip
from .categories import classes_of
from .writer import LabelledDrive, objects_of, write_json

MISC = "Misc"
"""Type of categories without one of KITTI's."""

OCCLUDED = (0.85, 0.45)
"""Minimum visibility of fully (0) and partly (1) visible objects; below it is 2."""

VELODYNE = (0.9, 0.0, 1.73)
"""Position of the scanner in the ego frame [m], at KITTI's height above the road. It has the axes
of the ego, so that the sequences of all cameras have the same scans."""

T_EGO_VELO = np.eye(4)
T_EGO_VELO[:3, 3] = VELODYNE

ROUNDS, SETTLED = 8, 1e-4
"""Maximum number of iterations to invert the motion compensation of a point, and maximum size of
the last step of a point that is kept [m]."""


class KittiWriter:
    """Writes ``tracking/training`` and ``object/training``."""

    name = "kitti"
    holds = "tracking (image_02, label_02, calib, velodyne, poses, times) and object (label_2)"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        sequences: dict[str, dict[str, str]] = {}
        tracking, single = (folder / name / "training" for name in ("tracking", "object"))
        numbers = itertools.count()
        for clip in drive.clips:
            with tempfile.TemporaryDirectory(dir=folder) as place:
                scans = write_scans(clip, Path(place))
                for camera in drive.cameras:
                    name = f"{len(sequences):04d}"
                    sequences[name] = {
                        "clip": clip.name,
                        "camera": camera.name,
                        "split": clip.split,
                    }
                    _write_sequence(tracking, name, clip, camera, scans)
                    _write_object_frames(single, numbers, clip, camera, scans)
        write_json(folder / "sequences.json", sequences)


def link_or_copy(source: Path, target: Path) -> None:
    """Make a hard link to a file, which stores it once; a copy where the file system refuses
    links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def _write_sequence(
    root: Path, name: str, clip: Clip, camera: Camera, scans: Sequence[Path]
) -> None:
    tracks = _track_numbers(clip)
    seen, all_around = [], []
    for k, frame in enumerate(clip.frames):
        link_or_copy(clip.file("rgb", camera.name, k), root / "image_02" / name / f"{k:06d}.png")
        link_or_copy(scans[k], root / "velodyne" / name / f"{k:06d}.bin")
        for row in _seen_rows(frame, camera):
            seen.append(f"{k} {tracks[row['object_id']]} {_columns(row)}")
        for row in _all_rows(frame, camera):
            all_around.append(f"{k} {tracks[row['object_id']]} {_columns(row)}")
    _write_lines(root / "label_02" / f"{name}.txt", seen)
    _write_lines(root / "boxes_surround" / f"{name}.txt", all_around)
    _write_lines(root / "calib" / f"{name}.txt", _calibration(camera, "R_rect", "Tr_velo_cam"))
    first = np.array(clip.frames[0]["T_world_ego"]) @ camera.T_vehicle_camera
    poses = [
        invert_transform(first) @ np.array(f["T_world_ego"]) @ camera.T_vehicle_camera
        for f in clip.frames
    ]
    _write_lines(root / "poses" / f"{name}.txt", [numbers(p[:3].ravel()) for p in poses])
    start = clip.frames[0]["t_us"]
    times = [f"{(f['t_us'] - start) * 1e-6:.6f}" for f in clip.frames]
    _write_lines(root / "times" / f"{name}.txt", times)


def _write_object_frames(
    root: Path, numbers: Iterator[int], clip: Clip, camera: Camera, scans: Sequence[Path]
) -> None:
    calibration = _calibration(camera, "R0_rect", "Tr_velo_to_cam")
    for k, frame in enumerate(clip.frames):
        name = f"{next(numbers):06d}"
        link_or_copy(clip.file("rgb", camera.name, k), root / "image_2" / f"{name}.png")
        link_or_copy(scans[k], root / "velodyne" / f"{name}.bin")
        labels = [_columns(row) for row in _seen_rows(frame, camera)]
        _write_lines(root / "label_2" / f"{name}.txt", labels)
        _write_lines(root / "calib" / f"{name}.txt", calibration)


def _track_numbers(clip: Clip) -> dict[str, int]:
    """A number for each object, in order of its first appearance."""
    numbers: dict[str, int] = {}
    for frame in clip.frames:
        for subject in frame["objects"]:
            numbers.setdefault(subject["object_id"], len(numbers))
    return numbers


def _seen_rows(frame: Mapping[str, Any], camera: Camera) -> list[dict[str, Any]]:
    """Objects with at least one visible pixel in the camera."""
    objects = objects_of(frame)
    return [
        {**objects[view["object_id"]], **view}
        for view in frame["views"][camera.name]
        if view["box_2d_modal"] is not None
    ]


def _all_rows(frame: Mapping[str, Any], camera: Camera) -> list[dict[str, Any]]:
    """All objects, including those outside the camera's view."""
    seen = {view["object_id"]: view for view in frame["views"][camera.name]}
    unseen = {"box_2d_modal": None, "visibility": 0.0, "truncation": 1.0}
    to_camera = invert_transform(camera.T_vehicle_camera)
    return [
        {
            **subject,
            "T_camera_object": (to_camera @ np.array(subject["T_ego_object"])).tolist(),
            **seen.get(subject["object_id"], unseen),
        }
        for subject in frame["objects"]
    ]


def _columns(row: Mapping[str, Any]) -> str:
    """Type, truncated, occluded, alpha, 2D box, h w l, x y z, ry."""
    pose: Float = np.array(row["T_camera_object"])
    length, width, height = row["size"]
    x, y, z = pose[:3, 3].tolist()
    heading = math.atan2(-pose[2, 0], pose[0, 0])
    alpha = float(wrapped(heading - math.atan2(x, z)))
    box = row["box_2d_modal"]
    pixels = [-1.0] * 4 if box is None else [max(edge - 0.5, 0.0) for edge in box]
    occluded = sum(row["visibility"] < least for least in OCCLUDED)
    values = [alpha, *pixels, height, width, length, x, y + height / 2, z, heading]
    kind = classes_of(row["category"]).kitti or MISC
    return f"{kind} {row['truncation']:.6f} {occluded} {numbers(values)}"


def _calibration(camera: Camera, rectification: str, velo_to_cam: str) -> list[str]:
    """Calibration with the camera as KITTI's colour camera and as the reference."""
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    projection = np.concatenate([K, np.zeros((3, 1))], axis=1)
    T_camera_velo = invert_transform(camera.T_vehicle_camera) @ T_EGO_VELO
    return [
        *(f"P{k}: {numbers(projection.ravel())}" for k in range(4)),
        f"{rectification}: {numbers(np.eye(3).ravel())}",
        f"{velo_to_cam}: {numbers(T_camera_velo[:3].ravel())}",
        f"Tr_imu_to_velo: {numbers(invert_transform(T_EGO_VELO)[:3].ravel())}",
    ]


def write_scans(clip: Clip, folder: Path) -> list[Path]:
    """Write the scan of each frame: x, y, z and reflectance of each point, float32, as measured by
    the moving scanner."""
    poses = np.array([frame["T_world_ego"] for frame in clip.frames])
    paths = [folder / f"{k}.bin" for k in range(len(clip.frames))]
    for k, path in enumerate(paths):
        rows = clip.points(k)
        points, measured = _as_measured(rows["xyz"].astype(np.float64), poses, k)
        scan = np.empty((len(rows), 4), "<f4")
        scan[:, :3] = points - VELODYNE
        scan[:, 3] = rows["intensity"]
        path.write_bytes(scan[measured].tobytes())
    return paths


def _as_measured(points: Float, poses: Float, frame: int) -> tuple[Float, NDArray[np.bool_]]:
    """Points [N, 3] of one instant, moved to the ego frame at their times of measurement, and a
    mask [N] of those that the scanner can measure.

    The scanner turns clockwise once per frame and looks ahead at the frame's time. In a curve, it
    misses a strip straight behind it.
    """
    measured, left = points.copy(), np.arange(len(points))
    for _ in range(ROUNDS):
        here = measured[left]
        offset = -np.arctan2(here[:, 1] - VELODYNE[1], here[:, 0] - VELODYNE[0]) / (2 * np.pi)
        step = points[left] - compensate_sweep(here, offset, poses, frame)
        measured[left] = here + step
        left = left[np.abs(step).max(axis=1) > SETTLED]
    settled = np.ones(len(points), np.bool_)
    settled[left] = False
    return measured, settled


def numbers(values: Any) -> str:
    """A number with nine decimal digits, as in KITTI's tables."""
    return " ".join(f"{value + 0.0:.9g}" for value in np.asarray(values).tolist())


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


# --- Raw data ------------------------------------------------------------------------------------

# A drive for each clip and camera, with GPS/IMU records and tracklets. Source: Geiger et al.,
# "Vision meets Robotics: The KITTI Dataset", IJRR 2013, and the raw data's development kit. Camera,
# scanner and scans are as above. The GPS/IMU frame is the ego frame. Boxes rotate about the
# scanner's vertical axis only.

DAY = "2011_09_26"
LATITUDE, LONGITUDE, ALTITUDE = 49.0, 8.4, 110.0
"""Arbitrary geographic position of the scene's world origin."""
EARTH_RADIUS = 6_378_137.0


class KittiRawWriter:
    """Writes ``<day>/<day>_drive_NNNN_sync`` and the calibration of each."""

    name = "kitti_raw"
    holds = "a drive a clip and camera: image_02, velodyne_points, oxts, tracklet_labels.xml, calib"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        drives: dict[str, dict[str, str]] = {}
        for clip in drive.clips:
            with tempfile.TemporaryDirectory(dir=folder) as place:
                scans = write_scans(clip, Path(place))
                for camera in drive.cameras:
                    name = f"{DAY}_drive_{len(drives):04d}_sync"
                    drives[name] = {"clip": clip.name, "camera": camera.name, "split": clip.split}
                    _write_drive(folder / DAY / name, clip, camera, scans)
        write_json(folder / "drives.json", drives)


def _write_drive(folder: Path, clip: Clip, camera: Camera, scans: Sequence[Path]) -> None:
    for part in ("image_02", "velodyne_points", "oxts"):
        (folder / part / "data").mkdir(parents=True)
        stamps = "".join(f"{_stamp(frame['t_us'])}\n" for frame in clip.frames)
        (folder / part / "timestamps.txt").write_text(stamps)
    for k, frame in enumerate(clip.frames):
        image = clip.file("rgb", camera.name, frame["index"])
        link_or_copy(image, folder / "image_02" / "data" / f"{k:010d}.png")
        link_or_copy(scans[k], folder / "velodyne_points" / "data" / f"{k:010d}.bin")
        oxts = _oxts(np.array(frame["T_world_ego"]))
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(oxts + "\n")
    _write_calibration(folder, camera)
    (folder / "tracklet_labels.xml").write_text(_tracklets(clip), encoding="utf-8")


def _stamp(t_us: int) -> str:
    """Time since noon as a date and time with nanoseconds."""
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
        "velo_to_cam": _rigid_lines(invert_transform(camera.T_vehicle_camera) @ T_EGO_VELO),
        "imu_to_velo": _rigid_lines(invert_transform(T_EGO_VELO)),
    }
    for name, rows in lines.items():
        (folder / f"calib_{name}.txt").write_text("".join(f"{row}\n" for row in rows))


def _rigid_lines(transform: Float) -> list[str]:
    turn, place = transform[:3, :3].ravel(), transform[:3, 3]
    return [f"calib_time: {DAY}", f"R: {numbers(turn)}", f"T: {numbers(place)}"]


def _tracklets(clip: Clip) -> str:
    to_velo = invert_transform(T_EGO_VELO)
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
    """Runs of consecutive frames with an object, for each object."""
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
    kind = classes_of(subject["category"]).kitti or MISC
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
