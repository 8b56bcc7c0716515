"""Projection of eight Gaussians at a time onto the image of a camera with a lens.

The eight Gaussians occupy RAY_PROJECTION planes of eight numbers: those of a pinhole projection,
the second half of a record, and intermediate values. Each step takes a bit mask of active lanes and
returns the lanes that remain.

The ellipse of the lens derivative, enlarged by the nonlinearity of perspective and lens over the
Gaussian's extent, bounds the pixels that a Gaussian may touch. Rays use the exact map of the
Gaussian to a unit sphere.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import Any

from llvmlite import ir

from ..backend import ALPHA_MIN
from ..lens import CELLS, NODE, STEADY
from .lanes import (
    FLOAT,
    I32,
    I64,
    INTEGERS,
    LANES,
    VECTOR,
    Integers,
    Lanes,
    Planes,
    Vector,
    cross,
    dot,
    dot_all,
    logarithm,
    turn_columns,
    whitened,
    whitening,
)
from .project import (
    COVARIANCE_MAX,
    HALF_UNIT,
    LOG_255,
    MEAN,
    OPACITY,
    PROJECTION,
    REACH_MAX,
    SHAPE,
    Named,
    eight_step,
    largest_sigma,
    on_image,
)
from .records import (
    DEPTH,
    DRIFT,
    EXPONENT_UNIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    FRAME,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    ORIGIN,
    RECORD,
    SHARPNESS,
    SLOPE,
    SQUARE,
    TIP_Y,
    WHITENING,
)

SECOND = PROJECTION
"""First plane of a record's second half."""
AXES = SECOND + RECORD
"""First of nine: columns of a square root of the covariance, in the cluster frame."""
CENTRE = AXES + 9
"""First of three: centre in the camera frame at mid-readout [m]."""
WAY = CENTRE + 3
"""First of three: displacement relative to the camera over the readout [m]."""
TURN = WAY + 3
"""First of nine, by rows: rotation into the camera frame at the time the centre is exposed."""
SEEN = TURN + 9
"""First of three: centre in that frame [m]."""
PLACE = SEEN + 3
"""First of NODE: entry of the lens directory in this direction."""
ROOT = PLACE + NODE
"""First of six: map of the Gaussian to a unit sphere, lower triangle by rows."""
REACH = ROOT + 6
"""Standard deviations from the centre to alpha = 1/255."""
LARGE = REACH + 1
"""1 if lens and perspective are too nonlinear for the ellipse to be a bound, else 0."""
RAY_PROJECTION = LARGE + 1

ROUNDS = 2
"""Iterations for the row and the exposure time of a centre; each leaves a few percent of the error.
Rays are exact."""
SMALL_ANGLE = 0.5
"""Largest relative nonlinearity of lens and perspective over a small Gaussian."""
BENT = 0.6
"""Bound for the error at the end of an extent, as a fraction of the change of slope over it."""
TINY = 1e-20

Parts = tuple[Lanes, Lanes, Lanes, Lanes]
"""Covariance xx, xy, yy on the image [px^2], and its determinant."""
Ellipse = tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]
"""The same, and the offset of the ellipse's middle from the projected centre [px]."""


def _place(eight: Planes, view: Named, cluster: Named, *, moving: bool) -> Any:
    """Write centres and displacements; keeps Gaussians whose ball meets the cone of all rays."""
    mean = [eight.load(MEAN + k).doubles() for k in range(3)]
    own = [dot(cluster.three("linear", row=k), mean) for k in range(3)]
    x, y, z = ((a + b).floats() for a, b in zip(own, cluster.three("offset"), strict=True))
    _write(eight, CENTRE, [x, y, z])
    beside = x.fused(x, y * y).root()
    radius = largest_sigma(eight, cluster, deformed=False) * REACH_MAX
    if moving:
        swing = cross(view.three("drift", row=1), own)
        parts = zip(view.three("drift", row=0), swing, view.three("shift"), strict=True)
        way = [(straight + turned - shift).floats() for straight, turned, shift in parts]
        _write(eight, WAY, way)
        far = (way[0].magnitude() + way[1].magnitude() + way[2].magnitude()) * 0.5
        radius = radius + (beside + z.magnitude()).fused(view.number("turned"), far)
    gap = beside * view.number("cosine") - z * view.number("sine")
    seen = eight.load(OPACITY).compare(">=", ALPHA_MIN)
    return eight.builder.and_(seen, gap.compare("<=", radius))


def _see(eight: Planes, view: Named, cluster: Named, *, moving: bool) -> Any:
    """Write projected centres; keeps those near the image and between near and far plane."""
    centre = _read(eight, CENTRE, 3)
    seen = centre
    place = _look_up(view, seen)
    if moving:
        way = _read(eight, WAY, 3)
        for _ in range(ROUNDS):
            turn, seen = _seen_at(view, _line_time(view, place), centre, way)
            place = _look_up(view, seen)
        _write(eight, TURN, [value for row in turn for value in row])
    _write(eight, SEEN, seen)
    _write(eight, PLACE, place)
    distance = dot(seen, seen).root()
    depth = distance.where(view.number("ranges").compare(">", 0.0), seen[2])
    for plane, value in ((MEAN_X, place[0]), (MEAN_Y, place[1]), (DEPTH, depth)):
        eight.store(plane, value)

    main = _largest(seen)
    sigma = largest_sigma(eight, cluster, deformed=False)
    reach = _face_reach(sigma * REACH_MAX, distance, main)
    edge = view.number("edge") + place[NODE - 1]
    grown = reach.fused(_bend(view, place, reach), 1.0) * reach
    reach_x = grown.fused(place[2].magnitude() + place[3].magnitude(), edge)
    reach_y = grown.fused(place[4].magnitude() + place[5].magnitude(), edge)
    builder = eight.builder
    near = reduce(builder.and_, on_image(view, place[0], place[1], reach_x, reach_y))
    tests = [
        depth.compare(">=", view.number("near_plane")),
        depth.compare("<=", view.number("far_plane")),
        builder.or_(near, builder.not_(_is_small(view, place, reach))),
    ]
    return reduce(builder.and_, tests)


def _axes(eight: Planes, view: Named, cluster: Named) -> Any:
    """Write columns of square roots of covariances from quaternions and scales."""
    for k, column in enumerate(turn_columns([eight.load(SHAPE + i) for i in range(4)])):
        scale = eight.load(SHAPE + 4 + k)
        _write(eight, AXES + 3 * k, [value * scale for value in column])
    return eight.load(OPACITY).compare(">", 0.0)


def _shape(eight: Planes, view: Named, cluster: Named, *, moving: bool) -> Any:
    """Write ellipses and ray data; keeps Gaussians that meet the image, and LARGE ones."""
    builder = eight.builder
    seen, centre, place = _read(eight, SEEN, 3), _read(eight, CENTRE, 3), _read(eight, PLACE, NODE)
    across, down = _image_axes(eight, seen, place, moving=moving)
    axes = _camera_axes(eight, cluster)
    u, v = ([dot(row, axis) for axis in axes] for row in (across, down))
    normal = cross(u, v)
    xx, xy, yy, sharp = dot(u, u), dot(u, v), dot(v, v), dot(normal, normal)
    eps = view.number("eps2d")
    wide = (xx + yy + eps).fused(eps, sharp)
    opacity, antialiased = eight.load(OPACITY), view.number("antialiased").compare(">", 0.0)
    opacity = (opacity * (sharp / wide).root()).where(antialiased, opacity)
    level = -logarithm(opacity)
    reach = ((-level + LOG_255).at_least(0.0) * 2.0).root()
    eight.store(LEVEL, level * (1 / EXPONENT_UNIT))
    eight.store(REACH, reach)

    columns = [*axes, *_blur(view, centre, across, down)]
    rows = [[column[k] for column in columns] for k in range(3)]
    root = whitening(rows, dot(centre, centre) * 1e-14)
    _write(eight, ROOT, root)
    (_write_moving if moving else _write_still)(eight, root, centre)
    deep, on_face = _face_extent(centre, rows)
    # On the image, a pixel's own extent has no part along the ray.
    edge = eps.root()
    lean_x, lean_y = dot(u, deep, edge * deep[3]), dot(v, deep, edge * deep[4])
    share = (dot_all(deep, deep).root() * reach).at_most(0.9)
    ellipse = _in_perspective((xx + eps, xy, yy + eps, wide), lean_x, lean_y, share, reach)
    if moving:
        ellipse = _rolled(eight, view, ellipse, (across, down))
    found = _bound(eight, view, ellipse, on_face * reach / (-share + 1.0), reach)
    large = eight.load(LARGE).compare(">", 0.0)
    return builder.and_(opacity.compare(">=", ALPHA_MIN), builder.or_(found, large))


def _look_up(view: Named, seen: Vector) -> Vector:
    """Emit the bilinear interpolation of the lens directory; see LensTables.

    The numbers of a node are contiguous: each lane loads its four nodes as vectors, and the result
    is transposed from lanes to planes.
    """
    builder = seen[0].builder
    by_z, by_x = _main_axis(seen)
    u = seen[0].where(by_z, seen[1].where(by_x, seen[2]))
    v = seen[1].where(by_z, seen[2].where(by_x, seen[0]))
    main = seen[2].where(by_z, seen[0].where(by_x, seen[1]))
    scale = main.magnitude().at_least(TINY).reciprocal()
    zero, one, two = (Integers.filled(builder, number) for number in (0, 1, 2))
    face = two.where(by_z, zero.where(by_x, one)) << 1
    face = face + one.where(main.compare("<", 0.0), zero)
    (row, a), (column, b) = (_cell((part * scale + 1.0) * (CELLS / 2)) for part in (u, v))
    edge = CELLS + 1
    index = _times(_times(face, edge) + row, edge) + column
    weights = ((-a + 1.0) * (-b + 1.0), a * (-b + 1.0), (-a + 1.0) * b, a * b)
    offsets = (0, edge * NODE, NODE, (edge + 1) * NODE)
    data, rows = view.data("directory"), []
    for lane in range(LANES):
        first = builder.zext(builder.extract_element(index.value, I32(lane)), I64)
        first = builder.mul(first, I64(NODE))
        nodes = []
        for offset in offsets:
            place = builder.gep(data, [builder.add(first, I64(offset))], source_etype=FLOAT)
            vector = builder.bitcast(place, VECTOR.as_pointer())
            nodes.append(Lanes(builder, builder.load(vector, typ=VECTOR, align=4)))
        rows.append(dot_all(nodes, [_spread(weight, lane) for weight in weights]))
    return _transposed(rows)


def _cell(place: Lanes) -> tuple[Integers, Lanes]:
    """Emit the index of a cell along an edge, and the position in the cell, 0 to 1."""
    first = place.at_least(0.0).floor().at_most(CELLS - 1.0)
    return first.integers(), (place - first).at_least(0.0).at_most(1.0)


def _times(numbers: Integers, factor: int) -> Integers:
    filled = Integers.filled(numbers.builder, factor)
    return Integers(numbers.builder, numbers.builder.mul(numbers.value, filled.value))


def _spread(lanes: Lanes, lane: int) -> Lanes:
    """Emit a broadcast of one lane to all lanes."""
    mask = ir.Constant(INTEGERS, [lane] * LANES)
    return Lanes(lanes.builder, lanes.builder.shuffle_vector(lanes.value, lanes.value, mask))


def _transposed(rows: Vector) -> Vector:
    """Emit the transpose of eight vectors."""
    for width in (1, 2, 4):
        swapped: list[Any] = [None] * LANES
        for low in range(LANES):
            if low & width:
                continue
            high = low | width
            first = [i if not i & width else LANES + (i ^ width) for i in range(LANES)]
            second = [i | width if not i & width else LANES + i for i in range(LANES)]
            for place, mask in ((low, first), (high, second)):
                pair = rows[low].value, rows[high].value, ir.Constant(INTEGERS, mask)
                swapped[place] = Lanes(rows[low].builder, rows[low].builder.shuffle_vector(*pair))
        rows = swapped
    return rows


def _main_axis(seen: Vector) -> tuple[Any, Any]:
    """Emit the masks of directions whose largest component is z, and x."""
    builder = seen[0].builder
    x, y, z = (part.magnitude() for part in seen)
    by_z = builder.and_(z.compare(">=", x), z.compare(">=", y))
    return by_z, builder.and_(builder.not_(by_z), x.compare(">=", y))


def _largest(vector: Vector) -> Lanes:
    """Emit the largest magnitude of three components, at least TINY."""
    x, y, z = (part.magnitude() for part in vector)
    return x.at_least(y).at_least(z).at_least(TINY)


def _line_time(view: Named, place: Vector) -> Lanes:
    """Emit the exposure time of image positions within the readout, -0.5 to 0.5."""
    a, b, c = view.three("line")
    return place[0].fused(a, place[1].fused(b, c)).at_least(-0.5).at_most(0.5)


def _seen_at(
    view: Named, time: Lanes, centre: Vector, way: Vector
) -> tuple[tuple[Vector, Vector, Vector], Vector]:
    """Emit the rotation into the camera frame at ``time``, by rows, and the centres in it."""
    rx, ry, rz = (-(time * part.floats()) for part in view.three("turn"))
    square = dot([rx, ry, rz], [rx, ry, rz])
    # Rodrigues' formula as a series: rotations within an image are small, and divisions are slow.
    s = -(square * (1 / 6)) * (-(square * (1 / 20)) + 1.0) + 1.0
    c = -(square * (1 / 24)) * (-(square * (1 / 30)) + 1.0) + 0.5
    xx, yy, zz = c * rx * rx, c * ry * ry, c * rz * rz
    xy, xz, yz = c * rx * ry, c * rx * rz, c * ry * rz
    sx, sy, sz = s * rx, s * ry, s * rz
    turn = (
        [-(yy + zz) + 1.0, xy - sz, xz + sy],
        [xy + sz, -(xx + zz) + 1.0, yz - sx],
        [xz - sy, yz + sx, -(xx + yy) + 1.0],
    )
    moved = [time.fused(step, place) for step, place in zip(way, centre, strict=True)]
    return turn, [dot(row, moved) for row in turn]


def _face_reach(radius: Lanes, distance: Lanes, main: Lanes) -> Lanes:
    """Emit an upper bound for the extent of balls of ``radius`` [m] on a directory face."""
    share = (radius / main).at_most(0.9)
    return share * (distance / main) / (-share + 1.0)


def _face_extent(centre: Vector, rows: list[Vector]) -> tuple[Vector, Lanes]:
    """Emit the row of the covariance roots along the face's axis, divided by the distance along
    that axis, and the largest standard deviation on the face."""
    x, y, z = rows
    by_z, by_x = _main_axis(centre)
    inverse = centre[2].where(by_z, centre[0].where(by_x, centre[1])).reciprocal()
    deep = [c.where(by_z, a.where(by_x, b)) * inverse for a, b, c in zip(x, y, z, strict=True)]
    squares = []
    for part, row in zip(centre, rows, strict=True):
        # Zero along the axis itself.
        off = [(-part).fused(along, own) for own, along in zip(row, deep, strict=True)]
        squares.append(dot_all(off, off))
    return deep, (squares[0] + squares[1] + squares[2]).root() * inverse.magnitude()


def _bend(view: Named, place: Vector, reach: Lanes) -> Lanes:
    """Emit a bound for the relative change of the lens slope per unit of reach on a face."""
    return place[NODE - 2].where(reach.compare("<", STEADY), view.number("bend"))


def _is_small(view: Named, place: Vector, reach: Lanes) -> Any:
    """Emit the mask of reaches on a face over which lens and perspective are nearly linear."""
    return ((_bend(view, place, reach) + 1.0) * reach).compare("<", SMALL_ANGLE)


def _image_axes(
    eight: Planes, seen: Vector, place: Vector, *, moving: bool
) -> tuple[Vector, Vector]:
    """Emit rows of the derivative of image positions [px/m], in the mid-readout camera frame."""
    by_z, by_x = _main_axis(seen)
    u = seen[0].where(by_z, seen[1].where(by_x, seen[2]))
    v = seen[1].where(by_z, seen[2].where(by_x, seen[0]))
    main = seen[2].where(by_z, seen[0].where(by_x, seen[1]))
    scale = main.magnitude().at_least(TINY).reciprocal()
    signed = -(scale * scale).negative_where(main.compare(">=", 0.0))
    rows = []
    for first, second in ((place[2], place[3]), (place[4], place[5])):
        by_u, by_v = first * scale, second * scale
        by_main = -(u.fused(first, v * second)) * signed
        x = by_u.where(by_z, by_main.where(by_x, by_v))
        y = by_v.where(by_z, by_u.where(by_x, by_main))
        z = by_main.where(by_z, by_v.where(by_x, by_u))
        rows.append([x, y, z])
    if moving:
        turn = [_read(eight, TURN + 3 * row, 3) for row in range(3)]
        columns = [[row[k] for row in turn] for k in range(3)]
        rows = [[dot(row, column) for column in columns] for row in rows]
    return rows[0], rows[1]


def _camera_axes(eight: Planes, cluster: Named) -> list[Vector]:
    """Emit columns of square roots of covariances in the camera frame."""
    linear = [[number.floats() for number in cluster.three("linear", row=k)] for k in range(3)]
    columns = (_read(eight, AXES + 3 * k, 3) for k in range(3))
    return [[dot(row, column) for row in linear] for column in columns]


def _blur(view: Named, centre: Vector, across: Vector, down: Vector) -> list[Vector]:
    """Emit columns of a square root of the image blur of a pinhole camera: the pixel's extent at
    the Gaussian, J^T (J J^T)^-1, and about the same extent along the ray."""
    a, b, c = dot(across, across), dot(across, down), dot(down, down)
    inverse = (a * c - b * b).at_least(TINY).reciprocal()
    scale = view.number("eps2d").root()
    p, q, r = scale * c * inverse, -(scale * b * inverse), scale * a * inverse
    first = [p.fused(i, q * j) for i, j in zip(across, down, strict=True)]
    second = [q.fused(i, r * j) for i, j in zip(across, down, strict=True)]
    # Rays use the mid-readout frame, where the viewing direction is that of the centre.
    deep = scale * (inverse.root() / dot(centre, centre)).root()
    return [first, second, [deep * part for part in centre]]


def _write_still(eight: Planes, root: Vector, centre: Vector) -> None:
    """Write the data for rays from one point: rows of a map that puts the centre on the third axis,
    and the square of its distance there."""
    o = whitened(root, centre)
    square = dot(o, o)
    inverse = square.at_least(TINY).root().reciprocal()
    x, y, z = (part * inverse for part in o)
    # A right-handed frame without branches (Duff et al. 2017).
    sign = _filled(z, -1.0).where(z.compare("<", 0.0), 1.0)
    a = -((sign + z).reciprocal())
    b = x * y * a
    rows = (
        ((sign * x * x).fused(a, 1.0), sign * b, -(sign * x)),
        (b, (y * y).fused(a, sign), -y),
        (x, y, z),
    )
    w00, w10, w11, w20, w21, w22 = root
    for index, row in enumerate(rows):
        through = [
            row[0].fused(w00, row[1].fused(w10, row[2] * w20)),
            row[1].fused(w11, row[2] * w21),
            row[2] * w22,
        ]
        _write(eight, SECOND - RECORD + FRAME + 3 * index, through)
    eight.store(SECOND - RECORD + SQUARE, square * HALF_UNIT)


def _write_moving(eight: Planes, root: Vector, centre: Vector) -> None:
    """Write the data for rays from many points: the map, and the ray origins in its space."""
    _write(eight, SECOND - RECORD + WHITENING, root)
    _write(eight, SECOND - RECORD + ORIGIN, [-part for part in whitened(root, centre)])
    way = _read(eight, WAY, 3)
    _write(eight, SECOND - RECORD + DRIFT, [-part for part in whitened(root, way)])


def _in_perspective(
    ellipse: Parts, lean_x: Lanes, lean_y: Lanes, share: Lanes, reach: Lanes
) -> Ellipse:
    """Emit the exact outline of an ellipsoid on a plane perpendicular to an axis.

    The derivative alone underestimates the nearer part.

    Args:
        ellipse: covariance from the derivative.
        lean_x, lean_y: covariance of image positions with distances along the axis [px], divided
            by the distance of the centre.
        share: extent of the ellipsoid along the axis, divided by that distance.
        reach: standard deviations of the outline.
    """
    xx, xy, yy, determinant = ellipse
    grown = (-(share * share) + 1.0).reciprocal()
    square = reach * reach * grown
    across = lean_x * lean_y
    xx_more, yy_more = lean_x * lean_x, lean_y * lean_y
    mixed = yy.fused(xx_more, xx.fused(yy_more, -(xy * across) * 2.0)).at_least(0.0)
    return (
        square.fused(xx_more, xx) * grown,
        square.fused(across, xy) * grown,
        square.fused(yy_more, yy) * grown,
        square.fused(mixed, determinant) * grown * grown,
        -(square * lean_x),
        -(square * lean_y),
    )


def _rolled(eight: Planes, view: Named, ellipse: Ellipse, image: tuple[Vector, Vector]) -> Ellipse:
    """Emit ellipses distorted by a rolling shutter: later rows see later positions."""
    # A rotation of the camera displaces a point p by -turn x p.
    swing = cross(_read(eight, CENTRE, 3), [part.floats() for part in view.three("turn")])
    motion = [step + turned for step, turned in zip(_read(eight, WAY, 3), swing, strict=True)]
    a, b, _ = view.three("line")
    vx, vy = (dot(row, motion) for row in image)
    stretch = (-(vx.fused(a, vy * b)) + 1.0).at_least(0.1).reciprocal()
    lean_x, lean_y = vx * stretch, vy * stretch
    p, q, r, s = lean_x.fused(a, 1.0), lean_x * b, lean_y * a, lean_y.fused(b, 1.0)
    xx, xy, yy, determinant, x, y = ellipse
    first, second = p.fused(xx, q * xy), p.fused(xy, q * yy)
    third, fourth = r.fused(xx, s * xy), r.fused(xy, s * yy)
    return (
        first.fused(p, second * q),
        first.fused(r, second * s),
        third.fused(r, fourth * s),
        determinant * stretch * stretch,
        p.fused(x, q * y),
        r.fused(x, s * y),
    )


def _bound(eight: Planes, view: Named, ellipse: Ellipse, on_face: Lanes, reach: Lanes) -> Any:
    """Write ellipses enlarged by the lens nonlinearity, and LARGE.

    ``on_face`` is the extent of the Gaussians on a face of the directory. Returns the mask of
    ellipses that meet the image.
    """
    place = _read(eight, PLACE, NODE)
    large = _filled(reach, 1.0)
    eight.store(LARGE, _filled(reach, 0.0).where(_is_small(view, place, on_face), large))
    xx, xy, yy, determinant, x, y = ellipse
    x, y = place[0] + x, place[1] + y
    eight.store(MEAN_X, x)
    eight.store(MEAN_Y, y)
    extent = xx.at_least(yy).root()
    off = place[NODE - 1] / reach.at_least(0.1)
    off = (on_face * _bend(view, place, on_face) * BENT).fused(extent, off)
    more_x, more_y = (off.fused(off, off * part.root() * 2.0) for part in (xx, yy))
    determinant = (xx + more_x).fused(more_y, more_x.fused(yy, determinant))
    xx, yy = xx + more_x, yy + more_y
    reach_x, reach_y = reach * xx.root(), reach * yy.root()
    inverse = yy.reciprocal()
    record = {
        SHARPNESS: (yy / determinant * HALF_UNIT).root(),
        SLOPE: xy * inverse,
        FALLOFF: inverse * HALF_UNIT,
        EXTENT_X: reach_x,
        EXTENT_Y: reach_y,
        TIP_Y: reach_x * xy / xx,
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
        xx.compare("<", COVARIANCE_MAX),
        yy.compare("<", COVARIANCE_MAX),
        reduce(eight.builder.or_, large_enough),
        *on_image(view, x, y, reach_x, reach_y),
    ]
    return reduce(eight.builder.and_, tests)


def _filled(like: Lanes, number: float) -> Lanes:
    """One float32 number in all lanes."""
    return Lanes(like.builder, ir.Constant(VECTOR, [number] * LANES))


def _read(eight: Planes, first: int, count: int) -> Vector:
    return [eight.load(first + k) for k in range(count)]


def _write(eight: Planes, first: int, values: Vector) -> None:
    for k, value in enumerate(values):
        eight.store(first + k, value)


place_still = eight_step(partial(_place, moving=False), count=RAY_PROJECTION)
place_moving = eight_step(partial(_place, moving=True), count=RAY_PROJECTION)
see_still = eight_step(partial(_see, moving=False), count=RAY_PROJECTION)
see_moving = eight_step(partial(_see, moving=True), count=RAY_PROJECTION)
axes_of_eight = eight_step(_axes, count=RAY_PROJECTION)
shape_still = eight_step(partial(_shape, moving=False), count=RAY_PROJECTION)
shape_moving = eight_step(partial(_shape, moving=True), count=RAY_PROJECTION)
