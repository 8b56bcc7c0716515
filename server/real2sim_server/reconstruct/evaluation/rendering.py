"""Rendered views of a scene: selected frames and cameras, recorded or shifted poses, frame rate."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ...logs import DrivingLog
from ...render import Frame, Instance, RasterOptions, render_cameras
from ...scene import Camera, Scene
from ..logged_view import image_time
from ..options import ReconstructError
from ..training.data import held_out_frames

# Rendered views at recorded and shifted poses, and their frame rate.


def scene_instances(scene: Scene, t_us: int) -> list[Instance]:
    """Background and all objects that exist at ``t_us``, at their recorded poses."""
    instances = [Instance(scene.background)]
    for index, item in enumerate(scene.objects.values()):
        if item.trajectory.covers(t_us):
            pose = item.trajectory.transform(t_us)
            instances.append(Instance(item.cloud_at(t_us), pose, instance_id=index + 1))
    return instances


def shifted_pose(T_world_vehicle: Float, left: float) -> Float:
    """``T_world_vehicle`` [4, 4] moved ``left`` [m] along the vehicle's own y axis."""
    shift = np.eye(4)
    shift[1, 3] = left
    return T_world_vehicle @ shift


def render_view(
    scene: Scene,
    camera: Camera,
    t_us: int,
    *,
    left: float = 0.0,
    instances: Iterable[Instance] | None = None,
    backend: str = "auto",
) -> Frame:
    """Colour and depth of ``camera`` on the recording vehicle at ``t_us``, ``left`` of its path.

    Args:
        instances: what is drawn before the sky; everything as recorded by default.

    Raises:
        TimeOutOfRangeError: the scene's ego path does not cover ``t_us``.
    """
    [frame] = render_cameras(
        scene_instances(scene, t_us) if instances is None else list(instances),
        [camera],
        shifted_pose(scene.ego.transform(t_us), left),
        sky=scene.sky,
        options=RasterOptions(instance=False),
        backend=backend,
    )
    return frame


def render_uncertainty(
    scene: Scene, camera: Camera, t_us: int, *, backend: str = "auto"
) -> NDArray[np.float32]:
    """Uncertainty [H, W] of the view of ``camera`` on the recording vehicle at ``t_us``.

    Raises:
        RenderError: the scene has no uncertainties.
        TimeOutOfRangeError: the scene's ego path does not cover ``t_us``.
    """
    [frame] = render_cameras(
        scene_instances(scene, t_us),
        [camera],
        scene.ego.transform(t_us),
        sky=scene.sky,
        modalities=("uncertainty",),
        backend=backend,
    )
    return frame.images["uncertainty"]


def render_logged_view(
    scene: Scene, camera: Camera, t_us: int, *, backend: str = "auto"
) -> NDArray[np.uint8]:
    """RGB [H, W, 3] of ``camera`` on the recording vehicle at ``t_us``, objects as recorded.

    Raises:
        TimeOutOfRangeError: the scene's ego path does not cover ``t_us``.
    """
    options = RasterOptions(depth=False, instance=False)
    [frame] = render_cameras(
        scene_instances(scene, t_us),
        [camera],
        scene.ego.transform(t_us),
        sky=scene.sky,
        options=options,
        backend=backend,
    )
    return frame.rgb


@dataclass(frozen=True)
class RenderRate:
    """Render speed of a scene.

    Attributes:
        frames_per_second: camera images per second, colour only, all cameras in one call: number
            of cameras divided by the median duration of a call.
        cameras: number of cameras.
        seconds: duration of each measured call.
    """

    frames_per_second: float
    cameras: int
    seconds: tuple[float, ...]


def measure_rate(
    scene: Scene,
    cameras: Sequence[Camera],
    times_us: Sequence[int],
    *,
    repeats: int = 10,
    backend: str = "auto",
) -> RenderRate:
    """Render all ``cameras`` at ``times_us`` in turn, ``repeats`` times after an untimed pass.

    The time includes the transfer of images to host memory, as in normal use.
    """
    options = RasterOptions(depth=False, instance=False)
    seconds = []
    for index in range(repeats + 1):
        t_us = times_us[index % len(times_us)]
        start = time.perf_counter()
        render_cameras(
            scene_instances(scene, t_us),
            cameras,
            scene.ego.transform(t_us),
            sky=scene.sky,
            options=options,
            backend=backend,
        )
        seconds.append(time.perf_counter() - start)
    timed = tuple(seconds[1:])
    return RenderRate(len(cameras) / statistics.median(timed), len(cameras), timed)


# Selection of the frames and cameras to compare.

DEFAULT_HOLD_OUT = 4
"""Every Nth frame is held out if the scene does not list its held-out frames."""


@dataclass(frozen=True)
class SelectedFrames:
    """Frames to compare.

    Attributes:
        frames: indices, increasing.
        held_out: whether the scene lists all of them as unused in its training.
    """

    frames: tuple[int, ...]
    held_out: bool


def select_frames(scene: Scene, log: DrivingLog, frames: str | Sequence[int]) -> SelectedFrames:
    """The selected frames.

    ``held-out`` selects the frames that training held out, as listed in the scene's provenance.
    Scenes without such a list (untrained, trained on all frames, or imported) are compared at
    frames 2, 6, 10, ..., which do not count as held out.

    Args:
        frames: ``held-out``, ``all``, or indices.

    Raises:
        ReconstructError: an unknown word, no frame, or a frame missing in the log or on the
            scene's path.
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
    """The log's cameras with the scene's calibration, at ``width`` or the logged width [px].

    Raises:
        ReconstructError: the scene lacks one of them.
    """
    missing = [name for name in log.rig.names if name not in scene.rig.names]
    if missing:
        raise ReconstructError(
            f"scene {scene.name!r} has cameras {list(scene.rig.names)} and lacks {missing} of log "
            f"{log.name!r}; evaluate it on the log it was made of"
        )
    return tuple(scene.rig[camera.name].resized(width or camera.width) for camera in log.rig)


def listed_held_out(scene: Scene) -> list[int]:
    """Frames that the scene lists as unused in its training; empty if it lists none."""
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
                    f"frame {frame} of log {log.name!r} is outside the path of scene "
                    f"{scene.name!r}; evaluate the scene on the log it was made from"
                )
