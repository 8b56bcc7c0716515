"""Drawing one camera for training: like drawing it, but keeping what the way back needs."""

# Kernels take arrays by position.
# ruff: noqa: PLR0917

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...types import ScreenStatistics
from ..base import Placement, RasterRequest, direction_matrix
from .blend import blend_tiles
from .cull import all_chunks
from .inputs import Workspace, array_of, project, timed
from .records import CHUNK, EXTENT_X, EXTENT_Y, MEMBER, TILE, Images, Records
from .sky import add_sky
from .sort import sort_records
from .tile import TILE_CHUNKS, count_tiles, tile_starts
from .tile_slots import scatter_slots


@dataclass(frozen=True, eq=False)
class CameraPass:
    """What the way back needs of one camera.

    Attributes:
        records: Records with the number of its regions.
        lists, slots, spans: see scatter_slots.
        starts: [tiles + 1] int64, where the list of each tile starts.
    """

    records: Records
    lists: NDArray[np.int32]
    slots: NDArray[np.int32]
    spans: NDArray[np.int32]
    starts: NDArray[np.int64]


def draw_camera(
    request: RasterRequest,
    placement: Placement,
    timing: dict[str, float],
    camera: int,
    images: Images,
    space: Workspace,
) -> CameraPass:
    """Draw one camera and keep what was made on the way; adds to ``timing`` [ms] by stage."""
    with timed(timing, "project"):
        records, regions = project(request, placement, camera, all_chunks(request), space)
    with timed(timing, "sort"):
        pairs = space.array("pairs", (int(records.counts[:regions].sum()),), np.uint64)
        scratch = space.array("pairs_scratch", pairs.shape, np.uint64)
        order = sort_records(records, regions, pairs, scratch)
    with timed(timing, "tile"):
        seen = _make_lists(request, records, order, space)
    with timed(timing, "blend"):
        tiles_x, tiles = -(-request.width // TILE), len(seen.starts) - 1
        behind = constant_behind(request)
        blend_tiles(records.values, seen.lists, seen.starts, tiles_x, 0, tiles, behind, images)
    if request.sky is not None:
        with timed(timing, "sky"):
            matrix = array_of(direction_matrix(request, camera))
            add_sky(array_of(request.sky.faces), matrix, 0, images.rgb, images.alpha)
    return seen


def _make_lists(
    request: RasterRequest, records: Records, order: NDArray[np.uint64], space: Workspace
) -> CameraPass:
    tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
    tiles = tiles_x * tiles_y
    cursors = space.array("cursors", (TILE_CHUNKS, tiles), np.int64)
    footprints = space.array("ordered_footprints", order.shape, np.int64)
    starts = space.array("starts", (tiles + 1,), np.int64)
    count_tiles(records.values, records.footprints, order, tiles_x, footprints, cursors)
    by_chunk = cursors.sum(1)
    first_slots = np.cumsum(by_chunk) - by_chunk
    tile_starts(cursors, 0, tiles, starts)
    length = int(by_chunk.sum())
    seen = CameraPass(
        records=records,
        lists=space.array("lists", (length,), np.int32),
        slots=space.array("slots", (length,), np.int32),
        spans=space.array("spans", (len(records.footprints), 2), np.int32),
        starts=starts,
    )
    scatter_slots(
        records.values,
        footprints,
        order,
        tiles_x,
        first_slots,
        cursors,
        seen.lists,
        seen.slots,
        seen.spans,
    )
    return seen


def constant_behind(request: RasterRequest) -> NDArray[np.float32]:
    """The colour that blending puts behind the picture."""
    color = (0.0, 0.0, 0.0) if request.sky is not None else request.options.background
    return np.array(color, np.float32)


def note_radii(
    request: RasterRequest, seen: CameraPass, screen: ScreenStatistics, camera: int
) -> None:
    """Write the largest extents [px] of what ``seen`` shows to ``screen``."""
    values, counts = seen.records.values, seen.records.counts
    region = 0
    for index, instance in enumerate(request.instances):
        radii = screen.radii[index][camera].numpy()
        for start in range(0, len(instance.cloud), CHUNK):
            used = values[region * CHUNK : region * CHUNK + counts[region]]
            extents = np.maximum(used[:, EXTENT_X], used[:, EXTENT_Y])
            radii[start + used[:, MEMBER].astype(np.int64)] = np.ceil(extents)
            region += 1
