"""Breakable vehicle parts, their fragments, and the underside shown in a rollover.

Parts are identified by their position in the vehicle's box. ECE R48 requires headlamps 0.5 to 1.2 m
above the road and within 0.4 m of the outline, so heights are in metres. Glass extends from the
belt line to just below the edge of the roof.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import Float, quaternion_to_matrix
from ..scene import GaussianCloud
from .structure import VEHICLES

Kind = Literal["lamp", "pane", "windscreen", "bumper"]
ENDS = 0.1
"""Length of the end that has lamps and bumpers, as a fraction of the vehicle's length."""
LAMP_HEIGHT, LAMP_WIDTH = (0.52, 0.9), 0.32
"""Height of lamps above the road [m]; width of a lamp, as a fraction of the vehicle's width."""
BUMPER_HEIGHT = (0.18, 0.52)
"""Height of bumpers above the road [m]."""
TALL = 1.9
"""Minimum height of a van or lorry, with higher belt line and bumpers [m]."""
BELT, BELT_TALL = 0.6, 0.5
"""Height of the belt line, where glass begins, as a fraction of the vehicle's height."""
COWL, UNDER_ROOF = 0.05, 0.94
"""Distance from the belt line to the lower edge of a windscreen, and height of the upper edge of
glass, as fractions of the vehicle's height."""
SCREEN, REAR_SCREEN = (0.56, 0.86), (0.02, 0.3)
"""Extents of the screens of a car along its length, as fractions from the rear."""
SCREEN_TALL = (0.72, 0.98)
INSIDE = 0.14
"""Depth of side windows from the outside, as a fraction of the width."""

AXLES, WHEEL_RADIUS, TREAD = 0.3, 0.38, 0.28
"""Wheels: distance of the axles from the middle as a fraction of the length, radius [m], width [m].
"""


@dataclass(frozen=True)
class Part:
    """A part of a vehicle.

    Attributes:
        name: unique name on the vehicle.
        kind: kind of breakage.
        low, high: corners of its box, vehicle frame [m].
        outward: [3] outward direction.
    """

    name: str
    kind: Kind
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    outward: tuple[float, float, float]

    def holds(self, points: Float, margin: float = 0.0) -> NDArray[np.bool_]:
        """[N] whether points [N, 3] are in its box, enlarged by ``margin`` [m]."""
        low, high = np.array(self.low) - margin, np.array(self.high) + margin
        inside: NDArray[np.bool_] = np.all((points > low) & (points < high), axis=1)
        return inside

    @property
    def middle(self) -> Float:
        """[3] centre of its box [m]."""
        middle: Float = np.array([self.low, self.high]).mean(axis=0)
        return middle


def parts_of(category: str, size: Sequence[float]) -> tuple[Part, ...]:
    """Parts of a vehicle of ``size`` (length, width, height) [m]; empty for other objects."""
    if category not in VEHICLES:
        return ()
    return (*_end(size, ahead=True), *_end(size, ahead=False), *_glass(size))


def in_wheels(points: Float, size: Sequence[float]) -> NDArray[np.bool_]:
    """[N] whether points [N, 3] of a vehicle are in the wheels below a box of ``size``."""
    length, width, height = size
    along = np.abs(np.abs(points[:, 0]) - AXLES * length)
    up = points[:, 2] + height / 2 - WHEEL_RADIUS
    inside: NDArray[np.bool_] = np.hypot(along, up) < WHEEL_RADIUS
    return inside & (np.abs(points[:, 1]) > width / 2 - TREAD)


def _end(size: Sequence[float], *, ahead: bool) -> list[Part]:
    """Lamps and bumper of the front or the rear."""
    length, width, height = size
    end, sign = ("front", 1.0) if ahead else ("rear", -1.0)
    near, far = sign * length * (0.5 - ENDS), sign * (length / 2 + 0.1)
    x = min(near, far), max(near, far)
    raised = 0.12 if height > TALL else 0.0
    bumper = [h + raised - height / 2 for h in BUMPER_HEIGHT]
    out = (sign, 0.0, 0.0)
    found = [
        Part(
            f"{end} bumper",
            "bumper",
            (x[0], -width, bumper[0] - 0.1),
            (x[1], width, bumper[1]),
            out,
        )
    ]
    lamp = [h + raised - height / 2 for h in LAMP_HEIGHT]
    for side, name in ((1.0, "left"), (-1.0, "right")):
        inner, outer = side * width * (0.5 - LAMP_WIDTH), side * (width / 2 + 0.1)
        y = min(inner, outer), max(inner, outer)
        low, high = (x[0], y[0], lamp[0]), (x[1], y[1], lamp[1])
        found.append(Part(f"{end} {name} lamp", "lamp", low, high, (sign, 0.3 * side, 0.0)))
    return found


def _glass(size: Sequence[float]) -> list[Part]:
    """Windscreen, rear window, side windows."""
    length, width, height = size
    tall = height > TALL
    belt = ((BELT_TALL if tall else BELT) - 0.5) * height
    top = (UNDER_ROOF - 0.5) * height
    half, inner = width / 2 + 0.1, (0.5 - INSIDE) * width
    x = [(f - 0.5) * length for f in (SCREEN_TALL if tall else SCREEN)]
    found = [
        Part(
            "windscreen",
            "windscreen",
            (x[0], -inner, belt + COWL * height),
            (x[1], inner, top),
            (0.8, 0.0, 0.6),
        )
    ]
    back = [(f - 0.5) * length for f in REAR_SCREEN]
    if not tall:
        low, high = (back[0], -inner, belt), (back[1], inner, top)
        found.append(Part("rear window", "pane", low, high, (-0.8, 0.0, 0.6)))
    # Side windows end at the A-pillar, which a crushed front does not reach.
    along = (x[0] - 0.15 * length, x[0] + 0.1 * length) if tall else (-0.36 * length, 0.18 * length)
    for side, name in ((1.0, "left"), (-1.0, "right")):
        y = (inner, half) if side > 0 else (-half, -inner)
        low, high = (along[0], y[0], belt), (along[1], y[1], top)
        found.append(Part(f"{name} windows", "pane", low, high, (0.0, side, 0.0)))
    return found


# Breakage: a part breaks when the particles around it move by its limit relative to each other.

LIMITS: dict[Kind, float] = {"lamp": 0.05, "bumper": 0.08, "windscreen": 0.03, "pane": 0.035}
"""Limits [m]. Lamps and bumpers: depth to which the outer part of their support is pushed in.
Glass: root mean square racking of its frame. Laminated screens crack first; side windows break with
their door."""
OUTER = 0.75
"""Quantile of the inward displacement to use: half the material around a lamp is behind it."""
MIN_PARTICLES = 3
NEAR = 0.6
"""Maximum distance from a part's box of the particles that carry it [spacings]."""


@dataclass(frozen=True)
class Breakage:
    """A broken part.

    Attributes:
        object_id, part, kind: vehicle, part and kind of breakage.
        time_s: time since the start [s].
        position: [3] centre of the part, world frame [m].
        velocity: [3] velocity of that point [m/s].
        outward: [3] outward direction of the part, world frame.
        severity: final strain over the limit, at least 1.
    """

    object_id: str
    part: str
    kind: Kind
    time_s: float
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    outward: tuple[float, float, float]
    severity: float

    def record(self) -> dict[str, Any]:
        """The breakage as JSON values."""
        return asdict(self)

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> Breakage:
        """Inverse of :meth:`record`. Raises TypeError for unknown fields."""
        members: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in record.items()
        }
        return cls(**members)


class BreakageLog:
    """Tracks the parts of one vehicle over the frames of a crash.

    Args:
        category, size: category and size of the vehicle; other objects have no parts.
        rest: [N, 3] particles at rest, object frame [m].
        spacing: particle spacing [m].
    """

    def __init__(
        self, category: str, size: Sequence[float], rest: Float, *, spacing: float
    ) -> None:
        self._rest = rest
        self._carried: list[tuple[Part, Any]] = []
        for part in parts_of(category, size):
            near = np.flatnonzero(part.holds(rest, NEAR * spacing))
            if len(near) >= MIN_PARTICLES:
                self._carried.append((part, near))
        self.broken: dict[str, float] = {}
        """Maximum strain over limit of each part; broken at 1 and above."""

    def follow(self, displacements: Float) -> list[Part]:
        """Parts that break in a frame in which particles are displaced [N, 3] [m] from rest."""
        new = []
        # Displacements are relative to the undeformed majority of the vehicle.
        moved = displacements - np.median(displacements, axis=0)
        for part, near in self._carried:
            passed = _strain(part, moved[near]) / LIMITS[part.kind]
            if passed >= 1.0 and part.name not in self.broken:
                new.append(part)
            if passed >= 1.0:
                self.broken[part.name] = max(self.broken.get(part.name, 0.0), passed)
        return new

    def copy(self) -> BreakageLog:
        """An independent copy of the log."""
        twin = copy(self)
        twin.broken = dict(self.broken)
        return twin

    def place(self, part: Part, displacements: Float) -> Float:
        """[3] current centre of a part, object frame [m]."""
        near = next(n for p, n in self._carried if p.name == part.name)
        place: Float = part.middle + displacements[near].mean(axis=0)
        return place


def _strain(part: Part, moved: Float) -> float:
    """The displacement to compare with the part's limit [m]."""
    if part.kind in ("windscreen", "pane"):
        return float(np.sqrt(((moved - moved.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return float(np.quantile(-(moved @ np.array(part.outward)), OUTER))


# Fragments fly, bounce, slide and come to rest on the road. Their paths are closed-form functions
# of time, so every instant can be rendered independently and is deterministic.

Heights = Callable[[Float], Float]
"""Height of the ground [K] [m] at positions [K, 2] or [K, 3]."""

GRAVITY = 9.81
REBOUND, KEPT, BOUNCES = 0.3, 0.6, 3
"""Vertical and horizontal restitution of a bounce, and number of bounces."""
SLIDING = 0.6
"""Coefficient of friction on the road."""
SPIN = 18.0
"""Angular speed of tumbling fragments [rad/s]."""
SH_0 = 0.28209479177387814


@dataclass(frozen=True)
class _Shards:
    """Fragment parameters of a kind of part.

    Attributes:
        count: number of fragments.
        size: range of half lengths [m]; glass is crumbs, bumpers are pieces.
        width, thickness: half width and half thickness as fractions of the half length.
        speed: initial speed outwards and sideways [m/s].
        spread: standard deviation of the start positions around the centre of the part [m].
        colours: colours, used in turn.
    """

    count: int
    size: tuple[float, float]
    width: float
    thickness: float
    speed: float
    spread: tuple[float, float, float]
    colours: tuple[tuple[float, float, float], ...]


CLEAR, DARK, RED = (0.72, 0.74, 0.76), (0.05, 0.05, 0.055), (0.42, 0.03, 0.03)
PALE = (0.58, 0.68, 0.66)
LAMP = _Shards(22, (0.015, 0.055), 0.7, 0.25, 1.2, (0.05, 0.1, 0.05), (CLEAR, CLEAR, DARK))
SHARDS: dict[Kind, _Shards] = {
    "lamp": LAMP,
    "bumper": _Shards(14, (0.035, 0.13), 0.5, 0.12, 0.8, (0.08, 0.55, 0.08), (DARK, DARK, CLEAR)),
    "windscreen": _Shards(20, (0.006, 0.016), 0.9, 0.6, 1.0, (0.2, 0.5, 0.1), (PALE,)),
    "pane": _Shards(90, (0.009, 0.022), 0.9, 0.7, 1.2, (0.45, 0.05, 0.1), (PALE, PALE, CLEAR)),
}


def fragment_cloud(
    broken: Sequence[Breakage], time_s: float, heights: Heights
) -> GaussianCloud | None:
    """All fragments at ``time_s`` [s], world frame, or None.

    Args:
        broken: broken parts.
        time_s: time on the clock of the breakages.
        heights: ground heights.
    """
    clouds = [
        _cloud(breakage, time_s - breakage.time_s, heights)
        for breakage in broken
        if breakage.time_s <= time_s
    ]
    return GaussianCloud.concatenate(clouds) if clouds else None


def _cloud(breakage: Breakage, age: float, heights: Heights) -> GaussianCloud:
    kind, shards = breakage.kind, SHARDS[breakage.kind]
    random = np.random.default_rng(zlib.crc32(f"{breakage.object_id}/{breakage.part}".encode()))
    n = max(round(shards.count * min(0.6 + 0.2 * breakage.severity, 1.4)), 1)
    start, velocity = _leaving(breakage, shards, n, random)
    half = random.uniform(*shards.size, n)
    thin = half * shards.thickness
    places, tumbled = _fallen(start, velocity, thin, age, heights)
    scales = np.stack([half, half * shards.width, thin], axis=1) * 0.7
    colours = np.array(shards.colours)[np.arange(n) % len(shards.colours)]
    if kind == "lamp" and breakage.part.startswith("rear"):
        colours[colours[:, 0] > 0.3] = RED
    colours = colours * random.uniform(0.7, 1.15, (n, 1))
    return GaussianCloud(
        means=_tensor(places),
        quats=_tensor(_tumbling(tumbled, random)),
        scales=_tensor(scales),
        opacities=_tensor(np.full(n, 0.97)),
        sh=_tensor(((colours - 0.5) / SH_0)[:, None, :]),
    )


def _leaving(
    breakage: Breakage, shards: _Shards, n: int, random: np.random.Generator
) -> tuple[Float, Float]:
    """Start [n, 3] and velocity [n, 3], relative to the outward direction of the part."""
    outward = np.array(breakage.outward)
    outward[2] = 0.0
    outward /= max(float(np.linalg.norm(outward)), 1e-9)
    across = np.array([-outward[1], outward[0], 0.0])
    axes = np.stack([outward, across, [0.0, 0.0, 1.0]])
    along, wide, high = shards.spread
    sides = (along, wide, high) if shards is not SHARDS["pane"] else (wide, along, high)
    start = np.array(breakage.position) + (random.normal(size=(n, 3)) * sides) @ axes
    scatter = random.normal(size=(n, 3)) * [0.6, 1.0, 0.6] + [0.35, 0.0, 0.7]
    # Higher severity throws fragments farther.
    speed = shards.speed * np.sqrt(min(breakage.severity, 4.0))
    return start, np.array(breakage.velocity) + speed * scatter @ axes


def _fallen(
    start: Float, velocity: Float, thin: Float, age: float, heights: Heights
) -> tuple[Float, Float]:
    """Positions [n, 3] at an age [s], and the tumbling time of each fragment [n]."""
    above = np.maximum(start[:, 2] - heights(start[:, :2]) - thin, 0.0)
    level, up = velocity[:, :2].copy(), velocity[:, 2].copy()
    left, place = np.full(len(start), age), start[:, :2].copy()
    tumbled, height = np.zeros(len(start)), above.copy()
    flying = np.ones(len(start), dtype=bool)
    for bounce in range(BOUNCES + 1):
        until = (up + np.sqrt(up**2 + 2 * GRAVITY * above)) / GRAVITY
        spent = np.where(flying, np.minimum(left, until), 0.0)
        height = np.where(flying, above + up * spent - GRAVITY / 2 * spent**2, height)
        place += level * spent[:, None]
        tumbled, left = tumbled + spent, left - spent
        landed = flying & (left > 0)
        flying = landed
        if bounce < BOUNCES:
            up = np.where(landed, REBOUND * np.abs(up - GRAVITY * until), up)
            level[landed] *= KEPT
            above = np.where(landed, 0.0, above)
    speed = np.linalg.norm(level, axis=1)
    stops = speed / (SLIDING * GRAVITY)
    slid = np.where(flying, np.minimum(left, stops), 0.0)
    place += level * (slid * (1 - slid / np.maximum(2 * stops, 1e-9)))[:, None]
    height = np.where(flying, 0.0, height)
    return np.concatenate(
        [place, (heights(place) + np.maximum(height, 0.0) + thin)[:, None]], axis=1
    ), tumbled


def _tumbling(tumbled: Float, random: np.random.Generator) -> Float:
    """[n, 4] quaternions of fragments after tumbling for [n] s; flat at rest."""
    n = len(tumbled)
    yaw, rate = random.uniform(0, np.pi, n), random.uniform(-SPIN, SPIN, n)
    axis = random.uniform(0, 2 * np.pi, n)
    roll = np.round(rate * tumbled / np.pi * 4) * np.pi / 4 * np.exp(-2.5 * tumbled)
    turn = np.stack(
        [
            np.cos(roll / 2),
            np.sin(roll / 2) * np.cos(axis),
            np.sin(roll / 2) * np.sin(axis),
            np.zeros(n),
        ],
        axis=1,
    )
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = turn.T
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=1)


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))


# The underside of a vehicle that turns over. Recordings do not show it. Training fits the contact
# shadow between wheels and road instead, which would look like a ragged plate on an overturned
# vehicle.

SHADOW, SILLS = 0.1, 0.3
"""Gaussians below SILLS [m] that reach down to SHADOW [m] above the road are shadow or tyre."""
FLOOR = 0.2
"""Height of the floor above the road [m]."""
INSET = (0.16, 0.06)
"""Inset of the floor from the ends and from the sides [m]."""
ROUNDED = 4.0
"""Exponent of its superelliptic outline, which is rounded like bumpers."""
PITCH, THICK = 0.07, 0.012
"""Spacing of its Gaussians, and half their thickness [m]."""
SHEET, FRAME, EXHAUST = 0.12, 0.2, 0.34
"""Brightness of the floor, of axles and sills, of the exhaust."""
ROUGH = 0.12
"""Amplitude of the brightness variation of ribs and covers."""
AXLE, PIPE = 0.09, 0.06
"""Half widths of an axle and of an exhaust [m]."""


def with_underside(cloud: GaussianCloud, size: Sequence[float]) -> GaussianCloud:
    """Replace the contact shadow of a vehicle by a floor.

    Args:
        cloud: Gaussians of the vehicle at rest, object frame.
        size: (length, width, height) [m].
    """
    points = cloud.means.detach().cpu().numpy().astype(np.float64)
    height = points[:, 2] + size[2] / 2
    axes = quaternion_to_matrix(cloud.quats.detach().cpu().numpy())
    reach = 2 * np.abs(axes[:, 2] * cloud.scales.detach().cpu().numpy()).max(axis=1)
    shadow = (height < SILLS) & (height - reach < SHADOW) & ~in_wheels(points, size)
    if not shadow.any():
        return cloud
    kept = torch.from_numpy(np.flatnonzero(~shadow)).to(cloud.device)
    pattern = torch.from_numpy(np.flatnonzero(shadow)[:1]).to(cloud.device)
    return GaussianCloud.concatenate([cloud.select(kept), _floor(cloud.select(pattern), size)])


def _floor(pattern: GaussianCloud, size: Sequence[float]) -> GaussianCloud:
    """Gaussians of a floor; other properties are those of ``pattern``."""
    length, width, height = size
    x, y = (
        np.linspace(-half, half, max(round(2 * half / PITCH), 2))
        for half in (length / 2 - INSET[0], width / 2 - INSET[1])
    )
    along, across = (a.ravel() for a in np.meshgrid(x, y, indexing="ij"))
    within = np.abs(along / x[-1]) ** ROUNDED + np.abs(across / y[-1]) ** (3 * ROUNDED) <= 1
    along, across = along[within], across[within]
    axle = np.abs(np.abs(along) - AXLES * length) < AXLE
    grey = np.where(axle | (np.abs(across) > width / 2 - 0.2), FRAME, SHEET)
    pipe = (np.abs(across - 0.15 * width) < PIPE) & (along < AXLES * length)
    grey = np.where(pipe, EXHAUST, grey)
    grey = grey * (1 + ROUGH * np.sin(9.0 * along) * np.sin(14.0 * across))
    means = np.stack([along, across, np.full(len(along), FLOOR - height / 2)], axis=1)
    count = len(means)
    each = pattern.select(torch.zeros(count, dtype=torch.int64, device=pattern.device))
    sh = torch.zeros_like(each.sh)
    sh[:, 0] = _tensor_like((grey - 0.5) / SH_0, sh)[:, None]
    return replace(
        each,
        means=_tensor_like(means, sh),
        quats=_tensor_like(np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), sh),
        scales=_tensor_like(np.tile([0.6 * PITCH, 0.6 * PITCH, THICK], (count, 1)), sh),
        opacities=torch.full_like(each.opacities, 0.98),
        sh=sh,
    )


def _tensor_like(values: np.ndarray, like: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32)).to(like.device)
