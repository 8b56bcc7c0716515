"""Many trajectories looked up at one instant, and one trajectory at many instants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..scene import Trajectory
from ..scene.rotation import slerp, transform_from

Float = NDArray[np.float64]
Index = NDArray[np.int64]


class Tracked(Protocol):
    """Anything with a trajectory and a box."""

    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102
    @property
    def scaled_size(self) -> tuple[float, float, float]: ...  # noqa: D102


T = TypeVar("T", bound=Tracked)


@dataclass(frozen=True, eq=False)
class Placed(Generic[T]):
    """The K objects that exist at one instant.

    Attributes:
        objects: in the state's order.
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
    """Trajectories of many objects in common arrays, so that one look-up serves them all.

    Attributes:
        objects: in the given order, N of them.
        sizes: [N, 3] float64, their boxes [m].
        lower, upper: [N, 3] float64, lowest and highest position of each trajectory [m].
    """

    def __init__(self, objects: tuple[T, ...]) -> None:
        trajectories = [o.trajectory for o in objects]
        counts = np.array([len(t.times_us) for t in trajectories], dtype=np.int64)
        self.objects = objects
        self.sizes = _stacked([np.array([o.scaled_size]) for o in objects], 3)
        self.lower = _stacked([t.positions.min(axis=0)[None] for t in trajectories], 3)
        self.upper = _stacked([t.positions.max(axis=0)[None] for t in trajectories], 3)
        self._times = np.concatenate([np.zeros(0, np.int64), *(t.times_us for t in trajectories)])
        self._ends = np.cumsum(counts)
        self._starts = self._ends - counts
        self._positions = _stacked([t.positions for t in trajectories], 3)
        self._quaternions = _stacked([t.quaternions for t in trajectories], 4)
        self._velocities = _stacked([_knot_velocities(t) for t in trajectories], 3)
        # Objects that stand or drive straight need no slerp; turning[k]: knot k to k + 1.
        self._turning = np.zeros(len(self._times), dtype=bool)
        self._turning[:-1] = (self._quaternions[1:] != self._quaternions[:-1]).any(axis=1)
        # One sorted array of (object, rank of the time among all times) finds the knots of all
        # objects in a single search; ranks, since times themselves could overflow the product.
        self._clock, ranks = np.unique(self._times, return_inverse=True)
        self._offsets = np.arange(len(objects)) * (len(self._clock) + 1)
        self._keys = np.repeat(self._offsets, counts) + ranks

    def at(self, t_us: int) -> Placed[T]:
        """Objects whose trajectory covers ``t_us``; poses and velocities as Trajectory has them."""
        rank = np.searchsorted(self._clock, t_us)
        after = np.searchsorted(self._keys, self._offsets + rank)
        known = np.flatnonzero(after < self._ends)
        known = known[self._times[self._starts[known]] <= t_us]
        after = after[known]
        exact = self._times[after] == t_us
        before = np.where(exact, after, after - 1)
        span = np.where(exact, 1, self._times[after] - self._times[before])
        return self._placed(known, before, after, (t_us - self._times[before]) / span)

    def _placed(self, known: Index, before: Index, after: Index, fraction: Float) -> Placed[T]:
        share = fraction[:, None]
        positions = (1 - share) * self._positions[before] + share * self._positions[after]
        quaternions = self._quaternions[before]
        turning = np.flatnonzero(self._turning[before] & (fraction > 0))
        if len(turning):
            a, b = quaternions[turning], self._quaternions[after[turning]]
            quaternions[turning] = slerp(a, b, fraction[turning])
        everything = len(known) == len(self.objects)
        return Placed(
            objects=self.objects if everything else tuple(self.objects[i] for i in known),
            sizes=self.sizes if everything else self.sizes[known],
            positions=positions,
            quaternions=quaternions,
            velocities=self._velocities[before],
            transforms=_transforms(positions, quaternions),
        )


def sample(trajectory: Trajectory, times_us: NDArray[np.int64]) -> tuple[Float, NDArray[np.bool_]]:
    """``T_world_object`` [S, 4, 4] at ``times_us`` [S], and where the trajectory covers them [S].

    Entries that are not covered hold the nearest known pose.
    """
    times = trajectory.times_us
    covered = (times_us >= times[0]) & (times_us <= times[-1])
    return transform_from(*sample_poses(trajectory, times_us)), covered


def sample_poses(trajectory: Trajectory, times_us: NDArray[np.int64]) -> tuple[Float, Float]:
    """Positions [S, 3] and quaternions [S, 4] at ``times_us`` [S]; the nearest known pose outside.

    Poses that the trajectory holds come back bit for bit.
    """
    times = trajectory.times_us
    clipped = np.clip(times_us, times[0], times[-1])
    after = np.searchsorted(times, clipped, side="left")
    before = np.maximum(after - 1, 0)
    span = np.maximum(times[after] - times[before], 1)
    share = np.where(after > before, (clipped - times[before]) / span, 0.0)
    p, q = trajectory.positions, trajectory.quaternions
    positions = (1 - share)[:, None] * p[before] + share[:, None] * p[after]
    quaternions = slerp(q[before], q[after], share)
    known = times[after] == clipped
    positions[known], quaternions[known] = p[after[known]], q[after[known]]
    return positions, quaternions


ROTATION_OF_PRODUCTS = np.zeros((4, 4, 3, 3))
"""[4, 4, 3, 3]: the rotation matrix of a unit quaternion q is the sum over i, j of q_i q_j times
entry [i, j]; one product instead of thirty small operations."""
for _i in range(3):
    _j, _k = (_i + 1) % 3, (_i + 2) % 3
    ROTATION_OF_PRODUCTS[0, 0, _i, _i] = 1
    ROTATION_OF_PRODUCTS[_i + 1, _i + 1, _i, _i] = 1
    ROTATION_OF_PRODUCTS[_i + 1, _i + 1, _j, _j] = -1
    ROTATION_OF_PRODUCTS[_i + 1, _i + 1, _k, _k] = -1
    ROTATION_OF_PRODUCTS[_i + 1, _j + 1, _i, _j] = ROTATION_OF_PRODUCTS[_i + 1, _j + 1, _j, _i] = 2
    ROTATION_OF_PRODUCTS[0, _i + 1, _k, _j], ROTATION_OF_PRODUCTS[0, _i + 1, _j, _k] = 2, -2


def _transforms(positions: Float, quaternions: Float) -> Float:
    """``T_world_object`` [K, 4, 4] of positions [K, 3] and unit quaternions [K, 4]."""
    products = (quaternions[:, :, None] * quaternions[:, None, :]).reshape(-1, 16)
    matrices = np.zeros((len(positions), 4, 4))
    matrices[:, :3, :3] = (products @ ROTATION_OF_PRODUCTS.reshape(16, 9)).reshape(-1, 3, 3)
    matrices[:, :3, 3] = positions
    matrices[:, 3, 3] = 1.0
    return matrices


def _stacked(parts: Sequence[Float], width: int) -> Float:
    return np.concatenate(parts) if parts else np.zeros((0, width))


def _knot_velocities(trajectory: Trajectory) -> Float:
    """Velocity [T, 3] from each knot to the next; the last knot has that of the last segment."""
    if len(trajectory.times_us) == 1:
        return np.zeros((1, 3))
    seconds = np.diff(trajectory.times_us)[:, None] * 1e-6
    segments = np.diff(trajectory.positions, axis=0) / seconds
    return np.concatenate([segments, segments[-1:]])
