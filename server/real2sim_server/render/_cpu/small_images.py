"""Small images in parallel, one per core, from the level of detail that matches the pixel size.

An image of a few thousand pixels is too little work for several cores, so whole images are
distributed. Each image depends only on its own request: results are bitwise independent of the
number of threads and of the other images.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numba
import numpy as np
import torch
from numba import carray, prange  # type: ignore[attr-defined]
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS, func
from ..backend import RasterRequest
from ..types import Instance, RasterOptions, RenderOutput, WorldViews
from .blend import PLANES, blend_tile, open_tile, write_tile
from .detail_levels import (
    BANDS_FIELD,
    BLOCKS,
    CELL,
    COUNT,
    LEVELS,
    MERGED,
    MERGED_BANDS_FIELD,
    TONES,
    Hierarchy,
    deformed_hierarchy,
    hierarchy_of,
    pointer_to,
    table_of,
)
from .drawing import Workspace, array_of, timed, view_of
from .lanes import LANES, inlined, kernel, lowest_bit, prefetch
from .project import FIELDS as RECORD_FIELDS
from .project import (
    PROJECTION,
    REACH_MAX,
    footprints_of_eight,
    gather_lane,
    in_one_tile,
    only_tile,
    place_eight,
    place_eight_deformed,
    shape_eight,
    shape_eight_deformed,
    tile_columns,
    tile_rows,
    write_color,
)
from .records import DEPTH, INSTANCE, RECORD, TILE, CameraParameters, Cluster
from .sky import CLEAR, add_sample, pixel_direction, texel_corner

F32 = np.float32
HALF = F32(0.5)
SLACK_PIXELS, SLACK_SIZE = 0.1, 1.001
DIGIT_BITS = 11
LOW_BITS = np.uint64(0xFFFFFFFF)
LOOK_AHEAD = 8
HALVES = TILE // LANES


@kernel(parallel=PARALLEL_LOOPS, fastmath={"contract", "nsz", "arcp"})
def draw_images(
    table, tones, draws, linear, offset, camera_position, scale, first_draws, views, cell_pixels,
    background, faces, sky_matrices, work, rgb, alpha, depth, instance, median
):  # fmt: skip
    """Draw M images, each on one core.

    Args:
        table: see table_of.
        tones: [D, F] float32, time basis of the draws with time-dependent colours.
        draws: [D, 2] int64, row of ``table`` and instance id of each draw, by image.
        linear, offset: [D, 3, 3], [D, 3] float64, cloud frame to camera frame.
        camera_position: [D, 3] float32, camera in the unscaled cloud frame [m].
        scale: [D, 3] float32.
        first_draws: [M + 1] int64, index of the first draw of each image.
        views: [M, 16] float32, CameraParameters.
        cell_pixels: largest size of merged cells on the image [px].
        background: [3] float32, used without a sky.
        faces: [6, R, R, 3] float32; R is 0 without a sky.
        sky_matrices: [M, 3, 3] float32, pixels to directions.
        work: arrays for S threads and the G Gaussians of the largest image: values [S, G, RECORD]
            float32, footprints [S, G] int64, depths [S, G] float32, pairs [2, S, G] uint64 and
            chosen [S, G] int64.
        rgb, alpha: [M, H, W, 3] and [M, H, W], written.
        depth, instance, median: [M, H, W], written, or [M, 0, 0].
    """
    values, footprints, depths, pairs, chosen = work
    slots = values.shape[0]
    extras = (1 if depth.shape[1] else 0) + (2 if instance.shape[1] else 0)
    extras += 4 if median.shape[1] else 0
    for slot in prange(slots):
        planes = np.empty(PROJECTION * LANES, np.float32)
        found = np.empty(LANES, np.int64)
        pixels = np.empty(TILE * HALVES * PLANES * LANES, np.float32)
        for image in range(slot, rgb.shape[0], slots):
            view = camera_of(views[image])
            count = 0
            for draw in range(first_draws[image], first_draws[image + 1]):
                count = project_draw(
                    table[draws[draw, 0]], draws[draw, 1], tones[draw], linear[draw],
                    offset[draw], camera_position[draw], scale[draw], view, cell_pixels,
                    planes, found, chosen[slot], values[slot], footprints[slot], depths[slot],
                    count,
                )  # fmt: skip
            flipped = sort_pairs(
                depths[slot].view(np.uint32), count, pairs[0, slot], pairs[1, slot]
            )
            order = pairs[flipped, slot][:count]
            lists, starts = tile_lists(values[slot], footprints[slot], order, alpha.shape)
            blend_image(
                values[slot], lists, starts, pixels, extras, background,
                rgb[image], alpha[image],
                depth[image] if depth.shape[1] else depth[0],
                instance[image] if instance.shape[1] else instance[0],
                median[image] if median.shape[1] else median[0],
            )  # fmt: skip
            if faces.shape[1] > 0:
                sky_image(faces, sky_matrices[image], rgb[image], alpha[image])


@inlined()
def camera_of(row):
    """CameraParameters from sixteen numbers."""
    return CameraParameters(
        row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7],
        row[8], row[9], row[10], row[11], row[12], row[13], row[14], row[15],
    )  # fmt: skip


@func()
def project_draw(
    row, instance_id, tones, linear, offset, camera_position, scale, view, cell_pixels,
    planes, found, chosen, values, footprints, depths, count
):  # fmt: skip
    """Append the records of one cloud after the first ``count``; returns the new number of records.

    ``chosen`` lists Gaussians of level 0 from its start and merged ones from its end.
    """
    f32, f64, i64 = np.float32, np.float64, np.int64
    gaussians, merged = row[COUNT], row[MERGED]
    full = Cluster(
        carray(pointer_to(row[0]), (gaussians, 3), f32),
        carray(pointer_to(row[1]), (gaussians, 4), f32),
        carray(pointer_to(row[2]), (gaussians, 3), f32),
        carray(pointer_to(row[3]), (gaussians,), f32),
        carray(pointer_to(row[4]), (gaussians, row[BANDS_FIELD], 3), f32),
        carray(pointer_to(row[12]), (0, 3, 3), f32),
        linear, offset, camera_position, scale, F32(instance_id),
        carray(pointer_to(row[5]), (gaussians, row[TONES], 3), f32),
        tones[: row[TONES]],
    )  # fmt: skip
    reduced = Cluster(
        carray(pointer_to(row[11]), (merged, 3), f32),
        full.quats,
        full.scales,
        carray(pointer_to(row[13]), (merged,), f32),
        carray(pointer_to(row[14]), (merged, row[MERGED_BANDS_FIELD], 3), f32),
        carray(pointer_to(row[12]), (merged, 3, 3), f32),
        linear, offset, camera_position, scale, F32(instance_id),
        carray(pointer_to(row[15]), (merged, row[TONES], 3), f32),
        tones[: row[TONES]],
    )  # fmt: skip
    blocks = row[BLOCKS]
    order = carray(pointer_to(row[6]), (gaussians,), i64)
    starts = carray(pointer_to(row[7]), (1 + LEVELS, blocks + 1), i64)
    low = carray(pointer_to(row[8]), (blocks, 3), f64)
    high = carray(pointer_to(row[9]), (blocks, 3), f64)
    sigmas = carray(pointer_to(row[10]), (blocks,), f64)
    near, far = choose_levels(
        order, starts, low, high, sigmas, row[CELL] * 1e-6, linear, offset, camera_position,
        scale, view, cell_pixels, chosen,
    )  # fmt: skip
    count = project_listed(
        full, view, chosen, 0, near, planes, found, values, footprints, depths, count
    )
    return project_listed(
        reduced, view, chosen, far, chosen.shape[0], planes, found, values, footprints, depths,
        count,
    )  # fmt: skip


@inlined()
def choose_levels(
    order, starts, low, high, sigmas, cell, linear, offset, camera_position, scale, view,
    cell_pixels, chosen
):  # fmt: skip
    """Choose a level for each potentially visible block and list its Gaussians in ``chosen``.

    Returns:
        End of the Gaussians of level 0 in ``chosen``, and start of the merged ones.
    """
    largest = max(np.float64(scale[0]), np.float64(scale[1]), np.float64(scale[2]))
    focal = max(np.float64(view.fx), np.float64(view.fy))
    near, far = 0, chosen.shape[0]
    for block in range(low.shape[0]):
        if not in_view(low[block], high[block], sigmas[block] * largest, linear, offset, view):
            continue
        gap = 0.0
        for k in range(3):
            at, own = np.float64(camera_position[k]), np.float64(scale[k])
            beyond = max(low[block, k] * own - at, at - high[block, k] * own)
            gap += max(beyond, 0.0) ** 2
        allowed = cell_pixels * math.sqrt(gap) / max(focal * cell * largest, 1e-30)
        level = 0 if cell > 0 else 1
        while level < LEVELS and allowed >= 1.0:
            allowed *= 0.5
            level += 1
        first, last = starts[level, block], starts[level, block + 1]
        if level == 0:
            for i in range(first, last):
                chosen[near] = order[i]
                near += 1
        else:
            for i in range(first, last):
                far -= 1
                chosen[far] = i
    return near, far


@inlined()
def in_view(low, high, sigma, linear, offset, view):
    """Whether a box may be visible; tests the planes of :mod:`.drawing` for one box."""
    reach = REACH_MAX * SLACK_SIZE
    edge = reach * view.blur + SLACK_PIXELS
    x = y = z = 0.0
    hx = hy = hz = 0.0
    ux = uy = 0.0
    for k in range(3):
        centre, half = 0.5 * (low[k] + high[k]), 0.5 * (high[k] - low[k])
        x += linear[0, k] * centre
        y += linear[1, k] * centre
        z += linear[2, k] * centre
        hz += abs(linear[2, k]) * half
    x, y, z = x + offset[0], y + offset[1], z + offset[2]
    if z + hz < view.near_plane * (2.0 - SLACK_SIZE) or z - hz > view.far_plane * SLACK_SIZE:
        return False
    for side in range(2):
        fx = view.fx if side == 0 else -view.fx
        fy = view.fy if side == 0 else -view.fy
        cx = (view.cx if side == 0 else view.width - view.cx) + edge
        cy = (view.cy if side == 0 else view.height - view.cy) + edge
        hx = hy = 0.0
        for k in range(3):
            half = 0.5 * (high[k] - low[k])
            hx += abs(fx * linear[0, k] + cx * linear[2, k]) * half
            hy += abs(fy * linear[1, k] + cy * linear[2, k]) * half
        ux = 1.0 + max(abs(view.left), abs(view.right))
        uy = 1.0 + max(abs(view.top), abs(view.bottom))
        if fx * x + cx * z + hx + reach * view.fx * ux * sigma <= 0:
            return False
        if fy * y + cy * z + hy + reach * view.fy * uy * sigma <= 0:
            return False
    return True


@inlined(fastmath={"contract", "nsz", "arcp"})
def project_listed(
    cluster, view, chosen, begin, end, planes, found, values, footprints, depths, count
):
    """Write records of chosen[begin:end]; returns the new number of records."""
    for eight in range(begin, end, LANES):
        size = min(end - eight, LANES)
        gather_listed(cluster, chosen, eight, size, min(eight + 2 * LANES, end - 1), planes)
        lanes = np.int64((1 << size) - 1)
        if cluster.covars.shape[0] > 0:
            lanes = place_eight_deformed(planes, lanes, view, cluster)
            if lanes != 0:
                lanes = shape_eight_deformed(planes, lanes, view, cluster)
        else:
            lanes = place_eight(planes, lanes, view, cluster)
            if lanes != 0:
                lanes = shape_eight(planes, lanes, view, cluster)
        if lanes != 0:
            lanes = footprints_of_eight(planes, lanes, view, found)
        while lanes != 0:
            lane = lowest_bit(lanes)
            lanes &= lanes - 1
            out = values[count]
            for field in RECORD_FIELDS:
                out[field] = planes[field * LANES + lane]
            out[INSTANCE] = cluster.instance_id
            write_color(cluster, chosen[eight + lane], out)
            footprints[count] = found[lane]
            depths[count] = out[DEPTH]
            count += 1
    return count


@inlined()
def gather_listed(cluster, chosen, first, size, ahead, planes):
    """Gather ``size`` listed Gaussians into the planes; see gather_eight."""
    prefetch(cluster.means, chosen[ahead])
    for lane in range(size):
        gather_lane(cluster, chosen[first + lane], lane, planes)


@kernel()
def sort_pairs(keys, count, pairs, scratch):
    """Stable sort of (key, index) pairs by key; returns 0 if the result is in ``pairs``, else 1."""
    if count == 0:
        return 0
    low, high = keys[0], keys[0]
    for i in range(count):
        low, high = min(low, keys[i]), max(high, keys[i])
    bits, span = 0, np.int64(high) - np.int64(low)
    while span > 0:
        bits += 1
        span >>= 1
    for i in range(count):
        pairs[i] = (np.uint64(keys[i] - low) << np.uint64(32)) | np.uint64(i)
    passes = (bits + DIGIT_BITS - 1) // DIGIT_BITS
    width = (bits + passes - 1) // passes if passes else 0
    cursors = np.empty(1 << DIGIT_BITS, np.int64)
    mask = np.uint64((1 << width) - 1)
    for index in range(passes):
        source, target = (pairs, scratch) if index % 2 == 0 else (scratch, pairs)
        shift = np.uint64(32 + index * width)
        cursors[:] = 0
        for i in range(count):
            cursors[(source[i] >> shift) & mask] += 1
        position = 0
        for digit in range(1 << width):
            number = cursors[digit]
            cursors[digit] = position
            position += number
        for i in range(count):
            digit = (source[i] >> shift) & mask
            target[cursors[digit]] = source[i]
            cursors[digit] += 1
    return passes % 2


@kernel()
def tile_lists(values, footprints, order, shape):
    """Records by tile, near to far, and the start of each tile's list."""
    tiles_x, tiles_y = (shape[2] + TILE - 1) // TILE, (shape[1] + TILE - 1) // TILE
    starts = np.zeros(tiles_x * tiles_y + 2, np.int64)
    for index in range(order.shape[0]):
        footprint = footprints[index]
        if in_one_tile(footprint):
            starts[only_tile(footprint, tiles_x) + 2] += 1
            continue
        first, last = tile_rows(footprint)
        for row in range(first, last):
            left, right = tile_columns(values, footprint, index, row)
            for column in range(left, right):
                starts[row * tiles_x + column + 2] += 1
    for tile in range(2, starts.shape[0]):
        starts[tile] += starts[tile - 1]
    lists = np.empty(starts[starts.shape[0] - 1], np.int32)
    for place in range(order.shape[0]):
        index = np.int64(order[place] & LOW_BITS)
        footprint = footprints[index]
        if in_one_tile(footprint):
            tile = only_tile(footprint, tiles_x) + 1
            lists[starts[tile]] = index
            starts[tile] += 1
            continue
        first, last = tile_rows(footprint)
        for row in range(first, last):
            left, right = tile_columns(values, footprint, index, row)
            for column in range(left, right):
                tile = row * tiles_x + column + 1
                lists[starts[tile]] = index
                starts[tile] += 1
    return lists, starts


@inlined()
def blend_image(
    values, lists, starts, pixels, extras, background, rgb, alpha, depth, instance, median
):
    """Blend all tiles of an image."""
    tiles_x = (alpha.shape[1] + TILE - 1) // TILE
    for tile in range(starts.shape[0] - 2):
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        going = open_tile(pixels, PLANES, x0, y0, alpha.shape)
        first, last = starts[tile], starts[tile + 1]
        blend_tile(values, lists, first, last, F32(x0), F32(y0), pixels, going, extras)
        write_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median)


@inlined()
def sky_image(faces, matrix, rgb, alpha):
    """Add the sky behind an image; see add_sky."""
    texels, size = faces.reshape(-1), faces.shape[1]
    for row in range(alpha.shape[0]):
        for x in range(alpha.shape[1]):
            weight = F32(1) - alpha[row, x]
            if weight > CLEAR:
                direction = pixel_direction(matrix, F32(x) + HALF, F32(row) + HALF)
                corner, down, right = texel_corner(direction, size)
                add_sample(texels, size, np.uint64(corner), down, right, weight, rgb[row, x])


# Single and batched requests of small images

CELL_PIXELS = 2.5
"""Largest size of merged cells on the image [px].

Relative to 2 px, it takes 1/7 less time and loses 0.7 dB PSNR against a downscaled large image.
3 px would take 1/5 less time and lose 1.4 dB.
"""
PIXEL_VARIANCE = 0.1
"""Variance of the pixel blur, slightly more than that of a pixel's square (1/12) [px^2].

With the usual 0.3 and without opacity compensation, Gaussians smaller than a pixel merge visually,
which costs 8 dB PSNR against a downscaled large image.
"""
NO_SKY = np.zeros((6, 0, 0, 3), np.float32)


class SmallImages:
    """Draws small images with a reused work space. Calls are not thread-safe."""

    def __init__(self) -> None:
        self._space = Workspace()

    def draw(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """Draw all images of requests that share size, sky and options, one image per core."""
        timing: dict[str, float] = {}
        with timed(timing, "project"):
            draws = _draws(requests)
        with timed(timing, "blend"):
            return self._drawn(requests[0], draws, timing)

    def draw_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """Draw all images of worlds with the same instances; ``like`` has size, sky and options."""
        timing: dict[str, float] = {}
        with timed(timing, "project"):
            draws = _world_draws(worlds, like)
        with timed(timing, "blend"):
            return self._drawn(like, draws, timing)

    def _drawn(self, like: RasterRequest, draws: _Draws, timing: dict[str, float]) -> RenderOutput:
        options, images = like.options, len(draws.views)
        shape = (images, like.height, like.width)
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (1, 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (1, 0, 0), np.uint16)
        median = np.empty(shape if options.median_depth else (1, 0, 0), np.float32)
        background = (0.0, 0.0, 0.0) if like.sky is not None else options.background
        draw_images(
            draws.table,
            draws.tones,
            draws.draws,
            draws.linear,
            draws.offset,
            draws.camera_position,
            draws.scale,
            draws.first_draws,
            draws.views,
            CELL_PIXELS,
            np.array(background, np.float32),
            NO_SKY if like.sky is None else array_of(like.sky.faces),
            draws.sky_matrices,
            self._work(min(numba.get_num_threads(), images), draws.gaussians),
            rgb,
            alpha,
            depth,
            instance,
            median,
        )
        return RenderOutput(
            rgb=torch.from_numpy(rgb),
            alpha=torch.from_numpy(alpha),
            depth=torch.from_numpy(depth) if options.depth else None,
            instance=torch.from_numpy(instance) if options.instance else None,
            timing_ms=timing,
            median_depth=torch.from_numpy(median) if options.median_depth else None,
        )

    def _work(self, slots: int, gaussians: int) -> tuple[NDArray[np.generic], ...]:
        array = self._space.array
        return (
            array("values", (slots, gaussians, RECORD), np.float32),
            array("footprints", (slots, gaussians), np.int64),
            array("depths", (slots, gaussians), np.float32),
            array("pairs", (2, slots, gaussians), np.uint64),
            array("chosen", (slots, gaussians), np.int64),
        )


@dataclass(frozen=True, eq=False)
class _Draws:
    """Arguments of draw_images.

    Attributes:
        held: keeps the arrays alive that ``table`` points to.
        gaussians: largest number of Gaussians in an image.
    """

    held: Sequence[Hierarchy]
    table: NDArray[np.int64]
    tones: NDArray[np.float32]
    draws: NDArray[np.int64]
    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]
    first_draws: NDArray[np.int64]
    views: NDArray[np.float32]
    sky_matrices: NDArray[np.float32]
    gaussians: int


def _draws(requests: Sequence[RasterRequest]) -> _Draws:
    rows: dict[tuple[int, int, int], int] = {}
    tones_at: dict[tuple[int, int], NDArray[np.float32]] = {}
    held: list[Hierarchy] = []
    drawn: list[tuple[int, int]] = []
    poses: list[NDArray[np.float64]] = []
    scales: list[tuple[float, float, float]] = []
    coloured: list[tuple[int, NDArray[np.float32]]] = []
    firsts = [0]
    image_of: list[int] = []
    cameras: list[NDArray[np.float64]] = []
    views, sky_matrices = [], []
    gaussians = 1
    options = _filtered(requests[0].options)
    for given in requests:
        request = replace(given, options=options)
        viewmats = request.viewmats.detach().cpu().numpy()
        Ks = request.Ks.detach().cpu().numpy()
        for c in range(request.cameras):
            total = 0
            for instance in request.instances:
                if not len(instance.cloud):
                    continue
                key = (id(instance.cloud), id(instance.covars), id(instance.colour))
                row = rows.get(key)
                if row is None:
                    row = rows[key] = len(held)
                    held.append(_hierarchy(instance))
                if instance.colour is not None:
                    at = (id(instance.colour), instance.t_us)
                    if at not in tones_at:
                        tones_at[at] = array_of(instance.colour.tones(instance.t_us))
                    coloured.append((len(drawn), tones_at[at]))
                drawn.append((row, instance.instance_id))
                poses.append(_pose(instance))
                scales.append(instance.scale)
                image_of.append(len(cameras))
                total += len(instance.cloud)
            gaussians = max(gaussians, total)
            firsts.append(len(drawn))
            cameras.append(viewmats[c])
            views.append(tuple(view_of(request, c)))
            sky_matrices.append(viewmats[c][:3, :3].T @ np.linalg.inv(Ks[c]))
    T_camera_object = np.array(poses).reshape(-1, 4, 4)
    if poses:
        T_camera_object = np.array(cameras)[image_of] @ T_camera_object
    tones = np.zeros((len(drawn), max((len(t) for _, t in coloured), default=0)), np.float32)
    for index, values in coloured:
        tones[index, : len(values)] = values
    return _Draws(
        held=held,
        table=table_of(held),
        tones=tones,
        draws=np.array(drawn, np.int64).reshape(-1, 2),
        **_places(T_camera_object, np.array(scales, np.float64).reshape(-1, 3)),
        first_draws=np.array(firsts, np.int64),
        views=np.array(views, np.float32),
        sky_matrices=np.array(sky_matrices, np.float32),
        gaussians=gaussians,
    )


def _world_draws(worlds: WorldViews, like: RasterRequest) -> _Draws:
    """Like :func:`_draws`, for worlds with the same instances."""
    filled = np.array([len(thing.cloud) > 0 for thing in worlds.things], np.bool_)
    held = [_hierarchy(thing) for thing in worlds.things if len(thing.cloud)]
    rows = np.cumsum(filled) - 1
    cameras = len(worlds.Ks)
    shown = np.repeat(worlds.shown & filled, cameras, axis=0)
    image_of, instance_of = np.nonzero(shown)
    world_of = image_of // cameras
    viewmats = worlds.viewmats.reshape(-1, 4, 4)
    ids = np.array([thing.instance_id for thing in worlds.things], np.int64)
    scales = np.array([thing.scale for thing in worlds.things], np.float64).reshape(-1, 3)
    sizes = np.array([len(thing.cloud) for thing in worlds.things], np.int64)
    numbers = replace(like, Ks=torch.from_numpy(worlds.Ks), options=_filtered(like.options))
    views = np.array([tuple(view_of(numbers, c)) for c in range(cameras)], np.float32)
    inverse = np.linalg.inv(worlds.Ks)
    images = len(viewmats)
    return _Draws(
        held=held,
        table=table_of(held),
        tones=_tones(worlds, instance_of, worlds.times_us[world_of]),
        draws=np.stack([rows[instance_of], ids[instance_of]], axis=1),
        **_places(viewmats[image_of] @ worlds.poses[world_of, instance_of], scales[instance_of]),
        first_draws=np.append(0, np.cumsum(shown.sum(1))).astype(np.int64),
        views=np.tile(views, (images // cameras, 1)),
        sky_matrices=(
            viewmats[:, :3, :3].transpose(0, 2, 1) @ np.tile(inverse, (images // cameras, 1, 1))
        ).astype(np.float32),
        gaussians=max(1, int((shown @ sizes).max(initial=0))),
    )


def _tones(
    worlds: WorldViews, instance_of: NDArray[np.int64], times_us: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Time basis [D, F] of each draw."""
    counts = [
        0 if thing.colour is None else int(thing.colour.coefficients.shape[1])
        for thing in worlds.things
    ]
    tones = np.zeros((len(instance_of), max(counts, default=0)), np.float32)
    for k, thing in enumerate(worlds.things):
        if thing.colour is None:
            continue
        own = instance_of == k
        tones[own, : counts[k]] = thing.colour.tones_of(times_us[own])
    return tones


class _Places(TypedDict):
    """Poses of draws relative to their cameras, see draw_images."""

    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]


def _places(T_camera_object: NDArray[np.float64], scale: NDArray[np.float64]) -> _Places:
    rotation, offset = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    position = -(rotation.transpose(0, 2, 1) @ offset[..., None])[..., 0]
    return {
        "linear": np.ascontiguousarray(rotation * scale[:, None, :]),
        "offset": np.ascontiguousarray(offset),
        "camera_position": position.astype(np.float32),
        "scale": scale.astype(np.float32),
    }


def _filtered(options: RasterOptions) -> RasterOptions:
    eps2d = min(options.eps2d, PIXEL_VARIANCE)
    return replace(options, eps2d=eps2d, rasterize_mode="antialiased")


def _hierarchy(instance: Instance) -> Hierarchy:
    if instance.covars is not None:
        return deformed_hierarchy(instance.cloud, instance.covars, instance.colour)
    return hierarchy_of(instance.cloud, instance.colour)


IDENTITY = np.eye(4)


def _pose(instance: Instance) -> NDArray[np.float64]:
    pose = instance.T_world_object
    if pose is None:
        return IDENTITY
    return pose.detach().cpu().numpy() if isinstance(pose, torch.Tensor) else np.asarray(pose)
