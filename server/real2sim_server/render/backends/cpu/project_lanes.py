"""Projection of eight Gaussians at a time as explicit vector code.

The eight lie in PROJECTION planes of eight float32 numbers: first those of a record, in the order
of its fields, then what is known of the Gaussian, then notes from one step for the next. Each step
is told by bits which lanes are still in question and answers with those that remain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ..base import ALPHA_MIN
from .lanes import DOUBLE, FLOAT, I64, Lanes, Planes, logarithm, mask_bits, mask_of, splat
from .records import (
    DEPTH,
    EXPONENT_UNIT,
    EXTENT_X,
    EXTENT_Y,
    FALLOFF,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    RECORD,
    SHARPNESS,
    SLOPE,
    TIP_Y,
)
from .vectors import Vector, dot, turn_columns

MEAN, OPACITY, SHAPE = RECORD, RECORD + 3, RECORD + 4
"""First planes of the centre, of the opacity, and of quaternion and scales; or, where a cluster
has covariances, of the upper half of one by rows."""
TANGENT = RECORD + 11
"""First of two planes: x/z and y/z, within their bounds."""
PROJECTION = RECORD + 13

LOG_255 = math.log(255.0)
REACH_MAX = math.sqrt(2 * LOG_255)
COVARIANCE_MAX = 1e30
"""Larger than any picture [px^2]; beyond it float32 gives out."""
HALF_UNIT = 0.5 / EXPONENT_UNIT


class Named:
    """A named tuple of the kernel: its numbers and those of its arrays, each in all lanes."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kind: Any, value: Any) -> None:
        self._context, self._builder, self._kind, self._value = context, builder, kind, value

    def number(self, name: str) -> Lanes:
        """A number."""
        return splat(self._builder, self._field(name)[1])

    def three(self, name: str, *, row: int = 0) -> Vector:
        """Three neighbours of an array: a row where it has rows."""
        element = DOUBLE if self._field(name)[0].dtype == types.float64 else FLOAT
        data = self.data(name)
        numbers = []
        for index in range(3 * row, 3 * row + 3):
            place = self._builder.gep(data, [I64(index)], source_etype=element)
            numbers.append(splat(self._builder, self._builder.load(place, typ=element)))
        return numbers

    def data(self, name: str) -> Any:
        """Where an array begins."""
        kind, value = self._field(name)
        return self._context.make_array(kind)(self._context, self._builder, value).data

    def _field(self, name: str) -> tuple[Any, Any]:
        index = self._kind.fields.index(name)
        return self._kind.types[index], self._builder.extract_value(self._value, index)


def eight_step(build: Callable[[Planes, Named, Named], Any], *, count: int) -> Any:
    """The intrinsic ``step(planes, lanes, view, cluster)`` that emits what ``build`` says.

    Args:
        build: gets ``count`` planes of eight numbers, and the named tuples of the viewer and of
            the cluster that is looked at; gives the mask of the lanes that remain.
        count: of the planes.
    """

    def step(typingctx, planes, lanes, view, cluster):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
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
    """Put the centres on the image; there remain those of which something may be seen.

    Centres are summed in float64 so that rounding cannot change the order by depth.
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
    """Upper bound of the standard deviation along any direction of the world [m]."""
    a, b, c = cluster.three("scale")
    largest = a.at_least(b).at_least(c)
    if deformed:
        trace = eight.load(SHAPE) + eight.load(SHAPE + 3) + eight.load(SHAPE + 5)
        return trace.root() * largest
    s0, s1, s2 = (eight.load(SHAPE + 4 + k) for k in range(3))
    return s0.at_least(s1).at_least(s2) * largest


def on_image(view: Named, x: Lanes, y: Lanes, reach_x: Lanes, reach_y: Lanes) -> list[Any]:
    """Masks: a box about (x, y) meets the image; false for what is not finite."""
    return [
        (x + reach_x).compare(">", 0.0),
        (x - reach_x).compare("<", view.number("width")),
        (y + reach_y).compare(">", 0.0),
        (y - reach_y).compare("<", view.number("height")),
    ]


def _shape(eight: Planes, view: Named, cluster: Named, *, deformed: bool) -> Any:
    """Write the ellipses to the planes of a record; there remain those that meet the image."""
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
    """Rows of the map from the cluster's frame to the image [px/m]: the projection's Jacobian."""
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

    The turn is float64 too: gradients of needles hang on its last digits.
    """
    columns = turn_columns([eight.load(SHAPE + k).doubles() for k in range(4)])
    scales = [eight.load(SHAPE + 4 + k).doubles() for k in range(3)]
    rows = [[number.doubles() for number in row] for row in (across, down)]
    u, v = (
        [scale * dot(row, column) for scale, column in zip(scales, columns, strict=True)]
        for row in rows
    )
    # Lagrange's identity: |u|^2 |v|^2 - (u v)^2 without the cancellation that ruins needles.
    normal = [u[i] * v[j] - u[j] * v[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    return dot(u, u), dot(u, v), dot(v, v), dot(normal, normal)


def _deformed_covariance(
    eight: Planes, across: Vector, down: Vector
) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Like _covariance, from the upper half of a covariance."""
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
