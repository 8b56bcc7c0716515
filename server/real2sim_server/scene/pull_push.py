"""Filling of holes in grids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pull_push(values: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill unknown cells smoothly from known ones (Gortler et al. 1996, "The Lumigraph").

    Args:
        values: [H, W, C] float32; ignored where the weight is 0.
        weights: [H, W] float32 in [0, 1], how well a cell is known.

    Returns:
        [H, W, C] float32: ``values`` where the weight is 1, elsewhere blended with coarser levels.
        All zeros where nothing is known at all.
    """
    height, width = weights.shape
    if height == 1 and width == 1:
        return np.where(weights[..., None] > 0, values, 0).astype(np.float32)
    coarse_values, coarse_weights = _halve(values, weights)
    coarse = pull_push(coarse_values, coarse_weights)
    w = weights[..., None]
    filled = np.where(w > 0, values, 0) * w + _double(coarse, height, width) * (1 - w)
    return np.asarray(filled, dtype=np.float32)


def _halve(
    values: NDArray[np.float32], weights: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    height, width = weights.shape
    padding = ((0, height % 2), (0, width % 2))
    w = np.pad(weights, padding)
    v = np.pad(np.where(weights[..., None] > 0, values, 0), (*padding, (0, 0))) * w[..., None]
    h2, w2 = w.shape[0] // 2, w.shape[1] // 2
    total = w.reshape(h2, 2, w2, 2).sum(axis=(1, 3))
    summed = v.reshape(h2, 2, w2, 2, -1).sum(axis=(1, 3))
    mean = summed / np.maximum(total, 1e-12)[..., None]
    return mean.astype(np.float32), np.minimum(total, 1).astype(np.float32)


def _double(coarse: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Bilinear enlargement to [height, width, C]."""
    rows = _linear(np.arange(height), coarse.shape[0])
    columns = _linear(np.arange(width), coarse.shape[1])
    r0, r1, fr = rows
    c0, c1, fc = columns
    wide = coarse[:, c0] * (1 - fc)[None, :, None] + coarse[:, c1] * fc[None, :, None]
    tall = wide[r0] * (1 - fr)[:, None, None] + wide[r1] * fr[:, None, None]
    return np.asarray(tall, dtype=np.float32)


def _linear(
    index: NDArray[np.int64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    place = np.clip((index + 0.5) / 2 - 0.5, 0, size - 1)
    low = np.floor(place).astype(np.int64)
    return low, np.minimum(low + 1, size - 1), (place - low).astype(np.float32)
