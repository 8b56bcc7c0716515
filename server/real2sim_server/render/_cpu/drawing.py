"""One pinhole camera on the CPU: visible chunks, kernel inputs, and drawing in pieces.

Neighbours in memory are mostly neighbours in space, so whole chunks of CHUNK Gaussians are often
behind a camera or outside its image. Bounding boxes of their centres are computed once per cloud.
Culling only skips Gaussians that the projection would drop, so images are bitwise unchanged.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from ...scene import GaussianCloud
from ..backend import CLAMP_MARGIN, Placement, RasterRequest, direction_matrix
from ..types import Instance, Sky, weak_cache
from .blend import TILE_CHUNKS, blend_tiles, count_tiles, scatter_tiles, sort_records, tile_starts
from .lanes import kernel
from .project import REACH_MAX, project_cluster, project_small_cluster
from .records import CHUNK, RECORD, TILE, CameraParameters, Cluster, Images, Records
from .sky import add_sky

SLACK = 0.1
"""Margin of the image against rounding [px]."""
RELATIVE_SLACK = 1e-3
"""Relative margin of Gaussian sizes and of the near and far planes against rounding."""

Chunks = NDArray[np.int64]


class CloudArrays(NamedTuple):
    """Views of the arrays of a GaussianCloud, float32 and contiguous."""

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    sh: NDArray[np.float32]


class ChunkBounds(NamedTuple):
    """Bounding boxes of the chunks of a cloud.

    Attributes:
        centres, halves: [chunks, 3] float64, boxes around the Gaussian centres, cloud frame [m].
        sigmas: [chunks] float64, largest standard deviation [m].
    """

    centres: NDArray[np.float64]
    halves: NDArray[np.float64]
    sigmas: NDArray[np.float64]


@weak_cache
def arrays_of(cloud: GaussianCloud) -> CloudArrays:
    """Arrays of a cloud, cached because clouds are immutable."""
    parts = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
    return CloudArrays(*(part.detach().cpu().contiguous().numpy() for part in parts))


@weak_cache
def bounds_of(cloud: GaussianCloud) -> ChunkBounds:
    """Bounds of the chunks of a cloud, cached."""
    arrays = arrays_of(cloud)
    table = np.empty((-(-len(cloud) // CHUNK), 7))
    bound_chunks(arrays.means, arrays.scales, table)
    return ChunkBounds(table[:, :3], table[:, 3:6], table[:, 6])


def all_chunks(request: RasterRequest) -> list[Chunks]:
    """All chunks of all instances."""
    return [np.arange(-(-len(i.cloud) // CHUNK)) for i in request.instances]


def seen_chunks(
    request: RasterRequest, placement: Placement, views: Sequence[CameraParameters]
) -> list[list[Chunks]]:
    """Indices of the potentially visible chunks, by camera and instance."""
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
    """Six half spaces of the camera frame that contain every visible Gaussian.

    These are the tests of place_eight times depth. The test x + reach > 0, for example, becomes
    ``fx X + (cx + reach blur) Z + reach fx (1 + |tx|) sigma > 0``, which is linear in the centre.

    Returns:
        normals [6, 3], offsets [6] and factors [6] of sigma; a Gaussian is potentially visible if
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
    """Write centre, half size and largest scale of each chunk to ``bounds``."""
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


# Kernel inputs: arrays of a request, and work space

NO_COVARS = np.zeros((0, 3, 3), np.float32)
NO_COEFFICIENTS = np.zeros((0, 0, 3), np.float32)
NO_TONES = np.zeros(0, np.float32)


class Workspace:
    """Named uninitialised arrays that grow on demand and are reused."""

    def __init__(self) -> None:
        self._held: dict[str, NDArray[Any]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """Array with that name; its values are undefined."""
        size = int(np.prod(shape))
        held = self._held.get(name)
        if held is None or held.size < size:
            held = self._held[name] = np.empty(size + size // 4, dtype)
        return held[:size].reshape(shape)


def project(
    request: RasterRequest,
    placement: Placement,
    camera: int,
    chunks: Sequence[Chunks],
    space: Workspace,
) -> tuple[Records, int]:
    """Project the given chunks of all instances; returns records and the number of regions."""
    total = sum(map(len, chunks))
    records = Records(
        space.array("values", (total * CHUNK, RECORD), np.float32),
        space.array("footprints", (total * CHUNK,), np.int64),
        space.array("depths", (total * CHUNK,), np.float32),
        space.array("counts", (total,), np.int64),
    )
    view, places = view_of(request, camera), places_of(placement, camera)
    base = 0
    for index, instance in enumerate(request.instances):
        count = len(chunks[index])
        if count:
            cluster = cluster_of(instance, places, index)
            draw = project_cluster if count > 1 else project_small_cluster
            draw(cluster, view, base * CHUNK, chunks[index], records)
        base += count
    return records, total


class Places(NamedTuple):
    """Placement of the instances relative to one camera, contiguous."""

    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]


def places_of(placement: Placement, camera: int) -> Places:
    """Placement of all instances relative to one camera."""
    return Places(
        linear=np.ascontiguousarray(placement.linear[camera].numpy()),
        offset=np.ascontiguousarray(placement.offset[camera].numpy()),
        camera_position=placement.camera_position[camera].numpy().astype(np.float32, order="C"),
        scale=placement.scale.numpy().astype(np.float32, order="C"),
    )


def cluster_of(instance: Instance, places: Places, index: int) -> Cluster:
    """Kernel input of one instance for one camera; large arrays are not copied."""
    cloud, colour = arrays_of(instance.cloud), instance.colour
    return Cluster(
        *cloud,
        covars=NO_COVARS if instance.covars is None else array_of(instance.covars),
        linear=places.linear[index],
        offset=places.offset[index],
        camera_position=places.camera_position[index],
        scale=places.scale[index],
        instance_id=np.float32(instance.instance_id),
        coefficients=NO_COEFFICIENTS if colour is None else array_of(colour.coefficients),
        tones=NO_TONES if colour is None else array_of(colour.tones(instance.t_us)),
    )


def array_of(tensor: torch.Tensor) -> NDArray[np.float32]:
    """NumPy view of a tensor; a copy if it is not on the CPU or not contiguous."""
    return tensor.detach().cpu().contiguous().numpy()


def view_of(request: RasterRequest, camera: int) -> CameraParameters:
    """Camera and options as kernel input."""
    options, width, height = request.options, request.width, request.height
    K = request.Ks[camera].detach().cpu().numpy()
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = CLAMP_MARGIN * 0.5 * width / fx, CLAMP_MARGIN * 0.5 * height / fy
    numbers = {
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "width": width,
        "height": height,
        "left": -cx / fx - margin_x,
        "right": (width - cx) / fx + margin_x,
        "top": -cy / fy - margin_y,
        "bottom": (height - cy) / fy + margin_y,
        "near_plane": options.near_plane,
        "far_plane": options.far_plane,
        "eps2d": options.eps2d,
        "radius_clip": options.radius_clip,
        "antialiased": options.rasterize_mode == "antialiased",
        "blur": options.eps2d**0.5,
    }
    return CameraParameters(**{name: np.float32(value) for name, value in numbers.items()})


@contextmanager
def timed(timing: dict[str, float], stage: str) -> Iterator[None]:
    """Add the milliseconds of the block to ``timing[stage]``."""
    start = time.perf_counter()
    yield
    timing[stage] = timing.get(stage, 0.0) + (time.perf_counter() - start) * 1e3


# Drawing in pieces; other requests may be drawn in between

LIST_BUDGET = 1 << 26
"""Maximum number of tile list entries in memory; larger images are drawn in bands of tile rows."""
PIECE_PIXELS = 1 << 18
"""Pixels per piece of blending or sky when a request may be interrupted."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Draws one camera of a request into ``images``.

    Attributes:
        space: work space.
        timing: receives milliseconds by stage.
    """

    request: RasterRequest
    camera: int
    images: Images
    space: Workspace
    timing: dict[str, float]

    def draw(self, placement: Placement, chunks: Sequence[Chunks]) -> None:
        """Project, sort, blend and add the sky."""
        with timed(self.timing, "project"):
            records, regions = self._project(placement, chunks)
        self._pause()
        with timed(self.timing, "sort"):
            pairs = self.space.array("pairs", (int(records.counts[:regions].sum()),), np.uint64)
            scratch = self.space.array("pairs_scratch", pairs.shape, np.uint64)
            order = sort_records(records, regions, pairs, scratch)
        self._pause()
        self._blend(records, order)
        if self.request.sky is not None:
            self._add_sky(self.request.sky)

    def _pause(self) -> None:
        """End a piece: call ``between`` if there is one."""
        if self.request.between is not None:
            self.request.between()

    def _project(self, placement: Placement, chunks: Sequence[Chunks]) -> tuple[Records, int]:
        """Records, and the number of regions in use."""
        return project(self.request, placement, self.camera, chunks, self.space)

    def _blend_tiles(
        self,
        records: Records,
        lists: NDArray[np.int32],
        starts: NDArray[np.int64],
        tiles: tuple[int, int],
        behind: NDArray[np.float32],
    ) -> None:
        """Blend a range of tiles."""
        tiles_x = -(-self.request.width // TILE)
        blend_tiles(records.values, lists, starts, tiles_x, *tiles, behind, self.images)

    def _blend(self, records: Records, order: NDArray[np.uint64]) -> None:
        request, space = self.request, self.space
        tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
        background = (0.0, 0.0, 0.0) if request.sky is not None else request.options.background
        behind = np.array(background, np.float32)
        starts = space.array("starts", (tiles_x * tiles_y + 1,), np.int64)
        with timed(self.timing, "tile"):
            cursors = space.array("cursors", (TILE_CHUNKS, tiles_x * tiles_y), np.int64)
            footprints = space.array("ordered_footprints", order.shape, np.int64)
            count_tiles(records.values, records.footprints, order, tiles_x, footprints, cursors)
            bands = _bands(cursors.sum(0).reshape(tiles_y, tiles_x).sum(1), self._rows(TILE))
        for first, last in bands:
            self._pause()
            tiles = first * tiles_x, last * tiles_x
            with timed(self.timing, "tile"):
                tile_starts(cursors, *tiles, starts)
                lists = space.array("lists", (int(starts[tiles[1]]),), np.int32)
                rows = first, last
                scatter_tiles(records.values, footprints, order, tiles_x, *rows, cursors, lists)
            with timed(self.timing, "blend"):
                self._blend_tiles(records, lists, starts, tiles, behind)

    def _add_sky(self, sky: Sky) -> None:
        matrix, images = array_of(direction_matrix(self.request, self.camera)), self.images
        step = self._rows(1)
        for first in range(0, self.request.height, step):
            self._pause()
            rows = slice(first, first + step)
            with timed(self.timing, "sky"):
                add_sky(array_of(sky.faces), matrix, first, images.rgb[rows], images.alpha[rows])

    def _rows(self, height: int) -> int:
        """Number of rows of ``height`` [px] per piece; all rows without interruption."""
        if self.request.between is None:
            return -(-self.request.height // height)
        return max(1, PIECE_PIXELS // (self.request.width * height))


def _bands(row_totals: NDArray[np.int64], most: int) -> Iterator[tuple[int, int]]:
    """Ranges of 1 to ``most`` tile rows whose lists fit LIST_BUDGET, if more than one row."""
    first, held = 0, 0
    for row, total in enumerate(row_totals):
        if row > first and (held + total > LIST_BUDGET or row - first >= most):
            yield first, row
            first, held = row, 0
        held += int(total)
    yield first, len(row_totals)
