"""Lenses other than the pinhole: maps between directions and points of the image plane.

A lens maps directions of the camera frame (x right, y down, z forward) to a plane of focal length
one, and the camera's ``K`` maps the plane to pixels. A lens is therefore independent of the image
size. Formulas are those of OpenCV 4 (``projectPoints``, ``fisheye``, ``omnidir``) and of NVIDIA's
f-theta model, in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry import Float
from .errors import SceneError

Valid = NDArray[np.bool_]
ROUNDS = 40
"""Maximum iterations of Newton's method; it stops at convergence."""
CONVERGED = 1e-12
SAMPLES = 2048
"""Number of samples in the search for the maximum of a radius."""
FLATTEST = math.tan(math.radians(89.0))
"""Maximum distance from the axis on the plane for perspective lenses."""
OPENING = math.pi
"""Maximum angle from the axis for all lenses [rad]."""


class Lens(Protocol):
    """Interface of all lenses.

    Attributes:
        model: its name in files and on the wire.
        perspective: whether straight lines stay almost straight, with a field of view of less than
            90 degrees from the axis. Depth images of such a camera hold depths along z, others
            ranges along rays.
        reach: maximum angle from the axis with a pixel [rad].
    """

    model: ClassVar[str]
    perspective: ClassVar[bool]

    @property
    def reach(self) -> float:
        """Maximum angle from the axis with a pixel [rad]."""
        ...

    def distort(self, directions: Float) -> tuple[Float, Valid]:
        """Positions [..., 2] on the plane of ``directions`` [..., 3] of any length, and whether
        they exist; other positions are arbitrary.
        """
        ...

    def undistort(self, plane: Float) -> tuple[Float, Valid]:
        """Unit directions [..., 3] of positions [..., 2] on the plane, and whether they have
        one."""
        ...


@dataclass(frozen=True)
class BrownConrady:
    """Radial, tangential and thin-prism distortion: OpenCV's rational model (6 + 2 + 4).

    Attributes:
        radial: k1 to k6; the last three are in the denominator.
        tangential: p1, p2.
        thin_prism: s1 to s4.

    Raises:
        SceneError: wrong counts, values that are not finite, or a radius that never grows.
    """

    radial: tuple[float, ...] = (0.0,) * 6
    tangential: tuple[float, ...] = (0.0,) * 2
    thin_prism: tuple[float, ...] = (0.0,) * 4

    model: ClassVar[str] = "brown_conrady"
    perspective: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_counts(self, radial=6, tangential=2, thin_prism=4)

    @cached_property
    def valid_radius(self) -> float:
        """Undistorted radius up to which the distorted radius grows; beyond it the image folds
        back.
        """
        # Denser near the axis, where lenses are meant to be used.
        x = np.geomspace(1e-3, FLATTEST, SAMPLES)
        grows = self._radius_grows(x)
        if grows.all():
            return FLATTEST
        first = int(np.argmin(grows))
        if first == 0:
            raise SceneError(
                f"brown_conrady lens: the radius never grows with radial={self.radial}"
            )
        low, high = float(x[first - 1]), float(x[first])
        return _last_true(lambda value: bool(self._radius_grows(np.array([value]))[0]), low, high)

    @property
    def reach(self) -> float:
        """Maximum angle from the axis with a pixel [rad]."""
        return math.atan(self.valid_radius)

    def distort(self, directions: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        z = directions[..., 2]
        ahead = z > 1e-12 * np.linalg.norm(directions, axis=-1)
        plane = directions[..., :2] / np.where(ahead, z, 1.0)[..., None]
        valid = ahead & (np.linalg.norm(plane, axis=-1) <= self.valid_radius)
        return self._forward(np.where(valid[..., None], plane, 0.0)), valid

    def undistort(self, plane: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`; by Newton's method in two dimensions."""
        plane = np.asarray(plane, dtype=np.float64)
        found = self._start(plane)
        for _ in range(ROUNDS):
            step = _solve_2x2(self._jacobian(found), self._forward(found) - plane)
            found = found - step
            if np.abs(step).max(initial=0.0) < CONVERGED:
                break
        miss = np.abs(self._forward(found) - plane).max(-1)
        valid = (miss < 1e-9 * (1 + np.linalg.norm(plane, axis=-1))) & (
            np.linalg.norm(found, axis=-1) <= self.valid_radius
        )
        found = np.where(valid[..., None], found, 0.0)
        return _unit(np.concatenate([found, np.ones((*found.shape[:-1], 1))], -1)), valid

    def _start(self, plane: Float) -> Float:
        """Start of Newton's method: the inverse for purely radial distortion."""
        x = np.geomspace(1e-3, self.valid_radius, SAMPLES)
        radius = x * self._factor(x * x)[0]
        given = np.linalg.norm(plane, axis=-1)
        ratio = np.interp(given, radius, x) / np.where(given > 0, given, 1.0)
        return plane * np.where(given > radius[0], ratio, 1.0)[..., None]

    def _factor(self, r2: Float) -> tuple[Float, Float]:
        """The radial factor, and its derivative by r^2."""
        k1, k2, k3, k4, k5, k6 = self.radial
        top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        top_slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
        bottom_slope = k4 + r2 * (2 * k5 + r2 * 3 * k6)
        bottom = np.where(np.abs(bottom) > 1e-9, bottom, 1e-9)
        return top / bottom, (top_slope * bottom - top * bottom_slope) / bottom**2

    def _radius_grows(self, x: Float) -> Valid:
        k4, k5, k6 = self.radial[3:]
        factor, slope = self._factor(x * x)
        bottom = 1 + x * x * (k4 + x * x * (k5 + x * x * k6))
        return np.asarray((factor + 2 * x * x * slope > 0) & (factor > 0) & (bottom > 0))

    def _forward(self, plane: Float) -> Float:
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.thin_prism
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        factor = self._factor(r2)[0]
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
        return np.stack([x * factor + dx, y * factor + dy], -1)

    def _jacobian(self, plane: Float) -> Float:
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.thin_prism
        x, y = plane[..., 0], plane[..., 1]
        r2 = x * x + y * y
        factor, slope = self._factor(r2)
        prism_x, prism_y = s1 + 2 * s2 * r2, s3 + 2 * s4 * r2
        xx = factor + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x + 2 * x * prism_x
        xy = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y + 2 * y * prism_x
        yx = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y + 2 * x * prism_y
        yy = factor + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x + 2 * y * prism_y
        return np.stack([np.stack([xx, xy], -1), np.stack([yx, yy], -1)], -2)


@dataclass(frozen=True)
class Fisheye:
    """OpenCV's fisheye: radius = angle (1 + k1 angle^2 + ... + k4 angle^8) (Kannala and Brandt).

    Attributes:
        k: k1 to k4.
        max_angle: maximum angle from the axis [rad]; None: the limit of growth of the radius.

    Raises:
        SceneError: wrong counts, values that are not finite or angles outside (0, pi].
    """

    k: tuple[float, ...] = (0.0,) * 4
    max_angle: float | None = None

    model: ClassVar[str] = "fisheye"
    perspective: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_counts(self, k=4)
        _check_angle(self.model, self.max_angle)

    @cached_property
    def reach(self) -> float:
        """Maximum angle from the axis with a pixel [rad]."""
        return _growing(self.model, self._slope, self.max_angle or OPENING)

    def distort(self, directions: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        angle, across = _angles(directions)
        valid = angle <= self.reach
        return across * self._radius(np.where(valid, angle, 0.0))[..., None], valid

    def undistort(self, plane: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        return _from_radius(plane, self._radius, self._slope, self.reach)

    def _radius(self, angle: Float) -> Float:
        k1, k2, k3, k4 = self.k
        a2 = angle * angle
        return angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))

    def _slope(self, angle: Float) -> Float:
        k1, k2, k3, k4 = self.k
        a2 = angle * angle
        return 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))


@dataclass(frozen=True)
class Omnidirectional:
    """OpenCV's omnidirectional lens (Mei and Rives 2007).

    The unit sphere seen from ``xi`` behind its centre, then distorted.

    Attributes:
        xi: at least 0; 0 is a pinhole with distortion, 1 the parabolic mirror.
        k: k1, k2.
        p: p1, p2.

    Raises:
        SceneError: wrong counts, values that are not finite, or a negative ``xi``.
    """

    xi: float = 1.0
    k: tuple[float, ...] = (0.0,) * 2
    p: tuple[float, ...] = (0.0,) * 2

    model: ClassVar[str] = "omnidirectional"
    perspective: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_counts(self, k=2, p=2)
        if not (math.isfinite(self.xi) and self.xi >= 0):
            raise SceneError(f"omnidirectional lens: xi must be finite and >= 0, not {self.xi!r}")

    @cached_property
    def _distortion(self) -> BrownConrady:
        return BrownConrady((*self.k, 0.0, 0.0, 0.0, 0.0), self.p)

    @cached_property
    def reach(self) -> float:
        """Maximum angle from the axis with a pixel [rad]."""
        limit = math.acos(-1 / self.xi) if self.xi > 1 else math.acos(-self.xi)
        return _last_true(lambda angle: bool(self._radius_of(angle)), 0.0, limit - 1e-6)

    def _radius_of(self, angle: float) -> bool:
        below = math.cos(angle) + self.xi
        return below > 1e-9 and math.sin(angle) / below <= self._distortion.valid_radius

    def distort(self, directions: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        unit = _unit(directions)
        valid = _angles(directions)[0] <= self.reach
        below = np.where(valid, unit[..., 2] + self.xi, 1.0)
        plane = np.where(valid[..., None], unit[..., :2] / below[..., None], 0.0)
        return self._distortion._forward(plane), valid

    def undistort(self, plane: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        flat, valid = self._distortion.undistort(plane)
        across = flat[..., :2] / flat[..., 2:]
        r2 = (across * across).sum(-1)
        room = 1 + (1 - self.xi**2) * r2
        valid = valid & (room >= 0)
        z = (np.sqrt(np.maximum(room, 0)) - self.xi * r2) / (1 + r2)
        rays = _unit(np.concatenate([across * (z + self.xi)[..., None], z[..., None]], -1))
        return rays, valid & (_angles(rays)[0] <= self.reach)


@dataclass(frozen=True)
class FTheta:
    """NVIDIA's f-theta lens: a polynomial between the angle from the axis and the radius.

    Attributes:
        polynomial: coefficients starting with the constant (0), at most degree 5. Radii are those
            of a plane of focal length one, see :meth:`of_pixels`.
        reference: argument of the polynomial: ``angle`` gives radii, ``radius`` gives angles; the
            inverse uses Newton's method.
        linear: c, d, e: the plane is [[c, d], [e, 1]] times the result of the polynomial.
        max_angle: maximum angle from the axis [rad].

    Raises:
        SceneError: values that are not finite, a constant that is not 0, a singular matrix, or a
            radius that does not grow.
    """

    polynomial: tuple[float, ...] = (0.0, 1.0)
    reference: str = "angle"
    linear: tuple[float, ...] = (1.0, 0.0, 0.0)
    max_angle: float = math.pi

    model: ClassVar[str] = "f_theta"
    perspective: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_counts(self, linear=3)
        values = self.polynomial
        if not 2 <= len(values) <= 6 or not np.isfinite(values).all() or values[0] != 0:
            raise SceneError(
                "f_theta lens: polynomial must be 2 to 6 finite numbers, the first of them 0, "
                f"not {list(values)}"
            )
        if self.reference not in {"angle", "radius"}:
            raise SceneError(
                f"f_theta lens: reference must be 'angle' or 'radius', not {self.reference!r}"
            )
        if not abs(np.linalg.det(self._matrix)) > 1e-6:
            raise SceneError(f"f_theta lens: linear {self.linear} cannot be inverted")
        _check_angle(self.model, self.max_angle)

    @classmethod
    def of_pixels(
        cls,
        polynomial: tuple[float, ...],
        focal: float,
        *,
        reference: str = "angle",
        linear: tuple[float, ...] = (1.0, 0.0, 0.0),
        max_angle: float = math.pi,
    ) -> FTheta:
        """From a polynomial in pixels, for a camera whose ``K`` has the focal length ``focal``
        [px].

        Any focal length works: it only sets the unit of the stored radii.
        """
        scaled = [
            value / focal if reference == "angle" else value * focal**power
            for power, value in enumerate(polynomial)
        ]
        return cls(tuple(scaled), reference, linear, max_angle)

    @cached_property
    def reach(self) -> float:
        """Maximum angle from the axis with a pixel [rad]."""
        if self.reference == "angle":
            return _growing(self.model, self._slope, self.max_angle)
        return min(self.max_angle, float(self._polynomial(np.array(self._last_radius))))

    @cached_property
    def _last_radius(self) -> float:
        """Radius at which the angle reaches ``max_angle``, or stops growing."""
        radius = 1.0
        while radius < 1e6 and float(self._polynomial(np.array(radius))) < self.max_angle:
            if not (self._slope(np.linspace(0, radius, SAMPLES)) > 0).all():
                break
            radius *= 2
        grows = _growing(self.model, self._slope, radius)
        return _last_true(
            lambda value: float(self._polynomial(np.array(value))) <= self.max_angle, 0.0, grows
        )

    def distort(self, directions: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        angle, across = _angles(directions)
        valid = angle <= self.reach
        angle = np.where(valid, angle, 0.0)
        radius = self._polynomial(angle) if self.reference == "angle" else self._inverse(angle)
        return (across * radius[..., None]) @ self._matrix.T, valid

    def undistort(self, plane: Float) -> tuple[Float, Valid]:
        """See :class:`Lens`."""
        plane = np.asarray(plane, dtype=np.float64) @ np.linalg.inv(self._matrix).T
        if self.reference == "angle":
            return _from_radius(plane, self._polynomial, self._slope, self.reach)
        radius = np.linalg.norm(plane, axis=-1)
        valid = radius <= self._last_radius
        return _direction(plane, radius, self._polynomial(np.where(valid, radius, 0.0))), valid

    @property
    def _matrix(self) -> Float:
        c, d, e = self.linear
        return np.array([[c, d], [e, 1.0]])

    def _inverse(self, angle: Float) -> Float:
        return _inverted(angle, self._polynomial, self._slope, self._last_radius)[0]

    def _polynomial(self, at: Float) -> Float:
        return np.asarray(np.polynomial.polynomial.polyval(at, self.polynomial))

    def _slope(self, at: Float) -> Float:
        slope = np.polynomial.polynomial.polyder(np.array(self.polynomial))
        return np.asarray(np.polynomial.polynomial.polyval(at, slope))


MODELS: dict[str, type[Any]] = {
    kind.model: kind for kind in (BrownConrady, Fisheye, Omnidirectional, FTheta)
}
"""Lenses by name; ``pinhole`` means none."""


def lens_values(lens: Lens | None) -> dict[str, Any] | None:
    """JSON values of a lens, exact to the last bit; None for the pinhole."""
    if lens is None:
        return None
    values = {field.name: getattr(lens, field.name) for field in fields(lens)}  # type: ignore[arg-type]
    plain = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
    return {"model": lens.model, **plain}


def lens_from(values: dict[str, Any] | None) -> Lens | None:
    """The lens of such values.

    Raises:
        SceneError: an unknown model or key, or values that its class rejects.
    """
    if values is None or values.get("model") == "pinhole":
        return None
    given = dict(values)
    kind = MODELS.get(given.pop("model", None))
    if kind is None:
        known = ["pinhole", *MODELS]
        raise SceneError(f"unknown lens model {values.get('model')!r}; allowed are {known}")
    unknown = set(given) - {field.name for field in fields(kind)}
    if unknown:
        raise SceneError(f"{kind.model} lens: unknown {sorted(unknown)}")
    try:
        built: Lens = kind(**{k: _numbers(v) for k, v in given.items()})
    except (TypeError, ValueError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{kind.model} lens: {error}") from error
    return built


def _numbers(value: Any) -> Any:
    return tuple(map(float, value)) if isinstance(value, list | tuple) else value


def _check_counts(lens: Any, **counts: int) -> None:
    for name, count in counts.items():
        values = getattr(lens, name)
        if len(values) != count or not np.isfinite(values).all():
            raise SceneError(
                f"{lens.model} lens: {name} must be {count} finite numbers, not {list(values)}"
            )


def _check_angle(model: str, angle: float | None) -> None:
    if angle is not None and not 0 < angle <= OPENING:
        raise SceneError(f"{model} lens: max_angle must be in (0, pi], not {angle!r}")


def _unit(directions: Float) -> Float:
    length = np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.asarray(directions / np.where(length > 0, length, 1.0))


def _angles(directions: Float) -> tuple[Float, Float]:
    """Angles [...] from the axis, and unit vectors [..., 2] across it (0 on the axis)."""
    across = np.asarray(directions[..., :2], dtype=np.float64)
    length = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(length, directions[..., 2])
    return angle, across / np.where(length > 0, length, 1.0)[..., None]


def _direction(plane: Float, radius: Float, angle: Float) -> Float:
    across = plane * (np.sin(angle) / np.where(radius > 0, radius, 1.0))[..., None]
    return np.concatenate([across, np.cos(angle)[..., None]], -1)


def _from_radius(
    plane: Float,
    radius_of: Callable[[Float], Float],
    slope_of: Callable[[Float], Float],
    reach: float,
) -> tuple[Float, Valid]:
    """Directions of a lens with a radius that depends only on the angle."""
    plane = np.asarray(plane, dtype=np.float64)
    radius = np.linalg.norm(plane, axis=-1)
    angle, valid = _inverted(radius, radius_of, slope_of, reach)
    return _direction(plane, radius, angle), valid


def _inverted(
    values: Float,
    function: Callable[[Float], Float],
    slope_of: Callable[[Float], Float],
    last: float,
) -> tuple[Float, Valid]:
    """Position in [0, last] at which a growing function has ``values``, and whether it exists.

    Newton's method from a table; the table alone is accurate to 1e-6.
    """
    table = np.linspace(0.0, last, SAMPLES)
    known = function(table)
    valid = values <= known[-1] * (1 + 1e-12)
    found = np.interp(values, known, table)
    for _ in range(ROUNDS):
        slope = slope_of(found)
        step = (function(found) - values) / np.where(np.abs(slope) > 1e-9, slope, 1e-9)
        step = np.clip(np.where(valid, step, 0.0), found - last, found)
        found = found - step
        if np.abs(step).max(initial=0.0) < CONVERGED:
            break
    return found, valid


def _growing(model: str, slope_of: Callable[[Float], Float], limit: float) -> float:
    """Position in [0, limit] up to which a slope is positive."""
    at = np.linspace(0.0, limit, SAMPLES)
    grows = slope_of(at) > 0
    if grows.all():
        return limit
    first = int(np.argmin(grows))
    if first == 0:
        raise SceneError(f"{model} lens: the radius does not grow with the angle on the axis")
    return _last_true(
        lambda value: bool(slope_of(np.array(value)) > 0), float(at[first - 1]), float(at[first])
    )


def _last_true(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Largest number in [low, high] for which the condition holds; it must hold at ``low``."""
    if holds(high):
        return high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _solve_2x2(matrix: Float, right: Float) -> Float:
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    determinant = a * d - b * c
    determinant = np.where(np.abs(determinant) > 1e-12, determinant, 1e-12)
    x = (d * right[..., 0] - b * right[..., 1]) / determinant
    y = (a * right[..., 1] - c * right[..., 0]) / determinant
    return np.stack([x, y], -1)
