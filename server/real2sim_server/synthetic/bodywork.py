"""What the bodies of vehicles show: paint, glass, lamps, plates, seams, wheels."""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math

from .._numba import func
from .noise import band, blend, hash01

GLASS_GLOSS = 0.9
PAINT_GLOSS = 0.55


@func(fastmath=True)
def body_surface(shape, roof, i, paint, p, number, x, y, z, nx, ny, f):
    """(r, g, b, gloss) of a body at a point in its own frame.

    Args:
        shape: table of measures, see ``vehicles.shape_row``.
        roof: table of roof lines, heights at even steps from rear to front [m].
        i: row of both.
        paint, p: paint table and the row of the body's colour.
        number: of the vehicle, for its plates.
        x, y, z: the point; z from the ground [m].
        nx, ny: of the surface normal.
        f: size of a pixel there [m].
    """
    length, height, belt = shape[i, 0], shape[i, 2], shape[i, 3]
    r, g, b, gloss = paint[p, 0], paint[p, 1], paint[p, 2], PAINT_GLOSS
    clearance = shape[i, 13]
    trim = band(z, -1.0, clearance + 0.1, f)
    r, g, b = blend(r, 0.025, trim), blend(g, 0.025, trim), blend(b, 0.027, trim)
    if abs(ny) > 0.4:
        r, g, b, gloss = _side(shape, roof, i, r, g, b, gloss, x, z, f)
    elif z > belt:
        r, g, b, gloss = _screens(shape, i, r, g, b, gloss, x, y, z, nx, f)
    if nx > 0.35 and x > length / 2 - 0.6 and z < belt:
        r, g, b, gloss = _nose(shape, i, number, r, g, b, gloss, y, z, f)
    elif nx < -0.35 and x < 0.4 - length / 2 and z < max(belt, 0.7 * height):
        r, g, b, gloss = _tail(shape, i, number, r, g, b, gloss, y, z, f)
    return r, g, b, gloss


@func(fastmath=True)
def _roof_at(roof, i, length, x):
    at = (x / length + 0.5) * (roof.shape[1] - 1)
    at = min(max(at, 0.0), roof.shape[1] - 1.001)
    j = int(at)
    return blend(roof[i, j], roof[i, j + 1], at - j)


@func(fastmath=True)
def _side(shape, roof, i, r, g, b, gloss, x, z, f):
    length, height, belt = shape[i, 0], shape[i, 2], shape[i, 3]
    rear, front, pillars = shape[i, 4], shape[i, 5], int(shape[i, 14])
    top = _roof_at(roof, i, length, x)
    wheel, clearance = shape[i, 12], shape[i, 13]
    for k in range(10, 12):
        distance = math.hypot(x - shape[i, k], z - wheel)
        arch = band(distance, -1.0, wheel + 0.055, f)
        if arch > 0.0:
            r, g, b, gloss = (
                blend(r, 0.012, arch),
                blend(g, 0.012, arch),
                blend(b, 0.012, arch),
                gloss * (1 - arch),
            )
    # The glass follows the roof line at a distance and leans with the screens.
    edge = 0.1 if height < 2.0 else 0.28
    glass = band(z, belt + 0.03, top - edge, f) * band(x, rear, front, f)
    step = (front - rear) / (pillars + 1)
    for k in range(1, pillars + 1):
        at = rear + k * step
        glass *= 1.0 - band(x, at - 0.045, at + 0.045, f)
        seam = band(x, at - 0.008, at + 0.008, f) * band(z, clearance + 0.14, belt, f)
        handle = band(x, at + 0.06, at + 0.22, f) * band(z, belt - 0.17, belt - 0.13, f)
        dark = max(0.75 * seam, 0.6 * handle)
        r, g, b = r * (1 - dark), g * (1 - dark), b * (1 - dark)
    seam = band(x, front - 0.008, front + 0.008, f) * band(z, clearance + 0.14, belt, f)
    crease = band(z, belt - 0.24, belt - 0.225, f) * band(x, -0.44 * length, 0.4 * length, f)
    dark = max(0.75 * seam, 0.25 * crease)
    r, g, b = r * (1 - dark), g * (1 - dark), b * (1 - dark)
    rim = band(z, belt + 0.005, top - edge + 0.035, f) * band(x, rear - 0.04, front + 0.04, f)
    r, g, b = blend(r, 0.02, rim), blend(g, 0.02, rim), blend(b, 0.02, rim)
    return (
        blend(r, 0.018, glass),
        blend(g, 0.022, glass),
        blend(b, 0.025, glass),
        blend(gloss, GLASS_GLOSS, glass),
    )


@func(fastmath=True)
def _screens(shape, i, r, g, b, gloss, x, y, z, nx, f):
    width, height, belt = shape[i, 1], shape[i, 2], shape[i, 3]
    side = abs(y)
    half = 0.5 * width * (0.86 - 0.16 * (z - belt) / (height - belt))
    if height > 2.0:
        half = 0.5 * width * 0.9
    glass = 0.0
    if nx > 0.2:
        glass = band(x, shape[i, 7], shape[i, 6], f)
    elif nx < -0.2 and shape[i, 9] > shape[i, 8]:
        glass = band(x, shape[i, 8], shape[i, 9], f)
    glass *= band(side, -1.0, half - 0.07, f) * band(z, belt - 0.02, height - 0.05, f)
    return (
        blend(r, 0.018, glass),
        blend(g, 0.022, glass),
        blend(b, 0.025, glass),
        blend(gloss, GLASS_GLOSS, glass),
    )


@func(fastmath=True)
def _nose(shape, i, number, r, g, b, gloss, y, z, f):
    width, height = shape[i, 1], shape[i, 2]
    big = height > 2.0
    lamp_z = 0.47 * shape[i, 3] + 0.2 if not big else 0.78
    side = abs(y)
    grille = band(side, -1.0, 0.42, f) * band(z, lamp_z - 0.1, lamp_z + 0.06, f)
    bars = 0.02 + 0.1 * band(z - math.floor(z / 0.04) * 0.04, 0.0, 0.014, f)
    r, g, b = blend(r, bars, grille), blend(g, bars, grille), blend(b, bars, grille)
    intake = band(side, -1.0, 0.3 * width, f) * band(z, shape[i, 13] + 0.08, shape[i, 13] + 0.2, f)
    r, g, b = blend(r, 0.02, intake), blend(g, 0.02, intake), blend(b, 0.02, intake)
    lamp = band(side, width / 2 - 0.52, width / 2 - 0.1, f) * band(
        z, lamp_z - 0.08, lamp_z + 0.08, f
    )
    glow = 0.45 + 0.45 * band(side, width / 2 - 0.42, width / 2 - 0.24, f)
    r, g, b = blend(r, glow, lamp), blend(g, glow, lamp), blend(b, glow, lamp)
    r, g, b = _plate(r, g, b, y, z - (lamp_z - 0.21), number, f)
    return r, g, b, blend(gloss, 0.3, grille)


@func(fastmath=True)
def _tail(shape, i, number, r, g, b, gloss, y, z, f):
    width, height, belt = shape[i, 1], shape[i, 2], shape[i, 3]
    side = abs(y)
    low, high = belt - 0.33, belt - 0.12
    inner = width / 2 - 0.42
    if height > 2.0:
        low, high, inner = belt - 0.4, belt - 0.02, width / 2 - 0.24
    lamp = band(side, inner, width / 2 + 0.1, f) * band(z, low, high, f)
    white = band(z, low, low + 0.06, f)
    r = blend(r, 0.42 + 0.1 * white, lamp)
    g = blend(g, 0.015 + 0.3 * white, lamp)
    b = blend(b, 0.015 + 0.3 * white, lamp)
    seam = band(z, low - 0.1, low - 0.085, f) + band(side, inner - 0.015, inner, f) * band(
        z, low, high, f
    )
    if height > 2.0:
        seam += band(side, -1.0, 0.01, f) * band(z, 0.5, height - 0.25, f)
    dark = 0.6 * min(seam, 1.0)
    r, g, b = r * (1 - dark), g * (1 - dark), b * (1 - dark)
    r, g, b = _plate(r, g, b, y, z - (low + 0.05), number, f)
    return r, g, b, gloss


@func(fastmath=True)
def _plate(r, g, b, y, z, number, f):
    """A number plate around (0, 0)."""
    plate = band(y, -0.26, 0.26, f) * band(z, -0.055, 0.055, f)
    if plate <= 0.0:
        return r, g, b
    ink = band(y, -0.25, 0.25, f) * band(z, -0.038, 0.038, f)
    column = math.floor((y + 0.25) / 0.0167)
    row = math.floor((z + 0.038) / 0.0152)
    glyph = 1.0 if hash01(column, row, 400 + number) < 0.55 else 0.0
    if int(column) % 4 == 3:
        glyph = 0.0
    # Below two pixels a stroke the letters melt into grey.
    sharp = min(max((0.02 - f) / 0.012, 0.0), 1.0)
    shade = 0.72 * (1.0 - ink * blend(0.4, 0.95 * glyph, sharp))
    return blend(r, shade, plate), blend(g, shade, plate), blend(b, shade * 0.97, plate)


@func(fastmath=True)
def wheel_surface(u, v, f):
    """(r, g, b, gloss) of a wheel; u, v are relative to its radius, f a pixel in these units."""
    radius, angle = math.hypot(u, v), math.atan2(v, u)
    k = 0.022
    rim = band(radius, -1.0, 0.68, f)
    if rim > 0.0:
        spoke = 0.5 + 0.5 * math.cos(5.0 * angle)
        open_ = band(radius, 0.22, 0.6, f) * min(max((0.45 - spoke) * 4.0, 0.0), 1.0)
        metal = blend(0.42, 0.03, open_)
        metal = blend(metal, 0.2, band(radius, 0.0, 0.1, f))
        k = blend(k, metal, rim)
    return k, k, k * 1.03, 0.25 * rim
