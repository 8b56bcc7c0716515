"""Many trajectories looked up at one instant, and one trajectory at many instants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from .._records import made_quickly
from ..geometry.rotation import slerp
from ..geometry.transform import transform_from
from ..scene import Trajectory
from .track_kernels import KNOT, poses_at

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
        # Objects that stand or drive straight need no slerp.
        quaternions = self._knots[:, 3:7]
        self._knots[:-1, 10] = (quaternions[1:] != quaternions[:-1]).any(axis=1)

    @property
    def arrays(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
        """Ends, times [us] and knots of all trajectories, as :func:`.track_kernels.poses_at` takes
        them."""
        return self._ends, self._times, self._knots

    def at(self, t_us: int) -> PlacedObjects[T]:
        """Objects whose trajectory covers ``t_us``; poses and velocities as Trajectory has them."""
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
        """Objects by their places, and their sizes; the same tuple as long as they are the same."""
        places = known.tobytes()
        newest = self._newest
        if newest is None or newest[0] != places:
            objects = tuple([self.objects[i] for i in known.tolist()])
            # One assignment, for worlds on other threads may look here too.
            self._newest = newest = (places, objects, self.sizes[known])
        return newest[1], newest[2]


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
    """Velocity [T, 3] from each knot to the next; the last knot has that of the last segment."""
    if len(trajectory.times_us) == 1:
        return np.zeros((1, 3))
    seconds = np.diff(trajectory.times_us)[:, None] * 1e-6
    segments = np.diff(trajectory.positions, axis=0) / seconds
    return np.concatenate([segments, segments[-1:]])
