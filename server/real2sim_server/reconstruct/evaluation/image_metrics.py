"""How alike two images are: peak signal-to-noise ratio and structural similarity."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

PSNR_CAP = 100.0
"""Stands for the infinite ratio of equal images where ratios are averaged or written [dB]."""
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


def ssim(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """Mean structural similarity of RGB images [H, W, 3], 1 for equal ones.

    Wang et al. 2004, eq. 13, with their Gaussian window of 11 taps and sigma 1.5 px, on each
    channel and averaged over all pixels and channels. Outside the image everything is zero, as
    in the evaluation of Kerbl et al. 2023, so that figures compare with published ones.
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
    return float((luminance * structure).mean())


def mean_psnr(values: Iterable[float]) -> float:
    """Mean of ratios [dB], infinite ones taken as PSNR_CAP and nan left out; nan for none."""
    known = [min(value, PSNR_CAP) for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")
