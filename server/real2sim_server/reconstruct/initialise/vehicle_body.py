"""Synthetic vehicle bodies fitted into tracked boxes: shape and colours of unseen sides."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform
from ...logs import DrivingLog, ObjectTrack
from ...scene import Scene, SceneObject
from ...scene.cloud import SH_C0
from ...scene.sunlight import relight
from ...synthetic.materials import BODY, PLAIN, WHEEL
from ...synthetic.vehicles import CARGO_FLOOR, SHAPES, VehicleShape, build_vehicle
from .accumulate import PointSet
from .surfels import GREY, Surfels, fill_from_mirror, modal_colour
from .vehicle_parts import (
    Light,
    Part,
    fit_light,
    fit_palette,
    light_on,
    palette_of,
    shell_parts,
    shown_paints,
    slope_light,
    wheel_parts,
    with_paints,
)

# Bodies.
#
# The body gives the shape of the unmeasured sides, and separates paint from glass, tyres and
# lamps. The colour of the paint comes from the log.

SPACING = 0.05
"""Distance between points on a body [m]."""
FINE_SPACING = 0.033
"""Distance between points where unlike parts meet, to keep their edges sharp [m]."""
WIDE_SPACING = 0.12
"""Spacing of rendered points on flat regions of a single part [m]."""
FLAT = 0.95
"""Minimum cosine between normals of neighbours on a flat body."""
FACING_DOWN = -0.5
"""Maximum vertical component of the normals of undersides, which are drawn as flat regions."""
FEW_POINTS = 50
"""Minimum number of measured points to distinguish shapes."""
COMPARED = 1500
MAX_SCALE = 1.35
"""Maximum factor by which a body may be stretched or compressed to fit a box."""
GRAZING = 0.35
"""Minimum cosine between ray and normal of a visible surface (20 degrees of grazing)."""
PAINT_REACH = 0.2
"""Maximum distance from a body of points that are evidence for its parts [m]."""


@dataclass(frozen=True, eq=False)
class VehicleBody:
    """Points on a body in the frame of its box.

    Attributes:
        points: [N, 3] float64 [m].
        normals: [N, 3] float64, outwards.
        parts: [N] uint8, see :class:`.vehicle_parts.Part`.
        own_colours: [N, 3] float32, colours from the vehicle builder, for points of part ``OTHER``.
        drawn: [N] float32, spacing of the rendered points after removal of redundant ones [m]; 0
        for omitted points.
    """

    points: Float
    normals: Float
    parts: NDArray[np.uint8]
    own_colours: NDArray[np.float32]
    drawn: NDArray[np.float32]

    @property
    def is_paint(self) -> NDArray[np.bool_]:
        """[N] bool."""
        return np.asarray(self.parts == Part.PAINT)

    def colours(self, palette: NDArray[np.float32]) -> NDArray[np.float32]:
        """Colours [N, 3] from ``palette`` [10, 3]; ``own_colours`` for part ``OTHER``."""
        other = (self.parts == Part.OTHER)[:, None]
        return np.where(other, self.own_colours, palette[self.parts])

    def unit_normals(self) -> Float:
        """[N, 3] of length 1."""
        length = np.linalg.norm(self.normals, axis=1, keepdims=True)
        return np.asarray(self.normals / length.clip(1e-9))

    def nearest(self, points: Float) -> NDArray[np.int64]:
        """Indices [N] of the body's points nearest to ``points`` [N, 3]."""
        return self.closest(points)[1]

    def closest(self, points: Float | NDArray[np.float32]) -> tuple[Float, NDArray[np.int64]]:
        """Distances [N] of ``points`` [N, 3] from the body [m], and its nearest points [N]."""
        distance, index = self._tree.query(points, workers=-1)
        return np.asarray(distance), np.asarray(index)

    def parts_at(
        self, distance: Float, index: NDArray[np.int64], *, reach: float = PAINT_REACH
    ) -> NDArray[np.uint8]:
        """Parts [N] for the result of :meth:`closest`; beyond ``reach`` [m] all points count as
        paint.
        """
        return np.where(distance < reach, self.parts[index], np.uint8(Part.PAINT))

    def parts_near(
        self, points: NDArray[np.float32], *, reach: float = PAINT_REACH
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Indices [N] of the body's points nearest to ``points`` [N, 3], and parts [N] there.

        Points farther than ``reach`` [m] from the body count as paint.
        """
        distance, index = self.closest(points)
        return index, self.parts_at(distance, index, reach=reach)

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


def fitted_body(
    measured: NDArray[np.float32], size: tuple[float, float, float], category: str
) -> VehicleBody | None:
    """The body of a category that fits measured points best; None for other categories.

    Args:
        measured: [N, 3] in the object frame [m].
        size: size of the box [m].
        category: category of the track.
    """
    shapes = [s for s in SHAPES if s.category == category and _fits(s, size)]
    if not shapes:
        return None
    bodies = [_scaled(_body(shape), shape, size) for shape in shapes]
    if len(bodies) == 1:
        return bodies[0]
    if len(measured) < FEW_POINTS:
        stretch = [_stretch(shape, size) for shape in shapes]
        return bodies[int(np.argmin(stretch))]
    from scipy.spatial import cKDTree

    few = measured[:: -(-len(measured) // COMPARED)]
    distances = [np.minimum(cKDTree(b.points).query(few)[0], 0.3).mean() for b in bodies]
    return bodies[int(np.argmin(distances))]


def scene_bodies(scene: Scene) -> list[VehicleBody | None]:
    """The bodies of the objects of stage 0, in their order."""
    return [
        fitted_body(item.cloud.means.detach().cpu().numpy(), item.size, item.category)
        for item in scene.objects.values()
    ]


def body_colours(body: VehicleBody, item: SceneObject, scene: Scene) -> NDArray[np.float32]:
    """Colours [B, 3] of the points of a body in the paint and light of an object of stage 0.

    The most common colour of its painted points, with the light removed, becomes the paint. A
    truck's cargo is handled likewise.
    """
    distance, nearest = body.closest(item.cloud.means.cpu().numpy())
    lit = light_on(item, scene)(body.unit_normals())
    # Points far from the body belong to the dark plate under it.
    near = distance < PAINT_REACH
    shown = (0.5 + SH_C0 * item.cloud.sh[:, 0]).cpu().numpy()
    plain = relight(shown, 1 / lit[nearest])
    usual = modal_colour(plain) if len(plain) else GREY
    palette = palette_of(scene)
    own = with_paints(palette, shown_paints(body.parts[nearest[near]], plain[near]), usual)
    return np.clip(relight(body.colours(own), lit), 0, 1)


def faced(
    log: DrivingLog, track: ObjectTrack, points: Float, normals: Float, frames: list[int]
) -> NDArray[np.bool_]:
    """[N] bool: whether any camera saw a surface at more than a grazing angle.

    Args:
        points: [N, 3] in the frame of the track's box [m].
        normals: [N, 3] of the surface there.
        frames: indices into the log.
    """
    found = np.zeros(len(points), dtype=np.bool_)
    for frame, camera in itertools.product(frames, log.rig):
        t_us = log.image_time_us(camera.name, frame)
        pose = track.transform_near(t_us)
        if pose is None or found.all() or not log.has_image(camera.name, frame):
            continue
        t_us = min(max(t_us, log.ego.start_us), log.ego.end_us)
        to_camera = camera.viewmat(log.ego.transform(t_us)) @ pose
        left = np.flatnonzero(~found)
        projected = points[left] @ to_camera[:3, :3].T + to_camera[:3, 3]
        x, y, z = (projected @ camera.K.T).T
        seen = (z > 0) & (x > 0) & (y > 0) & (x < z * camera.width) & (y < z * camera.height)
        direction = invert_transform(to_camera)[:3, 3] - points[left]
        cosine = (direction * normals[left]).sum(1)
        found[left] = seen & (cosine > GRAZING * np.linalg.norm(direction, axis=1))
    return found


def _stretch(shape: VehicleShape, size: tuple[float, float, float]) -> float:
    return float(np.abs(np.log(np.array(size) / shape.size)).max())


def _fits(shape: VehicleShape, size: tuple[float, float, float]) -> bool:
    return _stretch(shape, size) < float(np.log(MAX_SCALE))


def _scaled(
    body: VehicleBody, shape: VehicleShape, size: tuple[float, float, float]
) -> VehicleBody:
    points = body.points * (0.98 * np.array(size) / shape.size)
    return VehicleBody(points, body.normals, body.parts, body.own_colours, body.drawn)


@cache
def _body(shape: VehicleShape) -> VehicleBody:
    """Points of a shape at its original size."""
    paints: list[tuple[float, ...]] = []
    mesh = build_vehicle(shape, paints)
    triangle, weights = _spread(mesh.corners)
    points = np.einsum("nk,nkd->nd", weights, mesh.corners[triangle])
    # The shell behind the outer faces of wheels falls into the same cells.
    behind = mesh.material[triangle] != WHEEL
    coarse, fine = (_one_per_cell(points, size, behind) for size in (SPACING, FINE_SPACING))
    kept = np.concatenate([coarse, fine])
    triangle, weights, points = triangle[kept], weights[kept], points[kept]
    normals = np.einsum("nk,nkd->nd", weights, mesh.normals[triangle])
    uv = np.einsum("nk,nkd->nd", weights, mesh.uv[triangle])
    material = mesh.material[triangle]
    inwards = (normals * _outwards(shape, points, material)).sum(1) < 0
    normals[inwards] *= -1
    table = np.array([row[:3] for row in paints])
    # The builder's colours are linear; images are gamma-encoded.
    colours = np.clip(table[mesh.paint[triangle]], 0, 1) ** (1 / 2.2)
    parts = np.full(len(points), Part.OTHER, dtype=np.uint8)
    is_wheel, on_shell = material == WHEEL, material == BODY
    parts[is_wheel] = wheel_parts(uv[is_wheel])
    parts[_on_cargo(shape, points)] = Part.CARGO
    over_ground = points + np.array([0, 0, shape.size[2] / 2])
    parts[on_shell] = shell_parts(shape, over_ground[on_shell], normals[on_shell])
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
    is_fine = np.arange(len(points)) >= len(coarse)
    # Fine points where unlike parts meet, coarse ones elsewhere.
    kept = np.flatnonzero(_at_borders(points, unit, parts) == is_fine)
    points, normals, parts = points[kept], normals[kept], parts[kept]
    drawn = _drawn_spacing(points, unit[kept], parts)
    drawn[is_fine[kept]] = FINE_SPACING
    return VehicleBody(points, normals, parts, colours[kept].astype(np.float32), drawn)


def _one_per_cell(
    points: Float, spacing: float, behind: NDArray[np.bool_] | None = None
) -> NDArray[np.int64]:
    """Indices of the points [N, 3] nearest to the middle of each cell of a grid, which spreads them
    evenly. Points ``behind`` [N] only count in cells without others.
    """
    cells = np.floor(points / spacing)
    from_middle = np.abs(points / spacing - cells - 0.5).max(axis=1)
    behind = np.zeros(len(points), np.bool_) if behind is None else behind
    order = np.lexsort((from_middle, behind))
    first = np.unique(cells[order].astype(np.int64), axis=0, return_index=True)[1]
    return np.asarray(order[first])


def _at_borders(points: Float, unit: Float, parts: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Mask [N] of the points in cells of SPACING in which unlike parts meet.

    Dark parts are alike. ``unit`` are normals [N, 3].
    """
    from scipy.spatial import cKDTree

    near = cKDTree(points).query_pairs(1.5 * FINE_SPACING, output_type="ndarray")
    first, second = near.T
    dark = np.isin(parts, (Part.GLASS, Part.TRIM, Part.TYRE))
    unlike = (parts[first] != parts[second]) & ~(dark[first] & dark[second])
    # The opposite side of a thin part does not make a border.
    same_side = (unit[first] * unit[second]).sum(1) > 0
    border = near[unlike & same_side & (unit[first, 2] > FACING_DOWN)]
    _, cell = np.unique(np.floor(points / SPACING).astype(np.int64), axis=0, return_inverse=True)
    crossed = np.zeros(cell.max() + 1, dtype=np.bool_)
    crossed[cell[border.ravel()]] = True
    return crossed[cell]


def _drawn_spacing(points: Float, unit: Float, parts: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[N]: SPACING at borders of parts and at bends of a body, WIDE_SPACING or 0 elsewhere.

    ``unit`` are normals [N, 3].
    """
    from scipy.spatial import cKDTree

    near = cKDTree(points).query_pairs(0.75 * WIDE_SPACING, output_type="ndarray")
    cosine = (unit[near[:, 0]] * unit[near[:, 1]]).sum(1)
    unlike = (cosine < FLAT) | (parts[near[:, 0]] != parts[near[:, 1]])
    # The opposite side of a thin part does not make an edge.
    unlike &= cosine > -0.5
    plain = np.ones(len(points), dtype=np.bool_)
    plain[near[unlike].ravel()] = False
    plain |= unit[:, 2] < FACING_DOWN
    drawn = np.full(len(points), SPACING, dtype=np.float32)
    drawn[plain] = 0
    drawn[np.flatnonzero(plain)[_one_per_cell(points[plain], WIDE_SPACING)]] = WIDE_SPACING
    return drawn


def _on_cargo(shape: VehicleShape, points: Float) -> NDArray[np.bool_]:
    """Mask [N] of the points on the sides of the cargo box."""
    length, width, height = shape.size
    rear, front = (x * length for x in shape.cargo)
    if rear == front:
        return np.zeros(len(points), dtype=np.bool_)
    x, side, z = points[:, 0], np.abs(points[:, 1]), points[:, 2] + height / 2
    within = (x > rear - 0.01) & (x < front + 0.01) & (z > CARGO_FLOOR - 0.01)
    inner = (x > rear + 0.01) & (x < front - 0.01) & (side < width / 2 - 0.01)
    return np.asarray(within & ~(inner & (z < height - 0.01) & (z > CARGO_FLOOR + 0.01)))


def _outwards(shape: VehicleShape, points: Float, material: NDArray[np.int32]) -> Float:
    """Outward directions [N, 3] of the convex piece of each point. Windings differ by piece."""
    length, width, height = shape.size
    centres = np.zeros_like(points)
    # The shell is nearly convex: all of it is visible from the line through its middle.
    centres[:, 0] = np.clip(points[:, 0], -0.35 * length, 0.35 * length)
    x, y = points[:, 0], np.sign(points[:, 1])
    axle = np.where(x > 0, shape.axles[1], shape.axles[0]) * length
    of_wheel = np.stack([axle, y * (0.5 * width - 0.12), np.full_like(x, shape.wheel_radius)], 1)
    of_wheel[:, 2] -= height / 2
    wheel = material == WHEEL
    centres[wheel] = of_wheel[wheel]
    aside = (material == PLAIN) & (shape.cargo[0] == shape.cargo[1])
    for side in (-1.0, 1.0):
        mirror = aside & (y == side)
        if mirror.any():
            centres[mirror] = points[mirror].mean(axis=0)
    return np.asarray(points - centres)


def _spread(corners: Float) -> tuple[NDArray[np.int64], Float]:
    """Triangles [N] and barycentric weights [N, 3] of points FINE_SPACING apart on [T, 3, 3]."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(sides / FINE_SPACING)).astype(int)
    triangles, weights = [], []
    for n in np.unique(steps):
        i, j = np.array([(i, j) for i in range(n) for j in range(n - i)]).T
        a, b = (i + 1 / 3) / n, (j + 1 / 3) / n
        members = np.flatnonzero(steps == n)
        triangles.append(np.repeat(members, len(a)))
        weights.append(np.tile(np.stack([a, b, 1 - a - b], axis=1), (len(members), 1)))
    return np.concatenate(triangles), np.concatenate(weights)


# Shape of objects with too few LiDAR points.

GAP = 0.25
"""The generic body fills places without a measured point within this distance [m]."""
WINDOW_LINE, LEAN = 0.58, 0.2
PROFILES = {
    "car": ((-0.5, 0.68), (-0.44, 0.75), (-0.3, 0.97), (0.0, 1.0), (0.1, 0.95), (0.25, 0.66),
            (0.45, 0.58), (0.5, 0.45)),
    "van": ((-0.5, 0.97), (0.0, 1.0), (0.25, 0.95), (0.38, 0.6), (0.5, 0.5)),
}  # fmt: skip
"""Side views: (position along the length from -0.5 to 0.5, height from 0 to 1), front last."""

VEHICLE_LENGTH = 2.5
"""Minimum length of objects treated as vehicles, with a dark underside [m]."""
UNDERSIDE_HEIGHT = 0.05
"""Height of the underside over the box bottom, so that the road does not show through [m]."""


def underside(size: tuple[float, float, float], *, spacing: float = 0.08) -> Surfels:
    """A flat plate under a vehicle, in the object frame; empty for other objects.

    The plate holds the dark underside and contact shadow that cameras see, so that they move with
    the car and leave the road's colour unchanged.

    Args:
        size: (length, width, height) [m].
        spacing: distance between Gaussians [m].
    """
    half = np.array(size) / 2
    points = _face(half, 2, -1, spacing) if size[0] >= VEHICLE_LENGTH else np.zeros((0, 3))
    points[:, 2] += UNDERSIDE_HEIGHT
    axes = np.broadcast_to(np.eye(3, dtype=np.float32), (len(points), 3, 3)).copy()
    scales = np.tile(np.array([0.6, 0.6, 0.1], np.float32) * np.float32(spacing), (len(points), 1))
    return Surfels(points.astype(np.float32), axes, scales)


def complete_body(
    measured: PointSet,
    size: tuple[float, float, float],
    category: str,
    *,
    body: VehicleBody | None = None,
    spacing: float = 0.06,
) -> PointSet:
    """Complete measured points with a generic body in unmeasured places.

    LiDAR does not see the far side of a car, its windows, or the top of a truck. The generic body
    is a box with rounded corners; cars and vans also have a bonnet and a cabin. Body points nearer
    than GAP to a measured point, or to its mirror image across y = 0, are omitted. For vehicles,
    mirrored points replace them.

    Args:
        measured: points in the object frame.
        size: (length, width, height) [m].
        category: class of the object.
        body: body of a vehicle, used instead of the generic one.
        spacing: distance between points of the body [m]; larger for large objects.
    """
    from scipy.spatial import cKDTree

    spacing = max(spacing, 0.012 * size[0])
    if body is not None:
        added = body.points
    else:
        added = _with_profile(_box_surface(np.array(size), spacing), np.array(size), category)
    typical = float(np.median(measured.intensity)) if len(measured) else 0.3
    if len(measured):
        distance, _ = cKDTree(measured.points).query(added, workers=-1)
        added = added[distance > GAP]
    generic = PointSet.measured(added, np.full(len(added), typical, dtype=np.float32))
    return PointSet.join([measured, generic])


def mirrored(measured: PointSet, *, voxel: float) -> PointSet:
    """Measured points and, where nothing was measured, their mirror images across y = 0."""
    from scipy.spatial import cKDTree

    if len(measured) == 0:
        return measured
    image = measured.points * np.array([1, -1, 1], dtype=np.float32)
    distance, _ = cKDTree(measured.points).query(image, workers=-1)
    lone = distance > 3 * voxel
    return PointSet.join(
        [measured, PointSet(image[lone], measured.intensity[lone], measured.weight[lone])]
    )


def _box_surface(size: Float, spacing: float) -> Float:
    """Points on four sides and the top of a box a little smaller than ``size``."""
    half = 0.97 * size / 2
    faces = [_face(half, axis, sign, spacing) for axis in (0, 1) for sign in (-1, 1)]
    return np.concatenate([*faces, _face(half, 2, 1, spacing)])


def _with_profile(points: Float, size: Float, category: str) -> Float:
    """Lower points [N, 3] of a box surface to the side view of a vehicle."""
    profile = PROFILES.get(category)
    points = points.copy()
    if profile is None:
        return points
    along, height = np.array(profile).T
    bottom = points[:, 2] / size[2] + 0.5
    roof = np.interp(points[:, 0] / size[0], along, height)
    points[:, 2] = (np.minimum(bottom, 1) * roof - 0.5) * size[2]
    # Sides lean inwards from the window line up.
    above = np.clip((points[:, 2] / size[2] + 0.5 - WINDOW_LINE) / (1 - WINDOW_LINE), 0, 1)
    points[:, 1] *= 1 - LEAN * above
    return points


def _face(half: Float, axis: int, sign: int, spacing: float) -> Float:
    others = [a for a in range(3) if a != axis]
    counts = [max(2, int(np.ceil(2 * half[a] / spacing))) for a in others]
    grids = np.meshgrid(
        *(((np.arange(n) + 0.5) / n * 2 - 1) * half[a] for n, a in zip(counts, others, strict=True))
    )
    points = np.zeros((grids[0].size, 3))
    points[:, axis] = sign * half[axis]
    for a, grid in zip(others, grids, strict=True):
        points[:, a] = grid.ravel()
    return points


# Colours of unseen sides: mirrored, by part, or in one paint.
#
# Shading is removed first and applied again for the direction of the unseen side.

UPRIGHT = 0.3
"""Maximum vertical component of the normals of surfaces that face the horizon."""

ON_PART = 0.06
"""Maximum distance of points with the colour of the body's part [m]. Others are behind glass.
"""


@dataclass(frozen=True, eq=False)
class VehicleSurface:
    """Camera observations of one vehicle.

    Attributes:
        points: [N, 3] float32 in the frame of its box [m].
        normals: [N, 3] float64 unit, outwards, in the world.
        colours: [N, 3] float32 where ``seen``.
        seen: [N] bool.
        body: the fitted body.
    """

    points: NDArray[np.float32]
    normals: Float
    colours: NDArray[np.float32]
    seen: NDArray[np.bool_]
    body: VehicleBody

    def seen_paint(self) -> NDArray[np.bool_]:
        """[N] bool: seen, and not lamp, glass or tyre."""
        return np.asarray(self.seen & (self.parts() == Part.PAINT))

    def parts(self, *, reach: float = PAINT_REACH) -> NDArray[np.uint8]:
        """Parts [N] of the body at the points, see :meth:`.VehicleBody.parts_at`."""
        return self.body.parts_at(*self.closest, reach=reach)

    @cached_property
    def closest(self) -> tuple[Float, NDArray[np.int64]]:
        """See :meth:`.VehicleBody.closest`, for the surface's points."""
        return self.body.closest(self.points)


def fill_vehicles(
    surfaces: Sequence[VehicleSurface], lights: Sequence[Light] | None = None
) -> tuple[list[NDArray[np.float32]], Float, NDArray[np.float32]]:
    """Colours [N, 3] of each vehicle's points, and the shared light [3] and palette [10, 3].

    Seen colours do not change. A vehicle with almost no seen paint becomes grey, with the median
    brightness of the others.

    Args:
        surfaces: by vehicle.
        lights: the light on each vehicle, for normals in the world; None for the shared light.
    """
    painted = [s.seen_paint() for s in surfaces]
    light = fit_light(
        [s.normals[mine] for s, mine in zip(surfaces, painted, strict=True)],
        [s.colours[mine] for s, mine in zip(surfaces, painted, strict=True)],
    )
    shared: list[Light] = [partial(slope_light, light)] * len(surfaces)
    lit = [on(s.normals) for s, on in zip(surfaces, lights or shared, strict=True)]
    paints = [_shown_paints(s, bright) for s, bright in zip(surfaces, lit, strict=True)]
    palette = _shown_palette(surfaces, lit)
    found = [p[Part.PAINT] for p in paints if Part.PAINT in p]
    usual = np.full(3, np.median(np.mean(found, axis=1)), np.float32) if found else GREY
    filled = [
        _filled(s, bright, with_paints(palette, mine, usual))
        for s, bright, mine in zip(surfaces, lit, paints, strict=True)
    ]
    return filled, light, palette


def _shown_paints(
    surface: VehicleSurface, lit: NDArray[np.float32]
) -> dict[Part, NDArray[np.float32]]:
    seen = surface.seen
    return shown_paints(surface.parts()[seen], relight(surface.colours, 1 / lit)[seen])


def _shown_palette(
    surfaces: Sequence[VehicleSurface], lit: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    parts, colours, upright = [], [], [np.zeros(0, np.float32)]
    for surface, bright in zip(surfaces, lit, strict=True):
        parts.append(surface.parts(reach=ON_PART)[surface.seen])
        colours.append(relight(surface.colours, 1 / bright)[surface.seen])
        upright.append(bright[np.abs(surface.normals[:, 2]) < UPRIGHT].ravel())
    usual = np.concatenate(upright)
    return fit_palette(parts, colours, float(np.median(usual)) if len(usual) else 1.0)


def _filled(
    surface: VehicleSurface, lit: NDArray[np.float32], palette: NDArray[np.float32]
) -> NDArray[np.float32]:
    plain = relight(surface.colours, 1 / lit)
    mirrored, known = fill_from_mirror(surface.points, plain, surface.seen)
    own = surface.body.colours(palette)[surface.closest[1]]
    plain = np.where((surface.parts() != Part.PAINT)[:, None], own, palette[Part.PAINT])
    filled = relight(np.where(known[:, None], mirrored, plain), lit)
    return np.where(surface.seen[:, None], surface.colours, filled).clip(0, 1)
