"""Instance and median depth images on the GPU, from gsplat's tile lists.

gsplat has no mode for them. Requires numba-cuda; tests run the kernel in Numba's CUDA simulator.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from ..backend import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

F32 = np.float32
THREADS = (16, 16)


def instance_image(
    meta: dict[str, Any] | None, instance_ids: Tensor, shape: tuple[int, int, int]
) -> Tensor:
    """Instance images [C, H, W] uint16 on the device.

    Args:
        meta: ``meta`` of ``gsplat.rasterization(packed=True)``; None if nothing was drawn.
        instance_ids: [N] int32, instance id of each Gaussian passed to gsplat.
        shape: C, H, W.
    """
    if meta is None:
        return torch.zeros(shape, dtype=torch.int32, device=instance_ids.device).to(torch.uint16)
    return _numbers_image(meta, instance_ids[meta["gaussian_ids"].long()], shape).to(torch.uint16)


def median_depth_image(
    meta: dict[str, Any] | None, shape: tuple[int, int, int], device: torch.device
) -> Tensor:
    """Median depths [C, H, W] float32 [m] on the device, 0 where transmittance stays above 0.5.

    Arguments as for :func:`instance_image`.
    """
    if meta is None:
        return torch.zeros(shape, device=device)
    # The kernel writes the bit patterns of the depths as ids; that of 0.0 is 0.
    bits = meta["depths"].detach().float().contiguous().view(torch.int32)
    return _numbers_image(meta, bits, shape).view(torch.float32)


def _numbers_image(meta: dict[str, Any], ids: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Id [C, H, W] int32 of the Gaussian at which transmittance falls to 0.5 or below; 0 if none.

    ``ids`` [V] has the id of each projected Gaussian.
    """
    image = torch.zeros(shape, dtype=torch.int32, device=ids.device)
    arrays = (meta["means2d"], meta["conics"], meta["opacities"], ids)
    lists = (meta["isect_offsets"].reshape(shape[0], -1).int(), meta["flatten_ids"].int())
    cameras, height, width = shape
    blocks = (-(-width // THREADS[0]), -(-height // THREADS[1]), cameras)
    stream = cuda.external_stream(torch.cuda.current_stream(image.device).cuda_stream)
    given = [
        cuda.as_cuda_array(tensor.detach().contiguous()) for tensor in (*arrays, *lists, image)
    ]
    find_instances[blocks, (*THREADS, 1), stream](*given, meta["tile_size"], meta["tile_width"])
    return image


def instance_signature() -> Any:
    """Argument types of :func:`find_instances`, for ahead-of-time compilation."""
    from numba import types

    floats = [types.Array(types.float32, dims, "C") for dims in (2, 2, 1)]
    whole = [types.Array(types.int32, dims, "C") for dims in (1, 2, 1, 3)]
    return types.void(*floats, *whole, types.int64, types.int64)


@cuda.jit
def find_instances(
    means2d, conics, opacities, ids, offsets, members, image, tile_size, tiles_x
):  # pragma: no cover - runs on a GPU or in the simulator of another process
    """Find the id of the Gaussian at which each pixel's transmittance falls to 0.5 or below.

    Args:
        means2d, conics, opacities, ids: [V, 2], [V, 3], [V] float32 and [V] int32.
        offsets: [C, tiles] int32, start of each tile's list.
        members: [M] int32 records by tile, near to far.
        image: [C, H, W] int32, written at pixels with such a Gaussian.
        tile_size: edge length of a tile [px].
        tiles_x: tiles in a row.
    """
    x, y, camera = cuda.grid(3)
    cameras, height, width = image.shape
    if x >= width or y >= height or camera >= cameras:
        return
    tile = (y // tile_size) * tiles_x + x // tile_size
    position = offsets[camera, tile]
    if tile + 1 < offsets.shape[1]:
        end = offsets[camera, tile + 1]
    elif camera + 1 < cameras:
        end = offsets[camera + 1, 0]
    else:
        end = members.shape[0]
    left = F32(1)
    while position < end:
        k = members[position]
        dx, dy = means2d[k, 0] - F32(x) - F32(0.5), means2d[k, 1] - F32(y) - F32(0.5)
        sigma = F32(0.5) * (conics[k, 0] * dx * dx + conics[k, 2] * dy * dy)
        sigma += conics[k, 1] * dx * dy
        alpha = min(F32(ALPHA_MAX), opacities[k] * math.exp(-sigma))
        if sigma >= F32(0) and alpha >= F32(ALPHA_MIN):
            after = left * (F32(1) - alpha)
            if after <= F32(TRANSMITTANCE_MIN):
                return
            left = after
            if left <= F32(0.5):
                image[camera, y, x] = ids[k]
                return
        position += 1
