"""Materials of surfaces: albedo and gloss as functions of texture coordinates.

Every material takes the size of a pixel on the surface and fades finer detail, so that textures do
not alias at a distance. Colours are linear RGB; the last value is the fraction of mirror
reflection.
"""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math

import numpy as np

from .._numba import func

# Hash noise for textures, faded out below the size of a pixel.

_MASK = 0xFFFFFFFF
_RNG = np.random.default_rng(20240229)
_ORDER = np.tile(_RNG.permutation(256), 3)[:514].astype(np.uint16)
_VALUE = _RNG.permutation(256) / 255.0


@func
def hash01(x, y, seed):
    """A number in [0, 1) from two integers and a seed (32-bit finaliser of MurmurHash3)."""
    h = (int(x) * 0x9E3779B1 + int(y) * 0x85EBCA77 + int(seed) * 0xC2B2AE3D) & _MASK
    h = ((h ^ (h >> 16)) * 0x85EBCA6B) & _MASK
    h = ((h ^ (h >> 13)) * 0xC2B2AE35) & _MASK
    return (h ^ (h >> 16)) * (1.0 / 4294967296.0)


@func(fastmath=True)
def value_noise(x, y, seed):
    """Smooth noise in [0, 1] with features of size 1, of period 256.

    Uses Perlin's permutation table, which is much faster than an integer hash at every corner.
    """
    fx, fy = math.floor(x), math.floor(y)
    u, v = x - fx, y - fy
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
    i, j = (int(fx) + 37 * seed) & 255, (int(fy) + 101 * seed) & 255
    left, right = _ORDER[i] + j, _ORDER[i + 1] + j
    a, b = _VALUE[_ORDER[left]], _VALUE[_ORDER[right]]
    c, d = _VALUE[_ORDER[left + 1]], _VALUE[_ORDER[right + 1]]
    return a + (b - a) * u + (c - a) * v + (a - b - c + d) * u * v


@func(fastmath=True)
def layered_noise(x, y, octaves, footprint, seed):
    """Sum of octaves of noise, about [-1, 1] around 0.

    ``footprint`` is the size of a pixel in units of x: octaves finer than two pixels are faded
    out, so that the texture is band-limited at any distance.
    """
    total, amplitude, scale = 0.0, 0.5, 1.0
    for octave in range(octaves):
        fade = 1.5 - 2.0 * footprint * scale
        if fade <= 0.0:
            break
        total += (
            amplitude
            * min(fade, 1.0)
            * (2.0 * value_noise(x * scale, y * scale, seed + octave) - 1.0)
        )
        amplitude *= 0.55
        scale *= 2.03
    return total


@func(fastmath=True)
def band(x, low, high, footprint):
    """Fraction of a pixel of width ``footprint`` around x inside [low, high]."""
    half = 0.5 * max(footprint, 1e-6)
    return max(0.0, min(x + half, high) - max(x - half, low)) / (2.0 * half)


@func(fastmath=True)
def blend(a, b, weight):
    """a for weight 0, b for weight 1."""
    return a + (b - a) * weight


@func(fastmath=True)
def ramp(x, low, high):
    """Smooth step from 0 at ``low`` to 1 at ``high``."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


ROAD, KERB_STONE, PAVING, EARTH, WALL, WINDOW, DOOR, ROOF = range(8)
PLAIN, BARK, LEAVES, SIGN, BODY, WHEEL = range(8, 14)

PARKING_BAY = 6.5
"""Spacing of the marks between parking bays [m]."""


@func(fastmath=True)
def static_surface(  # noqa: PLR0911 - one return per material
    material, paint, p, u, v, fu, fv, seed
):
    """(r, g, b, gloss) of all materials except bodies and wheels of vehicles.

    ``u, v`` are texture coordinates [m], ``fu, fv`` a pixel's size along them [m], ``p`` a
    row of the paint table. Rows are not sliced, because reference counting is slow with threads.
    """
    f = math.sqrt(fu * fv)
    if material == ROAD:
        return _road(paint, p, u, v, fu, fv, f, seed)
    if material == KERB_STONE:
        return _kerb(paint, p, u, fu, f, v, seed)
    if material == PAVING:
        return _paving(paint, p, u, v, fu, fv, f, seed)
    if material == EARTH:
        k = 1.0 + 0.6 * layered_noise(u * 1.5, v * 1.5, 4, f * 1.5, seed + 40)
        return paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k, 0.0
    if material == WALL:
        return _wall(paint, p, u, v, fu, fv, f)
    if material == WINDOW:
        return _window(paint, p, u, v, f)
    if material == DOOR:
        return _door(paint, p, u, v, f)
    if material == ROOF:
        return _tiles(paint, p, u, v, fu, fv, seed)
    if material == BARK:
        k = 1.0 + 0.7 * layered_noise(u * 14, v * 3, 3, f * 14, seed + 50)
        return paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k, 0.0
    if material == LEAVES:
        k = 1.0 + 0.75 * layered_noise(u * 4.0, v * 4.0, 3, f * 4.0, seed + 60)
        return paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k, 0.0
    if material == SIGN:
        return _sign(paint, p, u, v, f)
    return paint[p, 0], paint[p, 1], paint[p, 2], 0.0


@func(fastmath=True)
def _road(paint, p, s, d, fs, fd, f, seed):
    crossing, lane, kerb = paint[p, 3], paint[p, 4], paint[p, 5]
    k = 1.0 + 0.22 * layered_noise(s * 0.3, d * 0.5, 3, f * 0.5, seed)
    k += 0.5 * layered_noise(s * 11.0, d * 11.0, 4, f * 11.0, seed + 5)
    side = abs(d)
    if side < lane:
        # Tyres polish two tracks in each lane and drip a dark line between them.
        across = side - lane / 2
        k += 0.1 * math.exp(-(((abs(across) - 0.8) / 0.28) ** 2))
        k -= 0.12 * math.exp(-((across / 0.3) ** 2))
    else:
        k *= 1.18
    k *= _repairs(s, d, fs, fd, seed)
    r, g, b = paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k
    gutter = band(side, kerb - 0.3, kerb, fd)
    if gutter > 0.0:
        stone = 0.2 * (1.0 + 0.5 * layered_noise(s * 3.0, d * 3.0, 3, f * 3.0, seed + 9))
        joint = 1.0 - 0.5 * band(s - math.floor(s / 0.5) * 0.5, 0.0, 0.02, fs)
        stone *= joint
        r, g, b = blend(r, stone, gutter), blend(g, stone, gutter), blend(b, stone, gutter)
    white = _markings(s, side, d, fs, fd, crossing, lane, kerb)
    if white > 0.0:
        worn = 0.86 + 0.4 * layered_noise(s * 5.0, d * 5.0, 3, f * 5.0, seed + 13)
        w = white * min(max(worn, 0.25), 1.0)
        r, g, b = blend(r, 0.66, w), blend(g, 0.66, w), blend(b, 0.63, w)
    return r, g, b, 0.0


@func(fastmath=True)
def _repairs(s, d, fs, fd, seed):
    """Factor for patches, cracks and manhole covers."""
    k = 1.0
    cell, half = math.floor(s / 11.0), 0.0 if d > 0 else 1.0
    if hash01(cell, half, seed + 20) < 0.5:
        start = cell * 11.0 + 1.0 + 5.0 * hash01(cell, half, seed + 21)
        length = 1.2 + 3.0 * hash01(cell, half, seed + 22)
        side, low = abs(d), 0.3 + 2.0 * hash01(cell, half, seed + 23)
        width = 0.8 + 1.2 * hash01(cell, half, seed + 24)
        inside = band(s, start, start + length, fs) * band(side, low, low + width, fd)
        core = band(s, start + 0.05, start + length - 0.05, fs)
        core *= band(side, low + 0.05, low + width - 0.05, fd)
        tone = 0.72 + 0.5 * hash01(cell, half, seed + 25)
        k *= 1.0 - 0.55 * (inside - core) + (tone - 1.0) * core
    wander = 0.6 * layered_noise(s * 0.7, 3.0, 3, 0.0, seed + 30)
    crack = band(d - 0.1 - wander, 0.0, 0.018, fd) * ramp(
        value_noise(s * 0.12, 7.0, seed + 31), 0.5, 0.6
    )
    k *= 1.0 - 0.6 * crack
    at = math.floor(s / 23.0)
    cs = s - (at * 23.0 + 4.0 + 14.0 * hash01(at, 0, seed + 32))
    cd = d - (1.7 if hash01(at, 1, seed + 33) < 0.5 else -1.6)
    radius = math.sqrt(cs * cs + cd * cd)
    if radius < 0.45:
        cover = band(radius, -1.0, 0.36, max(fs, fd))
        ring = band(radius, 0.28, 0.31, max(fs, fd)) + band(radius, 0.36, 0.4, max(fs, fd))
        k = blend(k, 0.75 + 0.25 * math.sin(cs * 60.0) * math.sin(cd * 60.0), cover) * (
            1 - 0.6 * ring
        )
    return k


@func(fastmath=True)
def _markings(s, side, d, fs, fd, crossing, lane, kerb):
    """Fraction of white paint at a point of the road."""
    from_crossing = abs(s - crossing)
    if from_crossing < 2.2:
        stripe = d - math.floor(d)
        white = band(stripe, 0.0, 0.5, fd) if fd < 1.0 else 0.5
        return white * band(from_crossing, -1.0, 1.8, fs) * band(side, -1.0, kerb - 0.4, fd)
    phase = s - math.floor(s / 7.0) * 7.0
    white = band(side, -1.0, 0.065, fd) * band(phase, 0.5, 3.5, fs)
    if from_crossing < 3.6:
        stop = band(from_crossing, 3.0, 3.3, fs)
        # Traffic keeps right: each lane has its stop line before the crossing.
        if (d < 0) == (s < crossing):
            white = max(white, stop * band(side, 0.15, lane - 0.1, fd))
    white = max(white, band(side, lane - 0.05, lane + 0.05, fd))
    bay = s - math.floor(s / PARKING_BAY) * PARKING_BAY
    return max(white, band(bay, 0.0, 0.1, fs) * band(side, lane, kerb - 0.5, fd))


@func(fastmath=True)
def _kerb(paint, p, s, fs, f, v, seed):
    stone = math.floor(s)
    k = (
        0.85
        + 0.3 * hash01(stone, 1, seed + 70)
        + 0.3 * layered_noise(s * 6, v * 6, 3, f * 6, seed + 71)
    )
    k *= 1.0 - 0.55 * band(s - stone, 0.0, 0.02, fs)
    return paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k, 0.0


@func(fastmath=True)
def _paving(paint, p, s, d, fs, fd, f, seed):
    row = math.floor(d / 0.5)
    shift = 0.5 * (row - 2.0 * math.floor(row / 2.0))
    a = s / 0.75 + shift
    slab = math.floor(a)
    fade = ramp(0.5 - f, 0.0, 0.35)
    k = 1.0 + (hash01(slab, row, seed + 80) - 0.5) * 0.32 * fade
    k += 0.3 * layered_noise(s * 5, d * 5, 4, f * 5, seed + 81)
    k += 0.2 * layered_noise(s * 0.4, d * 0.4, 2, f * 0.4, seed + 85)
    joint = max(band((a - slab) * 0.75, 0.0, 0.02, fs), band(d - row * 0.5, 0.0, 0.02, fd))
    k *= 1.0 - 0.45 * joint
    return paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k, 0.0


@func(fastmath=True)
def _wall(paint, p, u, z, fu, fv, f):
    seed = int(paint[p, 4])
    r, g, b = paint[p, 0], paint[p, 1], paint[p, 2]
    k = 1.0 + 0.16 * layered_noise(u * 0.35, z * 0.35, 3, f * 0.35, seed)
    if paint[p, 3] > 0.5:
        row = math.floor(z / 0.09)
        shift = 0.5 * (row - 2.0 * math.floor(row / 2.0))
        a = u / 0.27 + shift
        brick = math.floor(a)
        fade = ramp(0.2 - f, 0.0, 0.15)
        k += (hash01(brick, row, seed) - 0.5) * 0.5 * fade
        joint = max(band((a - brick) * 0.27, 0.0, 0.016, fu), band(z - row * 0.09, 0.0, 0.016, fv))
        r, g, b = blend(r, 0.3, joint), blend(g, 0.28, joint), blend(b, 0.25, joint)
    else:
        k += 0.12 * layered_noise(u * 9.0, z * 9.0, 3, f * 9.0, seed + 3)
        # Rain streaks: noise stretched along the wall's height.
        k -= 0.12 * ramp(layered_noise(u * 2.2, z * 0.12, 2, f * 2.2, seed + 7), 0.1, 0.5)
    plinth = band(z, -10.0, 0.75, fv)
    if plinth > 0.0:
        stone = 0.2 * (1.0 + 0.4 * layered_noise(u * 4.0, z * 4.0, 3, f * 4.0, seed + 9))
        r, g, b = (
            blend(r, stone, plinth),
            blend(g, stone * 0.97, plinth),
            blend(b, stone * 0.92, plinth),
        )
    k *= 0.82 + 0.18 * ramp(z, 0.0, 2.2)
    return r * k, g * k, b * k, 0.0


@func(fastmath=True)
def _window(paint, p, u, v, f):
    number = math.floor(u / 10.0)
    u -= number * 10.0
    w, h, shop = paint[p, 3], paint[p, 4], paint[p, 5]
    border = 0.07
    glass = band(u, border, w - border, f) * band(v, border, h - border, f)
    if shop < 0.5:
        glass *= 1.0 - band(u, w / 2 - 0.035, w / 2 + 0.035, f)
        glass *= 1.0 - band(v, h * 0.68 - 0.03, h * 0.68 + 0.03, f)
    dark = 0.02 + 0.03 * hash01(number, 3, 5)
    r = g = b = dark
    curtain = hash01(number, 7, 5)
    if shop < 0.5 and curtain < 0.55:
        reach = w * (0.14 + 0.16 * hash01(number, 8, 5))
        cloth = 0.22 + 0.2 * hash01(number, 9, 5)
        folds = 1.0 + 0.3 * math.sin(u * 45.0) * ramp(0.06 - f, 0.0, 0.04)
        fraction = 1.0 - band(u, reach, w - reach, f + 0.02)
        if curtain < 0.15:
            fraction = max(fraction, band(v, h * (0.3 + 0.5 * hash01(number, 10, 5)), h, f))
        cloth *= folds
        fraction *= 0.8
        r, g, b = blend(r, cloth, fraction), blend(g, cloth, fraction), blend(b, cloth, fraction)
    elif shop >= 0.5:
        # Goods behind the pane: blocks of colour up to chest height.
        column = math.floor(u / 0.55)
        tall = h * (0.2 + 0.4 * hash01(number * 16 + column, 1, 6))
        fraction = band(v, 0.12, tall, f) * band(u - column * 0.55, 0.06, 0.5, f) * 0.8
        r = blend(r, 0.3 * hash01(number * 16 + column, 2, 6), fraction)
        g = blend(g, 0.25 * hash01(number * 16 + column, 3, 6), fraction)
        b = blend(b, 0.25 * hash01(number * 16 + column, 4, 6), fraction)
    return (
        blend(paint[p, 0], r, glass),
        blend(paint[p, 1], g, glass),
        blend(paint[p, 2], b, glass),
        glass * 0.8,
    )


@func(fastmath=True)
def _door(paint, p, u, v, f):
    w, h = paint[p, 3], paint[p, 4]
    k = 0.9
    panel = band(u, 0.16, w - 0.16, f) * (band(v, 0.2, 0.95, f) + band(v, 1.1, h - 0.55, f))
    inner = band(u, 0.2, w - 0.2, f) * (band(v, 0.24, 0.91, f) + band(v, 1.14, h - 0.59, f))
    k *= 1.0 - 0.45 * (panel - inner)
    light = band(u, 0.12, w - 0.12, f) * band(v, h - 0.42, h - 0.08, f)
    knob = band(u, w - 0.14, w - 0.08, f) * band(v, 1.0, 1.12, f)
    r, g, b = paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k
    r, g, b = blend(r, 0.04, light), blend(g, 0.04, light), blend(b, 0.045, light)
    return blend(r, 0.5, knob), blend(g, 0.42, knob), blend(b, 0.2, knob), light * 0.7


@func(fastmath=True)
def _tiles(paint, p, u, v, fu, fv, seed):
    row, column = math.floor(v / 0.34), math.floor(u / 0.24)
    fade = ramp(0.4 - math.sqrt(fu * fv), 0.0, 0.3)
    k = 1.0 + (hash01(column, row, seed + 90) - 0.5) * 0.45 * fade
    k += 0.25 * layered_noise(u * 0.5, v * 0.5, 3, fu * 0.5, seed + 91)
    k *= 1.0 - 0.5 * band(v - row * 0.34, 0.0, 0.05, fv)
    k *= 1.0 - 0.25 * band(u - column * 0.24, 0.0, 0.03, fu)
    return paint[p, 0] * k, paint[p, 1] * k, paint[p, 2] * k, 0.0


@func(fastmath=True)
def _sign(paint, p, u, v, f):
    rim = 1.0 - band(max(abs(u), abs(v)), -1.0, 0.9, f * 3.0)
    bar = band(abs(u), -1.0, 0.5 - 0.35 * v, f * 3.0) * band(v, -0.6, 0.55, f * 3.0)
    white = max(rim, bar)
    return (
        blend(paint[p, 0], 0.7, white),
        blend(paint[p, 1], 0.7, white),
        blend(paint[p, 2], 0.7, white),
        0.05,
    )


# Vehicle bodies: paint, glass, lamps, plates, seams, wheels.


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
        number: number of the vehicle, for its plates.
        x, y, z: the point; z from the ground [m].
        nx, ny: components of the surface normal.
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
    # Below two pixels per stroke, the letters blend into grey.
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
