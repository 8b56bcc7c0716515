"""Which frames and cameras are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...logs import DrivingLog
from ...scene import Camera, Scene
from ..logged_view import image_time
from ..options import ReconstructError
from ..training.data import held_out_frames

DEFAULT_HOLD_OUT = 4
"""One of so many frames is held out where a scene does not say otherwise."""


@dataclass(frozen=True)
class SelectedFrames:
    """Frames to compare.

    Attributes:
        frames: indices, increasing.
        held_out: whether the scene says that none of them was used to make it.
    """

    frames: tuple[int, ...]
    held_out: bool


def select_frames(scene: Scene, log: DrivingLog, frames: str | Sequence[int]) -> SelectedFrames:
    """The frames that are asked for.

    ``held-out`` means those that training kept back, as the scene's provenance lists them. A
    scene that lists none (made without training, or on all frames, or elsewhere) is compared at
    every fourth frame by the same rule, 2, 6, 10 ..., and they do not count as held out.

    Args:
        frames: ``held-out``, ``all``, or indices.

    Raises:
        ReconstructError: an unknown word, no frame, or one the log or the scene's path lacks.
    """
    listed = listed_held_out(scene)
    if frames == "held-out":
        chosen = (
            listed or held_out_frames(log.frame_count, DEFAULT_HOLD_OUT) or [log.frame_count // 2]
        )
    elif frames == "all":
        chosen = list(range(log.frame_count))
    elif isinstance(frames, str):
        raise ReconstructError(f"frames must be 'held-out', 'all' or numbers, not {frames!r}")
    else:
        chosen = sorted(set(frames))
    _check(scene, log, chosen)
    return SelectedFrames(tuple(chosen), bool(listed) and set(chosen) <= set(listed))


def select_cameras(scene: Scene, log: DrivingLog, width: int | None) -> tuple[Camera, ...]:
    """The log's cameras, calibrated as the scene has them, at ``width`` or as logged [px].

    Raises:
        ReconstructError: the scene lacks one of them.
    """
    missing = [name for name in log.rig.names if name not in scene.rig.names]
    if missing:
        raise ReconstructError(
            f"scene {scene.name!r} has cameras {list(scene.rig.names)} and lacks {missing} of log "
            f"{log.name!r}; evaluate it on the log it was made of"
        )
    without = set(log.provenance.get("cameras_without_images", ()))
    return tuple(
        scene.rig[camera.name].resized(width or camera.width)
        for camera in log.rig
        if camera.name not in without
    )


def listed_held_out(scene: Scene) -> list[int]:
    """Frames that the scene says were not used to make it; none where it says nothing."""
    reconstruction = scene.provenance.get("reconstruction")
    listed = reconstruction.get("held_out_frames") if isinstance(reconstruction, dict) else None
    return sorted({int(frame) for frame in listed}) if listed else []


def _check(scene: Scene, log: DrivingLog, frames: Sequence[int]) -> None:
    if not frames:
        raise ReconstructError("name at least one frame to evaluate")
    for frame in frames:
        if not 0 <= frame < log.frame_count:
            raise ReconstructError(
                f"frame {frame}: log {log.name!r} has frames 0 to {log.frame_count - 1}"
            )
        for name in log.rig.names:
            if not scene.ego.covers(image_time(log, name, frame)):
                raise ReconstructError(
                    f"frame {frame} of log {log.name!r} lies outside the path of scene "
                    f"{scene.name!r}; evaluate it on the log it was made of"
                )
