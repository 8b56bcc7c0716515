"""Sun, sky and what they make of a surface."""

from __future__ import annotations

import math

from .._numba import func
from .noise import blend, layered_noise, ramp

SUN = (-0.52, 0.36, 0.775)
"""Direction to the sun, nearly unit: behind the drive's left shoulder, 51 degrees high."""

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
    """Light of sky and ground on a surface whose normal has the z component ``nz``."""
    up = 0.5 + 0.5 * nz
    r = blend(0.36, 0.62, up) * openness
    g = blend(0.34, 0.72, up) * openness
    b = blend(0.31, 0.9, up) * openness
    return r, g, b


@func(fastmath=True)
def mirrored(x, y, z, seed):
    """What a glossy surface sees in a direction: sky above, house fronts, road below."""
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
