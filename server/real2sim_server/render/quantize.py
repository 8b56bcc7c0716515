"""From blended floats to the numbers that leave the renderer, in one pass each."""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from .._numba import PARALLEL_LOOPS, kernel

SOLID_ALPHA = 0.5
"""A pixel below this alpha counts as nothing hit."""


def to_uint8(rgb: Tensor) -> NDArray[np.uint8]:
    """RGB [..., H, W, 3] float32 as uint8: clamped to [0, 1], halves rounded up, NaN to 0.

    Images on a GPU are rounded there and brought over as bytes.
    """
    if rgb.is_cuda:
        rounded = (rgb.nan_to_num(0.0).clamp(0, 1) * 255 + 0.5).byte()
        return rounded.cpu().numpy()
    values = np.ascontiguousarray(rgb.detach().numpy())
    levels = np.empty(values.shape, np.uint8)
    _round_to_bytes(values.reshape(-1), levels.reshape(-1))
    return levels


def solid_depth(depth: Tensor, alpha: Tensor) -> NDArray[np.float32]:
    """Depth [..., H, W] float32 [m], 0 where ``alpha`` is below SOLID_ALPHA."""
    if depth.is_cuda:
        return depth.where(alpha >= SOLID_ALPHA, 0.0).cpu().numpy()
    values = np.ascontiguousarray(depth.detach().numpy())
    kept = np.empty_like(values)
    cover = np.ascontiguousarray(alpha.detach().numpy())
    _keep_solid(values.reshape(-1), cover.reshape(-1), kept.reshape(-1))
    return kept


@kernel(parallel=PARALLEL_LOOPS)
def _round_to_bytes(values: NDArray[np.float32], levels: NDArray[np.uint8]) -> None:
    for i in prange(values.shape[0]):
        value = values[i]
        clamped = value if value > np.float32(0) else np.float32(0)
        clamped = clamped if clamped < np.float32(1) else np.float32(1)
        levels[i] = np.uint8(np.int32(clamped * np.float32(255) + np.float32(0.5)))


@kernel(parallel=PARALLEL_LOOPS)
def _keep_solid(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], kept: NDArray[np.float32]
) -> None:
    for i in prange(depth.shape[0]):
        kept[i] = depth[i] if alpha[i] >= np.float32(SOLID_ALPHA) else np.float32(0)
