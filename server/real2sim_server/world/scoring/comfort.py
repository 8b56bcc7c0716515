"""Comfort of a drive, consistency of successive plans, and kinematic feasibility."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from ..._numba import kernel
from ..._records import made_quickly
from ..path import Float
from ..plan import PlannedTrajectory
from .instant import EgoSample, Instant, ScoringContext

T = TypeVar("T")

ROOM = 8
"""Minimum capacity of a window of rows."""


class Window(Generic[T]):
    """The last entries of a growing sequence, newest last; immutable.

    :meth:`pushed` returns a new window that shares its entries with this one. A second push from
    the same window (in a forked world) copies them.
    """

    __slots__ = ("_end", "_entries", "_length", "_unclaimed")

    def __init__(self, *entries: T) -> None:
        self._own(list(entries), len(entries))

    def __len__(self) -> int:
        return self._length

    def __iter__(self) -> Iterator[T]:
        return iter(self._entries[self._end - self._length : self._end])

    def newest(self, back: int = 0) -> T:
        """The newest entry, or the one ``back`` entries before; ``back`` < the length."""
        return self._entries[self._end - 1 - back]

    def pushed(self, entry: T, most: int) -> Window[T]:
        """The window with one more entry, limited to the last ``most`` entries."""
        kept = min(self._length, most - 1)
        entries = self._entries
        try:
            # Popping is atomic, so that worlds that continue on two threads do not share entries.
            self._unclaimed.pop()
            shared = len(entries) < 2 * most
        except IndexError:
            shared = False
        if not shared:
            entries = entries[self._end - kept : self._end]
        entries.append(entry)
        found: Window[T] = Window.__new__(Window)
        found._own(entries, kept + 1)
        return found

    def mapped(self, change: Callable[[T], T]) -> Window[T]:
        """The window with ``change`` applied to every entry."""
        return Window(*(change(entry) for entry in self))

    def _own(self, entries: list[T], length: int) -> None:
        self._entries, self._length = entries, length
        self._end = len(entries)
        self._unclaimed = [True]


class RowWindow:
    """Like :class:`Window`, for rows of numbers that kernels take as one array.

    Attributes:
        rows: [n, C] float64, newest last; read-only.
    """

    __slots__ = ("_buffer", "_end", "_unclaimed", "rows")

    def __init__(self, rows: Float) -> None:
        self._own(rows, 0, len(rows))

    def __len__(self) -> int:
        return len(self.rows)

    def pushed(self, row: Sequence[float], most: int) -> RowWindow:
        """The window with one more row, limited to the last ``most`` rows."""
        kept = min(len(self.rows), most - 1)
        buffer, end = self._buffer, self._end
        try:
            # See Window.pushed.
            self._unclaimed.pop()
            shared = end < len(buffer)
        except IndexError:
            shared = False
        if not shared:
            buffer = np.empty((max(2 * kept, ROOM), self.rows.shape[1]))
            buffer[:kept] = self.rows[len(self.rows) - kept :]
            end = kept
        buffer[end] = row
        found = RowWindow.__new__(RowWindow)
        found._own(buffer, end - kept, end + 1)
        return found

    def _own(self, buffer: Float, begin: int, end: int) -> None:
        self._buffer, self._end = buffer, end
        self.rows = buffer[begin:end]
        self._unclaimed = [True]


PLAN_BOUNDS = (0.7, 0.5, 0.1, 0.1)
"""Maximum RMS differences of successive plans in acceleration, jerk, yaw rate and yaw acceleration
(NAVSIM v2, extended comfort)."""

PLAN_STEP = 0.1
MIN_OVERLAP = 6
"""Minimum number of common times for a comparison."""


@kernel
def windowed_sum(values, value, window):
    """Append a value to values [n]; return the last ``window`` of them and their sum."""
    kept = min(len(values), window - 1)
    found = np.empty(kept + 1)
    for k in range(kept):
        found[k] = values[len(values) - kept + k]
    found[kept] = value
    total = 0.0
    for v in found:
        total += v
    return found, total


@kernel
def derivatives(weights, samples):
    """Weighted sums of speed and yaw.

    Args:
        weights: [3, W] float64 of the value, the first and the second derivative.
        samples: [W, 2] float64, speed and yaw.

    Returns:
        Speed, its first and second derivative; first and second derivative of yaw.
    """
    speed = acceleration = jerk = rate = yaw_acceleration = 0.0
    for k in range(len(samples)):
        speed += weights[0, k] * samples[k, 0]
        acceleration += weights[1, k] * samples[k, 0]
        jerk += weights[2, k] * samples[k, 0]
        rate += weights[1, k] * samples[k, 1]
        yaw_acceleration += weights[2, k] * samples[k, 1]
    return speed, acceleration, jerk, rate, yaw_acceleration


@kernel
def make_continuous(poses):
    """Unwrap the yaws of poses [N, 3] (x, y, yaw [rad]) in place, like ``np.unwrap``."""
    before, added = poses[0, 2], 0.0
    for k in range(1, len(poses)):
        step = poses[k, 2] - before
        before = poses[k, 2]
        if abs(step) > math.pi:
            short = (step + math.pi) % math.tau - math.pi
            if short == -math.pi and step > 0:
                short = math.pi
            added += short - step
        poses[k, 2] += added


@kernel
def plans_alike(times_a, poses_a, times_b, poses_b):
    """Whether two plans are consistent in comfort where they overlap in time.

    Compares RMS differences of acceleration, jerk, yaw rate and yaw acceleration, by finite
    differences in steps of 0.1 s.

    Args:
        times_a, times_b: [N] int64, increasing [us].
        poses_a, poses_b: [N, 3] float64, x, y [m], yaw [rad].

    Returns:
        1 if consistent, 0 if not, -1 if they overlap for less than 0.5 s.
    """
    first, last = max(times_a[0], times_b[0]), min(times_a[-1], times_b[-1])
    count = int((last - first) * 1e-6 / PLAN_STEP + 1e-6) + 1
    if count < MIN_OVERLAP:
        return -1
    poses_a, poses_b = poses_a.copy(), poses_b.copy()
    make_continuous(poses_a)
    make_continuous(poses_b)
    speeds, rates = np.empty((2, count - 1)), np.empty((2, count - 1))
    _differentiate(times_a, poses_a, first, speeds[0], rates[0])
    _differentiate(times_b, poses_b, first, speeds[1], rates[1])
    # Differences of derivatives are derivatives of differences.
    acceleration, rate = _slopes(speeds[0] - speeds[1]), rates[0] - rates[1]
    alike = (
        _within(acceleration, PLAN_BOUNDS[0])
        and _within(_slopes(acceleration), PLAN_BOUNDS[1])
        and _within(rate, PLAN_BOUNDS[2])
        and _within(_slopes(rate), PLAN_BOUNDS[3])
    )
    return 1 if alike else 0


@kernel
def _differentiate(times, poses, first, speeds, rates):
    """Write speeds and yaw rates [T] of a plan, in steps of 0.1 s from ``first``."""
    k = 1
    x = y = yaw = 0.0
    for i in range(len(speeds) + 1):
        at = first * 1e-6 + PLAN_STEP * i
        while k < len(times) - 1 and times[k] * 1e-6 < at:
            k += 1
        start, end = times[k - 1] * 1e-6, times[k] * 1e-6
        fraction = (at - start) / (end - start)
        rest = 1 - fraction
        before = x, y, yaw
        x = poses[k - 1, 0] * rest + poses[k, 0] * fraction
        y = poses[k - 1, 1] * rest + poses[k, 1] * fraction
        yaw = poses[k - 1, 2] * rest + poses[k, 2] * fraction
        if i:
            vx, vy = (x - before[0]) / PLAN_STEP, (y - before[1]) / PLAN_STEP
            speeds[i - 1] = math.sqrt(vx * vx + vy * vy)
            rates[i - 1] = (yaw - before[2]) / PLAN_STEP


@kernel
def _slopes(values):
    """Finite differences [T - 1] of values [T] in steps of 0.1 s."""
    return (values[1:] - values[:-1]) / PLAN_STEP


@kernel
def _within(values, bound):
    """Whether the RMS of values [T] is at most ``bound``."""
    squares = 0.0
    for value in values:
        squares += value * value
    return squares <= len(values) * bound * bound


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
"""HUGSIM's bound of the longitudinal jerk [m/s^3]; the other bounds are the same."""


class ComfortSample(NamedTuple):
    """Motion that passengers feel at one time, in SI units.

    ``lon_acceleration`` is in the direction of the gear: negative values are braking, even in
    reverse.
    """

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

    Derivatives come from a cubic fit over a window of 1.5 s (Savitzky & Golay 1964), evaluated at
    its centre. The first and last 0.75 s of a drive are therefore not evaluated.

    Attributes:
        window: rows of speed [m/s] and continuous yaw [rad] of the last 1.5 s.
        comfortable: whether all bounds held so far.
        worst: largest magnitudes so far, in the order of :class:`ComfortSample`.
        newest: sample at the centre of the newest window; None before the first full window.
    """

    window: RowWindow = field(default_factory=lambda: RowWindow(np.zeros((0, 2))))
    comfortable: bool = True
    worst: tuple[float, ...] = (0.0,) * 6
    newest: ComfortSample | None = None

    @property
    def samples(self) -> Float:
        """[n, 2] float64, the rows of the window."""
        return self.window.rows

    def restarted(self) -> ComfortAccumulator:
        """The accumulator with the same samples and reset results."""
        return ComfortAccumulator(self.window)

    def updated(self, speed: float, yaw: float, dt: float) -> ComfortAccumulator:
        """The accumulator one clock step later."""
        return self._with(*_newest(self.window, speed, yaw, dt))

    def updated_with(
        self, other: ComfortAccumulator, speed: float, yaw: float, dt: float
    ) -> tuple[ComfortAccumulator, ComfortAccumulator]:
        """This accumulator and another one after one more clock step.

        Both have received the same samples since this one began. The shared samples are stored and
        evaluated once.
        """
        window, sample = _newest(self.window, speed, yaw, dt)
        # A full window holds no older samples.
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
    """The window with one more row, and the comfort sample once the window is full."""
    full = comfort_window(dt)
    window = window.pushed((speed, yaw), full)
    return window, comfort_sample(window.rows, dt) if len(window) == full else None


@lru_cache(maxsize=16)
def comfort_window(dt: float) -> int:
    """Number of samples in a window; odd, at least five."""
    return max(2 * round(WINDOW_S / dt / 2) - 1, 5) if dt < WINDOW_S / 4 else 5


@lru_cache(maxsize=16)
def _coefficients(window: int, dt: float) -> Float:
    """Weights [3, window] of value, first and second derivative in the middle.

    Bitwise equal to ``scipy.signal.savgol_coeffs``, whose import would delay a step by a second.
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
    """Whether two successive plans are consistent in comfort, see :func:`plans_alike`.

    None if they overlap for less than 0.5 s.
    """
    alike: int = plans_alike(before.times_us, before.poses, now.times_us, now.poses)
    return None if alike < 0 else bool(alike)


MAX_ACCELERATION, MAX_CURVATURE = 10.4, 0.3
"""Bounds of Waymax's kinematic infeasibility, for steps of 0.1 s [m/s^2], [1/m]."""

STEP_S = 0.1
"""Minimum interval [s]; shorter clock steps are combined, because position noise would look like
acceleration."""

MIN_CURVATURE_SPEED = 0.5
"""Minimum speed at which curvature is evaluated [m/s]."""

PLACE_NOISE = 0.03
"""Noise of recorded positions [m]."""

SLIP = 0.05
"""Tolerated lateral over longitudinal displacement, in addition to the vehicle model. The position
of the rear axle is rarely known more precisely."""

SPIN_S, SPIN_NOISE = 1.0, 0.1
"""Turning on the spot: time window [s], and heading noise in it [rad]."""

MAX_REVERSE_SPEED = 8.0
"""Maximum reverse speed [m/s], above that of a car's reverse gear."""

SETTLED = 0.2
"""Lateral speed below which a pushed vehicle rolls again [m/s]."""


Samples = Window[tuple[EgoSample, float]]


@made_quickly
@dataclass(frozen=True, eq=False)
class Feasibility:
    """Kinematic feasibility of the ego's motion so far.

    Attributes:
        samples: samples of the last second, newest last, each with the distance driven so far [m].
        pushed: whether the ego is still sliding after an impact; such steps count as feasible.
        steps: number of infeasible steps.
        first: index of the first infeasible step, or None.
    """

    samples: Samples = field(default_factory=Window)
    pushed: bool = False
    steps: int = 0
    first: int | None = None

    def updated(self, instant: Instant, way: float, context: ScoringContext) -> Feasibility:
        """One clock step later; ``way``: distance driven so far [m]."""
        ego = instant.ego
        pushed = bool(instant.contacts) and any(c.impulse != (0.0, 0.0) for c in instant.contacts)
        if pushed or (self.pushed and not _settled(ego)):
            return Feasibility(Window((ego, way)), True, self.steps, self.first)
        kept = max(round(SPIN_S / context.dt), 1) + 1
        samples = self.samples.pushed((ego, way), kept)
        if _is_feasible(samples, context.dt):
            return Feasibility(samples, False, self.steps, self.first)
        first = instant.step if self.first is None else self.first
        return Feasibility(samples, False, self.steps + 1, first)


def _settled(ego: EgoSample) -> bool:
    rolling = abs(ego.yaw_rate) <= MAX_CURVATURE * abs(ego.speed) + SPIN_NOISE
    return abs(ego.lateral_speed) < SETTLED and rolling


def _is_feasible(samples: Samples, dt: float) -> bool:
    stride = max(round(STEP_S / dt), 1)
    now, way = samples.newest()
    if len(samples) > stride:
        before, _ = samples.newest(stride)
        if not _follows(before, now, stride * dt):
            return False
    turns = max(round(SPIN_S / dt), 1)
    if len(samples) <= turns:
        return True
    before, driven = samples.newest(turns)
    return abs(now.yaw - before.yaw) <= MAX_CURVATURE * (way - driven) + SPIN_NOISE


def _follows(before: EgoSample, now: EgoSample, h: float) -> bool:
    """Whether a car can move from one sample to another in ``h`` seconds."""
    if abs(now.speed - before.speed) > MAX_ACCELERATION * h * (1 + 1e-9):
        return False
    if now.speed < -MAX_REVERSE_SPEED and now.speed < before.speed:
        return False
    speed = max(
        math.hypot(before.speed, before.lateral_speed), math.hypot(now.speed, now.lateral_speed)
    )
    turn = math.remainder(now.yaw - before.yaw, math.tau)
    if speed > MIN_CURVATURE_SPEED and abs(turn) > MAX_CURVATURE * speed * h:
        return False
    cos, sin = math.cos(before.yaw + turn / 2), math.sin(before.yaw + turn / 2)
    dx, dy = now.x - before.x, now.y - before.y
    ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
    reach = MAX_ACCELERATION * h * h
    sideways = (before.lateral_speed + now.lateral_speed) / 2 * h
    if abs(aside - sideways) > reach / 4 + SLIP * abs(ahead) + PLACE_NOISE:
        return False
    # A teleported vehicle has the speed of the previous step.
    return abs(ahead - before.speed * h) <= reach + PLACE_NOISE
