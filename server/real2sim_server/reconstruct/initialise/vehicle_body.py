"""Bodies of vehicles as the synthetic street builds them, fitted into the box of a track.

They say where the sides are that nothing measured, and what is paint there and what is glass,
tyre or lamp. The colour of the paint comes from the vehicle itself.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...geometry.transform import invert_transform
from ...logs import DrivingLog, ObjectTrack
from ...scene import Scene
from ...synthetic.materials import BODY, WHEEL
from ...synthetic.vehicles import SHAPES, VehicleShape, build_vehicle, roof_heights
from .inpainting import GREY, MIN_OBSERVED, modal_colour
from .vehicle_light import brightness

SPACING = 0.05
"""Distance between points on a body [m]."""
FEW_POINTS = 50
"""Fewer measured points do not tell one shape from another."""
COMPARED = 1500
LONGEST_SCALE = 1.35
"""A body that would have to be stretched or pressed more than this is another kind of vehicle."""
GLASS = (0.2, 0.23, 0.27)
TRIM = (0.13, 0.13, 0.14)
TYRE = (0.1, 0.1, 0.1)
RIM = (0.4, 0.4, 0.41)
WHITE_LAMP, RED_LAMP = (0.65, 0.65, 0.65), (0.45, 0.1, 0.1)
PLATE = (0.6, 0.6, 0.58)
GRAZING = 0.35
"""Cosine to a surface's normal up to which a camera hardly sees it: 20 degrees from edge on."""
PAINT_REACH = 0.2
"""Points farther from a body say nothing by its parts [m]."""


@dataclass(frozen=True, eq=False)
class VehicleBody:
    """Points on a body in the frame of its box.

    Attributes:
        points: [N, 3] float64 [m].
        normals: [N, 3] float64, outwards.
        colours: [N, 3] float32 of what is no paint.
        is_paint: [N] bool.
    """

    points: Float
    normals: Float
    colours: NDArray[np.float32]
    is_paint: NDArray[np.bool_]

    def unit_normals(self) -> Float:
        """[N, 3] of length 1."""
        length = np.linalg.norm(self.normals, axis=1, keepdims=True)
        return np.asarray(self.normals / length.clip(1e-9))

    def nearest(self, points: Float) -> NDArray[np.int64]:
        """Indices [N] of the body's points nearest to ``points`` [N, 3]."""
        from scipy.spatial import cKDTree

        return np.asarray(cKDTree(self.points).query(points, workers=-1)[1])

    def part_colours(
        self, points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Colours [N, 3] of the parts nearest to ``points`` [N, 3], and [N] bool: no paint."""
        from scipy.spatial import cKDTree

        distance, index = cKDTree(self.points).query(points, workers=-1)
        return self.colours[index], ~self.is_paint[index] & (distance < PAINT_REACH)


def fitted_body(
    measured: NDArray[np.float32], size: tuple[float, float, float], category: str
) -> VehicleBody | None:
    """The body of a category that is nearest to measured points; None for other categories.

    Args:
        measured: [N, 3] in the object frame [m].
        size: of the box [m].
        category: of the track.
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


def body_colours(
    body: VehicleBody,
    points: NDArray[np.float32],
    colours: NDArray[np.float32],
    *,
    light: Float,
) -> NDArray[np.float32]:
    """Colours [B, 3] of the points of a body: its parts' own, and one paint, in the given light.

    Args:
        points: [N, 3] of a vehicle in that box, stage 0's.
        colours: [N, 3] of these; the commonest where there is paint becomes the paint, the light
            taken off.
        light: slopes [3] in the frame of the box, see :func:`.vehicle_light.fit_light`.
    """
    _, is_part = body.part_colours(points)
    lit = brightness(light, body.unit_normals())
    plain = colours / lit[body.nearest(points.astype(np.float64))] if len(points) else colours
    painted = plain[~is_part] if (~is_part).sum() >= MIN_OBSERVED else plain
    paint = modal_colour(painted) if len(painted) else GREY
    mixed = np.where(body.is_paint[:, None], paint, body.colours)
    return np.clip(mixed * lit, 0, 1).astype(np.float32)


def faced(
    log: DrivingLog, track: ObjectTrack, points: Float, normals: Float, frames: list[int]
) -> NDArray[np.bool_]:
    """[N] bool: whether any camera saw a surface at more than a grazing angle.

    Args:
        points: [N, 3] in the frame of the track's box [m].
        normals: [N, 3] of the surface there.
        frames: of the log that count.
    """
    found = np.zeros(len(points), dtype=np.bool_)
    for frame, camera in itertools.product(frames, log.rig):
        t_us = log.image_time_us(camera.name, frame)
        pose = track.transform_near(t_us)
        if pose is None or found.all():
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
    return _stretch(shape, size) < float(np.log(LONGEST_SCALE))


def _scaled(
    body: VehicleBody, shape: VehicleShape, size: tuple[float, float, float]
) -> VehicleBody:
    points = body.points * (0.98 * np.array(size) / shape.size)
    return VehicleBody(points, body.normals, body.colours, body.is_paint)


@cache
def _body(shape: VehicleShape) -> VehicleBody:
    """Points of a shape in its own size."""
    paints: list[tuple[float, ...]] = []
    mesh = build_vehicle(shape, paints)
    triangle, weights = _spread(mesh.corners)
    points = np.einsum("nk,nkd->nd", weights, mesh.corners[triangle])
    _, kept = np.unique(np.floor(points / SPACING).astype(np.int64), axis=0, return_index=True)
    triangle, weights, points = triangle[kept], weights[kept], points[kept]
    # The builder's normals point inwards.
    normals = -np.einsum("nk,nkd->nd", weights, mesh.normals[triangle])
    uv = np.einsum("nk,nkd->nd", weights, mesh.uv[triangle])
    material = mesh.material[triangle]
    table = np.array([row[:3] for row in paints])
    # The builder's colours are linear; images are not.
    colours = np.clip(table[mesh.paint[triangle]], 0, 1) ** (1 / 2.2)
    is_wheel = material == WHEEL
    rim = np.linalg.norm(uv, axis=1) < 0.68
    colours[is_wheel] = np.where(rim[is_wheel, None], RIM, TYRE)
    on_shell = material == BODY
    shell = _shell_colours(shape, points + np.array([0, 0, shape.size[2] / 2]), normals)
    is_paint = on_shell & np.isnan(shell[:, 0])
    colours = np.where(on_shell[:, None], np.nan_to_num(shell), colours)
    return VehicleBody(points, normals, colours.astype(np.float32), is_paint)


def _spread(corners: Float) -> tuple[NDArray[np.int64], Float]:
    """Triangles [N] and barycentric weights [N, 3] of points SPACING apart on [T, 3, 3]."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(sides / SPACING)).astype(int)
    triangles, weights = [], []
    for n in np.unique(steps):
        i, j = np.array([(i, j) for i in range(n) for j in range(n - i)]).T
        a, b = (i + 1 / 3) / n, (j + 1 / 3) / n
        members = np.flatnonzero(steps == n)
        triangles.append(np.repeat(members, len(a)))
        weights.append(np.tile(np.stack([a, b, 1 - a - b], axis=1), (len(members), 1)))
    return np.concatenate(triangles), np.concatenate(weights)


def _shell_colours(shape: VehicleShape, points: Float, normals: Float) -> Float:
    """[N, 3] at points of the shell over the ground, nan where there is paint."""
    length, width, height = shape.size
    x, side, z = points[:, 0], np.abs(points[:, 1]), points[:, 2]
    nx, ny = normals[:, 0], np.abs(normals[:, 1])
    roof = np.interp(
        x, np.linspace(-0.5, 0.5, len(roof_heights(shape))) * length, roof_heights(shape)
    )
    colours = np.full((len(points), 3), np.nan)
    colours[z < shape.clearance + 0.1] = TRIM
    edge = 0.1 if height < 2 else 0.28
    rear, front = (a * length for a in shape.side_glass)
    flank = ny > 0.4
    colours[flank & (z > shape.belt) & (z < roof - edge + 0.03) & (x > rear) & (x < front)] = GLASS
    for axle in shape.axles:
        arch = np.hypot(x - axle * length, z - shape.wheel_radius) < shape.wheel_radius + 0.055
        colours[flank & arch] = TYRE
    half = 0.5 * width * (0.9 if height > 2 else 0.8)
    above = ~flank & (z > shape.belt) & (z < height - 0.05) & (side < half)
    foot, top = (a * length for a in shape.windscreen)
    colours[above & (nx > 0.2) & (x > top) & (x < foot)] = GLASS
    low, high = (a * length for a in shape.rear_window)
    colours[above & (nx < -0.2) & (x > low) & (x < high)] = GLASS
    _paint_ends(colours, shape, x, side, z, nx)
    return colours


def _paint_ends(  # noqa: PLR0917
    colours: Float, shape: VehicleShape, x: Float, side: Float, z: Float, nx: Float
) -> None:
    """Lamps and plates at nose and tail, in place."""
    length, width, height = shape.size
    big = height > 2
    lamp = 0.78 if big else 0.47 * shape.belt + 0.2
    nose = (nx > 0.35) & (x > length / 2 - 0.6) & (z < shape.belt)
    colours[nose & (side < 0.42) & (np.abs(z - lamp + 0.02) < 0.08)] = TRIM
    outer = (side > width / 2 - 0.52) & (side < width / 2 - 0.1)
    colours[nose & outer & (np.abs(z - lamp) < 0.08)] = WHITE_LAMP
    colours[nose & (side < 0.26) & (np.abs(z - lamp + 0.21) < 0.055)] = PLATE
    tail = (nx < -0.35) & (x < 0.4 - length / 2) & (z < max(shape.belt, 0.7 * height))
    low, high, inner = shape.belt - 0.33, shape.belt - 0.12, width / 2 - 0.42
    if big:
        low, high, inner = shape.belt - 0.4, shape.belt - 0.02, width / 2 - 0.24
    colours[tail & (side > inner) & (z > low) & (z < high)] = RED_LAMP
    colours[tail & (side < 0.26) & (np.abs(z - low - 0.05) < 0.055)] = PLATE
