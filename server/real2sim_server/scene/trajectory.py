"""Poses over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import (
    Float,
    apply_transform,
    are_rigid,
    invert_transform,
    matrix_to_quaternion,
    slerp,
    transform_from,
)
from .errors import SceneError, TimeOutOfRangeError

MOVING_DISTANCE, MOVING_SPREAD = 2.0, 0.5


def leads_anywhere(positions: Float) -> bool:
    """Whether positions [T, 3] end more than 2 m from their start, or spread by more than 0.5 m
    along an axis (standard deviation). Source: Street Gaussians.
    """
    gone = np.linalg.norm(positions[-1] - positions[0])
    return bool(gone > MOVING_DISTANCE or (positions.std(axis=0) > MOVING_SPREAD).any())


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Rigid poses at increasing time stamps; positions interpolate linearly, rotations by slerp.

    Attributes:
        times_us: [T] int64, strictly increasing [us], T >= 1.
        positions: [T, 3] float64, origin of the moving frame in the fixed frame [m].
        quaternions: [T, 4] float64, wxyz, unit; rotation from the moving to the fixed frame.

    Raises:
        SceneError: shapes differ, values are not finite, or times do not increase.
    """

    times_us: NDArray[np.int64]
    positions: Float
    quaternions: Float

    def __post_init__(self) -> None:
        times = _whole_microseconds(self.times_us)
        positions = np.atleast_2d(np.array(self.positions, dtype=np.float64))
        quaternions = np.atleast_2d(np.array(self.quaternions, dtype=np.float64))
        if len(times) == 0:
            raise SceneError("a trajectory needs at least one pose")
        if positions.shape != (len(times), 3) or quaternions.shape != (len(times), 4):
            raise SceneError(
                f"a trajectory of {len(times)} time stamps needs positions [{len(times)}, 3] and "
                f"quaternions [{len(times)}, 4], not {positions.shape} and {quaternions.shape}"
            )
        if not (np.isfinite(positions).all() and np.isfinite(quaternions).all()):
            raise SceneError("a trajectory holds a pose that is not finite")
        if (np.diff(times) <= 0).any():
            raise SceneError("time stamps of a trajectory must increase strictly")
        norms = np.linalg.norm(quaternions, axis=1)
        if (np.abs(norms - 1) > 1e-2).any():
            raise SceneError("quaternions of a trajectory must have unit length (wxyz)")
        object.__setattr__(self, "times_us", times)
        object.__setattr__(self, "positions", positions)
        # Unit quaternions stay bit-identical, so that a saved trajectory reads back unchanged.
        unit = np.abs(norms - 1) < 1e-15
        object.__setattr__(
            self, "quaternions", np.where(unit[:, None], quaternions, quaternions / norms[:, None])
        )

    @cached_property
    def extent(self) -> float:
        """Longer side of the bounding rectangle of its positions, seen from above [m]."""
        return float(np.ptp(self.positions[:, :2], axis=0).max())

    @classmethod
    def from_transforms(cls, times_us: ArrayLike, transforms: ArrayLike) -> Trajectory:
        """Build from ``T_fixed_moving`` [T, 4, 4].

        Raises:
            SceneError: a matrix is not a rigid transform (the message names it), or as above.
        """
        t = np.asarray(transforms, dtype=np.float64)
        if t.ndim != 3 or t.shape[1:] != (4, 4):
            raise SceneError(f"transforms of a trajectory must be [T, 4, 4], not {list(t.shape)}")
        bad = np.flatnonzero(~are_rigid(t))
        if len(bad):
            raise SceneError(
                f"{len(bad)} of {len(t)} poses are not rigid transforms, the first at index "
                f"{bad[0]}: {t[bad[0]].tolist()}"
            )
        return cls(np.asarray(times_us), t[:, :3, 3], matrix_to_quaternion(t[:, :3, :3]))

    @property
    def start_us(self) -> int:
        """First time stamp [us]."""
        return int(self.times_us[0])

    @property
    def end_us(self) -> int:
        """Last time stamp [us]."""
        return int(self.times_us[-1])

    @property
    def moves(self) -> bool:
        """Whether it moves, see :func:`leads_anywhere`."""
        return leads_anywhere(self.positions)

    @property
    def middle(self) -> Float:
        """``T_world_object`` [4, 4] in the middle of the time span."""
        return self.transform((self.start_us + self.end_us) // 2)

    def spread_times(self, count: int) -> NDArray[np.int64]:
        """``count`` evenly spaced times [us]; only the middle one if it stands still."""
        if not self.moves:
            return np.array([(self.start_us + self.end_us) // 2])
        return np.linspace(self.start_us, self.end_us, count).astype(np.int64)

    def spread(self, count: int) -> Float:
        """``T_world_object`` [T, 4, 4] at :meth:`spread_times`."""
        return np.stack([self.transform(int(t)) for t in self.spread_times(count)])

    def covers(self, t_us: int) -> bool:
        """Whether a pose is known at ``t_us``."""
        return self.start_us <= t_us <= self.end_us

    def pose(self, t_us: int) -> tuple[Float, Float]:
        """Position [3] [m] and quaternion [4] wxyz at ``t_us``.

        Raises:
            TimeOutOfRangeError: outside [start_us, end_us].
        """
        if not self.covers(t_us):
            raise TimeOutOfRangeError(
                f"t_us={t_us} is outside this trajectory's range "
                f"[{self.start_us}, {self.end_us}]; trajectories do not extrapolate"
            )
        after = int(np.searchsorted(self.times_us, t_us, side="left"))
        if self.times_us[after] == t_us:
            return self.positions[after].copy(), self.quaternions[after].copy()
        before = after - 1
        span = float(self.times_us[after] - self.times_us[before])
        fraction = float(t_us - self.times_us[before]) / span
        position = (1 - fraction) * self.positions[before] + fraction * self.positions[after]
        return position, slerp(self.quaternions[before], self.quaternions[after], fraction)

    def transform(self, t_us: int) -> Float:
        """``T_fixed_moving`` [4, 4] at ``t_us``. Raises like :meth:`pose`."""
        return transform_from(*self.pose(t_us))

    def velocity(self, t_us: int) -> Float:
        """Velocity [3] [m/s] in the fixed frame of the segment that contains ``t_us``.

        At an inner time stamp the later segment is used, at the end the last one. A trajectory with
        one pose has velocity zero. Raises like :meth:`pose`.
        """
        self.pose(t_us)
        if len(self.times_us) == 1:
            return np.zeros(3)
        after = int(np.searchsorted(self.times_us, t_us, side="right"))
        after = min(max(after, 1), len(self.times_us) - 1)
        span = float(self.times_us[after] - self.times_us[after - 1]) * 1e-6
        velocity: Float = (self.positions[after] - self.positions[after - 1]) / span
        return velocity

    def between(self, start_us: int, end_us: int) -> Trajectory:
        """The part within [start_us, end_us], with interpolated poses at the cuts.

        Raises:
            TimeOutOfRangeError: the trajectory does not overlap this range.
        """
        if start_us > end_us or end_us < self.start_us or start_us > self.end_us:
            raise TimeOutOfRangeError(
                f"[{start_us}, {end_us}] holds nothing of this trajectory's range "
                f"[{self.start_us}, {self.end_us}]"
            )
        first, last = max(start_us, self.start_us), min(end_us, self.end_us)
        inside = self.times_us[(self.times_us > first) & (self.times_us < last)]
        return self._at([first, *inside.tolist(), last])

    def sampled(self, times_us: NDArray[np.int64]) -> Trajectory:
        """Its poses at its ends, and in between at ``times_us`` [K]."""
        inside = times_us[(times_us > self.start_us) & (times_us < self.end_us)]
        return self._at([self.start_us, *inside.tolist(), self.end_us])

    def _at(self, times_us: Sequence[int]) -> Trajectory:
        times = np.unique(times_us)
        positions, quaternions = zip(*(self.pose(int(t_us)) for t_us in times), strict=True)
        return Trajectory(times, np.array(positions), np.array(quaternions))

    def moved(self, T_new_fixed: ArrayLike) -> Trajectory:
        """The same motion in another fixed frame, by ``T_new_fixed`` [4, 4]."""
        matrix = np.asarray(T_new_fixed, dtype=np.float64)
        return Trajectory.from_transforms(
            self.times_us, matrix @ transform_from(self.positions, self.quaternions)
        )


def _whole_microseconds(times_us: ArrayLike) -> NDArray[np.int64]:
    given = np.atleast_1d(np.asarray(times_us))
    if given.dtype == np.int64 and given.ndim == 1:
        return given.copy()
    with np.errstate(invalid="ignore"):
        times = given.astype(np.int64)
    if given.ndim != 1 or not np.array_equal(times, given):
        raise SceneError("times_us must be a list of whole microseconds")
    return times


def relative_transform(T_world_a: ArrayLike, T_world_b: ArrayLike) -> Float:
    """``T_a_b`` [4, 4] of two poses in the world."""
    return invert_transform(T_world_a) @ np.asarray(T_world_b, dtype=np.float64)


__all__ = ["Trajectory", "apply_transform", "relative_transform"]
