"""Drives that start off the recorded path and return to it: recovery data for planners.

The ego of a clip starts with a lateral and a heading offset, and a plan brings it back: the offset
from the path is a fifth-order polynomial in the driven distance, with the slope of the heading
offset at the start and slope zero at the end. Cameras and LiDAR are rendered from the perturbed
poses, and the ego's future is the plan. Similar to the pseudo-expert of SimScale (arXiv
2511.23369).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..edit import ObjectState, PlacedObjects
from ..geometry import Float, box_penetration, invert_transform
from ..scene import Lidar, Scene
from .drive import Drive, Moment, SweepTargets

STEP_US = 50_000
"""Spacing of poses for measuring the driven distance [us]."""
MIN_PATH_LENGTH = 8.0
"""Minimum length of the recovery [m]."""
TRIES = 20
"""Maximum number of samples for a start clear of all objects. Each offset is smaller than the
previous one.
"""
SMALLER = 0.85
LIMIT = 2.5
"""Samples are clipped at this many standard deviations."""
CHECK_US = 500_000
CLEAR_M = 0.3


@dataclass(frozen=True)
class Perturbation:
    """Distribution of the starts of clips.

    Attributes:
        lateral_sigma: standard deviation of the lateral offset [m].
        heading_sigma: standard deviation of the heading relative to the path [rad].
        recover_s: recovery time at the initial speed [s].
        copies: number of perturbed copies of each clip, with different starts.
    """

    lateral_sigma: float = 0.5
    heading_sigma: float = 0.07
    recover_s: float = 3.0
    copies: int = 1


@dataclass(frozen=True, eq=False)
class PerturbedDrive:
    """A drive with a perturbed start of the ego.

    Attributes:
        base: the original drive.
        lateral: initial offset, to the left [m].
        heading: initial offset, to the left [rad].
        times_us, way: driven distance [m] over time from the start of the clip.
        length: distance to the end of the recovery [m].
    """

    base: Drive
    lateral: float
    heading: float
    times_us: Float
    way: Float
    length: float

    @classmethod
    def beside(
        cls, base: Drive, start_us: int, lateral: float, heading: float, recover_s: float
    ) -> PerturbedDrive:
        """A drive that starts off the path of ``base`` at ``start_us`` and returns to it."""
        times = np.arange(start_us, base.span[1] + 1, STEP_US)
        places = np.array([base.ego_at(int(t))[:2, 3] for t in times])
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        way = np.concatenate([[0.0], np.cumsum(steps)])
        # Speed over the first half second, independent of the time step of an episode.
        first = min(10, len(way) - 1)
        speed = way[first] / max(first * STEP_US * 1e-6, 1e-6)
        length = max(MIN_PATH_LENGTH, speed * recover_s)
        return cls(base, lateral, heading, times.astype(np.float64), way, float(length))

    @property
    def scene(self) -> Scene:
        """See :class:`Drive`."""
        return self.base.scene

    @property
    def span(self) -> tuple[int, int]:
        """See :class:`Drive`."""
        return self.base.span

    def at(self, t_us: int) -> Moment:
        """See :class:`Drive`."""
        return replace(self.base.at(t_us), T_world_ego=self.ego_at(t_us))

    def placed_at(self, t_us: int) -> PlacedObjects[ObjectState]:
        """See :class:`Drive`."""
        return self.base.placed_at(t_us)

    def ego_at(self, t_us: int) -> Float:
        """See :class:`Drive`."""
        lateral, heading = self.offset_at(t_us)
        moved: Float = self._moved(self.base.ego_at(t_us)[None], lateral, heading)[0]
        return moved

    def ego_speed_at(self, t_us: int) -> float:
        """See :class:`Drive`; the oblique return path is longer."""
        return self.base.ego_speed_at(t_us) / math.cos(self.offset_at(t_us)[1])

    def sweep_at(self, lidar: Lidar, t_us: int) -> SweepTargets:
        """See :class:`Drive`."""
        targets = self.base.sweep_at(lidar, t_us)
        times = t_us + lidar.beams.slots[0]
        ends = [self.offset_at(round(t)) for t in (times[0], times[-1])]
        span = [times[0], max(times[-1], times[0] + 1)]
        lateral, heading = (np.interp(times, span, pair) for pair in zip(*ends, strict=True))
        mount = lidar.T_vehicle_lidar
        ego = self._moved(targets.T_world_lidar @ invert_transform(mount), lateral, heading)
        return SweepTargets(targets.scene, ego @ mount)

    def offset_at(self, t_us: int) -> tuple[float, float]:
        """Lateral offset from the path, to the left [m], and heading offset [rad]."""
        share = min(float(np.interp(t_us, self.times_us, self.way)) / self.length, 1.0)
        slope = math.tan(self.heading) * self.length
        offset, rise = _quintic(share, self.lateral, slope)
        return offset, math.atan(rise / self.length)

    def _moved(self, ego: Float, lateral: Float | float, heading: Float | float) -> Float:
        """Poses [N, 4, 4] shifted to the left and rotated, at the same height above the ground."""
        moved = ego.copy()
        moved[:, :3, 3] += ego[:, :3, 1] * np.broadcast_to(lateral, len(ego))[:, None]
        ground = self.scene.ground
        rise = ground.height_at(moved[:, :2, 3]) - ground.height_at(ego[:, :2, 3])
        moved[:, 2, 3] = ego[:, 2, 3] + np.where(np.isfinite(rise), rise, 0.0)
        turn = np.zeros((len(ego), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(heading)
        turn[:, 1, 0] = np.sin(heading)
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = 1
        moved[:, :3, :3] = ego[:, :3, :3] @ turn
        return moved


def perturbed(
    drive: Drive, perturbation: Perturbation, times_us: Sequence[int], seed: Sequence[int]
) -> PerturbedDrive:
    """The drive of a clip with a random start that is clear of all objects.

    After TRIES samples without success, the drive starts on its path.
    """
    rng = np.random.default_rng(list(seed))
    for k in range(TRIES):
        lateral, heading = np.clip(rng.standard_normal(2), -LIMIT, LIMIT) * SMALLER**k
        found = PerturbedDrive.beside(
            drive,
            times_us[0],
            float(lateral * perturbation.lateral_sigma),
            float(heading * perturbation.heading_sigma),
            perturbation.recover_s,
        )
        if _is_clear(found, times_us):
            return found
    return PerturbedDrive.beside(drive, times_us[0], 0.0, 0.0, perturbation.recover_s)


def _is_clear(drive: PerturbedDrive, times_us: Sequence[int]) -> bool:
    length, width, height = drive.scene.ego_size
    centre = np.eye(4)
    # From the rear axle on the ground to the centre of the vehicle.
    centre[:3, 3] = length / 4, 0.0, height / 2 + CLEAR_M
    size = (length + CLEAR_M, width + CLEAR_M, height)
    for t_us in range(times_us[0], times_us[-1] + 1, CHECK_US):
        placed = drive.placed_at(t_us)
        if not len(placed.objects):
            continue
        ego = drive.ego_at(t_us) @ centre
        if (box_penetration(ego, size, placed.transforms, placed.sizes) > 0).any():
            return False
    return True


def _quintic(share: float, start: float, slope: float) -> tuple[float, float]:
    """Value and derivative at ``share`` of a quintic from ``start`` and ``slope`` to 0.

    Curvature is zero at both ends, slope is zero at the end.
    """
    a, b = -10 * start - 6 * slope, 15 * start + 8 * slope
    c = -6 * start - 3 * slope
    u = share
    value = start + slope * u + a * u**3 + b * u**4 + c * u**5
    return value, slope + 3 * a * u**2 + 4 * b * u**3 + 5 * c * u**4
