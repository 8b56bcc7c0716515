"""Houses along a building line: walls with recessed windows, doors, shops, roofs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.transform import Float
from .materials import DOOR, PLAIN, ROOF, WALL, WINDOW
from .mesh import MeshBuilder

Corners = Float | Sequence[Sequence[float]]

UV_PERIOD = 10.0
"""Window textures count windows in multiples of this, so that each can differ."""

PLASTER, BRICK = 0.0, 1.0
WALL_COLOURS = (
    (PLASTER, (0.62, 0.55, 0.42)),
    (PLASTER, (0.66, 0.62, 0.55)),
    (PLASTER, (0.55, 0.36, 0.26)),
    (PLASTER, (0.42, 0.47, 0.5)),
    (PLASTER, (0.6, 0.5, 0.28)),
    (PLASTER, (0.5, 0.52, 0.42)),
    (BRICK, (0.33, 0.13, 0.085)),
    (BRICK, (0.28, 0.15, 0.1)),
    (BRICK, (0.45, 0.34, 0.22)),
)
FRAME_COLOURS = ((0.75, 0.75, 0.73), (0.2, 0.12, 0.07), (0.12, 0.14, 0.15), (0.1, 0.2, 0.14))
ROOF_COLOURS = ((0.3, 0.1, 0.06), (0.2, 0.09, 0.06), (0.09, 0.09, 0.1))
SHOP_COLOURS = (
    (0.05, 0.2, 0.1), (0.35, 0.04, 0.04), (0.04, 0.08, 0.25), (0.4, 0.28, 0.04), (0.05, 0.05, 0.05)
)  # fmt: skip


@dataclass(frozen=True)
class House:
    """How a house looks.

    Attributes:
        floors: storeys, the ground floor included.
        floor_height, bay: height of a storey, distance between windows [m].
        window: (width, height) of a window [m].
        shop: whether the ground floor is a shop.
        wall, trim, frame, roof, front: rows of the paint table.
        recess: depth of the windows behind the wall [m].
        depth: of the house [m].
    """

    floors: int
    floor_height: float
    bay: float
    window: tuple[float, float]
    shop: bool
    wall: int
    trim: int
    frame: int
    roof: int
    front: int
    recess: float
    depth: float

    @property
    def height(self) -> float:
        """Of the eaves [m]."""
        return self.floors * self.floor_height + 0.5


def design_house(rng: np.random.Generator, builder: MeshBuilder) -> House:
    """A house with random measures and colours."""
    kind, colour = WALL_COLOURS[rng.integers(len(WALL_COLOURS))]
    tint = np.array(colour) * rng.uniform(0.88, 1.08)
    frame = FRAME_COLOURS[rng.integers(len(FRAME_COLOURS))]
    window = (rng.uniform(1.0, 1.4), rng.uniform(1.45, 1.8))
    shop = bool(rng.random() < 0.35)
    shop_colour = SHOP_COLOURS[rng.integers(len(SHOP_COLOURS))]
    return House(
        floors=int(rng.integers(3, 6)),
        floor_height=rng.uniform(2.9, 3.3),
        bay=rng.uniform(2.3, 3.0),
        window=window,
        shop=shop,
        wall=builder.mix(*tint, kind, float(rng.integers(1000))),
        trim=builder.mix(*(np.array([0.6, 0.57, 0.52]) * rng.uniform(0.75, 1.1))),
        frame=builder.mix(*frame, *window),
        roof=builder.mix(*ROOF_COLOURS[rng.integers(len(ROOF_COLOURS))]),
        front=builder.mix(*shop_colour, 0.0, 0.0),
        recess=rng.uniform(0.12, 0.22),
        depth=rng.uniform(8, 11),
    )


class Facade:
    """Places flat pieces in a house's own axes: u along the front, w out of it, z up."""

    def __init__(self, builder: MeshBuilder, start: ArrayLike, end: ArrayLike) -> None:
        """The front runs from ``start`` to ``end`` [2]; the street lies to its right."""
        self.builder = builder
        self.start = np.asarray(start, dtype=np.float64)
        span = np.asarray(end, dtype=np.float64) - self.start
        self.width = float(np.linalg.norm(span))
        along = span / self.width
        self.axes = np.array([[*along, 0.0], [along[1], -along[0], 0.0], [0.0, 0.0, 1.0]])

    def world(self, local: ArrayLike) -> Float:
        """World points of (u, w, z) [..., 3]."""
        points: Float = np.asarray(local, dtype=np.float64) @ self.axes
        points += np.array([*self.start, 0.0])
        return points

    def panel(
        self,
        u: tuple[float, float],
        z: tuple[float, float],
        material: int,
        paint: int,
        *,
        w: float = 0.0,
        uv: Corners | None = None,
    ) -> None:
        """A rectangle parallel to the front."""
        corners = [[u[0], w, z[0]], [u[1], w, z[0]], [u[1], w, z[1]], [u[0], w, z[1]]]
        texture = np.array(corners)[:, [0, 2]] if uv is None else uv
        self.builder.quad(self.world(corners), material, paint, texture)

    def box(self, low: ArrayLike, high: ArrayLike, material: int, paint: int) -> None:
        """A box in (u, w, z)."""
        self.builder.oriented_box(
            self.axes, [*self.start, 0.0], low, high, material=material, paint=paint
        )

    def wall(self, corners: ArrayLike, material: int, paint: int, uv: Corners) -> None:
        """Any quad in (u, w, z)."""
        self.builder.quad(self.world(corners), material, paint, uv)


def add_house(facade: Facade, house: House, rng: np.random.Generator) -> None:
    """The whole house behind its front."""
    bays = max(1, int(facade.width / house.bay))
    bay = facade.width / bays
    door_bay = int(rng.integers(bays))
    for floor in range(house.floors):
        bottom = 0.5 + floor * house.floor_height if floor else 0.0
        top = 0.5 + (floor + 1) * house.floor_height
        for i in range(bays):
            cell = ((i * bay, (i + 1) * bay), (bottom, top))
            if floor:
                _add_window(facade, house, *cell, sill=0.85, rng=rng)
            elif i == door_bay:
                _add_door(facade, house, *cell)
            elif house.shop:
                _add_shop_window(facade, house, *cell, rng=rng)
            else:
                _add_window(facade, house, *cell, sill=1.35, rng=rng)
    if house.shop:
        z = 0.5 + house.floor_height
        facade.box([0.15, 0, z - 0.55], [facade.width - 0.15, 0.12, z - 0.05], PLAIN, house.front)
    else:
        z = 0.5 + house.floor_height
        facade.box([0, 0, z - 0.1], [facade.width, 0.07, z + 0.08], PLAIN, house.trim)
    _add_top(facade, house)


def _opening(
    facade: Facade,
    house: House,
    cell: tuple[tuple[float, float], tuple[float, float]],
    u: tuple[float, float],
    z: tuple[float, float],
) -> None:
    """Wall around an opening, and its reveal."""
    (u0, u1), (z0, z1) = cell
    for part in (
        ((u0, u[0]), (z0, z1)),
        ((u[1], u1), (z0, z1)),
        ((u[0], u[1]), (z0, z[0])),
        ((u[0], u[1]), (z[1], z1)),
    ):
        if part[0][1] - part[0][0] > 1e-6 and part[1][1] - part[1][0] > 1e-6:
            facade.panel(*part, WALL, house.wall)
    d = -house.recess
    for a, b in ((u[0], u[0]), (u[1], u[1])):
        corners = [[a, 0, z[0]], [b, d, z[0]], [b, d, z[1]], [a, 0, z[1]]]
        facade.wall(corners, WALL, house.wall, [[0, z[0]], [-d, z[0]], [-d, z[1]], [0, z[1]]])
    for h in z:
        corners = [[u[0], 0, h], [u[1], 0, h], [u[1], d, h], [u[0], d, h]]
        facade.wall(corners, PLAIN, house.trim, [[u[0], 0], [u[1], 0], [u[1], -d], [u[0], -d]])


def _add_window(
    facade: Facade,
    house: House,
    u: tuple[float, float],
    z: tuple[float, float],
    *,
    sill: float,
    rng: np.random.Generator,
) -> None:
    width, height = house.window
    left = (u[0] + u[1] - width) / 2
    low = z[0] + sill
    high = min(low + height, z[1] - 0.3)
    _opening(facade, house, (u, z), (left, left + width), (low, high))
    number = UV_PERIOD * float(rng.integers(1, 4000))
    uv = [[number, 0], [number + width, 0], [number + width, height], [number, height]]
    pane = ((left, left + width), (low, high))
    facade.panel(*pane, WINDOW, house.frame, w=-house.recess, uv=uv)
    facade.box(
        [left - 0.08, -0.02, low - 0.08], [left + width + 0.08, 0.09, low], PLAIN, house.trim
    )


def _add_shop_window(
    facade: Facade,
    house: House,
    u: tuple[float, float],
    z: tuple[float, float],
    *,
    rng: np.random.Generator,
) -> None:
    pane = (u[0] + 0.2, u[1] - 0.2)
    low, high = 0.45, z[1] - 0.6
    _opening(facade, house, (u, z), pane, (low, high))
    number = UV_PERIOD * float(rng.integers(1, 4000))
    width, height = pane[1] - pane[0], high - low
    paint = facade.builder.mix(0.06, 0.06, 0.065, width, height, 1.0)
    uv = [[number, 0], [number + width, 0], [number + width, height], [number, height]]
    facade.panel(pane, (low, high), WINDOW, paint, w=-house.recess, uv=uv)


def _add_door(facade: Facade, house: House, u: tuple[float, float], z: tuple[float, float]) -> None:
    width, high = 1.15, 2.65
    left = (u[0] + u[1] - width) / 2
    _opening(facade, house, (u, z), (left, left + width), (0.15, high))
    colour = facade.builder.paints[house.front][:3]
    paint = facade.builder.mix(*colour, width, high - 0.15)
    top = high - 0.15
    uv = [[0.0, 0.0], [width, 0.0], [width, top], [0.0, top]]
    facade.panel((left, left + width), (0.15, high), DOOR, paint, w=-house.recess, uv=uv)


def _add_top(facade: Facade, house: House) -> None:
    """Side walls, gables, cornice and a saddle roof."""
    width, height, depth = facade.width, house.height, house.depth
    ridge = height + depth * 0.32
    for u in (0.0, width):
        corners = [[u, 0, 0], [u, -depth, 0], [u, -depth, height], [u, 0, height]]
        facade.wall(corners, WALL, house.wall, [[0, 0], [depth, 0], [depth, height], [0, height]])
        gable = [
            [u, 0, height],
            [u, -depth, height],
            [u, -depth / 2, ridge],
            [u, -depth / 2, ridge],
        ]
        facade.wall(
            gable,
            WALL,
            house.wall,
            [[0, height], [depth, height], [depth / 2, ridge], [depth / 2, ridge]],
        )
    back = [[0, -depth, 0], [width, -depth, 0], [width, -depth, height], [0, -depth, height]]
    facade.wall(back, WALL, house.wall, [[0, 0], [width, 0], [width, height], [0, height]])
    facade.box([0, 0, height - 0.3], [width, 0.25, height], PLAIN, house.trim)
    slope = float(np.hypot(depth / 2, ridge - height))
    for edge in (0.3, -depth - 0.3):
        eaves = height - 0.02
        corners = [
            [0, edge, eaves],
            [width, edge, eaves],
            [width, -depth / 2, ridge],
            [0, -depth / 2, ridge],
        ]
        facade.wall(corners, ROOF, house.roof, [[0, 0], [width, 0], [width, slope], [0, slope]])
    chimney = 0.2 * width
    low = [chimney, -depth / 2 - 0.3, ridge - 0.6]
    facade.box(low, [chimney + 0.6, -depth / 2 + 0.3, ridge + 0.8], WALL, house.wall)
