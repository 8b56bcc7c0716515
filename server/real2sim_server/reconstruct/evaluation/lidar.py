"""Depth, coverage and cast sweeps of a scene against the LiDAR of its log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, apply_transform, invert_transform
from ...logs import DrivingLog
from ...render.cast import Echo, recorded_sweep
from ...render.cast.sensors import drop_probability
from ...scene import Beams, Camera, Lidar, Scene
from ...synthetic import SyntheticConfig
from ...synthetic.log import LIDAR_ELEVATION, LIDAR_POSITION, SyntheticLog
from ..lidar import RecordedRays, recorded_rays
from ..lidar.rays import fit_rings
from ..logged_view import resized
from ..options import ReconstructError
from .images import find_truth, psnr
from .rendering import render_logged_view

# Rendered depth against the LiDAR.

NEAR, FAR = 0.5, 80.0
"""Depth range of the compared points [m]."""
HIDDEN_BEHIND = 0.3
"""An occluder is nearer than a point by at least this much, plus the recession of the road [m]."""
REACH = 0.006
"""Radius of the search for occluders on the image [rad]; about two beams apart."""
ROAD_BELOW = 1.2
"""Minimum height of the cameras above the road [m]."""


def seen_points(
    points: Float, camera: Camera
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Rows [M], columns [M] and depths [M] [m] of the points that the camera can see.

    The LiDAR has a different position and sees points that the camera does not. A point counts as
    hidden if any point within REACH on the image is nearer by more than HIDDEN_BEHIND plus the
    recession z^2 angle / height of a road ROAD_BELOW the camera. The second term keeps distant
    stretches of road.

    Args:
        points: [N, 3] in the camera frame [m].
        camera: gives size and K.
    """
    import cv2

    points = points[(points[:, 2] > NEAR) & (points[:, 2] < FAR)]
    depth = points[:, 2]
    column = np.floor(camera.K[0, 0] * points[:, 0] / depth + camera.K[0, 2]).astype(np.int64)
    row = np.floor(camera.K[1, 1] * points[:, 1] / depth + camera.K[1, 2]).astype(np.int64)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    row, column, depth = row[inside], column[inside], depth[inside]
    nearest = np.full((camera.height, camera.width), FAR, dtype=np.float64)
    np.minimum.at(nearest, (row, column), depth)
    focal = camera.K[0, 0]
    reach = max(1, round(REACH * focal))
    # The default border is the largest finite number and hides nothing.
    nearest = np.asarray(cv2.erode(nearest, np.ones((2 * reach + 1,) * 2, np.uint8)))
    # One pixel more, as points are rounded to pixels.
    recedes = depth**2 * (reach + 1) / (focal * ROAD_BELOW)
    seen = depth - nearest[row, column] <= HIDDEN_BEHIND + recedes
    return row[seen], column[seen], depth[seen]


def depth_errors(depth: NDArray[np.float32], points: Float, camera: Camera) -> NDArray[np.float64]:
    """Absolute errors [M] [m] of a rendered depth image at the points the camera can see.

    Infinite where nothing was rendered, so that a median accounts for holes.

    Args:
        depth: [H, W] along the camera's z [m], 0 in empty pixels.
        points: [N, 3] in the camera frame [m].
        camera: camera of the image.
    """
    row, column, expected = seen_points(points, camera)
    rendered = depth[row, column].astype(np.float64)
    return np.where(rendered > 0, np.abs(rendered - expected), np.inf)


def median_error(errors: NDArray[np.float64]) -> float:
    """Median [m]; nan without points, infinite if most are holes."""
    # The mean of a finite and an infinite middle value is infinite, as it should be.
    return float(np.median(errors)) if len(errors) else float("nan")


def mean_error(errors: NDArray[np.float64]) -> float:
    """Mean over the points that are not holes [m]; nan without such points.

    Reveals long tails from hazy surfaces, which the median hides.
    """
    finite = errors[np.isfinite(errors)]
    return float(finite.mean()) if len(finite) else float("nan")


def error_p90(errors: NDArray[np.float64]) -> float:
    """90th percentile [m].

    Nan without points, infinite if more than a tenth of them are holes.
    """
    if len(errors) == 0:
        return float("nan")
    # Percentiles between a finite and an infinite value cannot be interpolated.
    return float(np.percentile(errors, 90, method="inverted_cdf"))


# PSNR of logged views, over all pixels and over those that the LiDAR covers (for the
# reconstruction report; :mod:`.scores` holds the full evaluation).

COVERAGE_NEAR = 0.5
"""Minimum depth of LiDAR points that count as coverage [m]."""


@dataclass(frozen=True)
class CoverageScore:
    """One rendered view against its logged image.

    Attributes:
        camera, frame: camera and frame of the view.
        psnr: over all pixels [dB].
        psnr_lidar: over the pixels that LiDAR covers [dB]; nan without such pixels.
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
        views: one score per view, by frame, then by camera.
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

    LiDAR covers a pixel if a point of the frame's sweep, at least COVERAGE_NEAR in front of the
    camera, projects to within 1/600 of the image width (2 px at 1242 px). There is no occlusion
    test.

    Args:
        scene: reconstructed from ``log``.
        frames: indices of frames.
        cameras: names; all by default.
        width: width of the compared images [px]; the logged width by default.
        backend: backend of the renderer.

    Raises:
        ReconstructError: no frames or no cameras were named, or the scene lacks a frame.
        LogError: unknown frames, or files that cannot be read.
    """
    names = list(log.rig.names if cameras is None else cameras)
    if not names or len(frames) == 0:
        raise ReconstructError("name at least one camera and one frame to evaluate")
    views = tuple(
        _coverage_score(scene, log, log.rig[name], frame, width=width, backend=backend)
        for frame in frames
        for name in names
        if log.has_image(name, frame)
    )
    return CoverageReport(
        views=views,
        psnr=_mean_coverage([v.psnr for v in views]),
        psnr_lidar=_mean_coverage([v.psnr_lidar for v in views]),
    )


def lidar_mask(log: DrivingLog, camera: Camera, frame: int) -> NDArray[np.bool_]:
    """[H, W] bool, pixels of ``camera`` that the sweep of ``frame`` covers.

    Defined in :func:`evaluate_views`.
    """
    import cv2

    T_camera_vehicle = invert_transform(camera.T_vehicle_camera)
    points = apply_transform(T_camera_vehicle, log.lidar(frame).points)
    points = points[points[:, 2] > COVERAGE_NEAR]
    u = np.floor(camera.K[0, 0] * points[:, 0] / points[:, 2] + camera.K[0, 2])
    v = np.floor(camera.K[1, 1] * points[:, 1] / points[:, 2] + camera.K[1, 2])
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    mask[v[inside].astype(np.int64), u[inside].astype(np.int64)] = 1
    reach = max(1, round(camera.width / 600))
    return np.asarray(cv2.dilate(mask, np.ones((2 * reach + 1,) * 2, np.uint8)) > 0)


def _coverage_score(
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


def _mean_coverage(values: list[float]) -> float:
    known = [v for v in values if not np.isnan(v)]
    return float(np.mean(known)) if known else float("nan")


# Cast LiDAR sweeps against the recorded or true ones.

CHAMFER = "mean squared distance from cast to true points plus from true to cast points"
F_DISTANCE = 0.05
"""Maximum distance between matching points for the F score [m]."""


@dataclass(frozen=True)
class SweepScore:
    """One sweep, or means over several.

    Attributes:
        frame: frame of the log; -1 for means.
        rays: number of compared rays.
        median_m, median_squared_m2, p90_m: absolute error of the range where both return.
        expected_m: median absolute error of the mean range of the light, which reveals haze.
        chamfer_m2: see CHAMFER.
        f_score: share of points within 5 cm of the other cloud, mean of both directions.
        hit_miss: share of rays with a correct hit or miss. For a recorded sweep, where all rays
        returned, the share that hit.
        intensity_rmse: root mean square error of the reflectivity where both return.
        drop_accuracy: share of rays whose return or loss is predicted correctly; nan if the lost
        rays are unknown.
    """

    frame: int
    rays: int
    median_m: float
    median_squared_m2: float
    p90_m: float
    expected_m: float
    chamfer_m2: float
    f_score: float
    hit_miss: float
    intensity_rmse: float
    drop_accuracy: float


@dataclass(frozen=True)
class LidarScore:
    """Sweeps of a scene against its log.

    Attributes:
        against: ``ray-cast truth`` or ``recorded returns``.
        chamfer: convention of the distance between two clouds.
        mean: over all sweeps.
        sweeps: one score per sweep.
        ring_residual_deg: residual of the fitted beam table [deg]; nan without one.
    """

    against: str
    chamfer: str
    mean: SweepScore
    sweeps: tuple[SweepScore, ...]
    ring_residual_deg: float


def evaluate_sweeps(scene: Scene, log: DrivingLog, frames: Sequence[int]) -> LidarScore | None:
    """Cast the sweeps of ``frames`` and score them; None if the log has no sweeps.

    Sweeps of synthetic logs are compared with rays cast into their street, without noise and
    losses. Other sweeps are compared with their recorded returns.

    Raises:
        LogError: a sweep cannot be read.
    """
    street = find_truth(log).log
    scores: list[SweepScore] = []
    residuals: list[float] = []
    for frame in frames:
        rays = recorded_rays(log, frame)
        if rays is None:
            continue
        if street is not None:
            scores.append(_against_street(scene, log, street, frame, rays))
        else:
            score, residual = _against_returns(scene, log, frame, rays)
            scores.append(score)
            residuals.append(residual)
    if not scores:
        return None
    return LidarScore(
        against="recorded returns" if street is None else "ray-cast truth",
        chamfer=CHAMFER,
        mean=_mean(scores),
        sweeps=tuple(scores),
        ring_residual_deg=float(np.degrees(np.nanmean(residuals))) if residuals else float("nan"),
    )


def synthetic_lidar(config: SyntheticConfig) -> Lidar:
    """The LiDAR of a synthetic drive as a grid of all its rays."""
    pose = np.eye(4)
    pose[:3, 3] = LIDAR_POSITION
    elevation = np.linspace(*LIDAR_ELEVATION, config.lidar_beams)
    beams = Beams.spinning(elevation, columns=config.lidar_columns, rate_hz=config.hz)
    return Lidar(
        "synthetic", beams, pose, min_range=0.0, max_range=config.lidar_range,
        range_noise=config.lidar_noise,
    )  # fmt: skip


def _against_street(
    scene: Scene, log: DrivingLog, street: SyntheticLog, frame: int, rays: RecordedRays
) -> SweepScore:
    config = SyntheticConfig.from_values(street.provenance["config"])
    lidar, t_us = synthetic_lidar(config), int(log.frame_times_us[frame])
    truth, reflectivity = street.sweep(lidar, t_us)
    echo = recorded_sweep(scene, lidar, t_us)
    given = rays.lidar.beams
    returned = _returned(lidar, given.azimuth, given.elevation)
    kept = _kept(echo, lidar)
    points = lidar.beams.directions
    return _score(
        frame,
        echo,
        truth,
        reflectivity,
        clouds=(
            (points * echo.range[..., None])[echo.hit],
            (points * truth[..., None])[truth > 0],
        ),
        drop_accuracy=float((kept == returned).mean()),
    )


def _returned(lidar: Lidar, azimuth: Float, elevation: Float) -> NDArray[np.bool_]:
    """Mask of the rays of a grid that were recorded, by nearest row and column."""
    beams = lidar.beams
    rows = np.argsort(beams.elevation[:, 0])
    heights = beams.elevation[rows, 0]
    middle = (heights[1:] + heights[:-1]) / 2
    row = rows[np.searchsorted(middle, elevation)]
    order = np.argsort(beams.azimuth[0])
    angles = beams.azimuth[0, order]
    step = 2 * np.pi / len(angles)
    column = order[np.rint((azimuth - angles[0]) / step).astype(int) % len(angles)]
    returned = np.zeros(lidar.shape, np.bool_)
    returned[row, column] = True
    return returned


def _against_returns(
    scene: Scene, log: DrivingLog, frame: int, rays: RecordedRays
) -> tuple[SweepScore, float]:
    t_us = int(log.frame_times_us[frame])
    echo = recorded_sweep(scene, rays.lidar, t_us)
    directions = rays.lidar.beams.directions
    rings = fit_rings(rays)
    accuracy = float("nan")
    if rings is not None:
        kept = int(_kept(echo, rays.lidar).sum())
        missing = rings.missing(rays)
        for lidar in missing:
            kept += int((~_kept(recorded_sweep(scene, lidar, t_us), lidar)).sum())
        accuracy = kept / (len(rays.range) + sum(lidar.beams.count for lidar in missing))
    response = scene.lidar.response if scene.lidar is not None else None
    if response is not None and rings is not None:
        answered = response.applied(
            echo.intensity, elevation=rings.elevation, ring=rings.ring, distance=echo.range
        )
        echo = replace(echo, intensity=answered)
    score = _score(
        frame,
        echo,
        rays.range.astype(np.float32),
        rays.intensity,
        clouds=((directions * echo.range[:, None])[echo.hit], directions * rays.range[:, None]),
        drop_accuracy=accuracy,
    )
    return score, rings.residual if rings is not None else float("nan")


def _kept(echo: Echo, lidar: Lidar) -> NDArray[np.bool_]:
    """Rays with a return probability above one half."""
    return echo.hit & (drop_probability(echo, lidar) <= 0.5)


def _score(
    frame: int,
    echo: Echo,
    truth: NDArray[np.float32],
    reflectivity: NDArray[np.float32],
    *,
    clouds: tuple[Float, Float],
    drop_accuracy: float,
) -> SweepScore:
    there = truth > 0
    both = echo.hit & there
    error = np.abs(echo.range - truth)[both].astype(np.float64)
    stopped = (echo.opacity > 0.5) & there
    expected = np.abs(echo.expected - truth)[stopped].astype(np.float64)
    chamfer, f_score = _distances(*clouds)
    off = (np.clip(echo.intensity, 0, 1) - reflectivity)[both].astype(np.float64)
    return SweepScore(
        frame=frame,
        rays=truth.size,
        median_m=_of(np.median, error),
        median_squared_m2=_of(np.median, error**2),
        p90_m=_of(lambda values: np.quantile(values, 0.9), error),
        expected_m=_of(np.median, expected),
        chamfer_m2=chamfer,
        f_score=f_score,
        hit_miss=float((echo.hit == there).mean()),
        intensity_rmse=_of(lambda values: np.sqrt(np.mean(values**2)), off),
        drop_accuracy=drop_accuracy,
    )


def _distances(cast: Float, true: Float) -> tuple[float, float]:
    """Chamfer distance and F score of two clouds."""
    from scipy.spatial import cKDTree

    if len(cast) == 0 or len(true) == 0:
        return float("nan"), 0.0
    there = cKDTree(true).query(cast)[0]
    back = cKDTree(cast).query(true)[0]
    agree = ((there < F_DISTANCE).mean() + (back < F_DISTANCE).mean()) / 2
    return float((there**2).mean() + (back**2).mean()), float(agree)


def _of(measure: Callable[[Float], Any], values: Float) -> float:
    return float(measure(values)) if len(values) else float("nan")


def _mean(scores: Sequence[SweepScore]) -> SweepScore:
    names = [f.name for f in fields(SweepScore)]
    table = np.array([[getattr(score, name) for name in names] for score in scores], float)
    means = dict(zip(names, table.mean(0).tolist(), strict=True))
    return SweepScore(**{**means, "frame": -1, "rays": int(table[:, names.index("rays")].sum())})
