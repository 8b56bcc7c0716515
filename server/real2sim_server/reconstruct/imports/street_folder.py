"""The preprocessed dataset folder of Street Gaussians: cameras, ego path and time stamps."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...scene import Camera, CameraRig
from ...scene.errors import SceneError
from .checkpoint import CheckpointError, image_size, read_intrinsics, read_json, read_pose

CAMERA_NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
WAYMO_SIZES = ((1920, 1280), (1920, 1280), (1920, 1280), (1920, 886), (1920, 886))


@dataclass(frozen=True, eq=False)
class StreetFolder:
    """What a dataset folder says of the frames a model was trained on.

    Attributes:
        rig: cameras that were trained on.
        first_frame: number of the first frame.
        times_us: [F] int64 time stamps of the frames [us].
        ego: [F, 4, 4] float64 ``T_world_vehicle``; the world is Waymo's, shifted by the mean
            position of the ego over all frames of the folder.
    """

    rig: CameraRig
    first_frame: int
    times_us: NDArray[np.int64]
    ego: Float


def read_street_folder(
    folder: Path, *, first_frame: int, last_frame: int | None, cameras: tuple[int, ...]
) -> StreetFolder:
    """Read ``ego_pose``, ``timestamps.json``, ``intrinsics`` and ``extrinsics``.

    Raises:
        CheckpointError: naming the file that is missing or does not fit.
    """
    poses = _ego_poses(folder)
    last = len(poses) - 1 if last_frame is None else last_frame
    if last >= len(poses):
        raise CheckpointError(
            f"{folder / 'ego_pose'}: has frames 0 to {len(poses) - 1}, not {first_frame} to {last}"
        )
    poses[:, :3, 3] -= poses[:, :3, 3].mean(axis=0)
    frames = range(first_frame, last + 1)
    try:
        rig = CameraRig(tuple(_camera(folder, camera) for camera in cameras))
    except SceneError as error:
        raise CheckpointError(f"{folder}: {error}") from error
    return StreetFolder(rig, first_frame, _times(folder, frames), poses[first_frame : last + 1])


def _ego_poses(folder: Path) -> Float:
    """``T_waymo_vehicle`` [all frames, 4, 4]; files of single cameras are not meant."""
    place = folder / "ego_pose"
    found = sorted(p for p in place.glob("*.txt") if re.fullmatch(r"\d+", p.stem))
    if not found:
        raise CheckpointError(f"{place}: holds no poses such as 000000.txt")
    numbers = [int(p.stem) for p in found]
    if numbers != list(range(len(numbers))):
        missing = sorted(set(range(max(numbers) + 1)) - set(numbers))[:5]
        raise CheckpointError(f"{place}: frames are missing or doubled, the first: {missing}")
    return np.stack([read_pose(p) for p in found])


def _camera(folder: Path, index: int) -> Camera:
    if not 0 <= index < len(CAMERA_NAMES):
        raise CheckpointError(f"camera {index}; allowed are 0 to {len(CAMERA_NAMES) - 1}")
    width, height = image_size(folder, index) or WAYMO_SIZES[index]
    return Camera(
        CAMERA_NAMES[index].lower(),
        width,
        height,
        read_intrinsics(folder / "intrinsics" / f"{index}.txt"),
        read_pose(folder / "extrinsics" / f"{index}.txt"),
    )


def _times(folder: Path, frames: range) -> NDArray[np.int64]:
    file = folder / "timestamps.json"
    by_frame = read_json(file).get("FRAME")
    try:
        seconds = [float(by_frame[f"{frame:06d}"]) for frame in frames]  # type: ignore[index]
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{file}: FRAME must hold seconds for frames {frames[0]:06d} to {frames[-1]:06d}; "
            f"at fault: {error}"
        ) from error
    times = np.rint(np.array(seconds) * 1e6).astype(np.int64)
    if (np.diff(times) <= 0).any():
        raise CheckpointError(f"{file}: time stamps of FRAME do not increase")
    return times
