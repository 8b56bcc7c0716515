"""The way that ego and objects have come, for sensors that take time to look.

Between two instants of the clock everything goes straight and turns evenly. Before its first
instant an object, and before the episode all, goes as it does then. The last sweep's worth of it is
part of a world: forked, replayed and resumed with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.rotation import (
    Float,
    matrix_to_quaternion,
    quaternion_to_matrix,
    slerp,
    yaw_quaternion,
)
from ...geometry.transform import transform_from
from ..agents import Agents, rows_of

SHORTEST_US = 100_000
"""So much is kept whatever the sensors, for a look aside."""


@dataclass(frozen=True, eq=False)
class StepWay:
    """One step of the clock.

    Attributes:
        since_us, until_us: its instants [us].
        ego: (before, after) ``T_world_body`` [4, 4].
        agents: (before, after) poses of the other objects.
    """

    since_us: int
    until_us: int
    ego: tuple[Float, Float]
    agents: tuple[Agents, Agents]


@dataclass(frozen=True, eq=False)
class Wake:
    """The last steps, oldest first; none before the first step.

    Attributes:
        keep_us: how far back they reach at least, where there have been so many.
        ways: of the steps.
    """

    keep_us: int
    ways: tuple[StepWay, ...] = ()

    @classmethod
    def of(cls, longest_us: int) -> Wake:
        """Before the first step of an episode whose sweeps take up to ``longest_us``."""
        return cls(max(longest_us, SHORTEST_US))

    def after(self, way: StepWay) -> Wake:
        """With one more step."""
        since = way.until_us - self.keep_us
        ways, old = self.ways, 0
        while old < len(ways) and ways[old].until_us <= since:
            old += 1
        return Wake(self.keep_us, (*ways[old:], way))

    def ego_poses(self, times_us: Float, *, t_us: int, now: Float, twist: Float) -> Float:
        """``T_world_body`` [S, 4, 4] at ``times_us`` [S] [us].

        Args:
            times_us: absolute, none later than ``t_us``.
            t_us: now.
            now: [4, 4], the pose now.
            twist: [6] velocity [m/s] and angular velocity [rad/s] now, for times before the first
                step.
        """
        if not self.ways:
            return _on(now, twist[:3], float(twist[5]), (times_us - t_us) * 1e-6)
        return _along(times_us, self.ways, [way.ego for way in self.ways])

    def object_poses(self, object_id: str, times_us: Float, *, t_us: int, now: Agents) -> Float:
        """``T_world_object`` [S, 4, 4] of an object that is there now, at ``times_us`` [S] [us]."""
        row = rows_of(now)[object_id]
        ends = [_ends(way, object_id) for way in self.ways]
        first = next((k for k, pair in enumerate(ends) if pair is not None), len(ends))
        whole = [pair for pair in ends[first:] if pair is not None]
        pose = now.transforms[row]
        if not whole or len(whole) < len(ends) - first or not np.array_equal(whole[-1][1], pose):
            # An edit has put it here.
            return _on(pose, now.velocities[row], 0.0, (times_us - t_us) * 1e-6)
        return _along(times_us, self.ways[first:], whole)


def _ends(way: StepWay, object_id: str) -> tuple[Float, Float] | None:
    """Poses of an object before and after a step; None where it was not there."""
    before, after = (rows_of(agents).get(object_id) for agents in way.agents)
    if before is None or after is None:
        return None
    return way.agents[0].transforms[before], way.agents[1].transforms[after]


def _along(times_us: Float, ways: Sequence[StepWay], ends: Sequence[tuple[Float, Float]]) -> Float:
    """Poses along ways; before the first straight on backwards."""
    found = np.empty((len(times_us), 4, 4))
    for number, (way, (before, after)) in enumerate(zip(ways, ends, strict=True)):
        inside = times_us <= way.until_us
        if number:
            inside &= times_us > way.since_us
        if inside.any():
            part = (times_us[inside] - way.since_us) / (way.until_us - way.since_us)
            found[inside] = _between(before, after, part)
    return found


def _between(before: Float, after: Float, part: Float) -> Float:
    """Poses [P, 4, 4] at ``part`` [P] of the way, 0 to 1; below 0 straight on, not turned."""
    turns = matrix_to_quaternion(np.stack([before[:3, :3], after[:3, :3]]))
    places = before[:3, 3] + part[:, None] * (after[:3, 3] - before[:3, 3])
    return transform_from(places, slerp(turns[0], turns[1], np.clip(part, 0.0, 1.0)))


def _on(pose: Float, velocity: Float, yaw_rate: float, seconds: Float) -> Float:
    """Poses [S, 4, 4] at a steady speed, ``seconds`` [S] from ``pose``."""
    found = np.broadcast_to(pose, (len(seconds), 4, 4)).copy()
    found[:, :3, 3] += seconds[:, None] * velocity
    if yaw_rate:
        turns = quaternion_to_matrix(yaw_quaternion(seconds * yaw_rate))
        found[:, :3, :3] = turns @ pose[:3, :3]
    return found
