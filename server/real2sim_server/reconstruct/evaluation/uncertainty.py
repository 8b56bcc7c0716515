"""Uncertainty of each Gaussian: estimated from training rays, checked against true errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry import Float
from ...logs import DrivingLog
from ...render import Instance, RasterOptions, rasterize
from ...render.backend import Backend
from ...render.select import select_backend
from ...scene import UNSEEN, Camera, Scene, Sky
from ...scene.cloud import SH_C0
from ..logged_view import image_time, resized, spread
from ..options import ReconstructError
from ..training.run import one_torch_thread
from .rendering import (
    listed_held_out,
    render_logged_view,
    render_uncertainty,
    scene_instances,
    select_cameras,
)

# Estimation from the training rays.
#
# An image is linear in the constant colours of its Gaussians. The gradients of two sums over its
# pixels with respect to these colours are therefore, for each Gaussian, the sum of its blending
# weights and the sum of weights times residuals. Their quotient over the training views is the
# mean residual of the rays that hit the Gaussian. A prior of a few hundredths of a pixel with the
# value UNSEEN covers Gaussians without hits. Rendered as a colour, this residual ranks the true
# errors of new images better than ray counts do, because it accounts for thin, shiny and moving
# surfaces (figures in docs/reconstruction.md).

VIEWS = 48
"""Maximum number of training views used."""
WIDTH = 640
"""Maximum width of the images [px]."""
PRIOR_PIXELS, PRIOR_WIDTH = 0.05, 240
"""Weight of the prior UNSEEN: pixels of an image of that width [px]."""


@dataclass(frozen=True)
class UncertaintyReport:
    """Result of the estimation.

    Attributes:
        views: number of compared training views.
        seen: share of the Gaussians with more evidence from their rays than from the prior.
        mean: mean uncertainty of these Gaussians over the rays that hit them.
    """

    views: int
    seen: float
    mean: float


@dataclass(frozen=True, eq=False)
class _Sums:
    """Per Gaussian or texel, over views: its blending weights [px], and weights times residuals."""

    weights: Tensor
    errors: Tensor

    @classmethod
    def zeros(cls, *shape: int) -> _Sums:
        return cls(torch.zeros(shape, dtype=torch.float64), torch.zeros(shape, dtype=torch.float64))

    def add(self, gradient: Tensor | None, unit: float) -> None:
        """Add the gradient [..., 3] of constant colours; channel 0 of weights, 1 of errors."""
        if gradient is not None:
            self.weights.add_(gradient[..., 0].cpu().double().clamp(min=0) / unit)
            self.errors.add_(gradient[..., 1].cpu().double().clamp(min=0) / unit)

    def uncertainties(self, prior: float) -> Tensor:
        """float32 in [0, 1]."""
        values = (self.errors + UNSEEN * prior) / (self.weights + prior)
        return values.clamp(0, 1).float()


def fit_uncertainties(
    scene: Scene,
    log: DrivingLog,
    *,
    views: int = VIEWS,
    backend: str | Backend = "auto",
    on_view: Callable[[int, int], None] | None = None,
) -> tuple[Scene, UncertaintyReport]:
    """The scene with uncertainties of its Gaussians and its sky, from its training views.

    Held-out frames are not used.

    Args:
        scene: scene made from ``log``.
        log: the same part of it.
        views: maximum number of images, evenly spread over all of them.
        backend: backend of the renderer; it must support gradients.
        on_view: called with the number of finished views and of all views.

    Raises:
        ReconstructError: the scene and the log do not belong together, or no image is left.
        LogError: an image cannot be read.
        RenderError: the renderer does not support gradients.
    """
    chosen = _views(scene, log, views)
    drawing = select_backend(backend) if isinstance(backend, str) else backend
    width = chosen[0][0].width
    prior = PRIOR_PIXELS * (width / PRIOR_WIDTH) ** 2
    sums = [_Sums.zeros(len(scene.background))]
    sums += [_Sums.zeros(len(item.cloud)) for item in scene.objects.values()]
    sky = _Sums.zeros(*scene.sky.faces.shape[:3]) if scene.sky is not None else None
    with one_torch_thread():
        for done, (camera, frame) in enumerate(chosen):
            _add_view(scene, log, camera, frame, backend=drawing, sums=sums, sky=sky)
            if on_view is not None:
                on_view(done + 1, len(chosen))
    weights, errors = torch.cat([s.weights for s in sums]), torch.cat([s.errors for s in sums])
    report = UncertaintyReport(
        views=len(chosen),
        seen=float((weights > prior).double().mean()) if len(weights) else 0.0,
        mean=float(errors.sum() / weights.sum().clamp(min=1e-9)),
    )
    return _with(scene, sums, sky, prior), report


def _views(scene: Scene, log: DrivingLog, count: int) -> list[tuple[Camera, int]]:
    """Cameras and frames, evenly spread over the training frames, other frames for each camera."""
    held_out = set(listed_held_out(scene))
    cameras = [
        camera.resized(min(WIDTH, camera.width))
        for camera in select_cameras(scene, log, None)
        if camera.is_pinhole
    ]
    chosen = []
    for place, camera in enumerate(cameras):
        frames = [
            frame
            for frame in range(log.frame_count)
            if frame not in held_out
            and log.has_image(camera.name, frame)
            and scene.ego.covers(image_time(log, camera.name, frame))
        ]
        own = min(len(frames), count // len(cameras) + (place < count % len(cameras)))
        shift = (place + 0.5) / len(cameras)
        chosen += [(camera, frames[int((k + shift) * len(frames) / own)]) for k in range(own)]
    if not chosen:
        raise ReconstructError(
            f"log {log.name!r} has no image of a pinhole camera that scene {scene.name!r} was "
            "trained on"
        )
    return chosen


def _add_view(
    scene: Scene,
    log: DrivingLog,
    camera: Camera,
    frame: int,
    *,
    backend: Backend,
    sums: list[_Sums],
    sky: _Sums | None,
) -> None:
    """Add the evidence of one view."""
    t_us = image_time(log, camera.name, frame)
    viewmat = camera.viewmat(scene.ego.transform(t_us))[None]
    instances = scene_instances(scene, t_us)
    image = torch.from_numpy(resized(log.image(camera.name, frame), camera).copy()).float() / 255
    options = RasterOptions(depth=False, instance=False)

    def draw(shown: list[Instance], behind: Sky | None) -> Tensor:
        size = (camera.width, camera.height)
        return rasterize(
            shown, viewmat, camera.K[None], *size, sky=behind, options=options, backend=backend
        ).rgb[0]

    with torch.no_grad():
        seen = draw(instances, scene.sky).clamp(0, 1)
    residual = (seen - image.to(seen.device)).abs().mean(-1)
    colours = [i.cloud.means.new_zeros(len(i.cloud), 1, 3, requires_grad=True) for i in instances]
    faces = torch.zeros_like(scene.sky.faces, requires_grad=True) if scene.sky else None
    # Grey, so that the clamp of colours at 0 lets gradients through.
    coloured = [
        replace(i, cloud=replace(i.cloud, sh=colour), colour=None)
        for i, colour in zip(instances, colours, strict=True)
    ]
    with torch.enable_grad():
        drawn = draw(coloured, None if faces is None else Sky(faces))
        torch.autograd.backward(drawn[..., 0].sum() + (drawn[..., 1] * residual).sum())
    for item, colour in zip(instances, colours, strict=True):
        # Ids count from 1 over the scene's objects; the background is 0.
        sums[item.instance_id].add(None if colour.grad is None else colour.grad[:, 0], SH_C0)
    if sky is not None and faces is not None:
        sky.add(faces.grad, 1.0)


def _with(scene: Scene, sums: list[_Sums], sky: _Sums | None, prior: float) -> Scene:
    device = scene.background.device
    background = replace(scene.background, uncertainties=sums[0].uncertainties(prior).to(device))
    objects = {
        name: replace(
            item, cloud=replace(item.cloud, uncertainties=own.uncertainties(prior).to(device))
        )
        for (name, item), own in zip(scene.objects.items(), sums[1:], strict=True)
    }
    behind = scene.sky
    if behind is not None and sky is not None:
        behind = replace(behind, uncertainties=sky.uncertainties(prior).to(device))
    return replace(scene, background=background, objects=objects, sky=behind, content_hash="")


# Check: rendered uncertainty against true errors.

Values = NDArray[np.float32]
"""An image [H, W] or a crop."""
BLUR = 9
"""Edge of the squares for the comparison of local means [px]."""
MAX_VIEWS = 24


@dataclass(frozen=True)
class UncertaintyScore:
    """Means over views.

    Attributes:
        spearman: rank correlation of uncertainty and absolute error, per pixel.
        spearman_regions: rank correlation of their means over squares of 9 by 9 pixels.
        sparsification: remaining error above the minimum when the most uncertain pixels are
            dropped, over all dropped shares: 0 if uncertainty ranks like the error itself, 1 if it
            ranks at random.
        uncertainty: mean rendered uncertainty.
        error: mean true error, of a colour in [0, 1].
        views: number of views.
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
    """Compare rendered uncertainty with errors; None if the scene has no uncertainties.

    Args:
        scene: scene with uncertainties.
        log: the log that the scene was made from.
        views: cameras and frames, of which at most MAX_VIEWS, evenly spread, are used.
        backend: backend of the renderer.

    Raises:
        LogError: an image cannot be read.
    """
    if not scene.has_uncertainties or not views:
        return None
    chosen = spread(views, MAX_VIEWS)
    images = [_images(scene, log, camera, frame, backend) for camera, frame in chosen]
    regions = [(_smooth(uncertainty), _smooth(error)) for uncertainty, error in images]
    return UncertaintyScore(
        spearman=_mean(rank_correlation(u, e) for u, e in images),
        spearman_regions=_mean(rank_correlation(u, e) for u, e in regions),
        sparsification=_mean(sparsification(u, e) for u, e in images),
        uncertainty=_mean(float(u.mean()) for u, _ in images),
        error=_mean(float(e.mean()) for _, e in images),
        views=len(chosen),
    )


def _mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def _smooth(image: Values) -> Values:
    import cv2

    return np.asarray(cv2.blur(image, (BLUR, BLUR)), np.float32)


def rank_correlation(first: Values, second: Values) -> float:
    """Spearman's rank correlation; equal values share their mean rank. 0 if one is constant."""
    from scipy.stats import rankdata

    a, b = (rankdata(values.ravel()) for values in (first, second))
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / scale if scale > 0 else 0.0


def sparsification(uncertainty: Values, error: Values) -> float:
    """Area between two curves, divided by the area for dropping at random.

    The curves are the mean remaining error after dropping the most uncertain values, and after
    dropping the largest errors.
    """
    overall, errors = float(error.mean()), error.ravel()
    by_uncertainty = _left(errors[np.argsort(-uncertainty.ravel(), kind="stable")])
    least = _left(np.sort(errors)[::-1])
    chance = float((overall - least).mean())
    return float((by_uncertainty - least).mean()) / chance if chance > 0 else 0.0


def _left(ordered: Values) -> Float:
    """Mean of the remaining values when the first k are dropped, for each k."""
    sums = np.cumsum(ordered[::-1].astype(np.float64))[::-1]
    return sums / np.arange(len(ordered), 0, -1)


def _images(
    scene: Scene, log: DrivingLog, camera: Camera, frame: int, backend: str
) -> tuple[Values, Values]:
    """Rendered uncertainty and true error [H, W]."""
    t_us = image_time(log, camera.name, frame)
    image = resized(log.image(camera.name, frame), camera)
    drawn = render_logged_view(scene, camera, t_us, backend=backend)
    error = np.abs(drawn.astype(np.float32) - image).mean(axis=-1) / np.float32(255)
    return render_uncertainty(scene, camera, t_us, backend=backend), error
