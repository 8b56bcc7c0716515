"""The preprocessed folder of Street Gaussians (Yan et al. 2024), made of Waymo segments.

Source: ``script/waymo`` and ``lib/utils/waymo_utils.py`` of the released program. Extrinsics are in
OpenCV's axes already, boxes and points in the vehicle frame. Images are as recorded, with the
lens's distortion in them; they are straightened when they are read.
"""

from __future__ import annotations

import re
import threading
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...scene.camera import T_VEHICLE_OPTICAL
from ..driving_log import DrivingLog, LidarSweep, LogError
from ..images import image_size
from .formats.array_pickles import read_pickled_arrays
from .formats.image_files import ImageFiles
from .formats.json_tables import read_json
from .formats.tables import check_rigid, parse_numbers, read_lines
from .waymo.segment import (
    CAMERA_NAMES,
    WaymoBox,
    WaymoCamera,
    WaymoFrame,
    WaymoImage,
    build_waymo_log,
    waymo_camera,
)

TYPES = {"vehicle": 1, "pedestrian": 2, "sign": 3, "cyclist": 4, "misc": 0}
MAX_TIME_S = 1e12
LASER = (1.43, 0.0, 2.184)
"""Where Waymo's TOP laser sits on the vehicle [m]; the folder does not say."""


class StreetGaussiansReader:
    """Reads ``images``, ``ego_pose``, ``extrinsics``, ``intrinsics``, ``track``."""

    name = "street_gaussians"
    expects = (
        "images/%06d_<camera>.png, ego_pose/%06d.txt, ego_pose/%06d_<camera>.txt, extrinsics/, "
        "intrinsics/, timestamps.json, track/track_info.txt, pointcloud.npz"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there are ``ego_pose`` and ``timestamps.json``."""
        return (path / "ego_pose").is_dir() and (path / "timestamps.json").is_file()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The drive in the folder ``path``; ``sequence`` is refused: a folder holds one.

        Raises:
            LogError: see :class:`LogReader`.
        """
        if sequence is not None:
            raise LogError(f"{path}: holds one drive; it has no sequence {sequence!r}")
        count = _frame_count(path / "ego_pose")
        times = _Times(path / "timestamps.json")
        cameras = [_read_camera(path, i) for i in _camera_indices(path / "intrinsics")]
        files = {c.name: _image_files(path, c.number - 1, count) for c in cameras}
        files = {name: found for name, found in files.items() if found}
        images = ImageFiles(files, {c.name: c.lens for c in cameras})
        boxes = _read_boxes(path / "track" / "track_info.txt")
        used = [c for c in cameras if c.name in files]
        frames = [_read_frame(path, i, times, used, boxes.get(i, ())) for i in range(count)]
        points = path / "pointcloud.npz"
        return build_waymo_log(
            name=f"street_gaussians_{path.resolve().name}",
            cameras=cameras,
            frames=frames,
            source=_StreetSource(images, points if points.exists() else None),
            where=str(path),
            provenance={
                "dataset": "Street Gaussians folder",
                "sequence": path.resolve().name,
                "reader": self.name,
            },
        )


def _frame_count(folder: Path) -> int:
    numbers = sorted(int(p.stem) for p in folder.glob("*.txt") if re.fullmatch(r"\d+", p.stem))
    if not numbers:
        raise LogError(f"{folder}: holds no poses %06d.txt")
    missing = sorted(set(range(numbers[-1] + 1)) - set(numbers))
    if missing:
        raise LogError(f"{folder / f'{missing[0]:06d}.txt'}: no such file ({len(missing)} missing)")
    return len(numbers)


class _Times:
    """``timestamps.json``: seconds by sensor and frame."""

    def __init__(self, path: Path) -> None:
        self._path, self._content = path, read_json(path)
        if not isinstance(self._content, dict) or "FRAME" not in self._content:
            raise LogError(f"{path}: expected an object with 'FRAME'")

    def time_us(self, sensor: str, frame: int) -> int | None:
        """Time stamp [us]; None where the file does not speak of the sensor."""
        by_frame = self._content.get(sensor)
        if by_frame is None:
            return None
        value = by_frame.get(f"{frame:06d}") if isinstance(by_frame, dict) else None
        if not isinstance(value, int | float) or not abs(value) < MAX_TIME_S:
            raise LogError(f"{self._path}: {sensor!r} has no time of frame {frame:06d}")
        return round(value * 1e6)


def _camera_indices(folder: Path) -> list[int]:
    return sorted(int(p.stem) for p in folder.glob("*.txt") if p.stem.isdecimal())


def _read_camera(path: Path, index: int) -> WaymoCamera:
    intrinsics, extrinsics = (path / n / f"{index}.txt" for n in ("intrinsics", "extrinsics"))
    images = sorted((path / "images").glob(f"*_{index}.*"))
    # Without images the size does not matter: the camera is left out.
    size = image_size(images[0]) if images else (1, 1)
    return waymo_camera(
        index + 1,
        size=size,
        intrinsic=_numbers(intrinsics).tolist(),
        extrinsic=_matrix(extrinsics) @ np.linalg.inv(T_VEHICLE_OPTICAL),
        shutter=0,
        where=str(intrinsics),
    )


def _numbers(path: Path) -> Float:
    return parse_numbers(" ".join(read_lines(path)).split(), str(path))


def _matrix(path: Path) -> Float:
    numbers = _numbers(path)
    if numbers.size != 16:
        raise LogError(f"{path}: expected 16 numbers, found {numbers.size}")
    return check_rigid(numbers.reshape(4, 4), str(path))


def _image_files(path: Path, camera: int, count: int) -> list[Path]:
    """A file per frame; none where the camera has no image at all."""
    found = sorted((path / "images").glob(f"*_{camera}.*"))
    if not found:
        return []
    return [path / "images" / f"{frame:06d}_{camera}{found[0].suffix}" for frame in range(count)]


def _read_frame(
    path: Path, frame: int, times: _Times, cameras: Sequence[WaymoCamera], boxes: Sequence[WaymoBox]
) -> WaymoFrame:
    start_us = times.time_us("FRAME", frame)
    pose = _matrix(path / "ego_pose" / f"{frame:06d}.txt")
    assert start_us is not None
    images = {}
    for camera in cameras:
        time_us = times.time_us(CAMERA_NAMES[camera.number].upper(), frame)
        file = path / "ego_pose" / f"{frame:06d}_{camera.number - 1}.txt"
        own = _matrix(file) if file.exists() else pose
        images[camera.number] = WaymoImage(start_us if time_us is None else time_us, own, 0.0)
    return WaymoFrame(start_us, pose, images, boxes)


def _read_boxes(path: Path) -> Mapping[int, list[WaymoBox]]:
    boxes: dict[int, list[WaymoBox]] = defaultdict(list)
    if not path.exists():
        return boxes
    for number, line in enumerate(read_lines(path)[1:], start=2):
        words, where = line.split(), f"{path} line {number}"
        if len(words) != 12:
            raise LogError(
                f"{where}: expected 12 columns (frame track class alpha height width length "
                f"x y z heading speed), found {len(words)}"
            )
        if words[2] not in TYPES:
            raise LogError(f"{where}: unknown class {words[2]!r}; known are {list(TYPES)}")
        height, width, length, x, y, z, heading = parse_numbers(words[4:11], where).tolist()
        box = WaymoBox(
            words[1], TYPES[words[2]], (x, y, z), (length, width, height), heading, where
        )
        boxes[int(parse_numbers(words[:1], where)[0])].append(box)
    return boxes


@dataclass(frozen=True, eq=False)
class _StreetSource:
    images: ImageFiles
    points: Path | None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _clouds: dict[str, Mapping[Any, NDArray[Any]]] = field(default_factory=dict)

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self.images.read(camera, frame)

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError when the image is cut off or not of its camera's size."""
        self.images.check(camera, frame)

    def check_sweep(self, frame: int) -> int:
        """All frames are in one file without a header of each, so it is read."""
        return len(self.lidar(frame).points)

    def lidar(self, frame: int) -> LidarSweep:
        points = np.zeros((0, 3)) if self.points is None else self._cloud(frame)
        n = len(points)
        return LidarSweep(
            points=points.astype(np.float32),
            intensity=np.zeros(n, np.float32),
            offset_us=np.zeros(n, np.int32),
            origin=np.array(LASER, np.float32),
        )

    def _cloud(self, frame: int) -> NDArray[Any]:
        """All frames are in one file, which is read once."""
        assert self.points is not None
        with self._lock:
            if "pointcloud" not in self._clouds:
                self._clouds["pointcloud"] = read_pickled_arrays(self.points, "pointcloud")
            clouds = self._clouds["pointcloud"]
        points = clouds.get(frame, clouds.get(f"{frame:06d}"))
        if points is None or points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind != "f":
            raise LogError(f"{self.points}: has no points [N, 3] of frame {frame}")
        finite: NDArray[Any] = points[np.isfinite(points[:, :3]).all(axis=1), :3]
        return finite
