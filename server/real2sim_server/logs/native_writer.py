"""Writes any DrivingLog in the native layout (``docs/log_format.md``)."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..scene import Camera, Trajectory
from ..scene.io.document import OpticsPart
from ..scene.io.lane_document import lane_document
from .driving_log import DrivingLog, LogError
from .images import write_image
from .readers.native import FORMAT, LANES, MANIFEST, VERSION


def write_native_log(
    log: DrivingLog,
    path: str | Path,
    *,
    image_format: str = "png",
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write ``log`` to the folder ``path``, which appears only when it is complete.

    Args:
        log: any log.
        path: a folder that does not exist yet, or an empty one.
        image_format: ``png`` (exact) or ``jpg`` (quality 95).
        on_progress: called with (done, total) after each image and each sweep.

    Returns:
        ``path``.

    Raises:
        LogError: the folder is not empty, or the log has a broken image or sweep.
    """
    target = Path(path)
    if image_format not in ("png", "jpg"):
        raise LogError(f"image_format must be 'png' or 'jpg', not {image_format!r}")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise LogError(f"{target}: is there already; name a folder that is new or empty")
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        has_lidar = _write_frames(log, partial, image_format, on_progress)
        manifest = json.dumps(_manifest(log, has_lidar), indent=1)
        if log.lanes is not None:
            document = lane_document(log.lanes)
            (partial / LANES).write_text(document.model_dump_json(), encoding="utf-8")
        (partial / MANIFEST).write_text(manifest, encoding="utf-8")
        partial.chmod(0o755)
        os.replace(partial, target)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    return target


def _write_frames(
    log: DrivingLog,
    folder: Path,
    image_format: str,
    on_progress: Callable[[int, int], None] | None,
) -> bool:
    total, done, has_lidar = log.frame_count * (len(log.rig) + 1), 0, False
    for name in ("lidar", *(f"images/{camera}" for camera in log.rig.names)):
        (folder / name).mkdir(parents=True)
    for frame in range(log.frame_count):
        for camera in log.rig.names:
            image = log.image(camera, frame)
            write_image(folder / "images" / camera / f"{frame:06d}.{image_format}", image)
            done = _report(done, total, on_progress)
        sweep = log.lidar(frame)
        has_lidar |= len(sweep.points) > 0
        np.savez(
            folder / "lidar" / f"{frame:06d}.npz",
            points=sweep.points,
            intensity=sweep.intensity,
            offset_us=sweep.offset_us,
            origin=sweep.origin,
        )
        done = _report(done, total, on_progress)
    if not has_lidar:
        shutil.rmtree(folder / "lidar")
    return has_lidar


def _report(done: int, total: int, on_progress: Callable[[int, int], None] | None) -> int:
    if on_progress is not None:
        on_progress(done + 1, total)
    return done + 1


def _recorded(camera: Camera) -> dict[str, Any]:
    """What the camera really is, where that is known."""
    if camera.recorded is None:
        return {}
    return {"recorded": OpticsPart.of(camera.recorded).model_dump(mode="json")}


def _manifest(log: DrivingLog, has_lidar: bool) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": log.name,
        "frame_times_us": log.frame_times_us.tolist(),
        "cameras": [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "T_vehicle_camera": camera.T_vehicle_camera.tolist(),
                **_recorded(camera),
            }
            for camera in log.rig
        ],
        "ego": {"size": list(log.ego_size), **_poses(log.ego)},
        "tracks": [
            {
                "object_id": track.object_id,
                "category": track.category,
                "size": list(track.size),
                **_poses(track.trajectory),
            }
            for track in log.tracks
        ],
        "lidar": has_lidar,
        "image_times_us": {
            name: log.image_times_us[name].tolist()
            for name in log.rig.names
            if name in log.image_times_us
        },
        "provenance": dict(log.provenance),
    }


def _poses(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "times_us": trajectory.times_us.tolist(),
        "positions": trajectory.positions.tolist(),
        "quaternions": trajectory.quaternions.tolist(),
    }
