"""Hash noise for textures: the same everywhere, faded where it is finer than a pixel."""

from __future__ import annotations

import math

import numpy as np

from .._numba import func

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

    Perlin's permutation table: an integer hash at every corner took most of a picture's time.
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
    """Fraction of a pixel of width ``footprint`` around x that lies in [low, high]."""
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
