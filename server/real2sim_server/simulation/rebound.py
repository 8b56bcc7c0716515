"""A wanted restitution, fitted on what the body will hit, where it will hit it.

How well a body on a grid bounces depends on where the surface lies between nodes and how it is
turned: an elastic block keeps 0.6 to 0.9 of its speed. So the body is followed on its way to the
first collider that it meets, and viscosity is fitted by canned impacts right there.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..geometry.rotation import Float
from ..physics.colliders import Collider, Plane, Solid
from ..physics.fitting import fit_restitution
from ..physics.solver import SolverOptions
from .body import DeformableBody
from .result import Rebound
from .rigid import RigidMotion
from .surroundings import clearance

HORIZON = 10.0
"""Time for which a body is followed [s]."""
STEPS_MAX = 4_000
STRIDE = 0.5
"""Furthest way between two looks [cells]."""
SLOW = 0.1
"""Slower approaches are no impacts [m/s]."""
USUAL_SPEED = 2.0
"""Approach at which restitution is fitted when the object itself stands [m/s]."""


@dataclass(frozen=True, eq=False)
class FirstTouch:
    """How a body meets the first collider on its way.

    Attributes:
        motion: of the body then.
        collider: as it is then, brought to rest.
        point: on its surface [m].
        normal: out of it there.
        speed: of approach along the normal [m/s].
    """

    motion: RigidMotion
    collider: Collider
    point: Float
    normal: Float
    speed: float


def fit_rebound(
    body: DeformableBody, requested: float, colliders: Sequence[Collider], gravity: Float
) -> Rebound:
    """Add the viscosity that lets a body bounce off what it will hit as ``requested``.

    Args:
        body: at its start; its materials change.
        requested: coefficient of restitution.
        colliders: that its surface may meet.
        gravity: [3] on its way there [m/s^2].
    """
    touch = first_touch(body, colliders, gravity)
    trial = copy.copy(body)
    options = SolverOptions(dx=body.cell, gravity=(0.0, 0.0, 0.0))
    if touch is None:
        speed = float(np.linalg.norm(body.motion.velocity))
        along = body.motion.velocity / speed if speed > SLOW else body.motion.rotation[:, 0]
        normal, speed = -along, speed if speed > SLOW else USUAL_SPEED
        fit = fit_restitution(_still(trial), requested, speed=speed, normal=normal, options=options)
    else:
        trial.motion = touch.motion
        wall = Plane(name="wall", point=touch.point, normal=touch.normal)
        speed = touch.speed
        fit = fit_restitution(
            _still(trial),
            requested,
            speed=speed,
            wall=wall,
            collider=touch.collider,
            options=options,
        )
    body.materials = fit.body.materials
    return Rebound(
        requested,
        fit.achieved,
        fit.elastic,
        None if touch is None else touch.collider.name,
        speed,
        fit.viscosity,
    )


def first_touch(
    body: DeformableBody, colliders: Sequence[Collider], gravity: Float
) -> FirstTouch | None:
    """The first collider that a body meets on its way, flying or rolling straight; None for none.

    Args:
        body: at its start.
        colliders: as they are then.
        gravity: [3] [m/s^2].
    """
    motion, now = body.motion, list(colliders)
    trial = copy.copy(body)
    surface = body.spacing / 2
    time = 0.0
    for _ in range(STEPS_MAX):
        fastest = max((c.fastest_point for c in now), default=0.0)
        turning = body.reach * float(np.linalg.norm(motion.angular_velocity))
        speed = float(np.linalg.norm(motion.velocity)) + turning + fastest
        if time > HORIZON or (speed < SLOW and not np.any(gravity)):
            return None
        trial.motion = motion
        shell = trial.shell_points()
        for collider in now:
            if isinstance(collider, Solid) and _is_far(collider, motion.centre, body.reach):
                continue
            distance, normals = clearance(collider, shell)
            k = int(distance.argmin())
            normal = normals[k]
            approach = _approach(motion, collider, shell[k], normal)
            if distance[k] < surface and approach > SLOW:
                point = shell[k] - distance[k] * normal
                return FirstTouch(motion, _at_rest(collider), point, normal, approach)
        step = min(STRIDE * body.cell / max(speed, SLOW), 0.02)
        motion = motion.with_gravity(step, gravity).advanced(step)
        now = [c.after(step) for c in now]
        time += step
    return None


def _is_far(solid: Solid, centre: Float, reach: float) -> bool:
    """Whether a solid is further from a point than ``reach`` [m] and a body's surface."""
    low, high = solid.bounds
    extent = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    away = float(np.linalg.norm(solid.pose[:3, 3] - centre))
    return away - extent > 2 * reach


def _still(body: DeformableBody) -> Any:
    """For the solver, at its place; velocities are those of the canned impact."""
    return replace(body.solver_body(), particle_velocities=None, particle_gradients=None)


def _approach(motion: RigidMotion, collider: Collider, point: Float, normal: Float) -> float:
    velocity = motion.velocity
    if isinstance(collider, Solid):
        velocity = velocity - collider.velocity_at(point)
    return -float(velocity @ normal)


def _at_rest(collider: Collider) -> Collider:
    return collider.at_rest() if isinstance(collider, Solid) else collider
