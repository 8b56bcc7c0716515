"""Vehicle bodies: lofted shells with wheels, lamps and mirrors, one mesh per shape.

The frame of a shape is its box: origin at the box centre, x forward, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import PchipInterpolator

from ..geometry import Float
from .materials import BODY, PLAIN, WHEEL
from .mesh import Mesh, MeshBuilder

PROFILE_SAMPLES = 96
"""Number of samples of the roof line for lookups by the body's surface."""
CARGO_FLOOR = 1.0
"""Height of the box behind a cab over the ground [m]."""


@dataclass(frozen=True)
class VehicleShape:
    """Measures of a body; lengths in metres, x from the middle, z from the ground.

    Attributes:
        name: name of the shape.
        category: category of the track.
        size: (length, width, height).
        roof: (x / length, z / height) along the top, from rear to front.
        belt: height of the window sill.
        side_glass: x / length from and to.
        windscreen: x / length of its foot and its top edge.
        rear_window: x / length of its foot and its top edge; equal values for none.
        axles: x / length of the rear and the front axle.
        wheel_radius, clearance: radius of the wheels, and clearance below the sill.
        pillars: number of pillars between the side windows.
        boxiness: exponent of the roof's cross-section, small for boxy.
        cargo: x / length from and to of a box behind the cab; equal values for none.
        weight: relative frequency.
    """

    name: str
    category: str
    size: tuple[float, float, float]
    roof: tuple[tuple[float, float], ...]
    belt: float
    side_glass: tuple[float, float]
    windscreen: tuple[float, float]
    rear_window: tuple[float, float]
    axles: tuple[float, float]
    wheel_radius: float = 0.32
    clearance: float = 0.2
    pillars: int = 2
    boxiness: float = 0.5
    cargo: tuple[float, float] = (0.0, 0.0)
    weight: float = 1.0


SHAPES = (
    VehicleShape(
        "saloon", "car", (4.7, 1.82, 1.46),
        ((-0.5, 0.58), (-0.49, 0.68), (-0.45, 0.71), (-0.38, 0.72), (-0.34, 0.75), (-0.2, 0.955),
         (-0.1, 0.995), (0.0, 1.0), (0.07, 0.97), (0.14, 0.85), (0.22, 0.69), (0.27, 0.655),
         (0.42, 0.58), (0.48, 0.5), (0.5, 0.44)),
        0.95, (-0.31, 0.19), (0.225, 0.08), (-0.345, -0.2), (-0.29, 0.3), weight=3.0,
    ),
    VehicleShape(
        "hatchback", "car", (4.1, 1.76, 1.5),
        ((-0.5, 0.55), (-0.49, 0.68), (-0.46, 0.74), (-0.38, 0.94), (-0.3, 0.985), (-0.15, 1.0),
         (0.0, 0.99), (0.07, 0.96), (0.15, 0.84), (0.24, 0.69), (0.29, 0.65), (0.43, 0.57),
         (0.48, 0.49), (0.5, 0.43)),
        0.96, (-0.4, 0.21), (0.245, 0.08), (-0.455, -0.37), (-0.31, 0.31), weight=3.0,
    ),
    VehicleShape(
        "estate", "car", (4.65, 1.84, 1.68),
        ((-0.5, 0.5), (-0.495, 0.64), (-0.47, 0.7), (-0.43, 0.94), (-0.38, 0.98), (-0.2, 1.0),
         (0.0, 0.995), (0.06, 0.97), (0.13, 0.85), (0.21, 0.7), (0.25, 0.665), (0.42, 0.6),
         (0.48, 0.53), (0.5, 0.45)),
        1.1, (-0.42, 0.18), (0.215, 0.07), (-0.465, -0.425), (-0.29, 0.3),
        wheel_radius=0.36, clearance=0.24, pillars=3, weight=2.5,
    ),
    VehicleShape(
        "van", "van", (5.3, 1.98, 2.15),
        ((-0.5, 0.93), (-0.49, 0.97), (-0.45, 0.99), (-0.2, 1.0), (0.15, 1.0), (0.21, 0.98),
         (0.26, 0.9), (0.36, 0.61), (0.39, 0.56), (0.47, 0.48), (0.495, 0.42), (0.5, 0.36)),
        1.22, (0.14, 0.335), (0.365, 0.22), (-0.4, -0.4), (-0.3, 0.33),
        wheel_radius=0.34, pillars=1, boxiness=0.3, weight=1.5,
    ),
    VehicleShape(
        "box_truck", "truck", (7.4, 2.4, 3.2),
        ((0.2, 0.76), (0.22, 0.79), (0.35, 0.8), (0.4, 0.79), (0.43, 0.75), (0.475, 0.5),
         (0.49, 0.42), (0.5, 0.36)),
        1.5, (0.26, 0.45), (0.478, 0.43), (0.2, 0.2), (-0.26, 0.36),
        wheel_radius=0.46, clearance=0.42, pillars=0, boxiness=0.25, cargo=(-0.5, 0.19), weight=0.7,
    ),
    VehicleShape(
        "bus", "bus", (10.8, 2.5, 3.05),
        ((-0.5, 0.88), (-0.495, 0.95), (-0.48, 0.99), (-0.4, 1.0), (0.4, 1.0), (0.48, 0.99),
         (0.49, 0.96), (0.495, 0.9), (0.4985, 0.45), (0.5, 0.36)),
        1.25, (-0.46, 0.47), (0.4987, 0.494), (-0.5, -0.5), (-0.26, 0.29),
        wheel_radius=0.48, clearance=0.32, pillars=6, boxiness=0.16, weight=0.4,
    ),
)  # fmt: skip


def shape_row(shape: VehicleShape) -> list[float]:
    """Measures in metres that the body's material needs, see ``materials.body_surface``."""
    length, width, height = shape.size
    return [
        length,
        width,
        height,
        shape.belt,
        *(x * length for x in shape.side_glass),
        *(x * length for x in shape.windscreen),
        *(x * length for x in shape.rear_window),
        *(x * length for x in shape.axles),
        shape.wheel_radius,
        shape.clearance,
        float(shape.pillars),
        float(shape.category == "bus"),
    ]


def roof_heights(shape: VehicleShape) -> Float:
    """Heights of the roof line [PROFILE_SAMPLES] at even steps from rear to front [m]."""
    return _roof(shape, np.linspace(-0.5, 0.5, PROFILE_SAMPLES) * shape.size[0])


def build_vehicle(shape: VehicleShape, paints: list[tuple[float, ...]]) -> Mesh:
    """The mesh of a shape, in the frame of its box."""
    builder = MeshBuilder(paints)
    black = builder.mix(0.02, 0.02, 0.022)
    _add_shell(builder, shape)
    _add_wheels(builder, shape, black)
    _add_mirrors(builder, shape, black)
    if shape.cargo[0] < shape.cargo[1]:
        _add_cargo(builder, shape, black)
    mesh = builder.build()
    mesh.corners[..., 2] -= shape.size[2] / 2
    return mesh


def _roof(shape: VehicleShape, x: Float) -> Float:
    ends = shape.roof[0][0], shape.roof[-1][0]
    heights: Float = _roof_curve(shape)(np.clip(x / shape.size[0], *ends))
    return heights * shape.size[2]


@cache
def _roof_curve(shape: VehicleShape) -> PchipInterpolator:
    return PchipInterpolator(*np.array(shape.roof).T)


def _add_shell(builder: MeshBuilder, shape: VehicleShape) -> None:
    length = shape.size[0]
    rear, front = shape.roof[0][0] * length, shape.roof[-1][0] * length
    ends = 0.5 * (1 - np.cos(np.linspace(0, np.pi / 2, 9)))
    even = np.linspace(0, 1, 44)
    at = np.unique(np.concatenate([even, ends * 0.12, 1 - ends * 0.12]))
    stations = rear + at * (front - rear)
    rings = np.array([_ring(shape, x, rear, front) for x in stations])
    points = np.concatenate(
        [np.broadcast_to(stations[:, None, None], (*rings.shape[:2], 1)), rings], axis=2
    )
    mirrored = points[:, -2::-1] * [1, -1, 1]
    loop = np.concatenate([points, mirrored], axis=1)
    builder.grid(loop, np.zeros((*loop.shape[:2], 2)), BODY, 0)
    for end in (0, -1):
        half = points[end]
        cap = np.stack([half * [1, -1, 1], half], axis=1)
        if end == 0:
            cap = cap[:, ::-1]
        builder.grid(cap, np.zeros((*cap.shape[:2], 2)), BODY, 0)


def _ring(shape: VehicleShape, x: float, rear: float, front: float) -> Float:
    """Half a cross-section [k, 2] (y, z) at x, from the middle below to the middle above."""
    _, width, height = shape.size
    half = (width / 2 - 0.012) * _plan(x, rear, front, shape)
    top = float(_roof(shape, np.array(x)))
    belt = min(shape.belt, top - 0.06)
    near_end = max(0.0, 1 - min(x - rear, front - x) / 0.35)
    bottom = shape.clearance + 0.08 * near_end**2
    side = np.linspace(0, 1, 7)
    bulge = 1 - 0.045 * (2 * side - 0.9) ** 2
    lower = np.stack([half * bulge, bottom + side * (belt - bottom)], axis=1)
    shoulder = lower[-1, 0]
    angle = np.linspace(0, np.pi / 2, 11)[1:]
    rise = np.sin(angle) ** shape.boxiness
    upper_z = belt + (top - belt) * rise
    lean = 0.2 * (shape.boxiness / 0.5) * (upper_z - belt) / (height - shape.belt)
    inset = 0.05 if top - belt > 0.2 else 0.05 * max(top - belt - 0.06, 0) / 0.14
    upper_y = (shoulder - inset) * np.cos(angle) ** shape.boxiness * (1 - lean)
    below = np.array([[0.0, bottom], [half * 0.86, bottom]])
    return np.concatenate([below, lower, np.stack([upper_y, upper_z], axis=1)])


def _plan(x: float, rear: float, front: float, shape: VehicleShape) -> float:
    """Half width as a fraction of the full one: corners rounded in plan view."""
    boxy = shape.boxiness < 0.4
    for distance, reach, depth in (
        (front - x, 0.35 if boxy else 0.75, 0.1 if boxy else 0.17),
        (x - rear, 0.2 if boxy else 0.5, 0.05 if boxy else 0.13),
    ):
        if distance < reach:
            q = 1 - distance / reach
            return 1 - depth * (1 - math.sqrt(max(1 - q * q, 0.0)))
    return 1.0


def _add_wheels(builder: MeshBuilder, shape: VehicleShape, black: int) -> None:
    length, width, _ = shape.size
    radius = shape.wheel_radius
    angle = np.linspace(0, 2 * np.pi, 29)
    circle = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)
    for axle in shape.axles:
        for side in (-1.0, 1.0):
            centre = np.array([axle * length, side * (width / 2), radius])
            steps = [(1.0, 0.24), (1.0, 0.03), (0.95, 0.0), (0.0, 0.0)]
            rings = np.array([centre + circle * radius * r - [0, side * d, 0] for r, d in steps])
            uv = np.array([circle[:, [0, 2]] * r for r, _ in steps])
            # Each step is a separate strip: a shared edge would round off the tyre's shoulder.
            for k in range(3):
                builder.grid(rings[k : k + 2], uv[k : k + 2], WHEEL, black)


def _add_mirrors(builder: MeshBuilder, shape: VehicleShape, black: int) -> None:
    length, width, _ = shape.size
    x = shape.side_glass[1] * length - 0.12
    low, high = shape.belt + 0.02, shape.belt + 0.17
    if shape.boxiness < 0.4:
        return
    for side in (-1.0, 1.0):
        outer, inner = side * (width / 2 - 0.002), side * (width / 2 - 0.17)
        ends = (min(outer, inner), max(outer, inner))
        builder.box([x - 0.05, ends[0], low], [x + 0.06, ends[1], high], PLAIN, black)


def _add_cargo(builder: MeshBuilder, shape: VehicleShape, black: int) -> None:
    length, width, height = shape.size
    rear, front = (x * length for x in shape.cargo)
    white = builder.mix(0.72, 0.72, 0.7)
    stripe = builder.mix(0.1, 0.22, 0.45)
    floor = CARGO_FLOOR
    half = width / 2
    builder.box([rear, -half, floor], [front, half, height], PLAIN, white)
    for y in (-half - 0.001, half + 0.001):
        corners = [[x, y, z] for x, z in ((rear, 1.5), (front, 1.5), (front, 1.8), (rear, 1.8))]
        builder.quad(corners, PLAIN, stripe)
    builder.box([rear + 0.1, -0.5, 0.5], [front + 0.6, 0.5, floor], PLAIN, black)
    red = builder.mix(0.45, 0.02, 0.02)
    for side in (-1.0, 1.0):
        ends = sorted((side * (half - 0.35), side * (half - 0.05)))
        builder.box([rear, ends[0], 0.8], [rear + 0.08, ends[1], 0.94], PLAIN, red)
