"""Colours and labels of one camera in one pass over the tiles.

Besides its colour, each pixel gets the record of its front. Within the window of an object, each
pixel also gets the front of that object without occluders. Once a pixel is finished, the pass
continues with the records of watched objects only. Depth, object and class are derived from the
front, once per pixel. Colours are bitwise equal to those of :mod:`.blend`.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from ..backend import ALPHA_MAX, TRANSMITTANCE_MIN, Placement, RasterRequest, place_instances
from ..types import LabelOutput, Window
from .blend import HALVES, LOOK_AHEAD, TASKS, exponential, open_tile, touched_halves
from .drawing import Chunks, Drawing, Workspace, cluster_of, places_of, seen_chunks, view_of
from .lanes import LANES, Lanes, Planes, inlined, kernel, lane_numbers, lowest_bit, prefetch, splat
from .records import (
    BLUE,
    CHUNK,
    DEPTH,
    EXPONENT_LIMIT,
    FALLOFF,
    GREEN,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    MEMBER,
    RED,
    SHARPNESS,
    SLOPE,
    TILE,
    Images,
    Records,
)

LABEL_PLANES = 5
"""Transmittance (negative once finished), red, green, blue and the front.

The front is 1 + the index of the first record that brings the transmittance to the requested level
or below. If no record does, it is that of the record that brings it to 0.5, else 0.
"""
OWN_PLANES = 2
"""Transmittance and front of an object without occluders."""


def _alpha(builder: ir.IRBuilder, scalars: list[Any]) -> tuple[Lanes, Any]:
    """Emit the alpha of one record and the mask of the pixels that it touches.

    ``scalars`` are sharpness, offset and rest of the exponent.
    """
    sharpness, offset, rest = (splat(builder, scalar) for scalar in scalars)
    distance = (lane_numbers(builder) + offset) * sharpness
    exponent = distance.fused(distance, rest)
    alpha = exponential(exponent)
    alpha = alpha.where(alpha.compare("<", ALPHA_MAX), ALPHA_MAX)
    return alpha, exponent.compare("<=", EXPONENT_LIMIT)


def _blend(
    builder: ir.IRBuilder,
    state: Planes,
    seen: tuple[Lanes, Any],
    colours: list[Any],
    asked: list[Any],
) -> Any:
    """Emit the blending of one record. Returns eight bits, set for unfinished pixels.

    Args:
        builder: IR builder of the kernel.
        state: eight pixels; the front is the plane after the colours.
        seen: alpha, and the mask of touched pixels.
        colours: red, green and blue, or empty.
        asked: front (index + 1) and level.
    """
    alpha, touched = seen
    front, level = (splat(builder, scalar) for scalar in asked)
    before = state.load(0)
    weight = alpha * before
    after = before - weight
    goes_on = after.compare(">", TRANSMITTANCE_MIN)
    blended = builder.and_(touched, goes_on)
    finished = builder.and_(touched, builder.not_(goes_on))
    weight = weight.where(blended, 0.0)
    new = (before - weight).negative_where(finished)
    state.store(0, new)
    for plane, value in enumerate(colours, start=1):
        state.store(plane, weight.fused(splat(builder, value), state.load(plane)))
    crossing = builder.or_(_crossed(before, after, 0.5), _crossed(before, after, level))
    crossing = builder.and_(blended, crossing)
    last = 1 + len(colours)
    held = state.load(last)
    state.store(last, held + (front - held).where(crossing, 0.0))
    mask = builder.bitcast(new.compare(">", 0.0), ir.IntType(LANES))
    return builder.zext(mask, ir.IntType(64))


def _crossed(before: Lanes, after: Lanes, level: Lanes | float) -> Any:
    """Mask of pixels whose transmittance falls to ``level`` or below in this step."""
    return before.builder.and_(before.compare(">", level), after.compare("<=", level))


@intrinsic
def blend_label(typingctx, pixels, half, sharpness, offset, rest, red, green, blue, front, level):
    """Blend colours and front of eight pixels; returns 0 when all of them are finished."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        state = Planes(builder, array.data, arguments[1], planes=LABEL_PLANES)
        scalars = list(arguments[2:])
        return _blend(builder, state, _alpha(builder, scalars[:3]), scalars[3:6], scalars[6:])

    return types.int64(pixels, types.int64, *(types.float32,) * 8), generate


@intrinsic
def blend_own(typingctx, own, place, sharpness, offset, rest, front, level):
    """Blend the front of one object in eight pixels; returns 0 when all are finished."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        state = Planes(builder, array.data, arguments[1], planes=OWN_PLANES)
        scalars = list(arguments[2:])
        return _blend(builder, state, _alpha(builder, scalars[:3]), [], scalars[3:])

    return types.int64(own, types.int64, *(types.float32,) * 5), generate


@intrinsic
def blend_both(
    typingctx, pixels, half, own, place, sharpness, offset, rest, red, green, blue, front, level
):
    """:func:`blend_label` and :func:`blend_own` with one alpha.

    The bits of the object are shifted left by eight.
    """

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        state = Planes(builder, array.data, arguments[1], planes=LABEL_PLANES)
        array = context.make_array(signature.args[2])(context, builder, arguments[2])
        alone = Planes(builder, array.data, arguments[3], planes=OWN_PLANES)
        scalars = list(arguments[4:])
        seen, asked = _alpha(builder, scalars[:3]), scalars[6:]
        bits = _blend(builder, state, seen, scalars[3:6], asked)
        own_bits = _blend(builder, alone, seen, [], asked)
        return builder.or_(bits, builder.shl(own_bits, ir.Constant(own_bits.type, LANES)))

    kinds = (pixels, types.int64, own, types.int64, *(types.float32,) * 8)
    return types.int64(*kinds), generate


# Blending colours and labels


F32 = np.float32
HALF = F32(0.5)
OWN = TILE * HALVES * OWN_PLANES * LANES
"""float32 values of one object in a tile."""
LEFT, TOP, RIGHT, BOTTOM, FIRST = 0, 1, 2, 3, 4
"""Columns of a window: its edges [px], and the index of its first pixel."""
ELSEWHERE, UNSEEN = -1, -2
"""Values in place of an object's unfinished half rows: its window is outside the tile, or the tile
has had none of its records yet."""
NO_RECORD = np.int64(1) << 62


@kernel(parallel=PARALLEL_LOOPS)
def blend_labels(
    values,
    lists,
    starts,
    tiles_x,
    first_tile,
    last_tile,
    background,
    level,
    objects,
    fronts,
    images,
):
    """Blend tiles [first_tile, last_tile) into RGB and alpha of Images, and find fronts.

    Args:
        values, lists, starts, background: see blend_tiles.
        level: transmittance that defines a pixel's front.
        objects: Objects.
        fronts: FirstHits.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    rgb, alpha, pixel_fronts = images.rgb, images.alpha, fronts.pixels
    alone, used, windows = fronts.alone, fronts.used, objects.windows
    slots, first_record = objects.slots, objects.first_record
    for task in prange(TASKS):
        pixels = np.empty(TILE * HALVES * LABEL_PLANES * LANES, np.float32)
        own = np.empty(windows.shape[0] * OWN, np.float32)
        own_alive = np.empty(windows.shape[0], np.int64)
        for tile in range(first_tile + task, last_tile, TASKS):
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            alive = open_tile(pixels, LABEL_PLANES, x0, y0, alpha.shape)
            watched = watch(own_alive, windows, x0, y0)
            label_tile(
                values, lists, starts[tile], starts[tile + 1], F32(x0), F32(y0), pixels, alive,
                own, own_alive, slots, first_record if watched else NO_RECORD, level,
            )  # fmt: skip
            write_colours(pixels, x0, y0, background, rgb, alpha, pixel_fronts, used)
            if watched:
                write_own(own, own_alive, windows, x0, y0, alpha.shape, alone, used)


@inlined()
def meets(window, x0, y0):
    """Whether a window overlaps a tile."""
    across = window[LEFT] < x0 + TILE and window[RIGHT] > x0
    return across and window[TOP] < y0 + TILE and window[BOTTOM] > y0


@inlined()
def watch(own_alive, windows, x0, y0):
    """Mark the objects whose windows overlap the tile; returns whether there are any."""
    watched = False
    for slot in range(windows.shape[0]):
        own_alive[slot] = ELSEWHERE
        if meets(windows[slot], x0, y0):
            own_alive[slot] = UNSEEN
            watched = True
    return watched


@inlined()
def open_own(own, slot):
    """Clear the state of an object."""
    for half in range(TILE * HALVES):
        place = slot * OWN + half * OWN_PLANES * LANES
        own[place : place + LANES] = 1
        own[place + LANES : place + 2 * LANES] = 0


@inlined()
def label_tile(
    values, lists, first, last, x0, y0, pixels, alive, own, own_alive, slots, first_record, level
):
    """Blend lists[first:last], near to far.

    Records before ``first_record`` belong to no watched object.
    """
    inside = alive
    for position in range(first, last):
        index = np.int64(lists[position])
        if alive == 0 and index < first_record:
            if first_record == NO_RECORD:
                break
            continue
        prefetch(values, np.int64(lists[min(position + LOOK_AHEAD, last - 1)]))
        record = values[index]
        slot, wanted = np.int64(-1), np.int64(0)
        if index >= first_record:
            slot = np.int64(slots[np.int64(record[INSTANCE])])
            if slot >= 0:
                wanted = own_alive[slot]
                if wanted == UNSEEN:
                    open_own(own, slot)
                    own_alive[slot] = wanted = inside
                elif wanted == ELSEWHERE:
                    slot, wanted = np.int64(-1), np.int64(0)
        if alive | wanted == 0:
            continue
        alive, wanted = blend_record(
            record, F32(index + 1), x0, y0, pixels, alive, own, slot, wanted, level
        )
        if slot >= 0:
            own_alive[slot] = wanted


@inlined()
def blend_record(record, front, x0, y0, pixels, alive, own, slot, wanted, level):
    """Blend one record; returns the unfinished half rows of the image and of its object."""
    x, y = x0 + HALF - record[MEAN_X], y0 + HALF - record[MEAN_Y]
    sharpness, slope = record[SHARPNESS], record[SLOPE]
    falloff, lowest = record[FALLOFF], record[LEVEL]
    red, green, blue = record[RED], record[GREEN], record[BLUE]
    touched = touched_halves(x, y, sharpness, slope, falloff, lowest) & (alive | wanted)
    while touched != 0:
        half = lowest_bit(touched)
        touched &= touched - 1
        dy = y + F32(half % TILE)
        start = x - slope * dy + F32(half // TILE * LANES)
        rest = falloff * dy * dy + lowest
        place = slot * TILE * HALVES + half
        if (wanted >> half) & 1 == 0:
            going = blend_label(
                pixels, half, sharpness, start, rest, red, green, blue, front, level
            )
            alive &= ~(np.int64(going == 0) << half)
        elif (alive >> half) & 1 == 0:
            going = blend_own(own, place, sharpness, start, rest, front, level)
            wanted &= ~(np.int64(going == 0) << half)
        else:
            going = blend_both(
                pixels, half, own, place, sharpness, start, rest, red, green, blue, front, level
            )
            alive &= ~(np.int64(going & 255 == 0) << half)
            wanted &= ~(np.int64(going >> 8 == 0) << half)
    return alive, wanted


@inlined()
def write_colours(pixels, x0, y0, background, rgb, alpha, fronts, used):
    """Composite the tile over the background and write it to the images."""
    height, width = alpha.shape
    for row in range(min(TILE, height - y0)):
        for column in range(min(TILE, width - x0)):
            p = (column // LANES * TILE + row) * LABEL_PLANES * LANES + column % LANES
            y, x = y0 + row, x0 + column
            left = abs(pixels[p])
            alpha[y, x] = F32(1) - left
            for channel in range(3):
                rgb[y, x, channel] = pixels[p + (1 + channel) * LANES] + left * background[channel]
            front = np.int32(pixels[p + 4 * LANES])
            fronts[y, x] = front
            used[front] = 1


@inlined()
def write_own(own, own_alive, windows, x0, y0, shape, alone, used):
    """Write the fronts of the objects watched in the tile."""
    for slot in range(windows.shape[0]):
        if own_alive[slot] < 0:
            continue
        window = windows[slot]
        across = window[RIGHT] - window[LEFT]
        for y in range(max(y0, window[TOP]), min(y0 + TILE, window[BOTTOM])):
            for x in range(max(x0, window[LEFT]), min(x0 + TILE, window[RIGHT])):
                half = (x - x0) // LANES * TILE + y - y0
                place = slot * OWN + half * OWN_PLANES * LANES + LANES + (x - x0) % LANES
                front = np.int32(own[place])
                alone[window[FIRST] + (y - window[TOP]) * across + x - window[LEFT]] = front
                used[front] = 1


# Depth of a pixel's front: the point on its ray where the Gaussian's response peaks. That is the
# point nearest to the centre in the Gaussian's own metric (Moenne-Loccoz et al. 2024), with the
# image blur. The depth of the centre can be off by decimetres, e.g. for discs on a road.


SHAPE = 16
"""float32 values of a shape, one cache line: centre in the camera frame [m], inverse covariance
(xx, yy, zz, xy, xz, yz), object."""
OBJECT = 9


@kernel(parallel=PARALLEL_LOOPS)
def shape_fronts(cluster, view, base, chunks, values, counts, used, shapes):
    """Write the shapes of the records of one Cluster that are a front.

    Args:
        cluster, view, base, chunks: see project_cluster.
        values, counts: see Records.
        used: [1 + M] uint8, nonzero at 1 + m if record m is a front.
        shapes: [M, SHAPE] float32, written.
    """
    for k in prange(chunks.shape[0]):
        first = base + k * CHUNK
        for slot in range(first, first + counts[first // CHUNK]):
            if used[1 + slot]:
                member = np.int64(values[slot, MEMBER])
                write_shape(cluster, view, chunks[k] * CHUNK + member, shapes[slot])
                shapes[slot, OBJECT] = cluster.instance_id


@inlined()
def write_shape(cluster, view, i, out):
    """Write the shape of Gaussian ``i`` in the camera frame."""
    a, mean = cluster.linear, cluster.means[i]
    xx, yy, zz, xy, xz, yz = covariance_of(cluster, i)
    for k in range(3):
        out[k] = F32(a[k, 0] * mean[0] + a[k, 1] * mean[1] + a[k, 2] * mean[2] + cluster.offset[k])
    # The image blur, so that discs seen edge-on also have a depth.
    blur = np.float64(view.blur) * out[2] / np.float64(view.fx)
    blur *= blur
    cxx = along(a, 0, 0, xx, yy, zz, xy, xz, yz) + blur
    cyy = along(a, 1, 1, xx, yy, zz, xy, xz, yz) + blur
    czz = along(a, 2, 2, xx, yy, zz, xy, xz, yz) + blur
    cxy = along(a, 0, 1, xx, yy, zz, xy, xz, yz)
    cxz = along(a, 0, 2, xx, yy, zz, xy, xz, yz)
    cyz = along(a, 1, 2, xx, yy, zz, xy, xz, yz)
    ixx, iyy, izz = cyy * czz - cyz * cyz, cxx * czz - cxz * cxz, cxx * cyy - cxy * cxy
    ixy, ixz, iyz = cxz * cyz - cxy * czz, cxy * cyz - cxz * cyy, cxy * cxz - cxx * cyz
    one = 1.0 / (cxx * ixx + cxy * ixy + cxz * ixz)
    out[3], out[4], out[5] = F32(ixx * one), F32(iyy * one), F32(izz * one)
    out[6], out[7], out[8] = F32(ixy * one), F32(ixz * one), F32(iyz * one)


@inlined()
def along(a, r, s, xx, yy, zz, xy, xz, yz):
    """Entry (r, s) of ``a @ covariance @ a.T``."""
    x = a[s, 0] * xx + a[s, 1] * xy + a[s, 2] * xz
    y = a[s, 0] * xy + a[s, 1] * yy + a[s, 2] * yz
    z = a[s, 0] * xz + a[s, 1] * yz + a[s, 2] * zz
    return a[r, 0] * x + a[r, 1] * y + a[r, 2] * z


@inlined()
def covariance_of(cluster, i):
    """Covariance of Gaussian ``i`` in the cloud frame: xx, yy, zz, xy, xz, yz."""
    if cluster.covars.shape[0] > 0:
        c = cluster.covars[i]
        return (
            np.float64(c[0, 0]), np.float64(c[1, 1]), np.float64(c[2, 2]),
            np.float64(c[0, 1]), np.float64(c[0, 2]), np.float64(c[1, 2]),
        )  # fmt: skip
    w, x = np.float64(cluster.quats[i, 0]), np.float64(cluster.quats[i, 1])
    y, z = np.float64(cluster.quats[i, 2]), np.float64(cluster.quats[i, 3])
    one = 1.0 / math.sqrt(max(w * w + x * x + y * y + z * z, 1e-24))
    w, x, y, z = w * one, x * one, y * one, z * one
    p, q, r = cluster.scales[i, 0], cluster.scales[i, 1], cluster.scales[i, 2]
    ax, ay, az = (1 - 2 * (y * y + z * z)) * p, 2 * (x * y + w * z) * p, 2 * (x * z - w * y) * p
    bx, by, bz = 2 * (x * y - w * z) * q, (1 - 2 * (x * x + z * z)) * q, 2 * (y * z + w * x) * q
    cx, cy, cz = 2 * (x * z + w * y) * r, 2 * (y * z - w * x) * r, (1 - 2 * (x * x + y * y)) * r
    return (
        ax * ax + bx * bx + cx * cx, ay * ay + by * by + cy * cy, az * az + bz * bz + cz * cz,
        ax * ay + bx * by + cx * cy, ax * az + bx * bz + cx * cz, ay * az + by * bz + cy * cz,
    )  # fmt: skip


@kernel(parallel=PARALLEL_LOOPS)
def read_fronts(fronts, left, top, view, values, shapes, depth, instance):
    """Write depth [m] and object of the fronts of a window [h, w] of the image.

    Args:
        fronts: [h, w] int32, 1 + index of a record, 0 for none.
        left, top: position of the window in the image [px].
        shapes: [M, SHAPE]; if [0, SHAPE], the depth is that of the centre.
    """
    inverse_x, inverse_y = F32(1) / view.fx, F32(1) / view.fy
    for row in prange(fronts.shape[0]):
        v = (F32(row + top) + F32(0.5) - view.cy) * inverse_y
        for column in range(fronts.shape[1]):
            front = fronts[row, column]
            if front == 0:
                depth[row, column], instance[row, column] = F32(0), np.uint16(0)
                continue
            if shapes.shape[0]:
                shape = shapes[front - 1]
                u = (F32(column + left) + F32(0.5) - view.cx) * inverse_x
                depth[row, column] = depth_along(shape, u, v, view.near_plane)
                instance[row, column] = np.uint16(shape[OBJECT])
            else:
                record = values[front - 1]
                depth[row, column] = record[DEPTH]
                instance[row, column] = np.uint16(record[INSTANCE])


@inlined()
def depth_along(shape, u, v, nearest):
    """Depth of the largest response along the ray (u, v, 1), at least ``nearest`` [m]."""
    x, y, z = shape[0] - shape[2] * u, shape[1] - shape[2] * v, shape[2]
    # The inverse covariance times the ray.
    a = shape[3] * u + shape[6] * v + shape[7]
    b = shape[6] * u + shape[4] * v + shape[8]
    c = shape[7] * u + shape[8] * v + shape[5]
    return max(z + (a * x + b * y) / (a * u + b * v + c), nearest)


# One camera, from Gaussians to an image with labels

MAX_ID = 65_535
NO_SHAPES = np.zeros((0, SHAPE), np.float32)
NOT_ASKED = np.zeros((0, 0), np.float32)


class Objects(NamedTuple):
    """Objects to draw also without occluders.

    Attributes:
        windows: [K, 5] int64: left, top, right, bottom [px], and the index of the first pixel.
        slots: [65536] int16, index of the window by instance id, -1 for none.
        first_record: Records before this index belong to none of these objects.
    """

    windows: NDArray[np.int64]
    slots: NDArray[np.int16]
    first_record: np.int64


class FirstHits(NamedTuple):
    """Fronts as 1 + index of a record, 0 for none.

    Attributes:
        pixels: [H, W] int32.
        alone: [P] int32, objects without occluders, window by window.
        used: [1 + M] uint8, nonzero for each front in ``pixels`` or ``alone``.
    """

    pixels: NDArray[np.int32]
    alone: NDArray[np.int32]
    used: NDArray[np.uint8]


@dataclass
class LabelPass:
    """Label options of one camera, and the results of its pass.

    Attributes:
        windows: windows of the objects to draw without occluders.
        level: transmittance that defines a pixel's front.
        along_rays: if true, depth is taken along the ray of the pixel, else at the front's centre.
        objects, fronts, records: set when the pass begins.
    """

    windows: Sequence[Window]
    level: float
    along_rays: bool
    objects: Objects | None = None
    fronts: FirstHits | None = None
    records: Records | None = None


@dataclass(frozen=True, eq=False)
class LabelDrawing(Drawing):
    """A Drawing that also finds fronts. It cannot be interrupted."""

    walk: LabelPass = field(default_factory=lambda: LabelPass((), 0.5, along_rays=True))

    def label(
        self, placement: Placement, chunks: Sequence[Chunks]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint16], list[NDArray[np.float32]]]:
        """Draw the image.

        Returns:
            Depth [m] and object, both [H, W], and the depth [h, w] [m] of each window.
        """
        self._prepare(chunks)
        self.draw(placement, chunks)
        walk, view = self.walk, view_of(self.request, self.camera)
        assert walk.records is not None
        assert walk.fronts is not None
        assert walk.objects is not None
        shapes = self._shapes(placement, chunks) if walk.along_rays else NO_SHAPES
        values, fronts = walk.records.values, walk.fronts
        shape = fronts.pixels.shape
        depth, instance = np.empty(shape, np.float32), np.empty(shape, np.uint16)
        read_fronts(fronts.pixels, 0, 0, view, values, shapes, depth, instance)
        alone = []
        for left, top, right, bottom, first in walk.objects.windows.tolist():
            high, wide = bottom - top, right - left
            own = np.empty((high, wide), np.float32)
            ids = self.space.array("own_ids", (high, wide), np.uint16)
            pixels = fronts.alone[first : first + high * wide].reshape(high, wide)
            read_fronts(pixels, left, top, view, values, shapes, own, ids)
            alone.append(own)
        return depth, instance, alone

    def _prepare(self, chunks: Sequence[Chunks]) -> None:
        """Lay out the windows and clear the fronts."""
        windows = np.zeros((len(self.walk.windows), 5), np.int64)
        slots = np.full(MAX_ID + 1, -1, np.int16)
        pixels = 0
        for slot, window in enumerate(self.walk.windows):
            windows[slot] = window.left, window.top, window.right, window.bottom, pixels
            slots[window.instance_id] = slot
            pixels += (window.right - window.left) * (window.bottom - window.top)
        before = 0
        for instance, own in zip(self.request.instances, chunks, strict=True):
            if slots[instance.instance_id] >= 0:
                break
            before += len(own)
        records = sum(map(len, chunks)) * CHUNK
        fronts = FirstHits(
            self.space.array("fronts", (self.request.height, self.request.width), np.int32),
            self.space.array("alone", (pixels,), np.int32),
            self.space.array("used", (1 + records,), np.uint8),
        )
        fronts.alone[:] = 0
        fronts.used[:] = 0
        self.walk.objects = Objects(windows, slots, np.int64(before * CHUNK))
        self.walk.fronts = fronts

    def _blend_tiles(
        self,
        records: Records,
        lists: NDArray[np.int32],
        starts: NDArray[np.int64],
        tiles: tuple[int, int],
        behind: NDArray[np.float32],
    ) -> None:
        walk, tiles_x = self.walk, -(-self.request.width // TILE)
        walk.records = records
        blend_labels(
            records.values,
            lists,
            starts,
            tiles_x,
            *tiles,
            behind,
            np.float32(walk.level),
            walk.objects,
            walk.fronts,
            self.images,
        )

    def _shapes(self, placement: Placement, chunks: Sequence[Chunks]) -> NDArray[np.float32]:
        """Shapes [M, SHAPE] of the records that are fronts; other rows are undefined."""
        walk, request = self.walk, self.request
        assert walk.records is not None
        assert walk.fronts is not None
        values, counts = walk.records.values, walk.records.counts
        shapes = self.space.array("shapes", (len(values), SHAPE), np.float32)
        view, places = view_of(request, self.camera), places_of(placement, self.camera)
        base = 0
        for index, instance in enumerate(request.instances):
            if len(chunks[index]):
                cluster = cluster_of(instance, places, index)
                used = walk.fronts.used
                shape_fronts(
                    cluster, view, base * CHUNK, chunks[index], values, counts, used, shapes
                )
            base += len(chunks[index])
        return shapes


def draw_labels(
    request: RasterRequest,
    windows: Sequence[Sequence[Window]],
    space: Workspace,
    *,
    level: float,
    along_rays: bool,
) -> list[LabelOutput]:
    """Draw images and labels of all cameras of a request, one camera after the other."""
    placement = place_instances(request.instances, request.viewmats.detach().cpu())
    views = [view_of(request, c) for c in range(request.cameras)]
    seen = seen_chunks(request, placement, views)
    found = []
    for c in range(request.cameras):
        shape = (request.height, request.width)
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        images = Images(rgb, alpha, NOT_ASKED, np.zeros((0, 0), np.uint16), NOT_ASKED)
        timing = dict.fromkeys(("project", "sort", "tile", "blend", "sky"), 0.0)
        walk = LabelPass(windows[c], level, along_rays)
        drawing = LabelDrawing(request, c, images, space, timing, walk)
        depth, instance, alone = drawing.label(placement, seen[c])
        found.append(LabelOutput(torch.from_numpy(rgb), depth, instance, tuple(alone), timing))
    return found
