"""Cameras and LiDAR as kernels over the world, parallel over rows and columns."""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from .._numba import func, kernel
from ..geometry.transform import Float
from .casting import Instances, cast, new_stack
from .light import tone
from .shading import RaycastWorld, ray_colour, surface_at

FAR = 1e6
CHUNK = 256


class Samples(NamedTuple):
    """What camera rays see.

    Attributes:
        colours: [N, 3] float32, display values in [0, 1].
        depth: [N] float32, along the camera's z [m], 0 in the sky.
        instance: [N] uint16, 0 for the static world, else 1 + the vehicle's index.
        keys, planes: [N] int64 and [N, 4] float32, surface and its plane, see
            :func:`.shading.ray_colour`.
    """

    colours: NDArray[np.float32]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    keys: NDArray[np.int64]
    planes: NDArray[np.float32]


def shoot_image(
    world: RaycastWorld,
    instances: Instances,
    T_world_camera: Float,
    k: Float,
    width: int,
    height: int,
    samples: int,
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint16]]:
    """RGB uint8 [height, width, 3], depth float32 and instance uint16 [height, width].

    One ray through every pixel's centre, which gives depth and instance; then ``samples``^2 rays
    where the surface, its direction or its shadow changes between neighbours. Textures are
    band-limited and need no more than one.
    """
    row, column = np.divmod(np.arange(width * height), width)
    centres = np.stack([column + 0.5, row + 0.5], axis=1)
    first = Samples(*_shoot(world, instances, T_world_camera, k, centres, 1.0))
    colours = first.colours
    if samples > 1:
        keys, planes = first.keys.reshape(height, width), first.planes.reshape(height, width, 4)
        edges = np.flatnonzero(_find_edges(keys, planes))
        inside = np.repeat(centres[edges], samples * samples, axis=0)
        inside += np.tile(_sheared_grid(samples), (len(edges), 1))
        again = Samples(*_shoot(world, instances, T_world_camera, k, inside, 1.0 / samples))
        colours[edges] = again.colours.reshape(len(edges), samples * samples, 3).mean(axis=1)
    image = (colours * 255 + 0.5).astype(np.uint8)
    return (
        image.reshape(height, width, 3),
        first.depth.reshape(height, width),
        first.instance.reshape(height, width),
    )


def _sheared_grid(samples: int) -> Float:
    """Sample positions [samples^2, 2] relative to a pixel's centre.

    No two share a row or a column, which smooths level and upright edges best; and being the same
    in every pixel they add no grain.
    """
    j, i = np.divmod(np.arange(samples * samples), samples)
    x = (i + (j + 0.5) / samples) / samples
    y = (j + (samples - i - 0.5) / samples) / samples
    return np.stack([x, y], axis=1) - 0.5


@kernel(parallel=True)
def _shoot(world, instances, m, k, positions, size):
    """Fields of :class:`Samples` for rays through image positions [N, 2].

    ``m`` is the camera's pose in the world, ``size`` the fraction of a pixel that a ray stands for.
    """
    n = len(positions)
    colours, planes = np.empty((n, 3), np.float32), np.empty((n, 4), np.float32)
    depth, instance = np.empty(n, np.float32), np.empty(n, np.uint16)
    keys = np.empty(n, np.int64)
    ox, oy, oz = m[0, 3], m[1, 3], m[2, 3]
    spread = size / k[0, 0]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        stack = new_stack()
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n)):
            x = (positions[i, 0] - k[0, 2]) / k[0, 0]
            y = (positions[i, 1] - k[1, 2]) / k[1, 1]
            s = 1.0 / math.sqrt(x * x + y * y + 1.0)
            dx = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * s
            dy = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * s
            dz = (m[2, 0] * x + m[2, 1] * y + m[2, 2]) * s
            hit = cast(world, instances, ox, oy, oz, dx, dy, dz, FAR, stack)
            r, g, b, keys[i], nx, ny, nz, offset = ray_colour(
                world, instances, hit, ox, oy, oz, dx, dy, dz, spread, stack
            )
            colours[i, 0], colours[i, 1], colours[i, 2] = tone(r), tone(g), tone(b)
            planes[i, 0], planes[i, 1], planes[i, 2], planes[i, 3] = nx, ny, nz, offset
            depth[i] = hit[0] * s if hit[1] >= 0 else 0.0
            instance[i] = hit[4] + 1
    return colours, depth, instance, keys, planes


@kernel(parallel=True)
def shoot_rays(world, instances, origins, directions, sizes):
    """Display colours [N, 3] float32 and ranges [N] float32 [m], 0 in the sky, along any rays.

    Args:
        world: static part.
        instances: vehicles at one instant.
        origins, directions: [N, 3] of the rays in the world, unit length.
        sizes: [N], angle that a ray stands for [rad].
    """
    n = len(origins)
    colours, ranges = np.empty((n, 3), np.float32), np.zeros(n, np.float32)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        stack = new_stack()
        for i in range(chunk * CHUNK, min((chunk + 1) * CHUNK, n)):
            ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            hit = cast(world, instances, ox, oy, oz, dx, dy, dz, FAR, stack)
            r, g, b, _, _, _, _, _ = ray_colour(
                world, instances, hit, ox, oy, oz, dx, dy, dz, sizes[i], stack
            )
            colours[i, 0], colours[i, 1], colours[i, 2] = tone(r), tone(g), tone(b)
            if hit[1] >= 0:
                ranges[i] = hit[0]
    return colours, ranges


@kernel(parallel=True)
def trace(world, instances, m, k, width, height):
    """What pixel centres see: triangle [N], u, v [N], instance [N] and distance [N] of the hit.

    Triangles are rows of the world's arrays, -1 in the sky; instances are -1 for the static world.
    """
    n = width * height
    triangle, instance = np.empty(n, np.int64), np.empty(n, np.int64)
    place = np.empty((n, 3))
    for row in prange(height):
        stack = new_stack()
        for column in range(width):
            i = row * width + column
            x = (column + 0.5 - k[0, 2]) / k[0, 0]
            y = (row + 0.5 - k[1, 2]) / k[1, 1]
            s = 1.0 / math.sqrt(x * x + y * y + 1.0)
            dx = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * s
            dy = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * s
            dz = (m[2, 0] * x + m[2, 1] * y + m[2, 2]) * s
            hit = cast(world, instances, m[0, 3], m[1, 3], m[2, 3], dx, dy, dz, FAR, stack)
            triangle[i], instance[i] = hit[1], hit[4]
            place[i, 0], place[i, 1], place[i, 2] = hit[2], hit[3], hit[0]
    return triangle, instance, place


@kernel
def _find_edges(keys, planes):
    """Which pixels [H, W] show another surface than one of their eight neighbours."""
    edges = np.zeros(keys.shape, np.bool_)
    for row in range(keys.shape[0]):
        for column in range(keys.shape[1]):
            edges[row, column] = _is_edge(keys, planes, row, column)
    return edges


@func
def _is_edge(keys, planes, row, column):
    key = keys[row, column]
    if key < 0:
        return True
    for y in range(max(row - 1, 0), min(row + 2, keys.shape[0])):
        for x in range(max(column - 1, 0), min(column + 2, keys.shape[1])):
            if keys[y, x] != key:
                return True
            turned = 1.0
            for i in range(3):
                turned -= planes[row, column, i] * planes[y, x, i]
            if key > 0 and turned > 0.06:
                return True
            # Flat surfaces of one kind at different depths; on curved ones offsets drift slowly.
            if abs(planes[row, column, 3] - planes[y, x, 3]) > 0.08 and turned < 1e-5:
                return True
    return False


@kernel(parallel=True)
def shoot_lidar(world, sweeps, origins, directions, limit):
    """Ranges [C, B], reflectivity [C, B] in [0, 1] of one turn; range 0 where nothing returns.

    Args:
        world: static part.
        sweeps: vehicles at each column's instant, arrays with a leading [C] axis.
        origins: [C, 3] of the sensor in the world at each column's instant [m].
        directions: [C, B, 3] unit, in the world.
        limit: farthest return [m].
    """
    columns, beams = directions.shape[:2]
    ranges = np.zeros((columns, beams), np.float32)
    returned = np.zeros((columns, beams), np.float32)
    for c in prange(columns):
        stack = new_stack()
        instances = Instances(
            sweeps.to_object[c],
            sweeps.to_world[c],
            sweeps.radius,
            sweeps.root,
            sweeps.shape,
            sweeps.paint,
            sweeps.half_size,
        )
        ox, oy, oz = origins[c, 0], origins[c, 1], origins[c, 2]
        for b in range(beams):
            dx, dy, dz = directions[c, b, 0], directions[c, b, 1], directions[c, b, 2]
            hit = cast(world, instances, ox, oy, oz, dx, dy, dz, limit, stack)
            if hit[1] < 0:
                continue
            s = surface_at(world, instances, hit, ox, oy, oz, dx, dy, dz, 0.002)
            brightness = 0.3 * s[0] + 0.5 * s[1] + 0.2 * s[2]
            facing = max(-(dx * s[4] + dy * s[5] + dz * s[6]), 0.0)
            # Glass and lacquer send most of a beam away from the sensor.
            diffuse = (1.0 - 0.6 * s[3]) * (0.25 + 0.75 * facing)
            ranges[c, b] = hit[0]
            returned[c, b] = min(1.25 * brightness * diffuse + 0.01, 1.0)
    return ranges, returned
