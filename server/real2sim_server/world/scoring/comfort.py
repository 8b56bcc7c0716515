"""Comfort of what was driven, and of how plans follow one another."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..._records import made_quickly
from ..ego.reference import PlannedTrajectory
from ..path import Float
from .comfort_kernels import derivatives, plans_alike
from .window import RowWindow

WINDOW_S = 1.5
ORDER = 3

LON_ACCELERATION = (-4.05, 2.40)
LAT_ACCELERATION = 4.89
JERK = 8.37
LON_JERK = 4.13
YAW_RATE = 0.95
YAW_ACCELERATION = 1.93
"""Bounds of nuPlan and NAVSIM [m/s^2], [m/s^3], [rad/s], [rad/s^2]."""

HUGSIM_LON_JERK = 8.37
"""HUGSIM bounds the jerk ahead by this and no other; the rest as above [m/s^3]."""


class ComfortSample(NamedTuple):
    """What passengers feel at one time: SI units, as the bounds. ``lon_acceleration`` is that in
    the direction of the gear: below 0 a vehicle brakes, backwards too."""

    lon_acceleration: float
    lat_acceleration: float
    jerk: float
    lon_jerk: float
    yaw_rate: float
    yaw_acceleration: float

    @property
    def comfortable(self) -> bool:
        """Whether all bounds hold."""
        low, high = LON_ACCELERATION
        return (
            low <= self.lon_acceleration <= high
            and abs(self.lat_acceleration) <= LAT_ACCELERATION
            and abs(self.jerk) <= JERK
            and abs(self.lon_jerk) <= LON_JERK
            and abs(self.yaw_rate) <= YAW_RATE
            and abs(self.yaw_acceleration) <= YAW_ACCELERATION
        )

    @property
    def comfortable_to_hugsim(self) -> bool:
        """Whether HUGSIM's bounds hold."""
        low, high = LON_ACCELERATION
        return (
            low <= self.lon_acceleration <= high
            and abs(self.lat_acceleration) <= LAT_ACCELERATION
            and abs(self.lon_jerk) <= HUGSIM_LON_JERK
            and abs(self.yaw_rate) <= YAW_RATE
            and abs(self.yaw_acceleration) <= YAW_ACCELERATION
        )


@made_quickly
@dataclass(frozen=True, eq=False)
class ComfortAccumulator:
    """Comfort of a drive so far.

    Derivatives are those of cubics through the last 1.5 s (Savitzky & Golay 1964), taken in the
    middle of that window; so the first and last 0.75 s of a drive are not evaluated.

    Attributes:
        window: rows of speed [m/s] and continuous yaw [rad] of the last 1.5 s.
        comfortable: whether all bounds held so far.
        worst: greatest magnitudes so far, in the order of :class:`ComfortSample`.
        newest: in the middle of the newest window; None before there is one.
    """

    window: RowWindow = field(default_factory=lambda: RowWindow(np.zeros((0, 2))))
    comfortable: bool = True
    worst: tuple[float, ...] = (0.0,) * 6
    newest: ComfortSample | None = None

    @property
    def samples(self) -> Float:
        """[n, 2] float64, the rows of the window."""
        return self.window.rows

    def begun_anew(self) -> ComfortAccumulator:
        """With the same samples and no verdict yet."""
        return ComfortAccumulator(self.window)

    def updated(self, speed: float, yaw: float, dt: float) -> ComfortAccumulator:
        """After one more clock step."""
        return self._with(*_newest(self.window, speed, yaw, dt))

    def updated_beside(
        self, other: ComfortAccumulator, speed: float, yaw: float, dt: float
    ) -> tuple[ComfortAccumulator, ComfortAccumulator]:
        """This one and another that has got the same samples since this one began: after one more
        clock step. What both hold is kept, and looked at, once."""
        window, sample = _newest(self.window, speed, yaw, dt)
        # A window that is full has room for nothing older.
        shared = other.window is self.window or sample is not None
        after = other._with(window, sample) if shared else other.updated(speed, yaw, dt)
        return self._with(window, sample), after

    def _with(self, window: RowWindow, sample: ComfortSample | None) -> ComfortAccumulator:
        if sample is None:
            return ComfortAccumulator(window, self.comfortable, self.worst)
        worst = tuple(
            [a if a > w else w for w, a in zip(self.worst, map(abs, sample), strict=True)]
        )
        comfortable = self.comfortable and sample.comfortable
        return ComfortAccumulator(window, comfortable, worst, sample)


def _newest(
    window: RowWindow, speed: float, yaw: float, dt: float
) -> tuple[RowWindow, ComfortSample | None]:
    """Samples with one more at their end, and what they say once the window is full."""
    full = comfort_window(dt)
    window = window.pushed((speed, yaw), full)
    return window, comfort_sample(window.rows, dt) if len(window) == full else None


@lru_cache(maxsize=16)
def comfort_window(dt: float) -> int:
    """Samples in a window; odd, at least five."""
    return max(2 * round(WINDOW_S / dt / 2) - 1, 5) if dt < WINDOW_S / 4 else 5


@lru_cache(maxsize=16)
def _coefficients(window: int, dt: float) -> Float:
    """Weights [3, window] of value, first and second derivative in the middle.

    They reproduce polynomials up to the order, with the least sum of squares; to the bit those of
    ``scipy.signal.savgol_coeffs``, which takes a second to load, in the midst of a step.
    """
    exponents = np.arange(min(ORDER, window - 2) + 1)
    places = np.arange(-(window // 2), window // 2 + 1, dtype=np.float64)
    powers = places ** exponents[:, None]
    rows = []
    for k in range(3):
        wanted = np.where(exponents == k, math.factorial(k) / dt**k, 0.0)
        rows.append(np.linalg.lstsq(powers, wanted, rcond=None)[0])
    return np.stack(rows)


def comfort_sample(samples: Float, dt: float) -> ComfortSample:
    """Comfort in the middle of samples [W, 2] of speed and yaw."""
    speed, acceleration, lon_jerk, rate, yaw_acceleration = derivatives(
        _coefficients(len(samples), dt), samples
    )
    lateral = speed * rate
    # d/dt of the lateral acceleration v w, by the product rule.
    lat_jerk = acceleration * rate + speed * yaw_acceleration
    jerk = math.hypot(lon_jerk, lat_jerk)
    driven = -acceleration if speed < 0.0 else acceleration
    return ComfortSample(driven, lateral, jerk, lon_jerk, rate, yaw_acceleration)


def plans_agree(before: PlannedTrajectory, now: PlannedTrajectory) -> bool | None:
    """Whether two successive plans feel alike where both say something.

    RMS differences of acceleration, jerk, yaw rate and yaw acceleration over the overlap, by
    finite differences of the plans in steps of 0.1 s. None where they overlap for less than 0.5 s.
    """
    alike: int = plans_alike(before.times_us, before.poses, now.times_us, now.poses)
    return None if alike < 0 else bool(alike)
