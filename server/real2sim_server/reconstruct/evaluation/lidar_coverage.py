"""PSNR of logged views over all pixels, and over those that the LiDAR covers.

Figures of a reconstruction report; :mod:`.scores` holds the full evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import apply_transform, invert_transform
from ...logs import DrivingLog
from ...scene import Camera, Scene
from ..logged_view import resized
from ..options import ReconstructError
from .images import psnr
from .rendering import render_logged_view

NEAR = 0.5
"""LiDAR points nearer to the camera plane do not count as covering [m]."""


@dataclass(frozen=True)
class CoverageScore:
    """One rendered view against its logged image.

    Attributes:
        camera, frame: which view.
        psnr: over all pixels [dB].
        psnr_lidar: over the pixels that LiDAR covers [dB]; nan where there are none.
        lidar_fraction: fraction of pixels that LiDAR covers, 0 to 1.
    """

    camera: str
    frame: int
    psnr: float
    psnr_lidar: float
    lidar_fraction: float


@dataclass(frozen=True)
class CoverageReport:
    """Scores of several views.

    Attributes:
        views: one score each, camera by camera within a frame.
        psnr, psnr_lidar: means of the views' values [dB].
    """

    views: tuple[CoverageScore, ...]
    psnr: float
    psnr_lidar: float


def evaluate_views(
    scene: Scene,
    log: DrivingLog,
    *,
    frames: Sequence[int],
    cameras: Sequence[str] | None = None,
    width: int | None = None,
    backend: str = "auto",
) -> CoverageReport:
    """Render logged views and compare them with the logged images.

    A pixel counts as covered by LiDAR when a point of that frame's own sweep, at least NEAR in
    front of the camera, projects into it or into one of the pixels around it, up to 1/600 of the
    image width away (2 px at 1242 px). Points are taken as the log gives them, without an
    occlusion test.

    Args:
        scene: reconstructed from ``log``.
        frames: indices of frames.
        cameras: names; all by default.
        width: of the compared images [px]; the logged width by default.
        backend: of the renderer.

    Raises:
        ReconstructError: no frames or no cameras were named, or the scene lacks a frame.
        LogError: unknown frames, or files that cannot be read.
    """
    names = list(log.rig.names if cameras is None else cameras)
    if not names or len(frames) == 0:
        raise ReconstructError("name at least one camera and one frame to evaluate")
    views = tuple(
        _score(scene, log, log.rig[name], frame, width=width, backend=backend)
        for frame in frames
        for name in names
    )
    return CoverageReport(
        views=views,
        psnr=_mean([v.psnr for v in views]),
        psnr_lidar=_mean([v.psnr_lidar for v in views]),
    )


def lidar_mask(log: DrivingLog, camera: Camera, frame: int) -> NDArray[np.bool_]:
    """[H, W] bool, pixels of ``camera`` that the sweep of ``frame`` covers.

    Defined in :func:`evaluate_views`.
    """
    import cv2

    T_camera_vehicle = invert_transform(camera.T_vehicle_camera)
    points = apply_transform(T_camera_vehicle, log.lidar(frame).points)
    points = points[points[:, 2] > NEAR]
    u = np.floor(camera.K[0, 0] * points[:, 0] / points[:, 2] + camera.K[0, 2])
    v = np.floor(camera.K[1, 1] * points[:, 1] / points[:, 2] + camera.K[1, 2])
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    mask[v[inside].astype(np.int64), u[inside].astype(np.int64)] = 1
    reach = max(1, round(camera.width / 600))
    return np.asarray(cv2.dilate(mask, np.ones((2 * reach + 1,) * 2, np.uint8)) > 0)


def _score(
    scene: Scene, log: DrivingLog, camera: Camera, frame: int, *, width: int | None, backend: str
) -> CoverageScore:
    truth = log.image(camera.name, frame)
    camera = camera if width is None else camera.resized(width)
    truth = resized(truth, camera)
    t_us = int(log.frame_times_us[frame])
    image = render_logged_view(scene, camera, t_us, backend=backend)
    mask = lidar_mask(log, camera, frame)
    return CoverageScore(
        camera.name, frame, psnr(image, truth), psnr(image, truth, mask), float(mask.mean())
    )


def _mean(values: list[float]) -> float:
    known = [v for v in values if not np.isnan(v)]
    return float(np.mean(known)) if known else float("nan")
