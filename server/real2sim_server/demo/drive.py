"""The demo's drive: a planner in the loop, filmed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from real2sim.planners import EpisodeSummary, Planner, run_episode

from ..render.video import video_file
from .pictures import Image, mosaic

if TYPE_CHECKING:
    from real2sim import DriveSession, Observation

STILLS = 3
FILM_WIDTH = 960
"""Of the film; encoding the stills' size would take longer than rendering it."""


@dataclass
class FilmedDrive:
    """A driven episode.

    Attributes:
        summary: figures of the episode.
        path: [N, 2] world positions of the vehicle, one a step [m].
        stills: a few frames of the film, by step.
    """

    summary: EpisodeSummary
    path: NDArray[np.float64]
    stills: dict[int, Image] = field(default_factory=dict)


def drive_through(
    session: DriveSession,
    planner: Planner,
    *,
    cameras: Sequence[str],
    steps: int,
    dt_us: int,
    video_path: Path,
) -> FilmedDrive:
    """Let ``planner`` drive ``steps`` steps and film all cameras side by side.

    Args:
        session: not yet opened; it is closed afterwards.
        planner: who drives.
        cameras: from left to right as they are to be shown.
        steps, dt_us: number and length [us] of clock steps.
        video_path: WebM file to write.
    """
    path: list[tuple[float, float]] = []
    stills: dict[int, Image] = {}
    wanted = {round(steps * (i + 1) / (STILLS + 1)) for i in range(STILLS)}
    with session, video_file(video_path, frames_per_second=1e6 / dt_us) as film:

        def watch(obs: Observation) -> None:
            caption = (
                f"t {obs.t_us * 1e-6:5.1f} s   {obs.ego.speed * 3.6:4.1f} km/h   "
                f"step {obs.step}   {obs.command}"
            )
            picture = mosaic([obs.image(camera) for camera in cameras], caption)
            film.add(_shrunk(picture))
            path.append(obs.ego.position[:2])
            if obs.step in wanted:
                stills[obs.step] = picture

        summary = run_episode(
            session,
            planner,
            steps=steps,
            sensors=list(cameras),
            on_observation=watch,
            seed=0,
            dt_us=dt_us,
            privileged=True,
        )
    return FilmedDrive(summary=summary, path=np.array(path), stills=stills)


def _shrunk(picture: Image) -> Image:
    height, width = picture.shape[:2]
    size = FILM_WIDTH, round(height * FILM_WIDTH / width)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
