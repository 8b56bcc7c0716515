"""Which parts of the clouds the cameras may see.

Gaussians lie in memory much as they lie in space, so whole chunks of CHUNK are behind a camera or
beside its image. Boxes around their centres are made once for each cloud; what is left out this
way would have been dropped one by one, so images keep their bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from ...._numba import PARALLEL_LOOPS
from ....scene import GaussianCloud
from ...made_once import made_once
from ..base import Placement, RasterRequest
from .kernel import kernel
from .project_lanes import REACH_MAX
from .records import CHUNK, CameraParameters

SLACK = 0.1
"""Images are widened by this [px] against rounding."""
RELATIVE_SLACK = 1e-3
"""Gaussians are enlarged by this share, and near and far planes moved, for the same reason."""

Chunks = NDArray[np.int64]


class CloudArrays(NamedTuple):
    """The parts of a cloud where they lie: as in GaussianCloud, float32 and contiguous."""

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh: NDArray[np.float32]


class ChunkBounds(NamedTuple):
    """What the chunks of a cloud fill.

    Attributes:
        centres, halves: [chunks, 3] float64, boxes around the centres in the cloud's frame [m].
        sigmas: [chunks] float64, largest standard deviation [m].
    """

    centres: NDArray[np.float64]
    halves: NDArray[np.float64]
    sigmas: NDArray[np.float64]


@made_once
def arrays_of(cloud: GaussianCloud) -> CloudArrays:
    """Arrays of a cloud; made once, since clouds are immutable."""
    parts = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
    return CloudArrays(*(part.detach().cpu().contiguous().numpy() for part in parts))


@made_once
def bounds_of(cloud: GaussianCloud) -> ChunkBounds:
    """Bounds of the chunks of a cloud; made once, for who draws it more than once."""
    arrays = arrays_of(cloud)
    table = np.empty((-(-len(cloud) // CHUNK), 7))
    bound_chunks(arrays.means, arrays.scales, table)
    return ChunkBounds(table[:, :3], table[:, 3:6], table[:, 6])


def all_chunks(request: RasterRequest) -> list[Chunks]:
    """Every chunk of every instance."""
    return [np.arange(-(-len(i.cloud) // CHUNK)) for i in request.instances]


def seen_chunks(
    request: RasterRequest, placement: Placement, views: Sequence[CameraParameters]
) -> list[list[Chunks]]:
    """Numbers of the chunks that may be seen, by camera and instance."""
    if not request.instances:
        return [[] for _ in views]
    bounds = [bounds_of(instance.cloud) for instance in request.instances]
    counts = np.array([len(held.sigmas) for held in bounds])
    owner = np.repeat(np.arange(len(bounds)), counts)
    centres = np.concatenate([held.centres for held in bounds])
    halves = np.concatenate([held.halves for held in bounds])
    scale = placement.scale.numpy().max(1)
    sigmas = np.concatenate([held.sigmas for held in bounds]) * scale[owner]
    deformed = np.array([instance.covars is not None for instance in request.instances])
    starts = np.cumsum(counts) - counts
    seen = []
    for c, view in enumerate(views):
        normals, offsets, growth = _planes(view)
        linear, offset = placement.linear[c].numpy(), placement.offset[c].numpy()
        across = (normals @ linear)[owner]
        farthest = (across @ centres[..., None])[..., 0]
        farthest += (np.abs(across) @ halves[..., None])[..., 0]
        farthest += (offset @ normals.T + offsets)[owner] + sigmas[:, None] * growth
        numbers = np.flatnonzero((farthest > 0).all(1) | deformed[owner])
        cuts = np.searchsorted(numbers, starts[1:])
        parts = np.split(numbers, cuts)
        seen.append([part - start for part, start in zip(parts, starts, strict=True)])
    return seen


def _planes(
    view: CameraParameters,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Six half spaces of the camera frame outside of which nothing is seen.

    What place_eight tests, times depth: for x + reach > 0 that is
    ``fx X + (cx + reach blur) Z + reach fx (1 + |tx|) sigma > 0``, linear in the centre.

    Returns:
        normals [6, 3], offsets [6] and factors [6] of sigma; a Gaussian may be seen where
        ``normals @ centre + offsets + factors sigma > 0`` for all six.
    """
    fx, fy, cx, cy, width, height, left, right, top, bottom = (float(v) for v in view[:10])
    reach = float(REACH_MAX) * (1 + RELATIVE_SLACK)
    edge = reach * float(view.blur) + SLACK
    by_x = reach * fx * (1 + max(abs(left), abs(right)))
    by_y = reach * fy * (1 + max(abs(top), abs(bottom)))
    near = -float(view.near_plane) * (1 - RELATIVE_SLACK)
    far = float(view.far_plane) * (1 + RELATIVE_SLACK)
    rows = [
        (fx, 0.0, cx + edge, 0.0, by_x),
        (-fx, 0.0, width - cx + edge, 0.0, by_x),
        (0.0, fy, cy + edge, 0.0, by_y),
        (0.0, -fy, height - cy + edge, 0.0, by_y),
        (0.0, 0.0, 1.0, near, 0.0),
        (0.0, 0.0, -1.0, far, 0.0),
    ]
    table = np.array(rows)
    return table[:, :3], table[:, 3], table[:, 4]


@kernel(parallel=PARALLEL_LOOPS)
def bound_chunks(
    means: NDArray[np.float32], scales: NDArray[np.float32], bounds: NDArray[np.float64]
) -> None:
    """Write centre and half size of each chunk's box, and its largest scale, to ``bounds``."""
    for chunk in prange(bounds.shape[0]):
        start, stop = chunk * CHUNK, min(means.shape[0], (chunk + 1) * CHUNK)
        sigma = np.float32(0)
        for k in range(3):
            low = high = means[start, k]
            for i in range(start, stop):
                low, high = min(low, means[i, k]), max(high, means[i, k])
                sigma = max(sigma, scales[i, k])
            bounds[chunk, k] = (np.float64(low) + np.float64(high)) / 2
            bounds[chunk, 3 + k] = (np.float64(high) - np.float64(low)) / 2
        bounds[chunk, 6] = sigma
