"""What surfaces are made of: albedo and gloss as functions of texture coordinates.

Every material takes the size of a pixel on the surface and fades what is finer, so that textures
do not alias at a distance. Colours are linear RGB; the last value is the fraction of mirror
reflection.
"""

# ruff: noqa: PLR0917 - kernels take numbers one by one: compiled code is fastest so.

from __future__ import annotations

import math

from .._numba import func
from .noise import band, blend, hash01, layered_noise, ramp, value_noise

ROAD, KERB_STONE, PAVING, EARTH, WALL, WINDOW, DOOR, ROOF = range(8)
PLAIN, BARK, LEAVES, SIGN, BODY, WHEEL = range(8, 14)

PARKING_BAY = 6.5
"""Distance of the marks between parking bays [m]."""


@func(fastmath=True)
def static_surface(  # noqa: PLR0911 - one return per material
    material, paint, p, u, v, fu, fv, seed
):
    """(r, g, b, gloss) of any material but bodies and wheels of vehicles.

    ``u, v`` are texture coordinates [m], ``fu, fv`` a pixel's size along them [m], ``p`` a
    row of the paint table. Rows are not sliced off: that counts references, across all threads.
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
