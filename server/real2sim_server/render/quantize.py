"""From blended floats to the numbers that leave the renderer, in one pass each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from .._numba import PARALLEL_LOOPS, kernel

SOLID_ALPHA = 0.5
"""A pixel below this alpha counts as nothing hit."""


PIECE = 1 << 21
"""Numbers that are converted in one go: a few milliseconds."""


def to_uint8(rgb: Tensor, *, between: Callable[[], object] | None = None) -> NDArray[np.uint8]:
    """RGB [..., H, W, 3] float32 as uint8: clamped to [0, 1], halves rounded up, NaN to 0.

    Images on a GPU are rounded there and brought over as bytes.

    Args:
        rgb: of any number of images.
        between: called between pieces of the work.
    """
    if rgb.device.type != "cpu":
        rounded = (rgb.nan_to_num(0.0).clamp(0, 1) * 255 + 0.5).byte()
        return _on_host(rounded)
    values = np.ascontiguousarray(rgb.detach().numpy())
    levels = np.empty(values.shape, np.uint8)
    given, result = values.reshape(-1), levels.reshape(-1)
    for piece in _pieces(len(given), between):
        _round_to_bytes(given[piece], result[piece])
    return levels


def solid_depth(
    depth: Tensor, alpha: Tensor, *, between: Callable[[], object] | None = None
) -> NDArray[np.float32]:
    """Depth [..., H, W] float32 [m], 0 where ``alpha`` is below SOLID_ALPHA; ``between`` is called
    between pieces of the work."""
    if depth.device.type != "cpu":
        return _on_host(depth.where(alpha >= SOLID_ALPHA, 0.0))
    values = np.ascontiguousarray(depth.detach().numpy())
    kept = np.empty_like(values)
    cover = np.ascontiguousarray(alpha.detach().numpy())
    given, covers, result = values.reshape(-1), cover.reshape(-1), kept.reshape(-1)
    for piece in _pieces(len(given), between):
        _keep_solid(given[piece], covers[piece], result[piece])
    return kept


def _on_host(image: Tensor) -> NDArray[Any]:
    """By memory that a GPU writes to without help, several times as fast as any other."""
    if image.device.type != "cuda":
        return image.cpu().numpy()
    held = torch.empty(image.shape, dtype=image.dtype, pin_memory=True)
    return held.copy_(image).numpy()


def _pieces(length: int, between: Callable[[], object] | None) -> Iterator[slice]:
    """All of it, or what is done between two calls of ``between``."""
    if between is None:
        yield slice(None)
        return
    for first in range(0, length, PIECE):
        yield slice(first, first + PIECE)
        between()


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
