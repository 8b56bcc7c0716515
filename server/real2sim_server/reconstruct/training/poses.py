"""Refined poses of objects: small corrections of the tracked boxes at the training frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.transform import (
    Float,
    multiply_quaternions,
    quaternion_to_matrix,
    transform_from,
    yaw_quaternion,
)
from ...scene import Scene, Trajectory
from .losses import second_differences


@dataclass(frozen=True, eq=False)
class KeyPoses:
    """Corrections of one object, about its own axes.

    Attributes:
        times_us: [T] int64 key times [us].
        positions, quaternions: [T, 3] and [T, 4] float64 of the boxes as given.
        first_row: of this object in the packed corrections.
    """

    times_us: NDArray[np.int64]
    positions: Float
    quaternions: Float
    first_row: int

    @property
    def rows(self) -> slice:
        """Rows of the packed corrections."""
        return slice(self.first_row, self.first_row + len(self.times_us))

    def covers(self, t_us: int) -> bool:
        """Whether the object exists at ``t_us``."""
        return bool(self.times_us[0] <= t_us <= self.times_us[-1])

    def bracket(self, t_us: int) -> tuple[int, int, float]:
        """Keys before and after ``t_us`` and the fraction of the way between them."""
        after = int(np.searchsorted(self.times_us, t_us, side="left"))
        if self.times_us[after] == t_us:
            return after, after, 0.0
        before = after - 1
        span = float(self.times_us[after] - self.times_us[before])
        return before, after, float(t_us - self.times_us[before]) / span


class ObjectPoses:
    """Poses of all objects with their corrections.

    At a key time ``T_world_object = T_given [Rz(yaw) Ry(pitch) Rx(roll) | shift]``; in between
    positions and corrections are linear and rotations slerped, as in Trajectory. Boxes are mostly
    labelled upright, while roads are steep and vehicles pitch when they brake.

    Args:
        scene: its trajectories are where refinement starts.
        key_times_us: [K] times of training frames: only there do images correct a pose, so
            other times between the first and last pose of a track lean on their neighbours.
            None keeps every pose of the trajectories as it is.
        device: where corrections lie, and poses with them.
    """

    def __init__(
        self,
        scene: Scene,
        key_times_us: NDArray[np.int64] | None,
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        self.keys: list[KeyPoses] = []
        row = 0
        for item in scene.objects.values():
            times = _key_times(item.trajectory, key_times_us)
            poses = [item.trajectory.pose(int(t)) for t in times]
            positions, quaternions = (np.array(part) for part in zip(*poses, strict=True))
            key = KeyPoses(times, positions, quaternions, row)
            self.keys.append(key)
            row += len(times)
        self._given = [Trajectory(k.times_us, k.positions, k.quaternions) for k in self.keys]
        self.shifts = torch.zeros(row, 3, device=device, requires_grad=True)
        self.yaws = torch.zeros(row, 1, device=device, requires_grad=True)
        self.tilts = torch.zeros(row, 2, device=device, requires_grad=True)

    def at(self, t_us: int) -> tuple[list[int], Tensor]:
        """Indices of the objects that exist at ``t_us``, K of them, and their ``T_world_object``
        [K, 4, 4] float64, which carry gradients."""
        present = [index for index, key in enumerate(self.keys) if key.covers(t_us)]
        if not present:
            return [], torch.zeros(0, 4, 4, dtype=torch.float64, device=self.shifts.device)
        keys = [self.keys[index] for index in present]
        before, after, fractions = zip(*(key.bracket(t_us) for key in keys), strict=True)
        first = np.array([key.first_row for key in keys])
        device = self.shifts.device
        rows = [torch.from_numpy(first + key).to(device) for key in (before, after)]
        later = torch.tensor(fractions, dtype=torch.float64, device=device)[:, None]
        weights = (1 - later).float(), later.float()
        shift, yaw, tilt = (
            held[rows[0]] * weights[0] + held[rows[1]] * weights[1]
            for held in (self.shifts, self.yaws, self.tilts)
        )
        poses = [self._given[index].pose(t_us) for index in present]
        given = transform_from(*(np.array(part) for part in zip(*poses, strict=True)))
        corrections = _corrections(shift.double(), torch.cat([tilt, yaw], dim=1).double())
        return present, torch.from_numpy(given).to(device) @ corrections

    def roughness(self) -> Tensor:
        """Mean squared second differences of all refined trajectories [m, rad] at 10 Hz."""
        terms = [
            second_differences(
                torch.cat(self._refined(key), dim=1), (key.times_us * 1e-6).astype(np.float64)
            )
            for key in self.keys
            if len(key.times_us) >= 3
        ]
        return torch.stack(terms).mean() if terms else self.shifts.sum() * 0

    def _refined(self, key: KeyPoses) -> tuple[Tensor, Tensor, Tensor]:
        """World positions [T, 3] about their mean, unwrapped yaws [T, 1] and corrections of roll
        and pitch [T, 2], float32."""
        device = self.shifts.device
        rotations = quaternion_to_matrix(key.quaternions).astype(np.float32)
        turns = torch.from_numpy(rotations).to(device)
        base = torch.from_numpy(key.positions - key.positions.mean(0)).float().to(device)
        positions = base + torch.einsum("tij,tj->ti", turns, self.shifts[key.rows])
        heading = np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
        given = torch.from_numpy(heading.astype(np.float32)).to(device)
        yaws = given[:, None] + self.yaws[key.rows]
        return positions, yaws, self.tilts[key.rows]

    def trajectory(self, index: int) -> Trajectory:
        """The refined trajectory of object ``index``."""
        key = self.keys[index]
        shift = self.shifts.detach()[key.rows].cpu().double().numpy()
        yaw = self.yaws.detach()[key.rows, 0].cpu().double().numpy()
        roll, pitch = self.tilts.detach()[key.rows].cpu().double().numpy().T
        rotations = quaternion_to_matrix(key.quaternions)
        positions = key.positions + np.einsum("tij,tj->ti", rotations, shift)
        quaternions = multiply_quaternions(key.quaternions, yaw_quaternion(yaw))
        for axis, angle in ((1, pitch), (0, roll)):
            quaternions = multiply_quaternions(quaternions, _about(axis, angle))
        return Trajectory(key.times_us, positions, quaternions)


def _corrections(shift: Tensor, angles: Tensor) -> Tensor:
    """``[Rz(yaw) Ry(pitch) Rx(roll) | shift]`` [K, 4, 4] of shifts [K, 3] and of roll, pitch and
    yaw [K, 3]."""
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(1), angles.sin().unbind(1)
    x, y, z = shift.unbind(1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y),
        (-sp, cp * sr, cp * cr, z),
        (zero, zero, zero, one),
    )
    return torch.stack([value for row in rows for value in row], dim=1).reshape(-1, 4, 4)


def _about(axis: int, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions [T, 4] wxyz of turns by ``angle`` [T] about one axis."""
    quaternions = np.zeros((len(angle), 4))
    quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
    return quaternions


def _key_times(trajectory: Trajectory, key_times_us: NDArray[np.int64] | None) -> NDArray[np.int64]:
    if key_times_us is None:
        return trajectory.times_us
    inside = key_times_us[(key_times_us > trajectory.start_us) & (key_times_us < trajectory.end_us)]
    ends = np.array([trajectory.start_us, trajectory.end_us], dtype=np.int64)
    return np.unique(np.concatenate([ends, inside]))
