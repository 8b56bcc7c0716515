"""From what light meets to what a LiDAR measures: detection limit, losses, range noise.

Chance is a hash of the seed and the ray's number, so that a sweep has the same bits on any number
of threads, and changing one ray changes no other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene import Lidar
from .motion_of_points import point_velocities
from .types import CastRequest, Echo, Image

GOLDEN, MIX_1, MIX_2 = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
WORD = (1 << 64) - 1
LOST, ACROSS, AROUND = 0, 1, 2
"""Draws of a ray."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """What a LiDAR measures in one turn or frame; arrays are of the sensor's shape.

    Attributes:
        range: [m], noise included; 0 where nothing returns.
        returns: ranges by name (``first``, ``strongest``, ``last``) of sensors with more than one.
        intensity: reflectivity, 0 to 1; 0 where nothing returns.
        hit: rays that return.
        drop_probability: how likely each ray is lost whatever it meets, 0 to 1.
        instance: uint16, instance_id of what is met; 0 where nothing returns.
        velocity: [..., 3] m/s in the world of what is met; None where nobody asked.
        time_us: when each ray is fired, relative to the sweep's time stamp.
        points: [..., 3] in the sensor's frame at the ray's own instant [m].
    """

    range: Image
    returns: dict[str, Image]
    intensity: Image
    hit: NDArray[np.bool_]
    drop_probability: Image
    instance: NDArray[np.uint16]
    velocity: Image | None
    time_us: Image
    points: Image


def detect(echo: Echo, lidar: Lidar, *, seed: int = 0, request: CastRequest | None = None) -> Sweep:
    """Measure ``echo`` with the detector of ``lidar``.

    Args:
        echo: what light meets.
        lidar: whose rays these are.
        seed: of noise and losses.
        request: of the cast, for the velocity of what is met.
    """
    probability = drop_probability(echo, lidar)
    hit = echo.hit & (uniform(seed, lidar.beams.count, LOST).reshape(lidar.shape) >= probability)
    noise = lidar.range_noise * normal(seed, lidar.beams.count).reshape(lidar.shape)
    within = echo.range + noise
    hit &= (within >= lidar.min_range) & (within <= lidar.max_range)
    measured = np.where(hit, within, 0).astype(np.float32)
    velocity = None if request is None else point_velocities(request, echo, hit)
    return Sweep(
        range=measured,
        returns={
            name: np.where(hit & (found.range > 0), found.range + noise, 0).astype(np.float32)
            for name, found in echo.returns.items()
        },
        intensity=np.where(hit, np.clip(echo.intensity, 0, 1), 0).astype(np.float32),
        hit=hit,
        drop_probability=probability,
        instance=np.where(hit, echo.instance, 0).astype(np.uint16),
        velocity=velocity,
        time_us=lidar.beams.time_us.astype(np.float32),
        points=(lidar.beams.directions * measured[..., None]).astype(np.float32),
    )


def drop_probability(echo: Echo, lidar: Lidar) -> Image:
    """How likely each ray is lost: by the sensor's own rate, by what the log lost there, and for
    want of power, which falls with the square of the range."""
    detection = lidar.detection
    limit = detection.reflectivity / detection.range_m**2
    with np.errstate(divide="ignore", invalid="ignore"):
        power = echo.intensity / np.square(echo.range)
        faint = 1 / (1 + np.exp(np.clip((power / limit - 1) / detection.softness, -50, 50)))
    kept = (1 - detection.loss) * (1 - np.clip(echo.drop, 0, 1)) * (1 - faint)
    return np.where(echo.hit, 1 - kept, 1).astype(np.float32)


def uniform(seed: int, count: int, draw: int) -> NDArray[np.float64]:
    """Numbers [count] in [0, 1) of each ray (splitmix64 of seed, ray and draw)."""
    base = np.uint64((seed * MIX_1 + draw * MIX_2) & WORD)
    state = base + (np.arange(count, dtype=np.uint64) + np.uint64(1)) * np.uint64(GOLDEN)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(MIX_1)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(MIX_2)
    state ^= state >> np.uint64(31)
    numbers: NDArray[np.float64] = (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return numbers


def normal(seed: int, count: int) -> NDArray[np.float64]:
    """Normal numbers [count] (Box and Muller)."""
    radius = np.sqrt(-2 * np.log(1 - uniform(seed, count, ACROSS)))
    numbers: NDArray[np.float64] = radius * np.cos(2 * np.pi * uniform(seed, count, AROUND))
    return numbers
