"""Fragments of what broke: they fly, bounce, slide and stay on the road.

Paths are closed formulas of time, so that any instant can be shown by itself and looks the same
whenever it is asked for.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ...scene import GaussianCloud
from .breakage import Breakage
from .parts import Kind

Heights = Callable[[Float], Float]
"""[K, 2] or [K, 3] places -> [K] height of the ground [m]."""

GRAVITY = 9.81
REBOUND, KEPT, BOUNCES = 0.3, 0.6, 3
"""Of the speed up, of the speed along the road, in a bounce; and how often."""
SLIDING = 0.6
"""Friction on the road."""
SPIN = 18.0
"""Of tumbling fragments [rad/s]."""
SH_0 = 0.28209479177387814


@dataclass(frozen=True)
class _Shards:
    """Fragments of a kind of part.

    Attributes:
        count: how many.
        size: from and to, half length [m]; glass is crumbs, bumpers are pieces.
        width, thickness: half of these as fractions of half the length.
        speed: of leaving [m/s], out and to the sides.
        spread: [m] standard deviation of where they leave from, around the part's middle.
        colours: that they have in turn.
    """

    count: int
    size: tuple[float, float]
    width: float
    thickness: float
    speed: float
    spread: tuple[float, float, float]
    colours: tuple[tuple[float, float, float], ...]


CLEAR, DARK, RED = (0.72, 0.74, 0.76), (0.05, 0.05, 0.055), (0.42, 0.03, 0.03)
PALE = (0.58, 0.68, 0.66)
LAMP = _Shards(22, (0.015, 0.055), 0.7, 0.25, 1.2, (0.05, 0.1, 0.05), (CLEAR, CLEAR, DARK))
SHARDS: dict[Kind, _Shards] = {
    "lamp": LAMP,
    "bumper": _Shards(14, (0.035, 0.13), 0.5, 0.12, 0.8, (0.08, 0.55, 0.08), (DARK, DARK, CLEAR)),
    "windscreen": _Shards(20, (0.006, 0.016), 0.9, 0.6, 1.0, (0.2, 0.5, 0.1), (PALE,)),
    "pane": _Shards(90, (0.009, 0.022), 0.9, 0.7, 1.2, (0.45, 0.05, 0.1), (PALE, PALE, CLEAR)),
}


def fragment_cloud(
    broken: Sequence[Breakage], time_s: float, heights: Heights
) -> GaussianCloud | None:
    """Everything that has come off by ``time_s`` [s], in the world; None before anything has.

    Args:
        broken: parts that broke.
        time_s: on the clock of the breakages.
        heights: of the ground.
    """
    clouds = [
        _cloud(breakage, time_s - breakage.time_s, heights)
        for breakage in broken
        if breakage.time_s <= time_s
    ]
    return GaussianCloud.concatenate(clouds) if clouds else None


def _cloud(breakage: Breakage, age: float, heights: Heights) -> GaussianCloud:
    kind, shards = breakage.kind, SHARDS[breakage.kind]
    random = np.random.default_rng(zlib.crc32(f"{breakage.object_id}/{breakage.part}".encode()))
    n = max(round(shards.count * min(0.6 + 0.2 * breakage.severity, 1.4)), 1)
    start, velocity = _leaving(breakage, shards, n, random)
    half = random.uniform(*shards.size, n)
    thin = half * shards.thickness
    places, tumbled = _fallen(start, velocity, thin, age, heights)
    scales = np.stack([half, half * shards.width, thin], axis=1) * 0.7
    colours = np.array(shards.colours)[np.arange(n) % len(shards.colours)]
    if kind == "lamp" and breakage.part.startswith("rear"):
        colours[colours[:, 0] > 0.3] = RED
    colours = colours * random.uniform(0.7, 1.15, (n, 1))
    return GaussianCloud(
        means=_tensor(places),
        quats=_tensor(_tumbling(tumbled, random)),
        scales=_tensor(scales),
        opacities=_tensor(np.full(n, 0.97)),
        sh=_tensor(((colours - 0.5) / SH_0)[:, None, :]),
    )


def _leaving(
    breakage: Breakage, shards: _Shards, n: int, random: np.random.Generator
) -> tuple[Float, Float]:
    """Where from and how fast, [n, 3] each: along, across and above where the part faces."""
    outward = np.array(breakage.outward)
    outward[2] = 0.0
    outward /= max(float(np.linalg.norm(outward)), 1e-9)
    across = np.array([-outward[1], outward[0], 0.0])
    axes = np.stack([outward, across, [0.0, 0.0, 1.0]])
    along, wide, high = shards.spread
    sides = (along, wide, high) if shards is not SHARDS["pane"] else (wide, along, high)
    start = np.array(breakage.position) + (random.normal(size=(n, 3)) * sides) @ axes
    scatter = random.normal(size=(n, 3)) * [0.6, 1.0, 0.6] + [0.35, 0.0, 0.7]
    # What is broken harder is thrown farther.
    speed = shards.speed * np.sqrt(min(breakage.severity, 4.0))
    return start, np.array(breakage.velocity) + speed * scatter @ axes


def _fallen(
    start: Float, velocity: Float, thin: Float, age: float, heights: Heights
) -> tuple[Float, Float]:
    """Places [n, 3] at an age [s], and for how long each has tumbled [n]."""
    above = np.maximum(start[:, 2] - heights(start[:, :2]) - thin, 0.0)
    level, up = velocity[:, :2].copy(), velocity[:, 2].copy()
    left, place = np.full(len(start), age), start[:, :2].copy()
    tumbled, height = np.zeros(len(start)), above.copy()
    flying = np.ones(len(start), dtype=bool)
    for bounce in range(BOUNCES + 1):
        until = (up + np.sqrt(up**2 + 2 * GRAVITY * above)) / GRAVITY
        spent = np.where(flying, np.minimum(left, until), 0.0)
        height = np.where(flying, above + up * spent - GRAVITY / 2 * spent**2, height)
        place += level * spent[:, None]
        tumbled, left = tumbled + spent, left - spent
        landed = flying & (left > 0)
        flying = landed
        if bounce < BOUNCES:
            up = np.where(landed, REBOUND * np.abs(up - GRAVITY * until), up)
            level[landed] *= KEPT
            above = np.where(landed, 0.0, above)
    speed = np.linalg.norm(level, axis=1)
    stops = speed / (SLIDING * GRAVITY)
    slid = np.where(flying, np.minimum(left, stops), 0.0)
    place += level * (slid * (1 - slid / np.maximum(2 * stops, 1e-9)))[:, None]
    height = np.where(flying, 0.0, height)
    return np.concatenate(
        [place, (heights(place) + np.maximum(height, 0.0) + thin)[:, None]], axis=1
    ), tumbled


def _tumbling(tumbled: Float, random: np.random.Generator) -> Float:
    """[n, 4] quaternions of fragments that have tumbled for [n] s; flat when they lie."""
    n = len(tumbled)
    yaw, rate = random.uniform(0, np.pi, n), random.uniform(-SPIN, SPIN, n)
    axis = random.uniform(0, 2 * np.pi, n)
    roll = np.round(rate * tumbled / np.pi * 4) * np.pi / 4 * np.exp(-2.5 * tumbled)
    turn = np.stack(
        [
            np.cos(roll / 2),
            np.sin(roll / 2) * np.cos(axis),
            np.sin(roll / 2) * np.sin(axis),
            np.zeros(n),
        ],
        axis=1,
    )
    c, s = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x, y, z = turn.T
    return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=1)


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))
