"""Projection of one cluster of Gaussians onto the image of a camera with a lens.

Which pixels a Gaussian may touch is bounded: small ones by the ellipse of the lens's derivative,
enlarged by what lens and perspective bend over their extent; large ones by the outline that the
camera sees. What is exact is the map that turns the Gaussian into a unit sphere, by which rays
decide.
"""

# Kernels take arrays by position, and Numba knows neither dataclasses nor keyword-only ones.
# ruff: noqa: PLR0917

from __future__ import annotations

import functools
import math

import numpy as np
from numba import prange

from ...._numba import PARALLEL_LOOPS, func
from ...lens_view import CELLS
from ..base import ALPHA_MIN
from .footprint import FIELD, SLACK, SMALL, ellipse_columns
from .kernel import inlined, kernel
from .project import write_color
from .project_lanes import LOG_255, REACH_MAX
from .ray_records import DRIFT, FRAME, ORIGIN, SQUARE, WHITENING
from .records import (
    CHUNK,
    DEPTH,
    EXPONENT_UNIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    MEMBER,
    SHARPNESS,
    SLOPE,
    TILE,
    TIP_Y,
)

called = functools.partial(func, _nrt=False)
"""Left to the compiler whether it is inlined: one Gaussian takes long enough for a call."""
F32 = np.float32
ROUNDS = 2
"""In which the row of a centre and its time settle, each to some hundredths of what was left; what
is exact is left to rays."""
SMALL_ANGLE = 0.3
"""Gaussians that lens and perspective bend by less than this share are small."""
OUTLINE = 24
"""Places on the outline of a large one."""
HALF_UNIT = 0.5 / EXPONENT_UNIT
STILL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@kernel(parallel=PARALLEL_LOOPS)
def project_rays(cluster, drift, view, base, chunks, records):
    """Write records of those Gaussians of one Cluster that may be seen.

    Args:
        drift: [2, 3] float64, of the cluster over the read-out: way of its origin [m] and rotation
            vector [rad], in the camera's frame.
        view: RayParameters.
        base: first record of this cluster, a multiple of CHUNK.
        chunks: [K] int64, numbers of the chunks to look at.
        records: Records of RAY_RECORD values each, K regions from ``base`` on are written.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    values, footprints = records.values, records.footprints
    depths, counts = records.depths, records.counts
    for k in prange(chunks.shape[0]):
        first, start = base + k * CHUNK, chunks[k] * CHUNK
        slot = first
        for i in range(start, min(cluster.means.shape[0], start + CHUNK)):
            if not may_be_seen(cluster, i, drift, view):
                continue
            out = values[slot]
            if project_gaussian(cluster, i, drift, view, out):
                footprint = footprint_of(out, view)
                if footprint >= 0:
                    out[INSTANCE] = cluster.instance_id
                    out[MEMBER] = F32(i - start)
                    color_of(cluster, i, out)
                    footprints[slot] = footprint
                    depths[slot] = out[DEPTH]
                    slot += 1
        counts[first // CHUNK] = slot - first


@called
def color_of(cluster, i, out):
    """Write the colour of a record."""
    write_color(cluster, i, out)


@inlined()
def may_be_seen(cluster, i, drift, view):
    """Whether a ball about Gaussian ``i`` comes into the cone of all rays."""
    if not cluster.opacities[i] >= ALPHA_MIN:
        return False
    (x, y, z), (u, v, w) = place_centre(cluster, i, drift, view)
    beside = math.sqrt(x * x + y * y)
    radius = REACH_MAX * largest_sigma(cluster, i)
    if view.rolls:
        radius += 0.5 * (abs(u) + abs(v) + abs(w)) + view.turned * (beside + abs(z))
    return beside * view.cosine - z * view.sine <= radius


@inlined()
def largest_sigma(cluster, i):
    """Upper bound of the standard deviation along any direction [m]."""
    if cluster.covars.shape[0] > 0:
        trace = cluster.covars[i, 0, 0] + cluster.covars[i, 1, 1] + cluster.covars[i, 2, 2]
        sigma = math.sqrt(np.float64(trace))
    else:
        sigma = np.float64(max(cluster.scales[i, 0], cluster.scales[i, 1], cluster.scales[i, 2]))
    return sigma * max(cluster.scale[0], cluster.scale[1], cluster.scale[2])


@inlined()
def is_beside_image(view, place, seen, share, distance):
    """Whether a small ball about the centre, of half-angle ``share``, is far beside the image."""
    if share * (1 + view.bend) >= SMALL_ANGLE:
        return False
    largest = max(abs(seen[0]), abs(seen[1]), abs(seen[2]))
    # Coordinates on a face change with angles by at most the square of this.
    steep = distance / largest
    reach = share / (1 - share) * (1 + view.bend) * steep * steep
    edge = 3.4 * math.sqrt(view.eps2d) + 2.0 + view.slack
    reach_x = reach * (abs(place[2]) + abs(place[3])) + edge
    reach_y = reach * (abs(place[4]) + abs(place[5])) + edge
    if place[0] + reach_x < 0 or place[0] - reach_x > view.width:
        return True
    return place[1] + reach_y < 0 or place[1] - reach_y > view.height


@inlined()
def place_centre(cluster, i, drift, view):
    """Centre and way over the read-out of a Gaussian, in the camera's frame in the middle."""
    m0, m1 = np.float64(cluster.means[i, 0]), np.float64(cluster.means[i, 1])
    m2, m = np.float64(cluster.means[i, 2]), cluster.linear
    a = m[0, 0] * m0 + m[0, 1] * m1 + m[0, 2] * m2
    b = m[1, 0] * m0 + m[1, 1] * m1 + m[1, 2] * m2
    c = m[2, 0] * m0 + m[2, 1] * m1 + m[2, 2] * m2
    wx, wy, wz = drift[1, 0], drift[1, 1], drift[1, 2]
    way = (
        drift[0, 0] + wy * c - wz * b - view.shift[0],
        drift[0, 1] + wz * a - wx * c - view.shift[1],
        drift[0, 2] + wx * b - wy * a - view.shift[2],
    )
    return (a + cluster.offset[0], b + cluster.offset[1], c + cluster.offset[2]), way


@inlined()
def project_gaussian(cluster, i, drift, view, out):
    """Write the record of Gaussian ``i``; whether it may be seen."""
    centre, way = place_centre(cluster, i, drift, view)
    turn, seen = STILL, centre
    place = look_up(view, seen)
    if view.rolls:
        for _ in range(ROUNDS):
            turn, seen = see_at(view, line_time(view, place), centre, way)
            place = look_up(view, seen)
    distance = length_of(seen)
    depth = distance if view.ranges else seen[2]
    if not (view.near_plane <= depth <= view.far_plane):
        return False
    if is_beside_image(
        view, place, seen, REACH_MAX * largest_sigma(cluster, i) / distance, distance
    ):
        return False
    sigma = covariance(cluster, i)
    radius = math.sqrt(sigma[0] + sigma[2] + sigma[5])
    across, down = image_axes(seen, place, turn)
    sharp = image_covariance(sigma, across, down)
    opacity = np.float64(cluster.opacities[i])
    if view.antialiased:
        opacity *= kept_opacity(sharp, view.eps2d)
        if not opacity >= ALPHA_MIN:
            return False
    level = -math.log(opacity)
    reach = math.sqrt(2 * max(LOG_255 - level, 0.0))
    share = reach * radius / distance
    out[DEPTH], out[LEVEL] = F32(depth), F32(level / EXPONENT_UNIT)
    root = inverse_root(blurred(sigma, centre, across, down, view.eps2d), distance)
    if share * (1 + view.bend) < SMALL_ANGLE:
        if view.rolls:
            sharp = rolled(view, sharp, across, down, centre, way)
        found = bound_small(view, place, sharp, share, reach, out)
    else:
        found = bound_large(view, centre, way, root, reach, level, out)
    if found:
        if view.rolls:
            write_moving(root, centre, way, out)
        else:
            write_still(root, centre, out)
    return found


@inlined()
def length_of(vector):
    """Euclidean length."""
    return math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


@inlined()
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined()
def line_time(view, place):
    """When the row or column of an image position is taken, -0.5 to 0.5."""
    if view.by_row:
        share = (place[1] - 0.5) / max(view.height - 1, 1.0)
    else:
        share = (place[0] - 0.5) / max(view.width - 1, 1.0)
    share = min(max(share, 0.0), 1.0) - 0.5
    return share if view.forward else -share


@called
def see_at(view, time, centre, way):
    """The turn into the camera's frame at ``time``, by rows, and where the centre is in it."""
    rx, ry, rz = -time * view.turn[0], -time * view.turn[1], -time * view.turn[2]
    square = rx * rx + ry * ry + rz * rz
    # Rodrigues; series serve better than divisions, since turns within an image are small.
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
    """Image position of a direction, and its derivatives by face coordinates; see LensTables."""
    face, u, v = face_of(seen)
    column = min(max((u + 1) * (0.5 * CELLS), 0.0), CELLS - 1e-9)
    row = min(max((v + 1) * (0.5 * CELLS), 0.0), CELLS - 1e-9)
    i, j = np.uint64(column), np.uint64(row)
    a, b = column - i, row - j
    near, far = (1 - a) * (1 - b), a * b
    first, last = a * (1 - b), (1 - a) * b
    one, two = np.uint64(1), np.uint64(2)
    three, four, five = np.uint64(3), np.uint64(4), np.uint64(5)
    p, q = view.directory[face, i, j], view.directory[face, i + one, j]
    r, s = view.directory[face, i, j + one], view.directory[face, i + one, j + one]
    zero = np.uint64(0)
    return (
        p[zero] * near + q[zero] * first + r[zero] * last + s[zero] * far,
        p[one] * near + q[one] * first + r[one] * last + s[one] * far,
        p[two] * near + q[two] * first + r[two] * last + s[two] * far,
        p[three] * near + q[three] * first + r[three] * last + s[three] * far,
        p[four] * near + q[four] * first + r[four] * last + s[four] * far,
        p[five] * near + q[five] * first + r[five] * last + s[five] * far,
    )


@inlined()
def face_of(seen):
    """Number of the face of the directory, and coordinates on it."""
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
def covariance(cluster, i):
    """Covariance (xx, xy, yy, xz, yz, zz) [m^2] in the camera's frame in the middle."""
    m = cluster.linear
    if cluster.covars.shape[0] > 0:
        shape = cluster.covars[i]
        xx, xy, xz = np.float64(shape[0, 0]), np.float64(shape[0, 1]), np.float64(shape[0, 2])
        yy, yz, zz = np.float64(shape[1, 1]), np.float64(shape[1, 2]), np.float64(shape[2, 2])
        rows = (
            (m[0, 0], m[0, 1], m[0, 2]),
            (m[1, 0], m[1, 1], m[1, 2]),
            (m[2, 0], m[2, 1], m[2, 2]),
        )
        c0, c1, c2 = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        px = (dot(c0, rows[0]), dot(c1, rows[0]), dot(c2, rows[0]))
        py = (dot(c0, rows[1]), dot(c1, rows[1]), dot(c2, rows[1]))
        pz = (dot(c0, rows[2]), dot(c1, rows[2]), dot(c2, rows[2]))
        return (
            dot(px, rows[0]),
            dot(px, rows[1]),
            dot(py, rows[1]),
            dot(px, rows[2]),
            dot(py, rows[2]),
            dot(pz, rows[2]),
        )
    w, x = np.float64(cluster.quats[i, 0]), np.float64(cluster.quats[i, 1])
    y, z = np.float64(cluster.quats[i, 2]), np.float64(cluster.quats[i, 3])
    n = 2 / (w * w + x * x + y * y + z * z)
    s0, s1 = np.float64(cluster.scales[i, 0]), np.float64(cluster.scales[i, 1])
    s2 = np.float64(cluster.scales[i, 2])
    a0, a1 = (1 - n * (y * y + z * z)) * s0, n * (x * y + w * z) * s0
    a2, b0 = n * (x * z - w * y) * s0, n * (x * y - w * z) * s1
    b1, b2 = (1 - n * (x * x + z * z)) * s1, n * (y * z + w * x) * s1
    c0, c1 = n * (x * z + w * y) * s2, n * (y * z - w * x) * s2
    c2 = (1 - n * (x * x + y * y)) * s2
    axes = ((a0, a1, a2), (b0, b1, b2), (c0, c1, c2))
    first, second, third = (
        (m[0, 0], m[0, 1], m[0, 2]),
        (m[1, 0], m[1, 1], m[1, 2]),
        (m[2, 0], m[2, 1], m[2, 2]),
    )
    p = (dot(first, axes[0]), dot(first, axes[1]), dot(first, axes[2]))
    q = (dot(second, axes[0]), dot(second, axes[1]), dot(second, axes[2]))
    r = (dot(third, axes[0]), dot(third, axes[1]), dot(third, axes[2]))
    return dot(p, p), dot(p, q), dot(q, q), dot(p, r), dot(q, r), dot(r, r)


@called
def image_axes(seen, place, turn):
    """Rows of the derivative of image positions [px/m], in the camera's frame in the middle."""
    face, u, v = face_of(seen)
    scale = 1 / max(abs(seen[0]), abs(seen[1]), abs(seen[2]))
    along = 1.0 if face % np.uint64(2) == 0 else -1.0
    xu, xv, yu, yv = place[2] * scale, place[3] * scale, place[4] * scale, place[5] * scale
    xm, ym = -along * (u * xu + v * xv), -along * (u * yu + v * yv)
    axis = face // np.uint64(2)
    if axis == 2:
        across, down = (xu, xv, xm), (yu, yv, ym)
    elif axis == 0:
        across, down = (xm, xu, xv), (ym, yu, yv)
    else:
        across, down = (xv, xm, xu), (yv, ym, yu)
    return turned_back(turn, across), turned_back(turn, down)


@inlined()
def turned_back(turn, row):
    """A row times the turn."""
    return (
        row[0] * turn[0][0] + row[1] * turn[1][0] + row[2] * turn[2][0],
        row[0] * turn[0][1] + row[1] * turn[1][1] + row[2] * turn[2][1],
        row[0] * turn[0][2] + row[1] * turn[1][2] + row[2] * turn[2][2],
    )


@inlined()
def image_covariance(sigma, across, down):
    """Covariance xx, xy, yy [px^2] on the image, without blur."""
    xx, xy, yy, xz, yz, zz = sigma
    p = (dot((xx, xy, xz), across), dot((xy, yy, yz), across), dot((xz, yz, zz), across))
    q = (dot((xx, xy, xz), down), dot((xy, yy, yz), down), dot((xz, yz, zz), down))
    return dot(p, across), dot(p, down), dot(q, down)


@inlined()
def kept_opacity(sharp, eps2d):
    """Share of the opacity that a blur by ``eps2d`` leaves."""
    xx, xy, yy = sharp
    wide = (xx + eps2d) * (yy + eps2d) - xy * xy
    return math.sqrt(max(xx * yy - xy * xy, 0.0) / wide) if wide > 0 else 0.0


@called
def blurred(sigma, centre, across, down, eps2d):
    """A covariance with the blur that a pinhole adds on the image, at the Gaussian's place: the
    pixel's own extent there, J^T (J J^T)^-2 J, and about as much along the ray."""
    a, b, c = dot(across, across), dot(across, down), dot(down, down)
    determinant = max(a * c - b * b, 1e-300)
    inverse = 1 / determinant
    p, q, r = c * inverse, -b * inverse, a * inverse
    pp, pq, qq = eps2d * (p * p + q * q), eps2d * q * (p + r), eps2d * (q * q + r * r)
    # Rays are told in the frame of the middle, where the Gaussian is seen along its centre.
    deep = eps2d * math.sqrt(inverse) / dot(centre, centre)
    xx = extent(pp, pq, qq, across[0], down[0], across[0], down[0], deep * centre[0] * centre[0])
    xy = extent(pp, pq, qq, across[0], down[0], across[1], down[1], deep * centre[0] * centre[1])
    yy = extent(pp, pq, qq, across[1], down[1], across[1], down[1], deep * centre[1] * centre[1])
    xz = extent(pp, pq, qq, across[0], down[0], across[2], down[2], deep * centre[0] * centre[2])
    yz = extent(pp, pq, qq, across[1], down[1], across[2], down[2], deep * centre[1] * centre[2])
    zz = extent(pp, pq, qq, across[2], down[2], across[2], down[2], deep * centre[2] * centre[2])
    return (
        sigma[0] + xx,
        sigma[1] + xy,
        sigma[2] + yy,
        sigma[3] + xz,
        sigma[4] + yz,
        sigma[5] + zz,
    )


@inlined()
def extent(pp, pq, qq, j0, j1, k0, k1, deep):
    """One number of a pixel's extent."""
    return pp * j0 * k0 + pq * (j0 * k1 + j1 * k0) + qq * j1 * k1 + deep


@called
def inverse_root(sigma, distance):
    """Inverse of the Cholesky root of a covariance: its lower triangle by rows."""
    least = 1e-14 * distance * distance
    i0 = 1 / math.sqrt(max(sigma[0], least))
    l10, l20 = sigma[1] * i0, sigma[3] * i0
    i1 = 1 / math.sqrt(max(sigma[2] - l10 * l10, least))
    l21 = (sigma[4] - l20 * l10) * i1
    i2 = 1 / math.sqrt(max(sigma[5] - l20 * l20 - l21 * l21, least))
    w10, w21 = -l10 * i0 * i1, -l21 * i1 * i2
    return i0, w10, i1, -(l20 * i0 + l21 * w10) * i2, w21, i2


@inlined()
def whitened(root, point):
    """A point in the space where the Gaussian is a unit sphere."""
    x, y, z = point
    return (
        root[0] * x,
        root[1] * x + root[2] * y,
        root[3] * x + root[4] * y + root[5] * z,
    )


@called
def write_still(root, centre, out):
    """Write what rays from one place need: rows of a map that puts the centre on the third axis,
    and the square of its distance there."""
    o = whitened(root, centre)
    square = dot(o, o)
    inverse = 1 / math.sqrt(max(square, 1e-300))
    x, y, z = o[0] * inverse, o[1] * inverse, o[2] * inverse
    # A right-handed frame without branches (Duff et al. 2017).
    sign = 1.0 if z >= 0 else -1.0
    a = -1 / (sign + z)
    b = x * y * a
    write_row(root, (1 + sign * x * x * a, sign * b, -sign * x), FRAME, out)
    write_row(root, (b, sign + y * y * a, -y), FRAME + 3, out)
    write_row(root, (x, y, z), FRAME + 6, out)
    out[SQUARE] = F32(square * HALF_UNIT)


@inlined()
def write_row(root, axis, place, out):
    """Write the direction in the camera's frame that the map takes to ``axis``."""
    out[place] = F32(axis[0] * root[0] + axis[1] * root[1] + axis[2] * root[3])
    out[place + 1] = F32(axis[1] * root[2] + axis[2] * root[4])
    out[place + 2] = F32(axis[2] * root[5])


@called
def write_moving(root, centre, way, out):
    """Write what rays from many places need: the map, and where they start in its space."""
    for k in range(6):
        out[WHITENING + k] = F32(root[k])
    o, d = whitened(root, centre), whitened(root, way)
    out[ORIGIN], out[ORIGIN + 1], out[ORIGIN + 2] = F32(-o[0]), F32(-o[1]), F32(-o[2])
    out[DRIFT], out[DRIFT + 1], out[DRIFT + 2] = F32(-d[0]), F32(-d[1]), F32(-d[2])


@called
def bound_small(view, place, sharp, share, reach, out):
    """Write the ellipse of the derivative, enlarged; whether it meets the image.

    An ellipsoid of half-angle ``share`` shows at most 1 / (1 - share) times as large as its
    derivative, and the lens bends that by ``bend``.
    """
    grown = (1 + share * view.bend) / (1 - share)
    grown *= grown
    xx, xy, yy = (sharp[0] + view.eps2d) * grown, sharp[1] * grown, (sharp[2] + view.eps2d) * grown
    slack = view.slack / max(reach, 0.1)
    xx += slack * (slack + 2 * math.sqrt(xx))
    yy += slack * (slack + 2 * math.sqrt(yy))
    determinant = xx * yy - xy * xy
    if not determinant > 0:
        return False
    reach_x, reach_y = reach * math.sqrt(xx), reach * math.sqrt(yy)
    inverse = 1 / yy
    out[MEAN_X], out[MEAN_Y] = F32(place[0]), F32(place[1])
    out[SHARPNESS] = F32(math.sqrt(yy / determinant * HALF_UNIT))
    out[SLOPE] = F32(xy * inverse)
    out[FALLOFF] = F32(HALF_UNIT * inverse)
    out[EXTENT_X], out[EXTENT_Y] = F32(reach_x), F32(reach_y)
    out[TIP_Y] = F32(reach_x * xy / xx)
    return view.radius_clip <= 0 or max(math.ceil(reach_x), math.ceil(reach_y)) > view.radius_clip


@called
def rolled(view, sharp, across, down, centre, way):
    """A covariance on the image as a rolling shutter shows it: rows farther down are taken later,
    when everything has moved on."""
    xx, xy, yy = sharp[0] + view.eps2d, sharp[1], sharp[2] + view.eps2d
    x, y, z = centre
    # Turning moves what is seen at p by -turn x p.
    motion = (
        way[0] + view.turn[2] * y - view.turn[1] * z,
        way[1] + view.turn[0] * z - view.turn[2] * x,
        way[2] + view.turn[1] * x - view.turn[0] * y,
    )
    lines = view.height if view.by_row else view.width
    per_line = (1.0 if view.forward else -1.0) / max(lines - 1, 1.0)
    vx, vy = dot(across, motion) * per_line, dot(down, motion) * per_line
    if view.by_row:
        stretch = 1 / max(1 - vy, 0.1)
        lean = vx * stretch
        xx += lean * (2 * xy + lean * yy)
        xy, yy = (xy + lean * yy) * stretch, yy * stretch * stretch
    else:
        stretch = 1 / max(1 - vx, 0.1)
        lean = vy * stretch
        yy += lean * (2 * xy + lean * xx)
        xy, xx = (xy + lean * xx) * stretch, xx * stretch * stretch
    return xx - view.eps2d, xy, yy - view.eps2d


@called
def bound_large(view, centre, way, root, reach, level, out):
    """Write an ellipse about the box of the outline; whether it meets the image."""
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
    out[MEAN_X], out[MEAN_Y] = F32((left + right) / 2), F32((top + bottom) / 2)
    room = (LOG_255 - level) / EXPONENT_UNIT
    out[SHARPNESS] = F32(math.sqrt(room / 2) / half_x)
    out[SLOPE] = F32(0)
    out[FALLOFF] = F32(room / 2 / (half_y * half_y))
    out[EXTENT_X], out[EXTENT_Y], out[TIP_Y] = F32(half_x), F32(half_y), F32(0)
    return True


@called
def outline(view, centre, way, root, reach, time):
    """Box of what the camera sees of the Gaussian at ``time``: left, top, right, bottom [px].

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
        cosine = radius * math.cos(2 * math.pi * k / OUTLINE)
        sine = radius * math.sin(2 * math.pi * k / OUTLINE)
        x = (along * a + cosine * ux + sine * vx) / root[0]
        y = (along * b + cosine * uy + sine * vy - root[1] * x) / root[2]
        z = (along * c + cosine * uz + sine * vz - root[3] * x - root[4] * y) / root[5]
        point = (x, y, z)
        place = look_up(view, (dot(turn[0], point), dot(turn[1], point), dot(turn[2], point)))
        left, right = min(left, place[0]), max(right, place[0])
        top, bottom = min(top, place[1]), max(bottom, place[1])
    return left, top, right, bottom


@called
def behind_is_inside(turn, root, reach, o):
    """Whether the outline holds the direction straight behind, about which images close up."""
    d = whitened(root, (-turn[2][0], -turn[2][1], -turn[2][2]))
    along = dot(o, d)
    beside = dot(o, o) - along * along / dot(d, d)
    return along > 0 and beside <= reach * reach * 1.05


@called
def footprint_of(record, view):
    """Footprint of a record, see :mod:`.footprint`; -1 where it touches no tile."""
    reach_x, reach_y = record[EXTENT_X] + SLACK, record[EXTENT_Y] + SLACK
    left = max(record[MEAN_X] - reach_x - F32(0.5), F32(0))
    right = min(record[MEAN_X] + reach_x - F32(0.5), F32(view.width - 1))
    top = max(record[MEAN_Y] - reach_y - F32(0.5), F32(0))
    bottom = min(record[MEAN_Y] + reach_y - F32(0.5), F32(view.height - 1))
    if not (left <= right and top <= bottom):
        return np.int64(-1)
    x0, x1 = np.int64(left) // TILE, np.int64(right) // TILE + 1
    y0, y1 = np.int64(top) // TILE, np.int64(bottom) // TILE + 1
    footprint = x0 | (x1 << FIELD) | (y0 << 2 * FIELD) | (y1 << 3 * FIELD)
    if 1 < x1 - x0 <= SMALL and 1 < y1 - y0 <= SMALL:
        for row in range(y1 - y0):
            first, last = ellipse_columns(record, y0 + row, x0, x1)
            if last > first:
                bits = ((np.int64(1) << (last - first)) - 1) << (first - x0)
                footprint |= bits << (4 * FIELD + row * SMALL)
    return footprint
