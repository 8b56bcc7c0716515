"""Projection of a cluster of Gaussians onto one image, fused with culling and colour.

The cluster is not copied: each visible Gaussian becomes one record, eight at a time. Chunks of
fixed size write to separate regions, so the result does not depend on the number of threads.

The steps are explicit vector code. Eight Gaussians occupy PROJECTION planes of eight float32
numbers: the fields of a record, then properties of the Gaussian, then intermediate values. Each
step takes a bit mask of active lanes and returns the lanes that remain.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic

from ..._numba import PARALLEL_LOOPS
from ..backend import ALPHA_MIN
from .lanes import (
    DOUBLE,
    FLOAT,
    I64,
    LANES,
    LONGS,
    Integers,
    Lanes,
    Planes,
    Vector,
    dot,
    inlined,
    kernel,
    logarithm,
    lowest_bit,
    mask_bits,
    mask_of,
    splat,
    turn_columns,
)
from .records import (
    BLUE,
    CHUNK,
    DEPTH,
    EXPONENT_LIMIT,
    EXPONENT_UNIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    GREEN,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    MEMBER,
    RECORD,
    RED,
    SHARPNESS,
    SLOPE,
    TILE,
    TIP_Y,
)

MEAN, OPACITY, SHAPE = RECORD, RECORD + 3, RECORD + 4
"""First planes of centre, opacity and shape. The shape is quaternion and scales, or the upper half
of the covariance by rows if the cluster has covariances."""
TANGENT = RECORD + 11
"""First of two planes: x/z and y/z, clamped to their bounds."""
PROJECTION = RECORD + 13

LOG_255 = math.log(255.0)
REACH_MAX = math.sqrt(2 * LOG_255)
COVARIANCE_MAX = 1e30
"""Larger than any image [px^2]; float32 fails beyond it."""
HALF_UNIT = 0.5 / EXPONENT_UNIT


class Named:
    """Access to a named tuple in a kernel; numbers are broadcast to all lanes."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kind: Any, value: Any) -> None:
        self._context, self._builder, self._kind, self._value = context, builder, kind, value

    def number(self, name: str) -> Lanes:
        """A scalar field."""
        return splat(self._builder, self._field(name)[1])

    def three(self, name: str, *, row: int = 0) -> Vector:
        """First three numbers of an array, or of its row ``row``."""
        element = DOUBLE if self._field(name)[0].dtype == types.float64 else FLOAT
        data = self.data(name)
        numbers = []
        for index in range(3 * row, 3 * row + 3):
            place = self._builder.gep(data, [I64(index)], source_etype=element)
            numbers.append(splat(self._builder, self._builder.load(place, typ=element)))
        return numbers

    def data(self, name: str) -> Any:
        """Pointer to the start of an array."""
        kind, value = self._field(name)
        return self._context.make_array(kind)(self._context, self._builder, value).data

    def _field(self, name: str) -> tuple[Any, Any]:
        index = self._kind.fields.index(name)
        return self._kind.types[index], self._builder.extract_value(self._value, index)


def eight_step(build: Callable[[Planes, Named, Named], Any], *, count: int) -> Any:
    """The intrinsic ``step(planes, lanes, view, cluster)`` whose code is emitted by ``build``.

    Args:
        build: function of ``count`` planes of eight numbers and the named tuples of view and
            cluster; returns the mask of the remaining lanes.
        count: number of planes.
    """

    def step(typingctx, planes, lanes, view, cluster):
        def generate(context, builder, signature, arguments):
            array = context.make_array(planes)(context, builder, arguments[0])
            eight = Planes(builder, array.data, I64(0), planes=count)
            known = (
                Named(context, builder, kind, value)
                for kind, value in zip((view, cluster), arguments[2:], strict=True)
            )
            remaining = build(eight, *known)
            return mask_bits(builder, builder.and_(mask_of(builder, arguments[1]), remaining))

        return types.int64(planes, types.int64, view, cluster), generate

    return intrinsic(step)


def _place(eight: Planes, view: Named, cluster: Named, *, deformed: bool) -> Any:
    """Project the centres; keeps potentially visible Gaussians.

    Centres are summed in float64 so that rounding cannot change the depth order.
    """
    mean = [eight.load(MEAN + k).doubles() for k in range(3)]
    offset = cluster.three("offset")
    x, y, z = (dot(cluster.three("linear", row=k), mean, offset[k]).floats() for k in range(3))
    inverse = z.reciprocal()
    tx, ty = x * inverse, y * inverse
    mean_x = tx.fused(view.number("fx"), view.number("cx"))
    mean_y = ty.fused(view.number("fy"), view.number("cy"))
    tx = tx.at_least(view.number("left")).at_most(view.number("right"))
    ty = ty.at_least(view.number("top")).at_most(view.number("bottom"))
    planes = (MEAN_X, MEAN_Y, DEPTH, TANGENT, TANGENT + 1)
    for plane, value in zip(planes, (mean_x, mean_y, z, tx, ty), strict=True):
        eight.store(plane, value)

    sigma, blur = largest_sigma(eight, cluster, deformed=deformed), view.number("blur")
    reach = (
        (view.number(focal) * inverse * (tangent.magnitude() + 1.0)).fused(sigma, blur) * REACH_MAX
        for focal, tangent in (("fx", tx), ("fy", ty))
    )
    tests = [
        eight.load(OPACITY).compare(">=", ALPHA_MIN),
        z.compare(">=", view.number("near_plane")),
        z.compare("<=", view.number("far_plane")),
        *on_image(view, mean_x, mean_y, *reach),
    ]
    return reduce(eight.builder.and_, tests)


def largest_sigma(eight: Planes, cluster: Named, *, deformed: bool) -> Lanes:
    """Upper bound of the standard deviation in any direction, world scale [m]."""
    a, b, c = cluster.three("scale")
    largest = a.at_least(b).at_least(c)
    if deformed:
        trace = eight.load(SHAPE) + eight.load(SHAPE + 3) + eight.load(SHAPE + 5)
        return trace.root() * largest
    s0, s1, s2 = (eight.load(SHAPE + 4 + k) for k in range(3))
    return s0.at_least(s1).at_least(s2) * largest


def on_image(view: Named, x: Lanes, y: Lanes, reach_x: Lanes, reach_y: Lanes) -> list[Any]:
    """Masks whether a box about (x, y) meets the image; false for non-finite values."""
    return [
        (x + reach_x).compare(">", 0.0),
        (x - reach_x).compare("<", view.number("width")),
        (y + reach_y).compare(">", 0.0),
        (y - reach_y).compare("<", view.number("height")),
    ]


def _shape(eight: Planes, view: Named, cluster: Named, *, deformed: bool) -> Any:
    """Write the ellipses to the record planes; keeps those that meet the image."""
    across, down = _image_axes(eight, view, cluster)
    covariance = _deformed_covariance if deformed else _covariance
    cxx, cxy, cyy, sharp = covariance(eight, across, down)
    eps = view.number("eps2d").doubles()
    determinant = (cxx + cyy + eps).fused(eps, sharp)
    cxx, cyy = cxx + eps, cyy + eps
    opacity, antialiased = eight.load(OPACITY), view.number("antialiased").compare(">", 0.0)
    kept = (sharp.at_least(0.0) / determinant).root().floats()
    opacity = (opacity * kept).where(antialiased, opacity)

    level = -logarithm(opacity)
    reach = ((-level + LOG_255).at_least(0.0) * 2.0).root()
    reach_x, reach_y = reach * cxx.floats().root(), reach * cyy.floats().root()
    inverse = cyy.floats().reciprocal()
    record = {
        SHARPNESS: ((cyy / determinant).floats() * HALF_UNIT).root(),
        SLOPE: cxy.floats() * inverse,
        FALLOFF: inverse * HALF_UNIT,
        LEVEL: level * (1 / EXPONENT_UNIT),
        EXTENT_X: reach_x,
        EXTENT_Y: reach_y,
        TIP_Y: reach_x * cxy.floats() / cxx.floats(),
    }
    for plane, value in record.items():
        eight.store(plane, value)
    clip = view.number("radius_clip")
    large_enough = [
        clip.compare("<=", 0.0),
        reach_x.ceiling().compare(">", clip),
        reach_y.ceiling().compare(">", clip),
    ]
    tests = [
        determinant.compare(">", 0.0),
        cxx.compare("<", COVARIANCE_MAX),
        cyy.compare("<", COVARIANCE_MAX),
        opacity.compare(">=", ALPHA_MIN),
        reduce(eight.builder.or_, large_enough),
        *on_image(view, eight.load(MEAN_X), eight.load(MEAN_Y), reach_x, reach_y),
    ]
    return reduce(eight.builder.and_, tests)


def _image_axes(eight: Planes, view: Named, cluster: Named) -> tuple[Vector, Vector]:
    """Rows of the Jacobian of the projection from the cluster frame to the image [px/m]."""
    linear = [[number.floats() for number in cluster.three("linear", row=k)] for k in range(3)]
    inverse = eight.load(DEPTH).reciprocal()
    rows = []
    for k, focal in enumerate(("fx", "fy")):
        scale, tangent = view.number(focal) * inverse, -eight.load(TANGENT + k)
        pairs = zip(linear[k], linear[2], strict=True)
        rows.append([scale * tangent.fused(along_z, own) for own, along_z in pairs])
    return rows[0], rows[1]


def _covariance(eight: Planes, across: Vector, down: Vector) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Covariance (xx, xy, yy) [px^2] on the image before blur, and its determinant, float64.

    The rotation is also float64: gradients of needles depend on its last digits.
    """
    columns = turn_columns([eight.load(SHAPE + k).doubles() for k in range(4)])
    scales = [eight.load(SHAPE + 4 + k).doubles() for k in range(3)]
    rows = [[number.doubles() for number in row] for row in (across, down)]
    u, v = (
        [scale * dot(row, column) for scale, column in zip(scales, columns, strict=True)]
        for row in rows
    )
    # Lagrange's identity: |u|^2 |v|^2 - (u v)^2 without cancellation for needles.
    normal = [u[i] * v[j] - u[j] * v[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    return dot(u, u), dot(u, v), dot(v, v), dot(normal, normal)


def _deformed_covariance(
    eight: Planes, across: Vector, down: Vector
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Like _covariance, from the upper half of a 3D covariance."""
    a, b = [number.doubles() for number in across], [number.doubles() for number in down]
    xx, xy, xz, yy, yz, zz = (eight.load(SHAPE + k).doubles() for k in range(6))
    matrix = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    p, q = ([dot(list(row), axis) for row in matrix] for axis in (a, b))
    cxx, cxy, cyy = dot(p, a), dot(p, b), dot(q, b)
    return cxx, cxy, cyy, cxx * cyy - cxy * cxy


place_eight = eight_step(partial(_place, deformed=False), count=PROJECTION)
place_eight_deformed = eight_step(partial(_place, deformed=True), count=PROJECTION)
shape_eight = eight_step(partial(_shape, deformed=False), count=PROJECTION)
shape_eight_deformed = eight_step(partial(_shape, deformed=True), count=PROJECTION)


# Footprints: the tiles that a record may touch, as one int64. From the lowest bit: tiles x0, x1,
# y0, y1 of the half-open bounding box, FIELD bits each, then one bit per tile for boxes of at most
# SMALL x SMALL tiles, row by row. Tile lists of small boxes need no records, which would not fit a
# cache.

F32 = np.float32
ZERO = F32(0)
HALF = F32(0.5)
ONE = F32(1)
LIMIT, PER_TILE = F32(EXPONENT_LIMIT), F32(1.0 / TILE)
SLACK = F32(0.01)
"""Margin of boxes and ranges against rounding [px]; blending tests pixels exactly."""
FIELD = 12
FIELD_MASK = (1 << FIELD) - 1
SMALL = 4
ROW_MASK = (1 << SMALL) - 1

LOWEST_BITS = np.uint64(sum((b & -b).bit_length() - 1 << 4 * b for b in range(1, 16)))
BIT_LENGTHS = np.uint64(sum(b.bit_length() << 4 * b for b in range(1, 16)))
"""Lookup table for the sixteen values of a row of bits, four bits each."""


@intrinsic
def footprints_of_eight(typingctx, planes, lanes, view, found):
    """Write the footprints of eight records to ``found`` [8] int64.

    Args:
        planes: PROJECTION planes, see the module.
        lanes: bits of the active lanes.
        view: CameraParameters.

    Returns:
        Bits of the lanes that may touch a tile.
    """

    def generate(context, builder, signature, arguments):
        data = context.make_array(planes)(context, builder, arguments[0]).data
        eight = Planes(builder, data, I64(0), planes=PROJECTION)
        named = Named(context, builder, view, arguments[2])
        footprints, remaining = _footprints(eight, named)
        target = context.make_array(found)(context, builder, arguments[3]).data
        builder.store(footprints.value, builder.bitcast(target, LONGS.as_pointer()), align=8)
        return mask_bits(builder, builder.and_(mask_of(builder, arguments[1]), remaining))

    return types.int64(planes, types.int64, view, found), generate


def _footprints(eight: Planes, view: Named) -> tuple[Integers, Any]:
    """Emit the footprints of eight records, and the mask of records that touch a tile."""
    x0, x1 = _tile_range(eight.load(MEAN_X), eight.load(EXTENT_X), view.number("width"))
    y0, y1 = _tile_range(eight.load(MEAN_Y), eight.load(EXTENT_Y), view.number("height"))
    columns, rows = x1 - x0, y1 - y0
    one, touched = (Integers.filled(eight.builder, number) for number in (1, 0))
    for row in range(SMALL):
        left, right = _row_columns(eight, y0 + row, (x0, x1))
        # A range of bits is a difference of powers of two.
        bits = (one << (right - x0)) - (one << (left - x0))
        here = eight.builder.and_(right.compare(">", left), rows.compare(">", row))
        touched = touched | (bits.where(here, 0) << row * SMALL)
    small = [n.compare(">", 1) for n in (columns, rows)]
    small += [n.compare("<=", SMALL) for n in (columns, rows)]
    touched = touched.where(reduce(eight.builder.and_, small), 0)
    across, down = x0 | (x1 << FIELD), y0 | (y1 << FIELD)
    footprints = across.longs() | (down.longs() << 2 * FIELD) | (touched.longs() << 4 * FIELD)
    there = eight.builder.and_(columns.compare(">", 0), rows.compare(">", 0))
    return footprints, there


def _tile_range(centre: Lanes, reach: Lanes, size: Lanes) -> tuple[Integers, Integers]:
    """Half-open range of the tiles with pixel centres within ``reach`` [px] of a centre."""
    first = (centre - (reach + SLACK) - 0.5).at_least(0.0)
    last = (centre + (reach + SLACK) - 0.5).at_most(size - 1.0)
    return (first * PER_TILE).floor().integers(), (last * PER_TILE).floor().integers() + 1


def _row_columns(
    eight: Planes, row: Integers, columns: tuple[Integers, Integers]
) -> tuple[Integers, Integers]:
    """Range of tile columns where the ellipses meet pixel centres of a row of tiles."""
    first, last = columns
    top = row.floats() * TILE + 0.5 - eight.load(MEAN_Y)
    centre, tip = eight.load(MEAN_X) - 0.5, eight.load(TIP_Y)
    right = (centre + _side_reach(eight, top, tip, 1) + SLACK) * PER_TILE
    left = (centre + _side_reach(eight, top, -tip, -1) - SLACK) * PER_TILE
    left_column = left.at_least(first.floats()).floor().integers()
    right_column = right.at_most(last.floats()).floor().integers() + 1
    return left_column, right_column.where(right_column.compare("<", last), last)


def _side_reach(eight: Planes, top: Lanes, tip: Lanes, side: int) -> Lanes:
    """Outermost dx of the ellipses on one side (±1) within the row of tiles starting at ``top``."""
    reach = eight.load(EXTENT_Y)
    dy = tip.at_least(top).at_most(top + (TILE - 1)).at_least(-reach).at_most(reach)
    room = (-(dy * dy)).fused(eight.load(FALLOFF), -eight.load(LEVEL) + EXPONENT_LIMIT)
    half = room.at_least(0.0).root() / eight.load(SHARPNESS)
    return dy.fused(eight.load(SLOPE), half if side > 0 else -half)


@inlined()
def in_one_tile(footprint: Any) -> Any:
    """Whether the bounding box is a single tile."""
    columns = ((footprint >> FIELD) - footprint) & FIELD_MASK
    rows = ((footprint >> 3 * FIELD) - (footprint >> 2 * FIELD)) & FIELD_MASK
    return columns == 1 and rows == 1


@inlined()
def only_tile(footprint: Any, tiles_x: Any) -> Any:
    """Index of the tile of a footprint with a single tile."""
    return ((footprint >> 2 * FIELD) & FIELD_MASK) * tiles_x + (footprint & FIELD_MASK)


@inlined()
def tile_rows(footprint: Any) -> Any:
    """Range of tile rows."""
    return (footprint >> 2 * FIELD) & FIELD_MASK, (footprint >> 3 * FIELD) & FIELD_MASK


@inlined()
def tile_columns(values: Any, footprint: Any, index: Any, row: Any) -> Any:
    """Range of tile columns where record ``index`` may touch pixels of a row of tiles."""
    first, last = footprint & FIELD_MASK, (footprint >> FIELD) & FIELD_MASK
    top, bottom = tile_rows(footprint)
    if last - first == 1 or bottom - top == 1:
        return first, last
    if last - first > SMALL or bottom - top > SMALL:
        return ellipse_columns(values[index], row, first, last)
    bits = np.uint64(footprint >> (4 * FIELD + (row - top) * SMALL)) & np.uint64(ROW_MASK)
    place = bits << np.uint64(2)
    left = np.int64((LOWEST_BITS >> place) & np.uint64(15))
    return first + left, first + np.int64((BIT_LENGTHS >> place) & np.uint64(15))


@inlined()
def ellipse_columns(record: Any, row: Any, first: Any, last: Any) -> Any:
    """Range within [first, last) of tile columns where the ellipse meets pixel centres of a row."""
    y0 = F32(row * TILE) + HALF - record[MEAN_Y]
    y1 = y0 + F32(TILE - 1)
    centre = record[MEAN_X] - HALF
    right = (centre + side_reach(record, y0, y1, record[TIP_Y], ONE) + SLACK) * PER_TILE
    left = (centre + side_reach(record, y0, y1, -record[TIP_Y], -ONE) - SLACK) * PER_TILE
    first = max(first, np.int64(math.floor(max(left, ZERO))))
    return first, min(last, np.int64(math.floor(min(right, F32(last)))) + 1)


@inlined()
def side_reach(record: Any, y0: Any, y1: Any, tip: Any, side: Any) -> Any:
    """Outermost dx of the ellipse on one side (``side`` = ±1) for dy in [y0, y1]."""
    dy = min(max(tip, y0), y1)
    dy = min(max(dy, -record[EXTENT_Y]), record[EXTENT_Y])
    room = max(LIMIT - record[LEVEL] - record[FALLOFF] * dy * dy, ZERO)
    return record[SLOPE] * dy + side * math.sqrt(room) / record[SHARPNESS]


# Projection of a cluster


TWO = F32(2)
FIELDS = tuple(
    field for field in range(RECORD) if field not in {RED, GREEN, BLUE, INSTANCE, MEMBER}
)
"""Fields of a record that are copied from the planes."""
FASTMATH = {"contract", "nsz", "arcp"}


@kernel(parallel=PARALLEL_LOOPS, fastmath=FASTMATH)
def project_cluster(cluster, view, base, chunks, records):
    """Write records of the potentially visible Gaussians of a Cluster.

    Args:
        view: CameraParameters.
        base: first record of this cluster, a multiple of CHUNK.
        chunks: [K] int64, indices of the chunks to project.
        records: Records; K regions starting at ``base`` are written.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    values, footprints = records.values, records.footprints
    depths, counts = records.depths, records.counts
    for k in prange(chunks.shape[0]):
        first, start = base + k * CHUNK, chunks[k] * CHUNK
        planes = np.empty(PROJECTION * LANES, np.float32)
        found = np.empty(LANES, np.int64)
        counts[first // CHUNK] = project_chunk(
            cluster, view, start, planes, found, values, footprints, depths, first
        )


@kernel(fastmath=FASTMATH)
def project_small_cluster(cluster, view, base, chunks, records):
    """Like project_cluster for a single chunk, without threads, whose start would take longer."""
    values, footprints, depths = records.values, records.footprints, records.depths
    start = chunks[0] * CHUNK
    planes = np.empty(PROJECTION * LANES, np.float32)
    found = np.empty(LANES, np.int64)
    records.counts[base // CHUNK] = project_chunk(
        cluster, view, start, planes, found, values, footprints, depths, base
    )


@inlined(fastmath=FASTMATH)
def project_chunk(cluster, view, start, planes, found, values, footprints, depths, first):
    """Write the records of CHUNK Gaussians starting at ``start`` to the region at ``first``.

    Args:
        planes, found: work space, see the module and footprints_of_eight.

    Returns:
        Number of records written.
    """
    slot = first
    stop = min(cluster.means.shape[0], start + CHUNK)
    for eight in range(start, stop, LANES):
        lanes = project_eight(cluster, view, eight, min(stop - eight, LANES), planes, found)
        while lanes != 0:
            lane = lowest_bit(lanes)
            lanes &= lanes - 1
            out = values[slot]
            for field in FIELDS:
                out[field] = planes[field * LANES + lane]
            out[INSTANCE] = cluster.instance_id
            out[MEMBER] = F32(eight + lane - start)
            write_color(cluster, eight + lane, out)
            footprints[slot] = found[lane]
            depths[slot] = out[DEPTH]
            slot += 1
    return slot - first


@inlined()
def project_eight(cluster, view, first, count, planes, found):
    """Project ``count`` Gaussians starting at ``first``; returns bits of those to record."""
    gather_eight(cluster, first, count, planes)
    lanes = np.int64((1 << count) - 1)
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
    return lanes


@inlined()
def gather_eight(cluster, first, count, planes):
    """Gather ``count`` Gaussians into the planes."""
    for lane in range(count):
        gather_lane(cluster, first + lane, lane, planes)


@inlined()
def gather_lane(cluster, i, lane, planes):
    """Gather Gaussian ``i`` into a lane of the planes."""
    for k in range(3):
        planes[(MEAN + k) * LANES + lane] = cluster.means[i, k]
    planes[OPACITY * LANES + lane] = cluster.opacities[i]
    gather_shape(cluster, i, SHAPE, lane, planes)


@inlined()
def gather_shape(cluster, i, first, lane, planes):
    """Gather the shape of Gaussian ``i`` into a lane of the planes starting at ``first``.

    The shape is the upper half of its covariance by rows, or quaternion and scales if the cluster
    has no covariances.
    """
    if cluster.covars.shape[0] > 0:
        covar, plane = cluster.covars[i], first * LANES + lane
        for row in range(3):
            for column in range(row, 3):
                planes[plane] = covar[row, column]
                plane += LANES
    else:
        for k in range(4):
            planes[(first + k) * LANES + lane] = cluster.quats[i, k]
        for k in range(3):
            planes[(first + 4 + k) * LANES + lane] = cluster.scales[i, k]


@inlined(fastmath=FASTMATH)
def write_color(cluster, i, out):
    """Evaluate the spherical harmonics of Gaussian ``i`` as seen by the camera (Sloan 2013)."""
    sh = cluster.sh[i]
    bands = cluster.sh.shape[1]
    c0 = F32(0.2820947917738781)
    r, g, b = sh[0, 0], sh[0, 1], sh[0, 2]
    for k in range(cluster.tones.shape[0]):
        tone = cluster.tones[k]
        r += tone * cluster.coefficients[i, k, 0]
        g += tone * cluster.coefficients[i, k, 1]
        b += tone * cluster.coefficients[i, k, 2]
    r, g, b = c0 * r + HALF, c0 * g + HALF, c0 * b + HALF
    if bands > 1:
        x = cluster.scale[0] * cluster.means[i, 0] - cluster.camera_position[0]
        y = cluster.scale[1] * cluster.means[i, 1] - cluster.camera_position[1]
        z = cluster.scale[2] * cluster.means[i, 2] - cluster.camera_position[2]
        inverse = ONE / math.sqrt(max(x * x + y * y + z * z, F32(1e-24)))
        x, y, z = x * inverse, y * inverse, z * inverse
        c1 = F32(0.48860251190292)
        r, g, b = add_band(r, g, b, sh, 1, -c1 * y)
        r, g, b = add_band(r, g, b, sh, 2, c1 * z)
        r, g, b = add_band(r, g, b, sh, 3, -c1 * x)
        if bands > 4:
            c2 = F32(1.092548430592079)
            r, g, b = add_band(r, g, b, sh, 4, c2 * x * y)
            r, g, b = add_band(r, g, b, sh, 5, -c2 * y * z)
            r, g, b = add_band(
                r, g, b, sh, 6, F32(0.9461746957575601) * z * z - F32(0.3153915652525201)
            )
            r, g, b = add_band(r, g, b, sh, 7, -c2 * x * z)
            r, g, b = add_band(r, g, b, sh, 8, F32(0.5462742152960395) * (x * x - y * y))
            if bands > 9:
                r, g, b = add_cubic(r, g, b, sh, x, y, z)
    out[RED], out[GREEN], out[BLUE] = max(r, ZERO), max(g, ZERO), max(b, ZERO)


@inlined(fastmath=FASTMATH)
def add_cubic(r, g, b, sh, x, y, z):
    """Add the seven functions of degree 3."""
    five, three = F32(5) * z * z - ONE, F32(3)
    c3, c5 = F32(-0.5900435899266435), F32(-0.4570457994644658)
    r, g, b = add_band(r, g, b, sh, 9, c3 * y * (three * x * x - y * y))
    r, g, b = add_band(r, g, b, sh, 10, F32(2.890611442640554) * x * y * z)
    r, g, b = add_band(r, g, b, sh, 11, c5 * y * five)
    r, g, b = add_band(r, g, b, sh, 12, F32(0.3731763325901154) * z * (five - TWO))
    r, g, b = add_band(r, g, b, sh, 13, c5 * x * five)
    r, g, b = add_band(r, g, b, sh, 14, F32(1.445305721320277) * z * (x * x - y * y))
    return add_band(r, g, b, sh, 15, c3 * x * (x * x - three * y * y))


@inlined(fastmath=FASTMATH)
def add_band(r, g, b, sh, k, basis):
    """Colour plus coefficient ``k`` times its basis function."""
    return r + basis * sh[k, 0], g + basis * sh[k, 1], b + basis * sh[k, 2]
