"""LiDAR sweeps cast through a scene against what was there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...logs import DrivingLog
from ...render.cast import Echo, recorded_sweep
from ...render.cast.sensors import drop_probability
from ...scene import Beams, Lidar, Scene
from ...synthetic import SyntheticConfig
from ...synthetic.log import LIDAR_ELEVATION, LIDAR_POSITION, SyntheticLog
from ..lidar import RecordedRays, recorded_rays
from ..lidar.rays import fit_rings
from .images import find_truth

CHAMFER = "mean squared distance from cast to true points plus from true to cast points"
F_DISTANCE = 0.05
"""Points nearer than this agree [m]."""


@dataclass(frozen=True)
class SweepScore:
    """One sweep, or means over several.

    Attributes:
        frame: of the log; -1 for means.
        rays: compared.
        median_m, median_squared_m2, p90_m: absolute error of the range where both return.
        expected_m: median absolute error of the mean range of the light, which tells haze.
        chamfer_m2: see CHAMFER.
        f_score: share of points within 5 cm of the others, mean of both ways.
        hit_miss: share of rays for which it is right whether anything is there; of a recorded
            sweep, whose rays all returned, the share that hit.
        intensity_rmse: of the reflectivity where both return.
        drop_accuracy: share of rays for which it is right whether they return; nan where nobody
            knows which did not.
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
        chamfer: convention of the distance of two clouds.
        mean: of all sweeps.
        sweeps: one each.
        ring_residual_deg: of the fitted beam table; nan where none was.
    """

    against: str
    chamfer: str
    mean: SweepScore
    sweeps: tuple[SweepScore, ...]
    ring_residual_deg: float


def evaluate_sweeps(scene: Scene, log: DrivingLog, frames: Sequence[int]) -> LidarScore | None:
    """Cast the sweeps of ``frames``; None where the log has none.

    Synthetic logs are compared with rays cast into their street, without noise and losses; others
    with their recorded returns.

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
    """Which rays of a grid are among recorded ones: nearest row and column."""
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
    """Rays that return more likely than not."""
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
