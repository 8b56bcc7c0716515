"""Image metrics, and comparisons with the true views of a synthetic log."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform, wrapped
from ...logs import DrivingLog, ObjectTrack
from ...render import Instance, RasterOptions, rasterize
from ...scene import Camera, Scene
from ...synthetic import SyntheticConfig, SyntheticLog, generate_log

# Image metrics: PSNR and SSIM.

PSNR_CAP = 100.0
"""Replaces the infinite PSNR of equal images in means and in files [dB]."""
SSIM_TAPS, SSIM_SIGMA = 11, 1.5
SSIM_K1, SSIM_K2 = 0.01, 0.03


def psnr(
    image: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Peak signal-to-noise ratio [dB] of RGB images [H, W, 3] over ``mask`` [H, W].

    Infinite for equal pixels, nan where the mask is empty.
    """
    difference = image.astype(np.float64) - truth
    if mask is not None:
        difference = difference[mask]
    if difference.size == 0:
        return float("nan")
    error = float((difference**2).mean())
    return float("inf") if error == 0 else float(10 * np.log10(255**2 / error))


def ssim(
    image: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Mean structural similarity of RGB images [H, W, 3] over ``mask`` [H, W], 1 for equal ones.

    Nan where the mask is empty.

    Wang et al. 2004, eq. 13, with their Gaussian window of 11 taps and sigma 1.5 px, on each
    channel and averaged over pixels and channels. Outside the image everything is zero, as
    in the evaluation of Kerbl et al. 2023, so results are comparable with published ones.
    """
    import cv2

    taps = np.arange(SSIM_TAPS) - SSIM_TAPS // 2
    window = np.exp(-(taps**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()

    def blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
        blurred = cv2.sepFilter2D(values, -1, window, window, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(blurred, dtype=np.float64)

    x, y = image.astype(np.float64) / 255, truth.astype(np.float64) / 255
    mean_x, mean_y = blur(x), blur(y)
    variance_x = blur(x * x) - mean_x**2
    variance_y = blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    similarity = luminance * structure
    if mask is not None:
        similarity = similarity[mask]
    return float(similarity.mean()) if similarity.size else float("nan")


def mean_psnr(values: Iterable[float]) -> float:
    """Mean PSNR [dB]; infinite values count as PSNR_CAP, nan values are dropped; nan for none."""
    known = [min(value, PSNR_CAP) for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


# Ground truth: a synthetic log's street can be rebuilt.

SAME_DB = 30.0
"""Minimum PSNR of a rebuilt street against the logged image [dB]. JPEG artefacts stay above it."""


@dataclass(frozen=True, eq=False)
class Truth:
    """A street that can be viewed from anywhere, or the reason why it is missing.

    Attributes:
        log: the street; None if missing.
        missing: the reason; empty if the street is available.
    """

    log: SyntheticLog | None
    missing: str = ""


def find_truth(log: DrivingLog) -> Truth:
    """The street of a synthetic log, built again from the config in its provenance.

    The first rendered image is compared with the logged one. This detects altered logs and logs of
    another generator version, which show a different street.

    Raises:
        LogError: the first image cannot be read.
    """
    if isinstance(log, SyntheticLog):
        return Truth(log)
    values = log.provenance.get("config")
    if log.provenance.get("dataset") != "synthetic street" or not isinstance(values, dict):
        return Truth(None, f"log {log.name!r} is not synthetic: only its own images are known")
    try:
        street = generate_log(SyntheticConfig.from_values(values))
    except (TypeError, ValueError, KeyError) as error:
        return Truth(None, f"the config of log {log.name!r} is of no known street ({error})")
    camera, t_us = log.rig.cameras[0], log.image_time_us(log.rig.names[0], 0)
    pose = camera.pose(street.ego.transform(t_us))
    image, _, _ = street.render(pose, camera.K, camera.width, camera.height, t_us)
    if psnr(image, log.image(camera.name, 0)) < SAME_DB:
        return Truth(None, f"log {log.name!r} shows another street than its config gives today")
    return Truth(street)


# Completeness of vehicles: orbit views of each vehicle against the truth.
#
# An edit can show a vehicle from sides that no logged camera saw. Their appearance comes from the
# mirrored side and from other frames of the vehicle.

AZIMUTHS = 8
"""Number of views around a vehicle. The first one looks at its front."""
WIDTH, HEIGHT = 320, 240
HALF_VIEW = np.deg2rad(25.0)
ELEVATION = np.deg2rad(12.0)
SEEN_WITHIN = np.deg2rad(40.0)
"""Largest azimuth difference to a logged camera at which a side counts as seen [rad]."""
MIN_PIXELS = 500
"""Minimum number of visible pixels of a vehicle for a view to count."""


@dataclass(frozen=True)
class SideScore:
    """One view of one vehicle against the truth, over the pixels that show it in the truth.

    Attributes:
        object_id: id of the vehicle.
        azimuth: azimuth of the camera about the vehicle [rad], 0 in front, pi behind.
        seen: whether a camera of the log saw this side.
        psnr: [dB]; missing pixels count as black.
        coverage: fraction of the pixels with a rendered part of the vehicle.
    """

    object_id: str
    azimuth: float
    seen: bool
    psnr: float
    coverage: float


@dataclass(frozen=True)
class AroundScore:
    """Means over views of all vehicles, separately for sides that the log saw and did not see.

    Attributes:
        psnr_seen, psnr_unseen: [dB], nan without such views.
        coverage_seen, coverage_unseen: in [0, 1], nan without such views.
        sides: every view.
    """

    psnr_seen: float
    psnr_unseen: float
    coverage_seen: float
    coverage_unseen: float
    sides: tuple[SideScore, ...]


def evaluate_around(
    scene: Scene, truth: SyntheticLog, *, min_views: int = 5, backend: str = "auto"
) -> AroundScore:
    """Render every vehicle visible in at least ``min_views`` logged images from all sides.

    Each vehicle is rendered alone, at the middle of its time span, from eight azimuths.
    """
    sides: list[SideScore] = []
    for index, track in enumerate(truth.tracks):
        logged_from = logged_azimuths(truth, track)
        if track.object_id in scene.objects and len(logged_from) >= min_views:
            sides += _sides(scene, truth, index, logged_from, backend)
    return AroundScore(
        psnr_seen=mean_psnr(s.psnr for s in sides if s.seen),
        psnr_unseen=mean_psnr(s.psnr for s in sides if not s.seen),
        coverage_seen=_mean([s.coverage for s in sides if s.seen]),
        coverage_unseen=_mean([s.coverage for s in sides if not s.seen]),
        sides=tuple(sides),
    )


def logged_azimuths(log: SyntheticLog, track: ObjectTrack) -> list[float]:
    """Azimuths [rad] in the object's frame of the cameras with its centre in the image."""
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
        sides.append(
            SideScore(
                object_id=track.object_id,
                azimuth=float(azimuth),
                seen=is_seen(azimuth, logged_from),
                psnr=psnr(rgb, image, mask),
                coverage=float(covered.mean()),
            )
        )
    return sides


def is_seen(azimuth: float, logged_from: Sequence[float]) -> bool:
    """Whether a side was seen: within SEEN_WITHIN of one of :func:`logged_azimuths`."""
    return bool((np.abs(wrapped(np.array(logged_from) - azimuth)) <= SEEN_WITHIN).any())


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
