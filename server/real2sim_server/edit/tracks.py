"""Many trajectories looked up at one instant, and one trajectory at many instants."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..scene import Trajectory
from ..scene.rotation import slerp, transform_from

Float = NDArray[np.float64]


class Tracked(Protocol):
    """Anything with a trajectory."""

    @property
    def trajectory(self) -> Trajectory: ...  # noqa: D102


T = TypeVar("T", bound=Tracked)


@dataclass(frozen=True, eq=False)
class Placed(Generic[T]):
    """The K objects that exist at one instant.

    Attributes:
        objects: in the state's order.
        positions: [K, 3] float64, box centres in the world [m].
        quaternions: [K, 4] float64, wxyz.
        velocities: [K, 3] float64, world [m/s].
        transforms: [K, 4, 4] float64, ``T_world_object``.
    """

    objects: tuple[T, ...]
    positions: Float
    quaternions: Float
    velocities: Float
    transforms: Float


class PackedTracks(Generic[T]):
    """Trajectories of many objects in common arrays, so that one look-up serves them all.

    Attributes:
        objects: in the given order, N of them.
        lower, upper: [N, 3] float64, lowest and highest position of each trajectory [m].
    """

    def __init__(self, objects: tuple[T, ...]) -> None:
        self.objects = objects
        trajectories = [o.trajectory for o in objects]
        starts = np.cumsum([0, *(len(t.times_us) for t in trajectories)]).tolist()
        self._clocks = [
            (i, start, t.times_us.tolist())
            for i, (start, t) in enumerate(zip(starts[:-1], trajectories, strict=True))
        ]
        self._positions = _stacked([t.positions for t in trajectories], 3)
        self._quaternions = _stacked([t.quaternions for t in trajectories], 4)
        self._velocities = _stacked([_knot_velocities(t) for t in trajectories], 3)
        self.lower = _stacked([t.positions.min(axis=0)[None] for t in trajectories], 3)
        self.upper = _stacked([t.positions.max(axis=0)[None] for t in trajectories], 3)

    def at(self, t_us: int) -> Placed[T]:
        """Objects whose trajectory covers ``t_us``; poses and velocities as Trajectory has them."""
        known: list[int] = []
        before: list[int] = []
        after: list[int] = []
        fractions: list[float] = []
        for i, start, times in self._clocks:
            if not times[0] <= t_us <= times[-1]:
                continue
            k = bisect_left(times, t_us)
            known.append(i)
            after.append(start + k)
            if times[k] == t_us:
                before.append(start + k)
                fractions.append(0.0)
            else:
                before.append(start + k - 1)
                fractions.append((t_us - times[k - 1]) / (times[k] - times[k - 1]))
        return self._placed(known, np.array(before, int), np.array(after, int), np.array(fractions))

    def _placed(
        self, known: list[int], before: NDArray[np.int_], after: NDArray[np.int_], fraction: Float
    ) -> Placed[T]:
        share = fraction[:, None]
        positions = (1 - share) * self._positions[before] + share * self._positions[after]
        quaternions = self._quaternions[before]
        between = np.flatnonzero(before != after)
        # Most poses at a logged time stamp or of parked objects need no slerp.
        if len(between):
            a, b = quaternions[between], self._quaternions[after[between]]
            quaternions[between] = slerp(a, b, fraction[between])
        objects = self.objects
        return Placed(
            objects=objects if len(known) == len(objects) else tuple(objects[i] for i in known),
            positions=positions,
            quaternions=quaternions,
            velocities=self._velocities[before],
            transforms=transform_from(positions, quaternions),
        )


def sample(trajectory: Trajectory, times_us: NDArray[np.int64]) -> tuple[Float, NDArray[np.bool_]]:
    """``T_world_object`` [S, 4, 4] at ``times_us`` [S], and where the trajectory covers them [S].

    Entries that are not covered hold the nearest known pose.
    """
    times = trajectory.times_us
    covered = (times_us >= times[0]) & (times_us <= times[-1])
    clipped = np.clip(times_us, times[0], times[-1])
    after = np.searchsorted(times, clipped, side="left")
    before = np.maximum(after - 1, 0)
    span = np.maximum(times[after] - times[before], 1)
    share = np.where(after > before, (clipped - times[before]) / span, 0.0)
    p, q = trajectory.positions, trajectory.quaternions
    positions = (1 - share)[:, None] * p[before] + share[:, None] * p[after]
    return transform_from(positions, slerp(q[before], q[after], share)), covered


def _stacked(parts: Sequence[Float], width: int) -> Float:
    return np.concatenate(parts) if parts else np.zeros((0, width))


def _knot_velocities(trajectory: Trajectory) -> Float:
    """Velocity [T, 3] from each knot to the next; the last knot has that of the last segment."""
    if len(trajectory.times_us) == 1:
        return np.zeros((1, 3))
    seconds = np.diff(trajectory.times_us)[:, None] * 1e-6
    segments = np.diff(trajectory.positions, axis=0) / seconds
    return np.concatenate([segments, segments[-1:]])
