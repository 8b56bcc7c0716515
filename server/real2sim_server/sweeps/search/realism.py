"""How far a case is from how people drive: what is subtracted from how critical it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...scene import Scene
from ...world import World
from .reference import gap_now

Array = NDArray[np.float64]

HARDEST, SIDEWAYS, JERK = 8.0, 4.0, 20.0
"""Accelerations [m/s^2] along and across, and jerk [m/s^3], that people reach in emergencies."""
TIGHTEST = 0.2
"""Curvature of the way of a vehicle, whatever its speed [1/m]: none turns within 5 m."""
START_GAP = 1.0
"""Free around the ego when the episode begins [m]."""
FEWEST_DRIVERS = 5
"""A log with fewer that move says nothing about how people drive there."""
LEAST_SPREAD = np.array([1.0, 0.5, 0.5])
"""Standard deviations are at least these: speed [m/s], accelerations [m/s^2]."""
ORDINARY = 3.0
"""Standard deviations within which nothing is subtracted."""


@dataclass(frozen=True)
class Manners:
    """How those who moved in the log did: mean and spread of speed and accelerations.

    Attributes:
        mean, spread: [3] each; None where too few moved.
    """

    mean: Array | None
    spread: Array | None

    @classmethod
    def of(cls, scene: Scene) -> Manners:
        """Those of the objects of a scene, and of its recording vehicle."""
        tracks = [o.trajectory for o in scene.objects.values()] + [scene.ego]
        rows = []
        for track in tracks:
            times = np.asarray(track.times_us, np.float64) * 1e-6
            if len(times) < 4 or times[-1] - times[0] < 1.0:
                continue
            even = np.arange(times[0], times[-1], 0.2)
            places = np.asarray(track.positions)[:, :2]
            points = np.stack([np.interp(even, times, places[:, k]) for k in (0, 1)], axis=1)
            motion = _motion(points, 0.2)
            if len(motion) and motion[:, 0].max() > 1.0:
                rows.append(_features(motion))
        if len(rows) < FEWEST_DRIVERS:
            return cls(None, None)
        found = np.array(rows)
        return cls(found.mean(axis=0), np.maximum(found.std(axis=0), LEAST_SPREAD))

    def distance(self, features: Array) -> float:
        """Mahalanobis distance beyond what is ordinary; 0 where the log says nothing."""
        if self.mean is None or self.spread is None:
            return 0.0
        z = (features - self.mean) / self.spread
        return max(float(np.sqrt((z * z).mean())) - ORDINARY, 0.0)


@dataclass
class Watch:
    """Follows those who make it hard, over an episode.

    Attributes:
        names: their objects.
        manners: of the log.
    """

    names: frozenset[str]
    manners: Manners
    _tracks: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _dt: float = 0.1
    _start_gap: float = math.inf

    def add(self, world: World) -> None:
        """The instant that a world is at."""
        if world.steps == 0:
            self._start_gap, self._dt = gap_now(world), world.context.dt
        others = world.instant.others
        for k, name in enumerate(others.ids):
            if name in self.names:
                x, y = others.centres[k, :2].tolist()
                self._tracks.setdefault(name, []).append((x, y))

    def implausibility(self) -> float:
        """0 for what people do, about 1 for what nobody does; none of it is forbidden, but nobody
        learns from it."""
        found = max(START_GAP - self._start_gap, 0.0) / START_GAP
        for track in self._tracks.values():
            motion = _motion(np.array(track), self._dt)
            if not len(motion):
                continue
            speed = motion[:, 0]
            moving = speed > 0.5
            if not moving.any():
                continue
            along, across = np.abs(motion[moving, 1]), np.abs(motion[moving, 2])
            jerk = np.abs(np.diff(motion[:, 1])) / self._dt
            found += _beyond(along, HARDEST) + _beyond(across, SIDEWAYS) + _beyond(jerk, JERK) / 4
            curvature = across / np.maximum(speed[moving], 0.5) ** 2
            found += _beyond(curvature[speed[moving] > 1.0], TIGHTEST)
            found += 0.2 * self.manners.distance(_features(motion))
        return found


def _motion(points: Array, dt: float) -> Array:
    """[M, 3] speed [m/s], acceleration along and across [m/s^2], from places [N, 2] every dt."""
    velocity = np.diff(points, axis=0) / dt
    if len(velocity) < 3:
        return np.zeros((0, 3))
    # Smoothed over three instants: places are rounded, and drivers change at steps of the clock.
    smooth = (velocity[:-2] + velocity[1:-1] + velocity[2:]) / 3
    change = np.diff(smooth, axis=0) / dt
    speed = np.hypot(smooth[:-1, 0], smooth[:-1, 1])
    unit = smooth[:-1] / np.maximum(speed, 1e-6)[:, None]
    along = (change * unit).sum(axis=1)
    across = unit[:, 0] * change[:, 1] - unit[:, 1] * change[:, 0]
    return np.stack([speed, along, across], axis=1)


def _features(motion: Array) -> Array:
    moving = motion[motion[:, 0] > 0.5]
    if not len(moving):
        return np.zeros(3)
    hard = np.percentile(np.abs(moving[:, 1:]), 95, axis=0)
    return np.concatenate([[moving[:, 0].mean()], hard])


def _beyond(values: Array, most: float) -> float:
    """By how much the nearly largest of values is beyond what people reach, as a share of it."""
    if not len(values):
        return 0.0
    return max(float(np.percentile(values, 98)) / most - 1.0, 0.0)
