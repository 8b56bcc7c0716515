"""Whether what a scene says of its uncertainty is so: drawn uncertainty against true errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import Float
from ...logs import DrivingLog
from ...scene import Camera, Scene
from ..logged_view import image_time, resized
from .rendering import render_logged_view, render_uncertainty

Values = NDArray[np.float32]
"""An image [H, W], or a part of one."""
BLUR = 9
"""Edge of the squares over whose means both are compared as well [px]."""
MAX_VIEWS = 24


@dataclass(frozen=True)
class UncertaintyScore:
    """Means over views.

    Attributes:
        spearman: rank correlation of uncertainty and absolute error, by pixel.
        spearman_regions: of their means over squares of 9 by 9 pixels.
        sparsification: error that is left above the least possible when the most uncertain pixels
            are dropped, over all shares dropped: 0 where uncertainty ranks as the error itself, 1
            where it ranks as chance does.
        uncertainty: that is drawn.
        error: that there is, of a colour in [0, 1].
        views: how many.
    """

    spearman: float
    spearman_regions: float
    sparsification: float
    uncertainty: float
    error: float
    views: int


def evaluate_uncertainty(
    scene: Scene,
    log: DrivingLog,
    views: Sequence[tuple[Camera, int]],
    *,
    backend: str = "auto",
) -> UncertaintyScore | None:
    """Compare drawn uncertainty with errors; None where the scene knows none.

    Args:
        scene: with uncertainties.
        log: it was made of.
        views: cameras and frames, of which at most MAX_VIEWS are taken, evenly spread.
        backend: of the renderer.

    Raises:
        LogError: an image cannot be read.
    """
    if not scene.has_uncertainties or not views:
        return None
    count = min(MAX_VIEWS, len(views))
    chosen = [views[round(i)] for i in np.linspace(0, len(views) - 1, count)]
    images = [_images(scene, log, camera, frame, backend) for camera, frame in chosen]
    regions = [(_smooth(uncertainty), _smooth(error)) for uncertainty, error in images]
    return UncertaintyScore(
        spearman=_mean(rank_correlation(u, e) for u, e in images),
        spearman_regions=_mean(rank_correlation(u, e) for u, e in regions),
        sparsification=_mean(sparsification(u, e) for u, e in images),
        uncertainty=_mean(float(u.mean()) for u, _ in images),
        error=_mean(float(e.mean()) for _, e in images),
        views=count,
    )


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _smooth(image: Values) -> Values:
    import cv2

    return np.asarray(cv2.blur(image, (BLUR, BLUR)), np.float32)


def rank_correlation(first: Values, second: Values) -> float:
    """Spearman's; equal values share the mean of their ranks. 0 where one is constant."""
    from scipy.stats import rankdata

    a, b = (rankdata(values.ravel()) for values in (first, second))
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / scale if scale > 0 else 0.0


def sparsification(uncertainty: Values, error: Values) -> float:
    """Area between the curve of the mean error left by dropping the most uncertain and that by
    dropping the worst, over that of dropping at random."""
    overall, errors = float(error.mean()), error.ravel()
    by_uncertainty = _left(errors[np.argsort(-uncertainty.ravel(), kind="stable")])
    least = _left(np.sort(errors)[::-1])
    chance = float((overall - least).mean())
    return float((by_uncertainty - least).mean()) / chance if chance > 0 else 0.0


def _left(ordered: Values) -> Float:
    """Mean of what is left when the first k are dropped, by k."""
    sums = np.cumsum(ordered[::-1].astype(np.float64))[::-1]
    return sums / np.arange(len(ordered), 0, -1)


def _images(
    scene: Scene, log: DrivingLog, camera: Camera, frame: int, backend: str
) -> tuple[Values, Values]:
    """Drawn uncertainty and true error [H, W]."""
    t_us = image_time(log, camera.name, frame)
    image = resized(log.image(camera.name, frame), camera)
    drawn = render_logged_view(scene, camera, t_us, backend=backend)
    error = np.abs(drawn.astype(np.float32) - image).mean(axis=-1) / np.float32(255)
    return render_uncertainty(scene, camera, t_us, backend=backend), error
