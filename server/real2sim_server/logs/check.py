"""Checks a whole log before hours of work are spent on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np

from .driving_log import DrivingLog, LogError

FARTHEST_M = 100_000.0
"""Of the world's zero; single precision is 8 mm there."""


@runtime_checkable
class ChecksImages(Protocol):
    """A source that can check an image without decoding it."""

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError when the image is missing, cut off or of another size."""
        ...


def check_log(
    log: DrivingLog,
    *,
    decode_images: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[int]:
    """Touch everything that training will read, and stop at the first thing that is wrong.

    Opening a log has checked its tables already; this reads every sweep, and the header, the size
    and the end marker of every image.

    Args:
        log: any log.
        decode_images: decode every image, which finds damage inside files too.
        on_progress: called with (done, total) after each frame.

    Returns:
        Frames whose sweep holds no points, where those of other frames do.

    Raises:
        LogError: names the file (or camera, frame, object), what is wrong and what is expected.
    """
    _check_cameras(log)
    _check_times(log)
    _check_place(log)
    _check_tracks(log)
    empty = []
    for frame in range(log.frame_count):
        for camera in log.rig.names:
            if decode_images:
                log.image(camera, frame)
            elif isinstance(log.source, ChecksImages):
                log.source.check_image(camera, frame)
        if not len(log.lidar(frame).points):
            empty.append(frame)
        if on_progress is not None:
            on_progress(frame + 1, log.frame_count)
    return empty if len(empty) < log.frame_count else []


def _check_cameras(log: DrivingLog) -> None:
    if len(log.rig):
        return
    known = list(log.provenance.get("cameras_without_images", []))
    named = f"its cameras {known} have no images" if known else "it has no cameras"
    raise LogError(
        f"log {log.name!r} cannot be trained on: {named}; put the images where the data set has "
        "them (LiDAR and boxes can be used as they are)"
    )


def _check_times(log: DrivingLog) -> None:
    times = log.frame_times_us
    if len(times) == 0 or (np.diff(times) <= 0).any():
        raise LogError(f"log {log.name!r}: frame times must increase strictly, at least one")
    for camera in log.rig.names:
        given = log.image_times_us.get(camera, times)
        if given.shape != times.shape:
            raise LogError(
                f"log {log.name!r}: camera {camera!r} has {len(given)} image times for "
                f"{len(times)} frames"
            )
        for t_us in (given.min(), given.max()):
            if not log.ego.covers(int(t_us)):
                raise LogError(
                    f"log {log.name!r}: ego poses cover [{log.ego.start_us}, {log.ego.end_us}] us, "
                    f"but camera {camera!r} takes an image at {t_us} us"
                )


def _check_place(log: DrivingLog) -> None:
    far = float(np.abs(log.ego.positions).max())
    if far > FARTHEST_M:
        raise LogError(
            f"log {log.name!r}: its drive lies {far / 1e3:,.0f} km from the world's zero, where "
            f"Gaussians could only move by {float(np.spacing(np.float32(far))):.2g} m; subtract "
            "the first pose's position from all poses and boxes"
        )


def _check_tracks(log: DrivingLog) -> None:
    names: set[str] = set()
    for track in log.tracks:
        if track.object_id in names:
            raise LogError(f"log {log.name!r}: object {track.object_id!r} is there twice")
        names.add(track.object_id)
        if not (np.isfinite(track.size).all() and min(track.size) > 0):
            raise LogError(
                f"log {log.name!r}: object {track.object_id!r} needs a positive length, width and "
                f"height, not {track.size}"
            )
