"""The static world along a street: ground, houses, trees, lamps and signs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..geometry import Float
from .materials import (
    BARK,
    DOOR,
    EARTH,
    KERB_STONE,
    LEAVES,
    PAVING,
    PLAIN,
    ROAD,
    ROOF,
    SIGN,
    WALL,
    WINDOW,
)
from .mesh import Mesh, MeshBuilder
from .street import FACADE, KERB, KERB_HEIGHT, LANE, Street

# Houses along a building line: walls with recessed windows, doors, shops, roofs.

Corners = Float | Sequence[Sequence[float]]

UV_PERIOD = 10.0
"""Texture coordinates number windows in multiples of this, so that each can differ."""

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
    """The appearance of a house.

    Attributes:
        floors: storeys, the ground floor included.
        floor_height, bay: height of a storey, distance between windows [m].
        window: (width, height) of a window [m].
        shop: whether the ground floor is a shop.
        wall, trim, frame, roof, front: rows of the paint table.
        recess: depth of the windows behind the wall [m].
        depth: depth of the house [m].
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
        """Height of the eaves [m]."""
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
    """Places flat pieces in the axes of a house: u along the front, w outwards, z up."""

    def __init__(self, builder: MeshBuilder, start: ArrayLike, end: ArrayLike) -> None:
        """The front runs from ``start`` to ``end`` [2]; the street is to its right."""
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


TREE_ROW = KERB + 0.7
LAMP_ROW = KERB + 0.5


def build_surroundings(
    street: Street, paints: list[tuple[float, ...]], rng: np.random.Generator
) -> Mesh:
    """All static geometry, without parked vehicles."""
    builder = MeshBuilder(paints)
    _add_ground(builder, street)
    for side in (-1.0, 1.0):
        _add_house_row(builder, street, side, rng)
        _add_street_furniture(builder, street, side, rng)
    _close_street(builder, street, rng)
    return builder.build()


def _add_ground(builder: MeshBuilder, street: Street) -> None:
    road = builder.mix(0.1, 0.1, 0.105, street.crossing, LANE, KERB)
    stone, slab = builder.mix(0.3, 0.29, 0.27), builder.mix(0.27, 0.26, 0.245)
    earth = builder.mix(0.09, 0.13, 0.04)
    s = np.arange(street.start, street.end + 0.5)
    strips = [((-KERB, 0.0), (KERB, 0.0), ROAD, road)]
    for side in (-1.0, 1.0):
        inner, outer = side * KERB, side * (KERB + 0.14)
        strips += [
            ((inner, -0.02), (inner, KERB_HEIGHT), KERB_STONE, stone),
            ((inner, KERB_HEIGHT), (outer, KERB_HEIGHT), KERB_STONE, stone),
            ((outer, KERB_HEIGHT), (side * FACADE, KERB_HEIGHT), PAVING, slab),
            ((side * FACADE, KERB_HEIGHT - 0.01), (side * 45, KERB_HEIGHT - 0.01), EARTH, earth),
        ]
    for (d0, z0), (d1, z1), material, paint in strips:
        d, z = np.array([d0, d1]), np.array([z0, z1])
        xy = street.point(s[:, None], d[None])
        heights = np.broadcast_to(z, xy.shape[:2])
        across = d if d0 != d1 else z
        uv = np.stack(np.broadcast_arrays(s[:, None], across[None]), axis=-1).astype(np.float64)
        points = np.concatenate([xy, heights[..., None]], axis=2)
        builder.grid(points, uv, material, paint)


def _add_house_row(
    builder: MeshBuilder, street: Street, side: float, rng: np.random.Generator
) -> None:
    s = street.start
    while s < street.end - 8:
        width = min(rng.uniform(9, 17), street.end - s)
        setback = float(rng.choice([0.0, 0.0, 0.4, 0.8, 5.0], p=[0.4, 0.15, 0.15, 0.15, 0.15]))
        ends = street.point([s, s + width], side * (FACADE + setback))
        # The street must be to the right of a front's direction.
        start, end = ends if side > 0 else ends[::-1]
        house = design_house(rng, builder)
        add_house(Facade(builder, start, end), house, rng)
        if setback > 2:
            _add_front_garden(builder, street, side, (s, s + width), rng)
        s += width


def _add_front_garden(
    builder: MeshBuilder,
    street: Street,
    side: float,
    span: tuple[float, float],
    rng: np.random.Generator,
) -> None:
    hedge = builder.mix(0.05, 0.11, 0.025, 0.8)
    middle = (span[0] + span[1]) / 2
    for a, b in ((span[0] + 0.3, middle - 0.8), (middle + 0.8, span[1] - 0.3)):
        ends = street.point([a, b], side * (FACADE + 0.45))
        front = Facade(builder, *(ends if side > 0 else ends[::-1]))
        front.box([0, -0.45, 0], [front.width, 0.3, rng.uniform(0.9, 1.3)], LEAVES, hedge)
    _add_tree(builder, street.point(middle - 2.5, side * (FACADE + 2.6)), 0.7, rng)


def _add_street_furniture(
    builder: MeshBuilder, street: Street, side: float, rng: np.random.Generator
) -> None:
    s = street.start + rng.uniform(2, 8)
    while s < street.end - 5:
        if abs(s - street.crossing) > 4:
            _add_tree(builder, street.point(s, side * TREE_ROW), rng.uniform(0.8, 1.1), rng)
        s += rng.uniform(11, 19)
    s = street.start + (6 if side > 0 else 19)
    while s < street.end:
        _add_lamp(builder, street, s, side)
        s += 26
    for at, colour in ((street.crossing - 2.6 * side, (0.03, 0.1, 0.45)), (58, (0.5, 0.03, 0.03))):
        _add_sign(builder, street, at, side, colour)
    for k in range(4):
        at = street.crossing + (-1) ** k * (2.6 + 1.4 * (k // 2))
        base = np.array([*street.point(at, side * (KERB + 0.35)), KERB_HEIGHT])
        post = builder.mix(0.06, 0.065, 0.07)
        builder.tube([base, _above(base, 0.95)], [0.06, 0.05], PLAIN, post)
        builder.tube([_above(base, 0.95), _above(base, 1.0)], [0.065, 0.02], PLAIN, post)


def _add_tree(builder: MeshBuilder, at: Float, size: float, rng: np.random.Generator) -> None:
    ground = np.array([*at, KERB_HEIGHT])
    bark = builder.mix(0.13, 0.1, 0.075)
    green = np.array([0.095, 0.17, 0.035]) * rng.uniform(0.75, 1.2) * [rng.uniform(0.8, 1.35), 1, 1]
    leaves = builder.mix(*green, 1.0)
    height = size * rng.uniform(2.7, 3.2)
    lean = np.array([*rng.uniform(-0.15, 0.15, 2), 0.0])
    levels = np.array([0, 0.15, 0.6, 1.0, 1.6])
    path = ground + levels[:, None] * (np.array([0, 0, height]) + lean)
    builder.tube(path, size * np.array([0.2, 0.15, 0.13, 0.11, 0.05]), BARK, bark)
    fork = path[3]
    for k in range(6):
        angle = k * 2.4 + rng.uniform(0, 0.8)
        reach = size * rng.uniform(0.5, 1.15) if k else 0.0
        shift = np.array([np.cos(angle), np.sin(angle), rng.uniform(0.35, 1.3)]) * reach
        centre = _above(fork + shift, size * (1.0 if k else 1.9))
        builder.tube([_above(fork, -0.2), centre], [0.07 * size, 0.02], BARK, bark, sides=5)
        _add_foliage(builder, centre, size * rng.uniform(0.95, 1.35), leaves, rng)


def _add_foliage(
    builder: MeshBuilder, centre: Float, radius: float, paint: int, rng: np.random.Generator
) -> None:
    """A clump of leaves: a ball of loose quads with light and sky visible through its edge."""
    count = 230
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    depth = rng.uniform(0.45, 1.05, (count, 1)) ** 0.5
    at = centre + direction * depth * radius * [1, 1, 0.8]
    normal = direction + rng.normal(scale=0.45, size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = np.cross(normal, rng.normal(size=(count, 3)))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    size = radius * rng.uniform(0.1, 0.22, (count, 1))
    corners = np.stack(
        [at - size * first, at + size * second, at + size * first, at - size * second], axis=1
    )
    split = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    # Leaves are lit like the clump that they belong to, which gives crowns their look.
    soft = direction * 0.8 + normal * 0.2
    soft /= np.linalg.norm(soft, axis=1, keepdims=True)
    normals = np.repeat(np.repeat(soft, 2, axis=0)[:, None], 3, axis=1)
    uv = np.stack([split[..., 0] + split[..., 2], split[..., 1] - split[..., 2]], axis=-1)
    builder.triangles(split, normals, LEAVES, paint, uv)


def _add_lamp(builder: MeshBuilder, street: Street, s: float, side: float) -> None:
    metal, glass = builder.mix(0.16, 0.18, 0.17), builder.mix(0.75, 0.75, 0.7)
    base = np.array([*street.point(s, side * LAMP_ROW), KERB_HEIGHT])
    head = np.array([*street.point(s, side * (LAMP_ROW - 1.7)), 6.9])
    knee = np.array([*base[:2], 6.4])
    builder.tube([base, _above(base, 1.0)], [0.11, 0.1], PLAIN, metal)
    middle = _above((knee + head) / 2, 0.18)
    builder.tube([_above(base, 1.0), knee, middle, head], [0.075, 0.055, 0.045, 0.04], PLAIN, metal)
    builder.box(
        head - np.array([0.28, 0.16, 0.09]), head + np.array([0.28, 0.16, 0.05]), PLAIN, metal
    )
    builder.box(
        head - np.array([0.22, 0.12, 0.12]), head + np.array([0.22, 0.12, -0.09]), PLAIN, glass
    )


def _add_sign(
    builder: MeshBuilder,
    street: Street,
    s: float,
    side: float,
    colour: tuple[float, float, float],
) -> None:
    metal, face = builder.mix(0.3, 0.31, 0.32), builder.mix(*colour)
    base = np.array([*street.point(s, side * (KERB + 0.55)), KERB_HEIGHT])
    builder.tube([base, _above(base, 2.95)], [0.032, 0.032], PLAIN, metal)
    heading = float(street.heading(s)) + (np.pi if side < 0 else 0.0)
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = np.array([-forward[1], forward[0], 0.0])
    centre = _above(base, 2.6) + 0.05 * forward
    corners = [
        centre + 0.32 * (a * across + b * np.array([0, 0, 1.0]))
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    builder.quad(corners, SIGN, face, [[-1, -1], [1, -1], [1, 1], [-1, 1]])


def _close_street(builder: MeshBuilder, street: Street, rng: np.random.Generator) -> None:
    """Houses across both ends of the street, to close the view."""
    for s, facing in ((street.start, 1.0), (street.end, -1.0)):
        heading = float(street.heading(s))
        across = np.array([-np.sin(heading), np.cos(heading)]) * facing
        outward = -facing * np.array([np.cos(heading), np.sin(heading)])
        middle = street.point(s, 0.0) - outward * 0.5
        for k in range(-2, 2):
            ends = middle + across * 14.0 * k, middle + across * 14.0 * (k + 1)
            add_house(Facade(builder, *ends), design_house(rng, builder), rng)


def _above(point: Float, height: float) -> Float:
    raised: Float = point + np.array([0.0, 0.0, height])
    return raised
