"""The colour of a ray: hit, material, light."""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._numba import func
from ..geometry.transform import Float
from .bodywork import body_surface, wheel_surface
from .casting import is_blocked, rotate
from .light import SUN_B, SUN_G, SUN_R, SUN_X, SUN_Y, SUN_Z, ambient, mirrored, sky_colour
from .materials import BODY, LEAVES, WHEEL, static_surface

SHADOW_REACH = 90.0
CAR_SHADE_REACH = 1.1


class RaycastWorld(NamedTuple):
    """All that a ray can meet, apart from where the vehicles are.

    One flat tuple, because parallel kernels take no nested ones.

    Attributes:
        bounds, children, counts, edges, uv, normals, material, paint: as in :class:`.bvh.Geometry`;
            the surroundings have root 0.
        paints: [P, 8] paint table.
        shapes: [S, 16] measures of vehicle shapes.
        roofs: [S, n] their roof lines [m].
        seed: of the textures.
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
    # Leaves are lit as the crown they belong to, whichever way each one is turned.
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
    """Size of a pixel along u and v: stretched along the view on slanted surfaces.

    On level ground u runs along the street, that is along x within some degrees; on walls u runs
    level and v up, and a wall is seen slanted along u.
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
    """A ray whose nearest hit is known: linear (r, g, b), key, normal and plane offset.

    The key names what was hit and whether the sun reaches it; equal keys, normals and offsets of
    neighbouring pixels mean that one sample each will do. Negative keys ask for more anyway.
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
        # Leaves let light through: their far side is dim, not black.
        facing = 0.35 + 0.65 * facing
    elif gx * SUN_X + gy * SUN_Y + gz * SUN_Z <= 0.0:
        facing = 0.0
    lit = 0.0
    if facing > 0.0:
        # A smooth body of flat triangles would shade itself near its silhouette.
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
    """Fraction of the sky's light that reaches a point: less beside and under vehicles."""
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
