"""Projection of one cluster of Gaussians onto the image of a camera with a lens.

Like :mod:`.project`, with the steps of :mod:`.ray_lanes`. The visible outline bounds the pixels
that a large Gaussian may touch.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import functools
import math

import numpy as np
from numba import prange

from ..._numba import PARALLEL_LOOPS, func
from ..lens import CELLS
from .lanes import LANES, inlined, kernel, lowest_bit
from .project import FIELDS, MEAN, OPACITY, SHAPE, footprints_of_eight, gather_shape, write_color
from .ray_lanes import (
    AXES,
    CENTRE,
    LARGE,
    RAY_PROJECTION,
    REACH,
    ROOT,
    SECOND,
    WAY,
    axes_of_eight,
    place_moving,
    place_still,
    see_moving,
    see_still,
    shape_moving,
    shape_still,
)
from .records import (
    CHUNK,
    DEPTH,
    EXPONENT_LIMIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    MEMBER,
    RAY_RECORD,
    RECORD,
    SHARPNESS,
    SLOPE,
    TILE,
    TIP_Y,
)

called = functools.partial(func, _nrt=False)
"""Options for functions that the compiler may inline or call: the work outweighs a call."""
F32 = np.float32
OUTLINE = 24
"""Number of points on the outline of a large Gaussian."""
COSINES = np.cos(2 * np.pi * np.arange(OUTLINE) / OUTLINE)
SINES = np.sin(2 * np.pi * np.arange(OUTLINE) / OUTLINE)


@kernel(parallel=PARALLEL_LOOPS)
def project_rays(cluster, view, base, chunks, records):
    """Write records of the potentially visible Gaussians of a Cluster.

    Args:
        view: RayParameters.
        base: first record of this cluster, a multiple of CHUNK.
        chunks: [K] int64, indices of the chunks to project.
        records: Records of RAY_RECORD values each; K regions starting at ``base`` are written.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    values, footprints = records.values, records.footprints
    depths, counts = records.depths, records.counts
    for k in prange(chunks.shape[0]):
        planes = np.empty(RAY_PROJECTION * LANES, np.float32)
        found = np.empty(LANES, np.int64)
        first, start = base + k * CHUNK, chunks[k] * CHUNK
        slot, stop = first, min(cluster.means.shape[0], start + CHUNK)
        for eight in range(start, stop, LANES):
            lanes = project_eight(cluster, view, eight, min(stop - eight, LANES), planes, found)
            while lanes != 0:
                lane = lowest_bit(lanes)
                lanes &= lanes - 1
                out = values[slot]
                for field in FIELDS:
                    out[field] = planes[field * LANES + lane]
                for field in range(RECORD, RAY_RECORD):
                    out[field] = planes[(SECOND + field - RECORD) * LANES + lane]
                out[INSTANCE] = cluster.instance_id
                out[MEMBER] = F32(eight + lane - start)
                color_of(cluster, eight + lane, out)
                footprints[slot] = found[lane]
                depths[slot] = out[DEPTH]
                slot += 1
        counts[first // CHUNK] = slot - first


@called
def color_of(cluster, i, out):
    """Write the colour of a record."""
    write_color(cluster, i, out)


@inlined()
def project_eight(cluster, view, first, count, planes, found):
    """Project ``count`` Gaussians starting at ``first``; returns bits of those to record."""
    gather(cluster, first, count, planes)
    lanes = np.int64((1 << count) - 1)
    if view.rolls:
        lanes = place_moving(planes, lanes, view, cluster)
        if lanes != 0:
            lanes = see_moving(planes, lanes, view, cluster)
    else:
        lanes = place_still(planes, lanes, view, cluster)
        if lanes != 0:
            lanes = see_still(planes, lanes, view, cluster)
    if lanes == 0:
        return lanes
    if cluster.covars.shape[0] == 0:
        axes_of_eight(planes, lanes, view, cluster)
    if view.rolls:
        lanes = shape_moving(planes, lanes, view, cluster)
    else:
        lanes = shape_still(planes, lanes, view, cluster)
    lanes = bound_large_ones(view, lanes, planes)
    return footprints_of_eight(planes, lanes, view, found) if lanes != 0 else lanes


@inlined()
def gather(cluster, first, count, planes):
    """Gather ``count`` Gaussians into the planes.

    Deformed Gaussians have a Cholesky factor of their covariance, and an upper bound as scales.
    """
    for lane in range(count):
        i = first + lane
        for k in range(3):
            planes[(MEAN + k) * LANES + lane] = cluster.means[i, k]
        planes[OPACITY * LANES + lane] = cluster.opacities[i]
        if cluster.covars.shape[0] > 0:
            root_of(cluster.covars[i], lane, planes)
        else:
            gather_shape(cluster, i, SHAPE, lane, planes)


@called
def root_of(covar, lane, planes):
    """Write the Cholesky factor of a covariance to a lane of the planes."""
    xx, xy, xz = np.float64(covar[0, 0]), np.float64(covar[0, 1]), np.float64(covar[0, 2])
    yy, yz, zz = np.float64(covar[1, 1]), np.float64(covar[1, 2]), np.float64(covar[2, 2])
    least = 1e-14 * (xx + yy + zz)
    a = math.sqrt(max(xx, least))
    b, c = xy / a, xz / a
    d = math.sqrt(max(yy - b * b, least))
    e = (yz - b * c) / d
    f = math.sqrt(max(zz - c * c - e * e, least))
    for k, value in enumerate((a, b, c, 0.0, d, e, 0.0, 0.0, f)):
        planes[(AXES + k) * LANES + lane] = F32(value)
    for k in range(3):
        planes[(SHAPE + 4 + k) * LANES + lane] = F32(math.sqrt(xx + yy + zz))


@inlined()
def bound_large_ones(view, lanes, planes):
    """Bound the LARGE Gaussians; returns bits of all lanes that meet the image."""
    remaining = lanes
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        if planes[LARGE * LANES + lane] > 0 and not bound_large(view, lane, planes):
            remaining &= ~(np.int64(1) << lane)
    return remaining


@called
def bound_large(view, lane, planes):
    """Write an ellipse around the box of the outline; returns whether it meets the image."""
    centre, way = vector_of(planes, CENTRE, lane), vector_of(planes, WAY, lane)
    low, high = vector_of(planes, ROOT, lane), vector_of(planes, ROOT + 3, lane)
    root = (low[0], low[1], low[2], high[0], high[1], high[2])
    reach = np.float64(planes[REACH * LANES + lane])
    if not view.rolls:
        way = (0.0, 0.0, 0.0)
    left, top, right, bottom = 1e30, 1e30, -1e30, -1e30
    for moment in range(3 if view.rolls else 1):
        time = 0.5 * (moment - 1) if view.rolls else 0.0
        a, b, c, d = outline(view, centre, way, root, reach, time)
        left, top, right, bottom = min(left, a), min(top, b), max(right, c), max(bottom, d)
    margin = 0.03 * max(right - left, bottom - top) + view.slack + 2.0
    left, right = max(left - margin, -TILE), min(right + margin, view.width + TILE)
    top, bottom = max(top - margin, -TILE), min(bottom + margin, view.height + TILE)
    half_x, half_y = (right - left) / 2, (bottom - top) / 2
    if not (half_x > 0 and half_y > 0):
        return False
    room = EXPONENT_LIMIT - planes[LEVEL * LANES + lane]
    planes[MEAN_X * LANES + lane] = F32((left + right) / 2)
    planes[MEAN_Y * LANES + lane] = F32((top + bottom) / 2)
    planes[SHARPNESS * LANES + lane] = F32(math.sqrt(room / 2) / half_x)
    planes[SLOPE * LANES + lane] = F32(0)
    planes[FALLOFF * LANES + lane] = F32(room / 2 / (half_y * half_y))
    planes[EXTENT_X * LANES + lane], planes[EXTENT_Y * LANES + lane] = F32(half_x), F32(half_y)
    planes[TIP_Y * LANES + lane] = F32(0)
    return True


@inlined()
def vector_of(planes, first, lane):
    """Three numbers of a lane, from plane ``first``."""
    return (
        np.float64(planes[first * LANES + lane]),
        np.float64(planes[(first + 1) * LANES + lane]),
        np.float64(planes[(first + 2) * LANES + lane]),
    )


@called
def outline(view, centre, way, root, reach, time):
    """Bounding box of the Gaussian's outline at ``time``: left, top, right, bottom [px].

    In the space where the Gaussian is a sphere of radius ``reach``, the outline is a circle.
    """
    turn = see_at(view, time, centre, way)[0]
    moved = (centre[0] + time * way[0], centre[1] + time * way[1], centre[2] + time * way[2])
    o = whitened(root, moved)
    square = dot(o, o)
    if square <= reach * reach * 1.02 or behind_is_inside(turn, root, reach, o):
        return -1e30, -1e30, 1e30, 1e30
    length = math.sqrt(square)
    a, b, c = o[0] / length, o[1] / length, o[2] / length
    u = (0.0, -c, b) if abs(a) < 0.6 else (-b, a, 0.0)
    norm = 1 / length_of(u)
    ux, uy, uz = u[0] * norm, u[1] * norm, u[2] * norm
    vx, vy, vz = b * uz - c * uy, c * ux - a * uz, a * uy - b * ux
    along = length - reach * reach / length
    radius = reach * math.sqrt(1 - reach * reach / square)
    left, top, right, bottom = 1e30, 1e30, -1e30, -1e30
    for k in range(OUTLINE):
        cosine = radius * COSINES[k]
        sine = radius * SINES[k]
        x = (along * a + cosine * ux + sine * vx) / root[0]
        y = (along * b + cosine * uy + sine * vy - root[1] * x) / root[2]
        z = (along * c + cosine * uz + sine * vz - root[3] * x - root[4] * y) / root[5]
        point = (x, y, z)
        place = look_up(view, (dot(turn[0], point), dot(turn[1], point), dot(turn[2], point)))
        left, right = min(left, place[0]), max(right, place[0])
        top, bottom = min(top, place[1]), max(bottom, place[1])
    return left, top, right, bottom


@called
def see_at(view, time, centre, way):
    """Rotation into the camera frame at ``time``, by rows, and the centre in that frame."""
    rx, ry, rz = -time * view.turn[0], -time * view.turn[1], -time * view.turn[2]
    square = rx * rx + ry * ry + rz * rz
    # Rodrigues' formula as a series: rotations within an image are small, and divisions are slow.
    s = 1 - square / 6 * (1 - square / 20)
    c = 0.5 - square / 24 * (1 - square / 30)
    turn = (
        (1 - c * (ry * ry + rz * rz), c * rx * ry - s * rz, c * rx * rz + s * ry),
        (c * rx * ry + s * rz, 1 - c * (rx * rx + rz * rz), c * ry * rz - s * rx),
        (c * rx * rz - s * ry, c * ry * rz + s * rx, 1 - c * (rx * rx + ry * ry)),
    )
    moved = (centre[0] + time * way[0], centre[1] + time * way[1], centre[2] + time * way[2])
    return turn, (dot(turn[0], moved), dot(turn[1], moved), dot(turn[2], moved))


@called
def look_up(view, seen):
    """Image position of a direction; see LensTables."""
    face, u, v = face_of(seen)
    column = min(max((u + 1) * (0.5 * CELLS), 0.0), CELLS - 1e-9)
    row = min(max((v + 1) * (0.5 * CELLS), 0.0), CELLS - 1e-9)
    i, j = np.uint64(column), np.uint64(row)
    a, b = column - i, row - j
    near, far = (1 - a) * (1 - b), a * b
    first, last = a * (1 - b), (1 - a) * b
    zero, one = np.uint64(0), np.uint64(1)
    p, q = view.directory[face, i, j], view.directory[face, i + one, j]
    r, s = view.directory[face, i, j + one], view.directory[face, i + one, j + one]
    return (
        p[zero] * near + q[zero] * first + r[zero] * last + s[zero] * far,
        p[one] * near + q[one] * first + r[one] * last + s[one] * far,
    )


@inlined()
def face_of(seen):
    """Index of the directory face, and coordinates on it."""
    x, y, z = seen
    ax, ay, az = abs(x), abs(y), abs(z)
    if az >= ax and az >= ay:
        scale = 1 / max(az, 1e-300)
        return np.uint64(4 if z > 0 else 5), x * scale, y * scale
    if ax >= ay:
        scale = 1 / ax
        return np.uint64(0 if x > 0 else 1), y * scale, z * scale
    scale = 1 / ay
    return np.uint64(2 if y > 0 else 3), z * scale, x * scale


@called
def behind_is_inside(turn, root, reach, o):
    """Whether the outline contains the direction straight behind the camera."""
    d = whitened(root, (-turn[2][0], -turn[2][1], -turn[2][2]))
    along = dot(o, d)
    beside = dot(o, o) - along * along / dot(d, d)
    return along > 0 and beside <= reach * reach * 1.05


@inlined()
def whitened(root, point):
    """A point in the space where the Gaussian is a unit sphere."""
    x, y, z = point
    return (
        root[0] * x,
        root[1] * x + root[2] * y,
        root[3] * x + root[4] * y + root[5] * z,
    )


@inlined()
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined()
def length_of(vector):
    """Euclidean length."""
    return math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
