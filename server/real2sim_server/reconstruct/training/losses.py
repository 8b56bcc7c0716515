"""Training losses. Every function returns a scalar that carries gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import kernels

FRAME_STEP = 0.1
"""Second differences are scaled to this frame interval [s]."""
KEPT_QUANTILE = 0.95
"""Fraction of LiDAR points in the loss; the rest are edges, reflections and moving objects."""


@dataclass(frozen=True)
class LossWeights:
    """Factors of the terms of the loss; a term of weight 0 is not computed.

    Attributes:
        ssim: fraction of 1 - SSIM in the photometric loss, the rest is L1 (Kerbl et al. 2023).
        depth: mean distance from LiDAR along the view [m] (drivestudio: 0.01).
        sky: cross-entropy of accumulated opacity, 0 in the sky and 1 below the horizon (Street
            Gaussians: 0.05).
        object_entropy: entropy of the objects' opacity inside their projected boxes, and their
            opacity outside (Street Gaussians: 0.1).
        box: distance of object Gaussians outside their box [m].
        needle: excess of the ratio of a Gaussian's longest to its second axis over
            ``needle_ratio``.
        needle_ratio: that ratio (drivestudio: 10).
        smooth: squared second differences of refined object poses [m, rad] (drivestudio: 0.01).
        box_pose: squared corrections of object poses [m, rad]. Images alone do not determine
            them: Gaussians can move the other way within their box.
        opacity, scale: mean opacity and mean size [m] (MCMC, Kheradmand et al. 2024: 0.01).
        exposure: squared distance of exposures from the identity, and squared logarithms of the
            gains of images.
    """

    ssim: float = 0.2
    depth: float = 0.01
    sky: float = 0.4
    object_entropy: float = 0.0
    box: float = 0.1
    needle: float = 0.01
    needle_ratio: float = 10.0
    smooth: float = 0.01
    box_pose: float = 0.1
    opacity: float = 0.0
    scale: float = 0.0
    exposure: float = 0.1


class _Photometric(torch.autograd.Function):
    """(1 - s) L1 + s (1 - SSIM), value and gradient in one pass."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, truth: Tensor, fraction: float) -> tuple[Tensor, ...]:
        x, y = image.detach(), truth
        similarity, gradient = _ssim_and_gradient(x, y, scale=-fraction)
        difference = x - y
        if ctx.needs_input_grad[0]:
            gradient += difference.sign() * ((1 - fraction) / x.numel())
            ctx.save_for_backward(gradient)
        l1 = difference.abs().mean()
        loss = (1 - fraction) * l1 + fraction * (1 - similarity)
        parts = l1, torch.tensor(similarity), (difference * difference).mean()
        ctx.mark_non_differentiable(*parts)
        return (loss, *parts)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * gradients[0], None, None


def photometric(
    image: Tensor, truth: Tensor, *, ssim_weight: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """``(1 - s) L1 + s (1 - SSIM)`` of RGB images.

    Args:
        image: [H, W, 3] float32, carries the gradient.
        truth: [H, W, 3] float32 in [0, 1].
        ssim_weight: s.

    Returns:
        The loss; without gradients mean absolute error, SSIM, and mean squared error.
    """
    if image.device.type != "cpu":
        return _photometric_plain(image, truth, ssim_weight)
    loss, l1, similarity, squared = _Photometric.apply(  # type: ignore[no-untyped-call]
        image, truth, ssim_weight
    )
    return loss, l1, similarity, squared


def ssim(image: Tensor, truth: Tensor) -> float:
    """Mean structural similarity of RGB images [H, W, 3] in [0, 1] (Wang et al. 2004).

    Gaussian window of 11 px, standard deviation 1.5 px, zeros beyond the border.
    """
    return _ssim_and_gradient(image.detach().cpu(), truth.cpu(), scale=0.0)[0]


def ssim_plain(image: Tensor, truth: Tensor) -> Tensor:
    """Mean SSIM in plain torch, on any device, differentiable; images are [H, W, 3]."""
    window = torch.from_numpy(kernels.gaussian_window()).to(image)
    kernel = (window[:, None] * window)[None, None]
    x, y = (t.movedim(-1, 0)[:, None] for t in (image, truth))
    mx, my, xx, yy, xy = (
        torch.nn.functional.conv2d(m, kernel, padding=kernels.REACH)
        for m in (x, y, x * x, y * y, x * y)
    )
    c1, c2 = float(kernels.C1), float(kernels.C2)
    luminance = (2 * mx * my + c1) / (mx * mx + my * my + c1)
    structure = (2 * (xy - mx * my) + c2) / (xx - mx * mx + yy - my * my + c2)
    return (luminance * structure).mean()


def _photometric_plain(
    image: Tensor, truth: Tensor, fraction: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    difference = image - truth
    l1, similarity = difference.abs().mean(), ssim_plain(image, truth)
    loss = (1 - fraction) * l1 + fraction * (1 - similarity)
    return loss, l1.detach(), similarity.detach(), (difference.detach() ** 2).mean()


def _ssim_and_gradient(image: Tensor, truth: Tensor, *, scale: float) -> tuple[float, Tensor]:
    """SSIM and ``scale`` times its gradient by ``image`` [H, W, 3]."""
    height, width, _ = image.shape
    x = image.contiguous().numpy().reshape(height, 3 * width)
    y = truth.contiguous().numpy().reshape(height, 3 * width)
    window = kernels.gaussian_window()
    blurred = np.empty((5, *x.shape), np.float32)
    slopes = np.empty((3, *x.shape), np.float32)
    sums = np.empty(height, np.float64)
    gradient = np.zeros_like(x)
    kernels.blur_rows(x, y, window, blurred)
    kernels.compare(blurred, window, sums, slopes)
    if scale != 0:
        factor = np.float32(scale / x.size)
        kernels.gather_slopes(x, y, slopes, window, factor, gradient)
    return float(sums.sum() / x.size), torch.from_numpy(gradient.reshape(height, width, 3))


def lidar_depth(depth: Tensor, pixels: Tensor, measured: Tensor) -> Tensor:
    """Mean distance [m] of rendered depth from LiDAR over the nearest 95 % of the points.

    Args:
        depth: [H, W] rendered [m].
        pixels: [M] int64, row-major indices into the image.
        measured: [M] float32 along the camera's z [m].
    """
    if len(pixels) == 0:
        return depth.sum() * 0
    error = (depth.reshape(-1)[pixels] - measured).abs()
    kept = max(1, int(KEPT_QUANTILE * len(error)))
    limit = error.detach().kthvalue(kept).values
    return torch.where(error <= limit, error, 0.0).sum() / kept


def sky_opacity(alpha: Tensor, sky: Tensor) -> Tensor:
    """``-log(1 - alpha)`` where ``sky`` is positive and ``-log(alpha)`` where it is negative,
    weighted by its absolute value and averaged over all pixels; both [H, W].
    """
    # Rendering stops at a transmittance of 1e-4, so that even an opaque wall keeps its gradient.
    in_sky = sky.clamp(min=0) * torch.log1p(-alpha.clamp(max=1 - 1e-5))
    below = (-sky).clamp(min=0) * alpha.clamp(min=1e-3).log()
    return -(in_sky + below).mean()


def object_accumulation(alpha: Tensor, inside: Tensor) -> Tensor:
    """Entropy of the objects' opacity inside their boxes, ``-log(1 - alpha)`` outside.

    Args:
        alpha: [H, W] accumulated opacity of objects alone.
        inside: [H, W] bool, within a projected box.

    Source: Street Gaussians (Yan et al. 2024), eq. 10.
    """
    a = alpha.clamp(1e-4, 1 - 1e-3)
    entropy = -(a * a.log() + (1 - a) * (1 - a).log())
    return torch.where(inside, entropy, -torch.log(1 - a)).mean()


def outside_box(means: Tensor, half_sizes: Tensor) -> Tensor:
    """Mean distance [m] of centres [N, 3] outside their boxes, half sizes [N, 3]."""
    if len(means) == 0:
        return means.sum()
    return (means.abs() - half_sizes).clamp(min=0).sum(-1).mean()


def needles(log_scales: Tensor, ratio: float) -> Tensor:
    """Mean excess of longest / second longest axis over ``ratio``; flat discs have none."""
    if len(log_scales) == 0:
        return log_scales.sum()
    low, high = log_scales.amin(-1), log_scales.amax(-1)
    middle = log_scales.sum(-1) - low - high
    return ((high - middle).exp() - ratio).clamp(min=0).mean()


def second_differences(values: Tensor, times_s: NDArray[np.float64]) -> Tensor:
    """Mean of squared second differences over rows of [T, D], scaled to intervals of 0.1 s.

    Uniform motion has no cost, even at uneven times [T] [s], for example around held-out frames.
    """
    if len(values) < 3:
        return values.sum() * 0
    steps = torch.from_numpy(np.diff(times_s)).to(values)[:, None]
    speeds = (values[1:] - values[:-1]) / steps
    bends = 2 * (speeds[1:] - speeds[:-1]) / (steps[1:] + steps[:-1])
    return (bends * FRAME_STEP**2).square().sum(-1).mean()


def psnr_of(squared_error: float) -> float:
    """PSNR [dB] of a mean squared error of values in [0, 1]; at most 100."""
    return float(-10 * np.log10(max(squared_error, 1e-10)))


__all__ = [
    "LossWeights",
    "lidar_depth",
    "needles",
    "object_accumulation",
    "outside_box",
    "photometric",
    "psnr_of",
    "second_differences",
    "sky_opacity",
    "ssim",
    "ssim_plain",
]
