"""How complete vehicles are: views from all around each of them against the truth.

An edited vehicle is seen from where no camera of the log ever was. Its appearance there was never
measured; it comes from the mirrored side and from its own frames over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float, invert_transform
from ...logs import ObjectTrack
from ...render import Instance, RasterOptions, rasterize
from ...scene import Camera, Scene
from ...synthetic import SyntheticLog
from .image_metrics import mean_psnr, psnr

AZIMUTHS = 8
"""Views around a vehicle, the first one from ahead of it."""
WIDTH, HEIGHT = 320, 240
HALF_VIEW = np.deg2rad(25.0)
ELEVATION = np.deg2rad(12.0)
SEEN_WITHIN = np.deg2rad(40.0)
"""A side counts as seen when the azimuth of a logged camera differs by no more than this."""
MIN_PIXELS = 500
"""Views that show fewer pixels of the vehicle, as other things hide it, do not count."""


@dataclass(frozen=True)
class SideScore:
    """One view of one vehicle against the truth, over the pixels that truly show it.

    Attributes:
        object_id: of the vehicle.
        azimuth: of the camera about the vehicle [rad], 0 from ahead, pi from behind.
        seen: whether a camera of the log saw this side.
        psnr: [dB]; what is missing counts as black.
        coverage: fraction of the pixels where anything of the vehicle is drawn.
    """

    object_id: str
    azimuth: float
    seen: bool
    psnr: float
    coverage: float


@dataclass(frozen=True)
class AroundScore:
    """Means over views of all vehicles, apart for sides that the log saw and that it did not.

    Attributes:
        psnr_seen, psnr_unseen: [dB], nan where there are no such views.
        coverage_seen, coverage_unseen: in [0, 1], nan where there are no such views.
        sides: every view.
    """

    psnr_seen: float
    psnr_unseen: float
    coverage_seen: float
    coverage_unseen: float
    sides: tuple[SideScore, ...]


def evaluate_around(
    scene: Scene, truth: SyntheticLog, *, least_views: int = 5, backend: str = "auto"
) -> AroundScore:
    """Render every vehicle that the log shows in ``least_views`` images from all around.

    Each is rendered at the middle of its time, alone, from eight azimuths.
    """
    sides: list[SideScore] = []
    for index, track in enumerate(truth.tracks):
        logged_from = logged_azimuths(truth, track)
        if track.object_id in scene.objects and len(logged_from) >= least_views:
            sides += _sides(scene, truth, index, logged_from, backend)
    return AroundScore(
        psnr_seen=mean_psnr(s.psnr for s in sides if s.seen),
        psnr_unseen=mean_psnr(s.psnr for s in sides if not s.seen),
        coverage_seen=_mean([s.coverage for s in sides if s.seen]),
        coverage_unseen=_mean([s.coverage for s in sides if not s.seen]),
        sides=tuple(sides),
    )


def logged_azimuths(log: SyntheticLog, track: ObjectTrack) -> list[float]:
    """Azimuths [rad] in the object's frame of the cameras in whose images its centre is."""
    azimuths = []
    for camera in log.rig:
        for frame in range(log.frame_count):
            t_us = log.image_time_us(camera.name, frame)
            pose = track.transform_near(t_us)
            if pose is None:
                continue
            T_world_camera = camera.pose(log.ego.transform(t_us))
            u, v, depth = camera.K @ (invert_transform(T_world_camera) @ pose)[:3, 3]
            if depth > 0 and 0 < u < depth * camera.width and 0 < v < depth * camera.height:
                x, y, _ = (invert_transform(pose) @ T_world_camera)[:3, 3]
                azimuths.append(float(np.arctan2(y, x)))
    return azimuths


def view_from(track: ObjectTrack, t_us: int, azimuth: float) -> tuple[Camera, Float]:
    """A camera aimed at the middle of an object, and its ``T_world_camera`` [4, 4]."""
    focal = WIDTH / 2 / np.tan(HALF_VIEW)
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    distance = 0.62 * np.linalg.norm(track.size) / np.tan(HALF_VIEW)
    flat = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    backwards = flat * np.cos(ELEVATION) + np.array([0, 0, np.sin(ELEVATION)])
    right = np.cross(-backwards, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    T_object_camera = np.eye(4)
    T_object_camera[:3, :3] = np.stack([right, np.cross(-backwards, right), -backwards], axis=1)
    T_object_camera[:3, 3] = distance * backwards
    pose = track.trajectory.transform(t_us) @ T_object_camera
    return Camera("around", WIDTH, HEIGHT, K, np.eye(4)), pose


def _sides(
    scene: Scene, truth: SyntheticLog, index: int, logged_from: Sequence[float], backend: str
) -> list[SideScore]:
    track = truth.tracks[index]
    item = scene.objects[track.object_id]
    start = max(track.trajectory.start_us, item.trajectory.start_us)
    t_us = (start + min(track.trajectory.end_us, item.trajectory.end_us)) // 2
    cloud, T_world_object = item.cloud_at(t_us), item.trajectory.transform(t_us)
    sides = []
    for azimuth in 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
        camera, pose = view_from(track, t_us, azimuth)
        image, _, instance = truth.render(pose, camera.K, WIDTH, HEIGHT, t_us)
        mask = instance == index + 1
        if mask.sum() < MIN_PIXELS:
            continue
        drawn = rasterize(
            [Instance(cloud, T_world_object, instance_id=1)],
            invert_transform(pose)[None],
            camera.K[None],
            WIDTH,
            HEIGHT,
            options=RasterOptions(depth=False, instance=False),
            backend=backend,
        )
        rgb = (drawn.rgb[0].clamp(0, 1).cpu().numpy() * 255).round().astype(np.uint8)
        covered = drawn.alpha[0].cpu().numpy()[mask] > 0.5
        offsets = np.abs(_wrapped(np.array(logged_from) - azimuth))
        sides.append(
            SideScore(
                object_id=track.object_id,
                azimuth=float(azimuth),
                seen=bool((offsets <= SEEN_WITHIN).any()),
                psnr=psnr(rgb, image, mask),
                coverage=float(covered.mean()),
            )
        )
    return sides


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles [rad] in [-pi, pi)."""
    return np.asarray((angles + np.pi) % (2 * np.pi) - np.pi)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
