"""Legs of a planned trajectory: its parts that are driven in one gear each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..._records import made_quickly
from ..path import Float
from .motion import Motion
from .reference import PlannedTrajectory, SinglePose, ways_along

CUSP, ON_AGAIN = 0.05, 0.02
"""A plan turns back where it goes the other way for this far, and goes on forwards again for this;
less is noise of a plan that stands [m]."""

NEAR = 0.05
"""A plan of a single pose changes the gear where the pose is farther away than this on the other
side [m]."""


CREEPING = 0.1
"""Plans of a single pose that go faster than this from one to the next have the gear of that way,
wherever the vehicle is [m/s]."""


@made_quickly
@dataclass(frozen=True, eq=False)
class Leg:
    """A part of a plan.

    Attributes:
        backwards: whether it leads against the headings of its poses.
        trajectory: its poses after its beginning.
        begin_us: absolute time of its beginning [us]; None for that of the plan.
        cusp: x, y [m], yaw [rad] where it begins; None where the vehicle is.
    """

    backwards: bool
    trajectory: PlannedTrajectory
    begin_us: int | None = None
    cusp: tuple[float, float, float] | None = None


def legs_of(
    trajectory: PlannedTrajectory, motion: Motion, before: SinglePose | None = None
) -> tuple[Leg, ...]:
    """The legs of a plan for a vehicle; one where it leads forwards all the way. ``before``: what
    a plan of a single pose goes on from."""
    poses = trajectory.poses
    if len(poses) == 1:
        at_us = int(trajectory.times_us[0])
        goes = None if before is None else before.speed_to(at_us, poses[0])
        backwards = _is_behind(poses[0], motion)
        if goes is not None and abs(goes) > CREEPING:
            backwards = goes < 0
        return (Leg(backwards, trajectory),)
    if not motion.reversing and trajectory.leads_forwards:
        return (Leg(False, trajectory),)
    turns = _turns(ways_along(poses), backwards=motion.reversing)
    legs = []
    for k, (begin, backwards) in enumerate(turns):
        end = turns[k + 1][0] if k + 1 < len(turns) else len(poses) - 1
        first = begin + 1 if k else 0
        part = PlannedTrajectory(trajectory.times_us[first : end + 1], poses[first : end + 1])
        x, y, yaw = poses[begin].tolist()
        legs.append(
            Leg(backwards, part, int(trajectory.times_us[begin]), (x, y, yaw))
            if k
            else Leg(backwards, part)
        )
    return tuple(legs)


def may_lead_backwards(plans: Float) -> NDArray[np.bool_]:
    """[W] bool, whether any part of a plan goes against its headings.

    Args:
        plans: [W, N, 3] poses x, y [m], yaw [rad], each in the frame of its vehicle.
    """
    if plans.shape[1] == 1:
        x, y, yaw = plans[:, 0].T
        behind: NDArray[np.bool_] = np.less(x * (1 + np.cos(yaw)) + y * np.sin(yaw), 0.0)
        return behind
    against: NDArray[np.bool_] = np.any(ways_along(plans) < 0, axis=1)
    return against


def _turns(along: Float, *, backwards: bool) -> list[tuple[int, bool]]:
    """Where each leg begins, and whether it leads backwards. ``backwards``: the gear before."""
    way, farthest, place = 0.0, 0.0, 0
    turns = [(0, backwards)]
    for k, step in enumerate(along.tolist(), start=1):
        way += -step if backwards else step
        if way >= farthest:
            farthest, place = way, k
        elif farthest - way > (ON_AGAIN if backwards else CUSP):
            backwards = not backwards
            if place == turns[-1][0]:
                turns[-1] = (place, backwards)
            else:
                turns.append((place, backwards))
            way, farthest, place = farthest - way, farthest - way, k
    return turns


def _is_behind(pose: Float, motion: Motion) -> bool:
    """Whether a single pose leads a vehicle backwards."""
    x, y, yaw = pose.tolist()
    dx, dy = x - motion.x, y - motion.y
    cos, sin = math.cos(motion.yaw) + math.cos(yaw), math.sin(motion.yaw) + math.sin(yaw)
    ahead: float = (dx * cos + dy * sin) / 2
    return ahead < (NEAR if motion.reversing else -NEAR)
