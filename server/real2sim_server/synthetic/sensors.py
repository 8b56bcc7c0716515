"""Cameras and LiDAR: kernels that trace and shade rays, parallel over rows and columns."""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from .._numba import func, kernel
from ..geometry import Float
from .casting import Instances, cast, is_blocked, new_stack, rotate
from .materials import (
    BODY,
    LEAVES,
    WHEEL,
    blend,
    body_surface,
    layered_noise,
    ramp,
    static_surface,
    wheel_surface,
)

# Light of sun and sky.

SUN = (-0.52, 0.36, 0.775)
"""Direction to the sun, nearly unit: left and behind the direction of travel, 51 degrees high."""

_NORM = math.sqrt(sum(c * c for c in SUN))
SUN_X, SUN_Y, SUN_Z = (c / _NORM for c in SUN)
SUN_R, SUN_G, SUN_B = 2.55, 2.4, 2.1
EXPOSURE = 0.72


@func(fastmath=True)
def sky_colour(x, y, z, seed):
    """Linear RGB of the sky in a direction: gradient, clouds, and the sun's glow."""
    z = max(z, 0.0)
    haze = math.exp(-4.5 * z)
    r, g, b = blend(0.2, 0.95, haze), blend(0.42, 1.03, haze), blend(0.92, 1.12, haze)
    if z > 0.02:
        u, v = x / (z + 0.12), y / (z + 0.12)
        n = layered_noise(u * 0.9 + 11.0, v * 0.9, 5, 0.0, seed + 100)
        cover = 0.85 * ramp(n, -0.02, 0.4) * ramp(z, 0.02, 0.2)
        shade = 1.25 - 0.3 * ramp(n, 0.25, 0.75)
        r, g, b = blend(r, shade, cover), blend(g, shade, cover), blend(b, shade * 1.03, cover)
    glow = max(x * SUN_X + y * SUN_Y + z * SUN_Z, 0.0) ** 24
    return r + 0.6 * glow, g + 0.5 * glow, b + 0.35 * glow


@func(fastmath=True)
def ambient(nz, openness):
    """Light of sky and ground on a surface with z component ``nz`` of its normal."""
    up = 0.5 + 0.5 * nz
    r = blend(0.36, 0.62, up) * openness
    g = blend(0.34, 0.72, up) * openness
    b = blend(0.31, 0.9, up) * openness
    return r, g, b


@func(fastmath=True)
def mirrored(x, y, z, seed):
    """Reflected light from a direction: sky above, house fronts, road below."""
    r, g, b = sky_colour(x, y, z, seed)
    houses = 1.0 - ramp(z, 0.12, 0.45)
    road = 1.0 - ramp(z, -0.12, 0.0)
    r, g, b = blend(r, 0.3, houses), blend(g, 0.28, houses), blend(b, 0.26, houses)
    return blend(r, 0.16, road), blend(g, 0.16, road), blend(b, 0.165, road)


@func(fastmath=True)
def tone(c):
    """Display value in [0, 1] of a linear one: a soft shoulder, then the sRGB curve."""
    c = max(c, 0.0) * EXPOSURE
    c = c * (1.0 + c / 6.0) / (1.0 + 0.62 * c)
    c = min(c, 1.0)
    if c <= 0.0031308:
        return 12.92 * c
    return 1.055 * c ** (1.0 / 2.4) - 0.055


# The colour of a ray: hit, material, light.


SHADOW_REACH = 90.0
CAR_SHADE_REACH = 1.1


class RaycastWorld(NamedTuple):
    """All static geometry and vehicle shapes for ray casting, without the poses of vehicles.

    One flat tuple, because parallel kernels do not support nested ones.

    Attributes:
        bounds, children, counts, edges, uv, normals, material, paint: see :class:`.Geometry`;
            the surroundings have root 0.
        paints: [P, 8] paint table.
        shapes: [S, 16] measures of vehicle shapes.
        roofs: [S, n] their roof lines [m].
        seed: seed of the textures.
    """

    bounds: Float
    children: NDArray[np.uint32]
    counts: NDArray[np.uint32]
    edges: Float
    uv: Float
    normals: Float
    material: NDArray[np.int32]
    paint: NDArray[np.int32]
    paints: Float
    shapes: Float
    roofs: Float
    seed: int


@func(fastmath=True)
def _mix3(values, row, offset, u, v):
    """Component of three corner values, interpolated at barycentric u, v."""
    a, b, c = values[row, offset], values[row, offset + 3], values[row, offset + 6]
    return a * (1.0 - u - v) + b * u + c * v


@func(fastmath=True, forceinline=True)
def surface_at(world, instances, hit, ox, oy, oz, dx, dy, dz, spread):
    """Material and normal at a hit: (r, g, b, gloss, nx, ny, nz, gx, gy, gz).

    n is the shading normal and g the triangle's own, both in the world and towards the ray's
    origin. ``spread`` is the size of a pixel at distance 1.
    """
    t, k, u, v, instance = hit
    g = world
    nx, ny, nz = (
        _mix3(g.normals, k, 0, u, v),
        _mix3(g.normals, k, 1, u, v),
        _mix3(g.normals, k, 2, u, v),
    )
    e = g.edges
    gx = e[k, 4] * e[k, 8] - e[k, 5] * e[k, 7]
    gy = e[k, 5] * e[k, 6] - e[k, 3] * e[k, 8]
    gz = e[k, 3] * e[k, 7] - e[k, 4] * e[k, 6]
    lx, ly, lz = ox + t * dx, oy + t * dy, oz + t * dz
    bx, by, bz = nx, ny, nz
    if instance >= 0:
        m = instances.to_object
        lx, ly, lz = rotate(m, instance, lx, ly, lz)
        lx, ly, lz = lx + m[instance, 0, 3], ly + m[instance, 1, 3], lz + m[instance, 2, 3]
        nx, ny, nz = rotate(instances.to_world, instance, nx, ny, nz)
        gx, gy, gz = rotate(instances.to_world, instance, gx, gy, gz)
    nx, ny, nz = _unit(nx, ny, nz)
    gx, gy, gz = _unit(gx, gy, gz)
    if gx * dx + gy * dy + gz * dz > 0.0:
        gx, gy, gz = -gx, -gy, -gz
    # Leaves are lit like their crown, independent of their orientation.
    if nx * gx + ny * gy + nz * gz < 0.0 and g.material[k] != LEAVES:
        nx, ny, nz, bx, by, bz = -nx, -ny, -nz, -bx, -by, -bz
    f = t * spread
    material = g.material[k]
    if material == BODY:
        shape = instances.shape[instance]
        bx, by, bz = _unit(bx, by, bz)
        r, gr, b, gloss = body_surface(
            world.shapes,
            world.roofs,
            shape,
            world.paints,
            instances.paint[instance],
            instance,
            lx,
            ly,
            lz + 0.5 * world.shapes[shape, 2],
            bx,
            by,
            f,
        )
        return r, gr, b, gloss, nx, ny, nz, gx, gy, gz
    a = g.uv[k, 0] * (1.0 - u - v) + g.uv[k, 2] * u + g.uv[k, 4] * v
    c = g.uv[k, 1] * (1.0 - u - v) + g.uv[k, 3] * u + g.uv[k, 5] * v
    if material == WHEEL:
        radius = world.shapes[instances.shape[instance], 12]
        r, gr, b, gloss = wheel_surface(a, c, f / radius)
    else:
        fu, fv = _footprint(f, dx, dy, dz, gx, gy, gz)
        r, gr, b, gloss = static_surface(
            material, world.paints, g.paint[k], a, c, fu, fv, world.seed
        )
    return r, gr, b, gloss, nx, ny, nz, gx, gy, gz


@func(fastmath=True)
def _unit(x, y, z):
    s = 1.0 / math.sqrt(max(x * x + y * y + z * z, 1e-24))
    return x * s, y * s, z * s


@func(fastmath=True)
def _footprint(f, dx, dy, dz, gx, gy, gz):
    """Size of a pixel along u and v, stretched along the view on slanted surfaces.

    On level ground u follows the street, within some degrees of x. On walls u is horizontal and v
    vertical, and the view is slanted along u.
    """
    slant = min(1.0 / max(-(dx * gx + dy * gy + dz * gz), 0.02), 30.0)
    if abs(gz) > 0.5:
        level = dx * dx / max(dx * dx + dy * dy, 1e-12)
        stretched = f * slant
        return (
            math.sqrt(stretched * stretched * level + f * f * (1.0 - level)),
            math.sqrt(stretched * stretched * (1.0 - level) + f * f * level),
        )
    return f * slant, f


@func(fastmath=True, forceinline=True)
def ray_colour(world, instances, hit, ox, oy, oz, dx, dy, dz, spread, stack):
    """Shade a ray with a known nearest hit: linear (r, g, b), key, normal and plane offset.

    The key identifies the surface and whether it is in the sun. Neighbouring pixels with equal
    keys, normals and offsets need only one sample each. Negative keys always need more samples.
    """
    t, k, _, _, instance = hit
    if k < 0:
        r, g, b = sky_colour(dx, dy, dz, world.seed)
        return r, g, b, 0, 0.0, 0.0, 0.0, 0.0
    r, g, b, gloss, nx, ny, nz, gx, gy, gz = surface_at(
        world, instances, hit, ox, oy, oz, dx, dy, dz, spread
    )
    px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
    facing = nx * SUN_X + ny * SUN_Y + nz * SUN_Z
    leaves = world.material[k] == LEAVES
    if leaves:
        # Leaves transmit light: their far side is dim, not black.
        facing = 0.35 + 0.65 * facing
    elif gx * SUN_X + gy * SUN_Y + gz * SUN_Z <= 0.0:
        facing = 0.0
    lit = 0.0
    if facing > 0.0:
        # Avoid self-shadowing of smooth bodies near their silhouettes.
        lift = 0.012 if instance >= 0 else 0.004
        if leaves:
            lift = 0.25
        hidden = is_blocked(
            world,
            instances,
            px + lift * gx,
            py + lift * gy,
            pz + lift * gz,
            SUN_X,
            SUN_Y,
            SUN_Z,
            SHADOW_REACH,
            stack,
        )
        lit = 0.0 if hidden else 1.0
    open_ = _openness(instances, instance, px, py, pz, nz)
    ar, ag, ab = ambient(nz, open_)
    sun = lit * facing
    r, g, b = r * (SUN_R * sun + ar), g * (SUN_G * sun + ag), b * (SUN_B * sun + ab)
    if gloss > 0.0:
        mr, mg, mb = _reflection(world, gloss, open_, lit, dx, dy, dz, nx, ny, nz)
        r, g, b = r + mr, g + mg, b + mb
    r, g, b = _haze(t, r, g, b)
    key = 2 + 2 * (world.paint[k] + 100_000 * (instance + 1)) + int(lit)
    return r, g, b, -1 if leaves else key, nx, ny, nz, px * gx + py * gy + pz * gz


@func(fastmath=True, forceinline=True)
def _openness(instances, instance, x, y, z, nz):
    """Fraction of the sky's light that reaches a point: less next to and under vehicles."""
    fraction = 1.0
    if instance >= 0:
        height = z - (instances.to_world[instance, 2, 3] - instances.half_size[instance, 2])
        fraction *= 0.45 + 0.55 * min(max(height / 0.8, 0.0), 1.0)
    if z > 2.0 or (instance >= 0 and nz < 0.5):
        return fraction
    m = instances.to_object
    for i in range(len(instances.radius)):
        reach = instances.radius[i] + CAR_SHADE_REACH
        wx, wy = x - instances.to_world[i, 0, 3], y - instances.to_world[i, 1, 3]
        if i == instance or wx * wx + wy * wy > reach * reach:
            continue
        px, py, pz = rotate(m, i, x, y, z)
        outx = max(abs(px + m[i, 0, 3]) - instances.half_size[i, 0] + 0.12, 0.0)
        outy = max(abs(py + m[i, 1, 3]) - instances.half_size[i, 1] + 0.12, 0.0)
        if pz + m[i, 2, 3] > instances.half_size[i, 2]:
            continue
        distance = math.sqrt(outx * outx + outy * outy)
        fraction *= 1.0 - 0.9 * math.exp(-distance / 0.3)
    return fraction


@func(fastmath=True, forceinline=True)
def _reflection(world, gloss, open_, lit, dx, dy, dz, nx, ny, nz):
    cos = max(-(dx * nx + dy * ny + dz * nz), 0.0)
    fresnel = gloss * (0.045 + 0.75 * (1.0 - cos) ** 5)
    rx, ry, rz = dx + 2.0 * cos * nx, dy + 2.0 * cos * ny, dz + 2.0 * cos * nz
    r, g, b = mirrored(rx, ry, rz, world.seed)
    glint = lit * 5.0 * max(rx * SUN_X + ry * SUN_Y + rz * SUN_Z, 0.0) ** 60
    fraction = fresnel * (0.3 + 0.7 * open_)
    return fraction * (r + glint), fraction * (g + glint), fraction * (b + 0.9 * glint)


@func(fastmath=True)
def _haze(t, r, g, b):
    clear = math.exp(-t / 900.0)
    return r * clear + 0.85 * (1 - clear), g * clear + 0.92 * (1 - clear), b * clear + (1 - clear)


FAR = 1e6
CHUNK = 256


class Samples(NamedTuple):
    """Results of camera rays.

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

    One ray through every pixel's centre gives depth and instance. Pixels where the surface, its
    direction or its shadow differs from a neighbour get ``samples``^2 rays. Textures are
    band-limited and need only one.
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

    No two samples share a row or column, for the best antialiasing of horizontal and vertical
    edges. Every pixel uses the same pattern, which avoids grain.
    """
    j, i = np.divmod(np.arange(samples * samples), samples)
    x = (i + (j + 0.5) / samples) / samples
    y = (j + (samples - i - 0.5) / samples) / samples
    return np.stack([x, y], axis=1) - 0.5


@kernel(parallel=True)
def _shoot(world, instances, m, k, positions, size):
    """Fields of :class:`Samples` for rays through image positions [N, 2].

    ``m`` is the camera's pose in the world, ``size`` the fraction of a pixel per ray.
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
        instances: vehicles at one time.
        origins, directions: [N, 3] of the rays in the world, unit length.
        sizes: [N], angular size of a ray [rad].
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
    """Hits of pixel centres: triangle [N], u, v [N], instance [N] and distance [N] of the hit.

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
    """Mask [H, W] of pixels with a surface that differs from one of their eight neighbours."""
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
            # Flat surfaces of one kind at different depths; on curved ones offsets change slowly.
            if abs(planes[row, column, 3] - planes[y, x, 3]) > 0.08 and turned < 1e-5:
                return True
    return False


@kernel(parallel=True)
def shoot_lidar(world, sweeps, origins, directions, limit):
    """Ranges [C, B], reflectivity [C, B] in [0, 1] of one turn; range 0 without a return.

    Args:
        world: static part.
        sweeps: vehicles at each column's time, arrays with a leading [C] axis.
        origins: [C, 3] of the sensor in the world at each column's time [m].
        directions: [C, B, 3] unit, in the world.
        limit: maximum range [m].
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
            # Glass and lacquer reflect most of a beam away from the sensor.
            diffuse = (1.0 - 0.6 * s[3]) * (0.25 + 0.75 * facing)
            ranges[c, b] = hit[0]
            returned[c, b] = min(1.25 * brightness * diffuse + 0.01, 1.0)
    return ranges, returned
