"""The preprocessed folder of drivestudio (Chen et al. 2024), made from Waymo segments.

Source: ``datasets/waymo`` of the released program and its documentation. Unlike those of Street
Gaussians, extrinsics are in Waymo's own axes. There are no time stamps: frames are 0.1 s apart. The
other data sets that it can prepare differ in ways that are not visible in their folders; read their
original files instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform
from ...scene import CameraRig, Trajectory
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LidarSweep, LogError, ObjectTrack
from .common import FrameBox, build_tracks
from .files import (
    ImageFiles,
    count_rows,
    read_json,
    read_rigid,
    read_rows,
)
from .waymo_common import EGO_SIZE, LICENCE, TRUCK_LENGTH, folder_cameras, folder_images

PERIOD_US = 100_000
COLUMNS = 14
"""Number of float32 columns: origin (3), point (3), flow (3), flow class, ground, intensity,
elongation, laser."""
ONLY_WAYMO = "only folders made of Waymo segments can be read"

CATEGORIES = {"vehicle": "car", "pedestrian": "pedestrian", "cyclist": "cyclist", "sign": "sign"}


class DrivestudioReader:
    """Reads ``images``, ``ego_pose``, ``extrinsics``, ``intrinsics``, ``instances``, ``lidar``."""

    name = "drivestudio"
    expects = (
        "images/%03d_<camera>.jpg, ego_pose/%03d.txt, extrinsics/, intrinsics/, lidar/%03d.bin, "
        "instances/instances_info.json (Waymo)"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there are three-digit ``ego_pose`` files and no ``timestamps.json``."""
        return (path / "ego_pose" / "000.txt").is_file() and not (path / "timestamps.json").exists()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The drive in the folder ``path``; ``sequence`` is rejected: a folder contains one.

        Raises:
            LogError: see :class:`LogReader`.
        """
        if sequence is not None:
            raise LogError(f"{path}: holds one drive; it has no sequence {sequence!r}")
        left_out = LeftOut()
        poses = _read_poses(path / "ego_pose", left_out)
        frames = sorted(poses)
        times_us = np.array(frames, dtype=np.int64) * PERIOD_US
        to_first = invert_transform(poses[frames[0]])
        in_log = {frame: to_first @ pose for frame, pose in poses.items()}
        cameras = folder_cameras(path, np.eye(4), left_out)
        rig = CameraRig(tuple(c.lens.camera(c.name, c.T_vehicle_camera) for c in cameras))
        images = ImageFiles(
            {c.name: folder_images(path, c, frames, 3) for c in cameras},
            {c.name: c.lens for c in cameras},
        )
        info = path / "instances" / "instances_info.json"
        tracks, keys = _read_tracks(info, to_first, in_log, left_out)
        return DrivingLog(
            name=f"drivestudio_{path.resolve().name}",
            rig=rig,
            frame_times_us=times_us,
            ego=Trajectory.from_transforms(times_us, np.array([in_log[f] for f in frames])),
            tracks=tracks,
            source=_DrivestudioSource(images, _sweep_files(path / "lidar", frames)),
            ego_size=EGO_SIZE,
            provenance={
                "dataset": "drivestudio folder (Waymo)",
                "sequence": path.resolve().name,
                "licence": LICENCE,
                "reader": self.name,
                "track_ids": keys,
            },
            left_out=left_out.told(),
        )


def _read_poses(folder: Path, left_out: LeftOut) -> dict[int, Float]:
    """Poses by frame; frames without a usable one are left out."""
    numbers = [int(p.stem) for p in folder.glob("*.txt") if p.stem.isdecimal()]
    poses = {}
    for frame in range(max(numbers, default=-1) + 1):
        with left_out.damaged("frames"):
            poses[frame] = read_rigid(folder / f"{frame:03d}.txt")
    if not poses:
        raise LogError(f"{folder}: holds no usable pose %03d.txt")
    return poses


def _read_tracks(
    path: Path, to_first: Float, poses: Mapping[int, Float], left_out: LeftOut
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    if not path.exists():
        return (), {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise LogError(f"{path}: expected an object of instances")
    boxes: list[FrameBox] = []
    for key, value in content.items():
        with left_out.damaged("objects"):
            for box in _boxes(path, key, value):
                if box.time_us // PERIOD_US in poses:
                    boxes.append(replace(box, T_world_object=to_first @ box.T_world_object))
                else:
                    left_out["boxes"].append(
                        f"{box.where}: there is no usable frame of this number"
                    )
    return build_tracks(boxes, left_out)


def _boxes(path: Path, key: str, value: Any) -> list[FrameBox]:
    where = f"{path}: instance {key!r}"
    try:
        kind = str(value["class_name"]).lower()
        rows = value["frame_annotations"]
        frames = [int(f) for f in rows["frame_idx"]]
        poses = np.array(rows["obj_to_world"], dtype=np.float64).reshape(len(frames), 4, 4)
        sizes = np.array(rows["box_size"], dtype=np.float64).reshape(len(frames), 3)
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(
            f"{where}: needs class_name and frame_annotations with frame_idx, obj_to_world and "
            f"box_size, as many of each ({error})"
        ) from error
    boxes = []
    for frame, pose, size in zip(frames, poses, sizes.tolist(), strict=True):
        category = CATEGORIES.get(kind, kind)
        if category == "car" and size[0] > TRUCK_LENGTH:
            category = "truck"
        length, width, height = size
        boxes.append(
            FrameBox(
                key,
                category,
                (length, width, height),
                frame * PERIOD_US,
                pose,
                f"{where}, frame {frame}",
            )
        )
    return boxes


def _sweep_files(folder: Path, frames: list[int]) -> list[Path] | None:
    if not folder.is_dir():
        return None
    return [folder / f"{frame:03d}.bin" for frame in frames]


@dataclass(frozen=True, eq=False)
class _DrivestudioSource:
    images: ImageFiles
    sweeps: list[Path] | None

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self.images.read(camera, frame)

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is truncated or has a wrong size."""
        self.images.check(camera, frame)

    def check_sweep(self, frame: int) -> int:
        """See :class:`ChecksFiles`."""
        return 0 if self.sweeps is None else count_rows(self.sweeps[frame], COLUMNS, ONLY_WAYMO)

    def lidar(self, frame: int) -> LidarSweep:
        rows = np.zeros((0, COLUMNS), np.float32)
        if self.sweeps is not None:
            rows = read_rows(self.sweeps[frame], COLUMNS, ONLY_WAYMO)
        rows = rows[np.isfinite(rows[:, :6]).all(axis=1)]
        top = rows[rows[:, 13] == 0]
        origin = np.median((top if len(top) else rows)[:, :3], axis=0) if len(rows) else np.zeros(3)
        return LidarSweep(
            points=rows[:, 3:6].copy(),
            intensity=np.clip(rows[:, 11], 0, 1),
            offset_us=np.zeros(len(rows), np.int32),
            origin=origin.astype(np.float32),
        )
