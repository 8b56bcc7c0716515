"""Cameras and LiDAR as kernels over the world, parallel over rows and columns."""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from .casting import Instances, cast, new_stack
from .light import tone
from .shading import ray_colour, surface_at

FAR = 1e6


@njit(cache=True, parallel=True, error_model="numpy")
def shoot_image(world, instances, T_world_camera, k, width, height, samples):
    """RGB uint8 [height, width, 3].

    One ray through every pixel's centre; then ``samples``^2 rays where the surface, its direction
    or its shadow changes between neighbours. Textures are band-limited and need no more than one.
    """
    colours = np.empty((height, width, 3), np.float32)
    keys = np.empty((height, width), np.int64)
    planes = np.empty((height, width, 4), np.float32)
    for row in prange(height):
        stack = new_stack()
        for column in range(width):
            r, g, b, keys[row, column], nx, ny, nz, offset = _sample(
                world, instances, T_world_camera, k, column + 0.5, row + 0.5, 1, stack
            )
            pixel, plane = colours[row, column], planes[row, column]
            pixel[0], pixel[1], pixel[2] = tone(r), tone(g), tone(b)
            plane[0], plane[1], plane[2], plane[3] = nx, ny, nz, offset
    image = np.empty((height, width, 3), np.uint8)
    for row in prange(height):
        stack = new_stack()
        for column in range(width):
            r, g, b = colours[row, column, 0], colours[row, column, 1], colours[row, column, 2]
            if samples > 1 and _is_edge(keys, planes, row, column):
                r, g, b = _supersample(
                    world, instances, T_world_camera, k, column, row, samples, stack
                )
            image[row, column, 0] = int(255.0 * r + 0.5)
            image[row, column, 1] = int(255.0 * g + 0.5)
            image[row, column, 2] = int(255.0 * b + 0.5)
    return image


@njit(cache=True, error_model="numpy")
def _sample(world, instances, m, k, px, py, samples, stack):
    """What the camera sees at image coordinates px, py, see :func:`.shading.ray_colour`."""
    ox, oy, oz = m[0, 3], m[1, 3], m[2, 3]
    dx, dy, dz = _direction(m, (px - k[0, 2]) / k[0, 0], (py - k[1, 2]) / k[1, 1])
    hit = cast(world, instances, ox, oy, oz, dx, dy, dz, FAR, stack)
    spread = 1.0 / (k[0, 0] * samples)
    return ray_colour(world, instances, hit, ox, oy, oz, dx, dy, dz, spread, stack)


@njit(cache=True, error_model="numpy")
def _is_edge(keys, planes, row, column):
    """Whether a pixel shows another surface than one of its eight neighbours."""
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


@njit(cache=True, error_model="numpy")
def _supersample(world, instances, m, k, column, row, samples, stack):
    """Mean display values (r, g, b) of ``samples``^2 rays through a pixel.

    The rays lie on a sheared grid: no two share a row or a column, which smooths level and upright
    edges best, and being the same in every pixel it adds no grain.
    """
    red = green = blue = 0.0
    for j in range(samples):
        for i in range(samples):
            px = column + (i + (j + 0.5) / samples) / samples
            py = row + (j + (samples - i - 0.5) / samples) / samples
            s = _sample(world, instances, m, k, px, py, samples, stack)
            red, green, blue = red + tone(s[0]), green + tone(s[1]), blue + tone(s[2])
    share = 1.0 / (samples * samples)
    return red * share, green * share, blue * share


@njit(cache=True, error_model="numpy")
def _direction(m, x, y):
    """Unit direction in the world of the camera ray (x, y, 1)."""
    s = 1.0 / math.sqrt(x * x + y * y + 1.0)
    return (
        (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * s,
        (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * s,
        (m[2, 0] * x + m[2, 1] * y + m[2, 2]) * s,
    )


@njit(cache=True, parallel=True, error_model="numpy")
def shoot_depth(world, instances, T_world_camera, k, width, height):
    """Depth float32 [height, width] along z and instance uint16, through pixel centres.

    Depth is 0 in the sky; instance is 0 for the static world, else 1 + the vehicle's index.
    """
    depth = np.zeros((height, width), np.float32)
    index = np.zeros((height, width), np.uint16)
    for row in prange(height):
        stack = new_stack()
        m = T_world_camera
        for column in range(width):
            x, y = (column + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1]
            dx, dy, dz = _direction(m, x, y)
            hit = cast(world, instances, m[0, 3], m[1, 3], m[2, 3], dx, dy, dz, FAR, stack)
            if hit[1] >= 0:
                depth[row, column] = hit[0] / math.sqrt(x * x + y * y + 1.0)
                index[row, column] = hit[4] + 1
    return depth, index


@njit(cache=True, parallel=True, error_model="numpy")
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
