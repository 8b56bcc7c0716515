"""Lookup of many trajectories at one instant, and of one trajectory at many instants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from .._numba import kernel
from .._records import made_quickly
from ..geometry import slerp, transform_from
from ..scene import Trajectory

# --- Kernels -------------------------------------------------------------------------------------

KNOT = 11
"""Values per knot: position [3], quaternion wxyz [4], velocity [3], and whether the quaternion of
the next knot differs."""


@kernel
def poses_at(t_us, ends, times, knots):
    """Poses and velocities of the trajectories that cover a time, K of N.

    Args:
        t_us: int64 [us].
        ends: [N + 1] int64; trajectory k has the knots from ``ends[k]`` to ``ends[k + 1]``.
        times: [M] int64 times of all knots, increasing within each trajectory [us].
        knots: [M, 11] float64, see ``KNOT``; [m], [m/s].

    Returns:
        Indices of the trajectories [K] int64, and in float64 positions [K, 3], quaternions
        [K, 4], velocities [K, 3] and transforms [K, 4, 4]. Poses at a knot are exact.
    """
    known, after = _covering(t_us, ends, times)
    count = len(known)
    positions, quaternions = np.empty((count, 3)), np.empty((count, 4))
    velocities, transforms = np.empty((count, 3)), np.empty((count, 4, 4))
    for k in range(count):
        j = after[k]
        i = j if times[j] == t_us else j - 1
        fraction = (t_us - times[i]) / (times[j] - times[i]) if i < j else 0.0
        for c in range(3):
            positions[k, c] = (1 - fraction) * knots[i, c] + fraction * knots[j, c]
            velocities[k, c] = knots[i, 7 + c]
        if fraction > 0 and knots[i, 10] != 0:
            _slerp(knots[i], knots[j], fraction, quaternions[k])
        else:
            for c in range(4):
                quaternions[k, c] = knots[i, 3 + c]
        _put(positions[k], quaternions[k], transforms[k])
    return known, positions, quaternions, velocities, transforms


@kernel
def _covering(t_us, ends, times):
    """Trajectories that cover ``t_us`` [K], and the first knot of each at or after ``t_us``."""
    known, after = np.empty(len(ends) - 1, np.int64), np.empty(len(ends) - 1, np.int64)
    count = 0
    for k in range(len(ends) - 1):
        low, high = ends[k], ends[k + 1]
        if times[low] > t_us or times[high - 1] < t_us:
            continue
        while low < high:
            middle = (low + high) // 2
            if times[middle] < t_us:
                low = middle + 1
            else:
                high = middle
        known[count], after[count] = k, low
        count += 1
    return known[:count], after[:count]


@kernel
def _slerp(start, end, fraction, found):
    """Quaternion [4] between two knots, along the shorter arc; like ``scene.rotation.slerp``."""
    dot = 0.0
    for c in range(3, 7):
        dot += start[c] * end[c]
    sign = -1.0 if dot < 0 else 1.0
    angle = math.acos(min(abs(dot), 1.0))
    sine = math.sin(angle)
    a, b = 1 - fraction, fraction
    if sine >= 1e-6:
        a, b = math.sin(a * angle) / sine, math.sin(b * angle) / sine
    squares = 0.0
    for c in range(4):
        found[c] = a * start[3 + c] + b * sign * end[3 + c]
        squares += found[c] * found[c]
    length = math.sqrt(squares)
    for c in range(4):
        found[c] /= length


@kernel
def _put(position, quaternion, transform):
    """``T_world_object`` [4, 4] of a position [3] and a unit quaternion [4]."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    transform[0, 0] = w * w + x * x - y * y - z * z
    transform[1, 1] = w * w - x * x + y * y - z * z
    transform[2, 2] = w * w - x * x - y * y + z * z
    transform[0, 1], transform[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    transform[0, 2], transform[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    transform[1, 2], transform[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    for c in range(3):
        transform[c, 3], transform[3, c] = position[c], 0.0
    transform[3, 3] = 1.0


Float = NDArray[np.float64]


class HasTrajectory(Protocol):
    """Anything with a trajectory and a box."""

    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102
    @property
    def scaled_size(self) -> tuple[float, float, float]: ...  # noqa: D102


T = TypeVar("T", bound=HasTrajectory)


@made_quickly
@dataclass(frozen=True, eq=False)
class PlacedObjects(Generic[T]):
    """The K objects that exist at one instant.

    Attributes:
        objects: objects in the state's order.
        sizes: [K, 3] float64, (length, width, height) of their boxes [m].
        positions: [K, 3] float64, box centres in the world [m].
        quaternions: [K, 4] float64, wxyz.
        velocities: [K, 3] float64, world [m/s].
        transforms: [K, 4, 4] float64, ``T_world_object``.
    """

    objects: tuple[T, ...]
    sizes: Float
    positions: Float
    quaternions: Float
    velocities: Float
    transforms: Float


class PackedTracks(Generic[T]):
    """Trajectories of many objects in common arrays, for one lookup of all objects.

    Attributes:
        objects: the N objects, in the given order.
        sizes: [N, 3] float64, sizes of their boxes [m].
        lower, upper: [N, 3] float64, lowest and highest position of each trajectory [m].
    """

    def __init__(self, objects: tuple[T, ...]) -> None:
        trajectories = [o.trajectory for o in objects]
        self.objects = objects
        self._newest: tuple[bytes, tuple[T, ...], Float] | None = None
        self.sizes = _stacked([np.array([o.scaled_size]) for o in objects], 3)
        self.lower = _stacked([t.positions.min(axis=0)[None] for t in trajectories], 3)
        self.upper = _stacked([t.positions.max(axis=0)[None] for t in trajectories], 3)
        self._times = np.concatenate([np.zeros(0, np.int64), *(t.times_us for t in trajectories)])
        self._ends = np.array([0, *np.cumsum([len(t.times_us) for t in trajectories])], np.int64)
        self._knots = np.zeros((len(self._times), KNOT))
        self._knots[:, :3] = _stacked([t.positions for t in trajectories], 3)
        self._knots[:, 3:7] = _stacked([t.quaternions for t in trajectories], 4)
        self._knots[:, 7:10] = _stacked([_knot_velocities(t) for t in trajectories], 3)
        # Objects with constant rotation need no slerp.
        quaternions = self._knots[:, 3:7]
        self._knots[:-1, 10] = (quaternions[1:] != quaternions[:-1]).any(axis=1)

    @property
    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
        """Ends, times [us] and knots of all trajectories, for :func:`.poses_at`."""
        return self._ends, self._times, self._knots

    def at(self, t_us: int) -> PlacedObjects[T]:
        """Objects whose trajectory covers ``t_us``, with the poses and velocities of Trajectory."""
        known, positions, quaternions, velocities, transforms = poses_at(
            t_us, self._ends, self._times, self._knots
        )
        objects, sizes = self.objects, self.sizes
        if len(known) < len(objects):
            objects, sizes = self._some(known)
        return PlacedObjects(
            objects=objects,
            sizes=sizes,
            positions=positions,
            quaternions=quaternions,
            velocities=velocities,
            transforms=transforms,
        )

    def _some(self, known: NDArray[np.int64]) -> tuple[tuple[T, ...], Float]:
        """Objects by index, and their sizes; returns the same tuple for unchanged indices."""
        places = known.tobytes()
        newest = self._newest
        if newest is None or newest[0] != places:
            objects = tuple([self.objects[i] for i in known.tolist()])
            # A single assignment, because other threads may read this too.
            self._newest = newest = (places, objects, self.sizes[known])
        return newest[1], newest[2]


def sample(trajectory: Trajectory, times_us: NDArray[np.int64]) -> tuple[Float, NDArray[np.bool_]]:
    """``T_world_object`` [S, 4, 4] at ``times_us`` [S], and whether the trajectory covers each [S].

    Outside the trajectory, entries have the nearest pose.
    """
    times = trajectory.times_us
    covered = (times_us >= times[0]) & (times_us <= times[-1])
    return transform_from(*sample_poses(trajectory, times_us)), covered


def sample_poses(trajectory: Trajectory, times_us: NDArray[np.int64]) -> tuple[Float, Float]:
    """Positions [S, 3] and quaternions [S, 4] at ``times_us`` [S]; the nearest pose outside.

    Stored poses are returned exactly.
    """
    times = trajectory.times_us
    clipped = np.clip(times_us, times[0], times[-1])
    after = np.searchsorted(times, clipped, side="left")
    before = np.maximum(after - 1, 0)
    span = np.maximum(times[after] - times[before], 1)
    fraction = np.where(after > before, (clipped - times[before]) / span, 0.0)
    p, q = trajectory.positions, trajectory.quaternions
    positions = (1 - fraction)[:, None] * p[before] + fraction[:, None] * p[after]
    quaternions = slerp(q[before], q[after], fraction)
    known = times[after] == clipped
    positions[known], quaternions[known] = p[after[known]], q[after[known]]
    return positions, quaternions


def _stacked(parts: Sequence[Float], width: int) -> Float:
    return np.concatenate(parts) if parts else np.zeros((0, width))


def _knot_velocities(trajectory: Trajectory) -> Float:
    """Velocity [T, 3] from each knot to the next; the last knot repeats the last segment."""
    if len(trajectory.times_us) == 1:
        return np.zeros((1, 3))
    seconds = np.diff(trajectory.times_us)[:, None] * 1e-6
    segments = np.diff(trajectory.positions, axis=0) / seconds
    return np.concatenate([segments, segments[-1:]])
