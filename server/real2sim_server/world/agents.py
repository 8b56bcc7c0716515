"""Poses and walking phases of all objects at one instant, and events of a step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.drive import EventType, Lamp

from ..edit import ObjectState, PlacedObjects
from ..edit.compose import figure_of
from ..geometry import Float
from ..scene import Figure, Scene, Stride

Agents = PlacedObjects[ObjectState]
"""Poses of all objects at one instant."""


def rows_of(agents: Agents) -> dict[str, int]:
    """The row of each object, by id."""
    return {o.object_id: k for k, o in enumerate(agents.objects)}


def rows_in(before: Agents, after: Agents) -> NDArray[np.int64]:
    """The row in ``before`` of each object of ``after``, [K] int64; -1 if it was not present."""
    if before.objects is after.objects:
        return _all_rows(len(after.objects))
    rows = rows_of(before)
    return np.array([rows.get(o.object_id, -1) for o in after.objects], np.int64)


@lru_cache(maxsize=64)
def _all_rows(count: int) -> NDArray[np.int64]:
    """Row numbers [count]. The array is shared between callers; do not modify it."""
    return np.arange(count)


Lamps = Mapping[str, tuple[Lamp, ...]]
"""Lit lamps of the objects that have any, by id."""


def agent_fields(agents: Agents, lamps: Lamps) -> list[dict[str, Any]]:
    """The wire's AgentState of each object, as plain maps."""
    poses = zip(
        agents.objects,
        agents.positions.tolist(),
        agents.quaternions.tolist(),
        agents.velocities.tolist(),
        agents.sizes.tolist(),
        strict=True,
    )
    return [
        {
            "object_id": subject.object_id,
            "category": subject.category,
            "position": position,
            "quaternion": quaternion,
            "velocity": velocity,
            "size": size,
            **({"lamps": lamps[subject.object_id]} if subject.object_id in lamps else {}),
        }
        for subject, position, quaternion, velocity, size in poses
    ]


# --- Strides -------------------------------------------------------------------------------------

# Pedestrians off their recorded trajectories (moved by a driver or a storyboard, or hit) walk with
# strides computed from their motion.

LED = 1e-3
"""Maximum deviation from the recorded trajectory for recorded strides: position [m], and entries of
the rotation."""
UPRIGHT = 0.9
"""Minimum cosine between a walking pedestrian and the vertical."""

Walker = tuple[int, ObjectState, Figure]


@dataclass(frozen=True, eq=False)
class Strides:
    """Strides of pedestrians at one instant; part of the world, so replayed and forked with it.

    Attributes:
        made: strides by object id, of pedestrians off their trajectories.
        objects: objects of the world, in order.
        walkers: row, object and figure of the pedestrians among them.
    """

    made: Mapping[str, Stride] = field(default_factory=dict)
    objects: tuple[ObjectState, ...] = ()
    walkers: tuple[Walker, ...] = ()

    def after(self, scene: Scene, agents: Agents, *, since_us: int, t_us: int) -> Strides:
        """The strides one step later.

        Args:
            scene: scene of the objects.
            agents: current poses of all objects.
            since_us, t_us: previous and current time [us].
        """
        walkers = self.walkers
        # Traffic creates a new tuple every step, mostly of the same objects.
        if agents.objects != self.objects:
            walkers = _walkers(scene, agents.objects)
        elif not walkers:
            return self
        made, seconds = {}, (t_us - since_us) * 1e-6
        for row, subject, figure in walkers:
            transform = agents.transforms[row]
            if _is_led(subject, transform, t_us):
                continue
            stride = self.made.get(subject.object_id)
            if stride is None:
                stride = figure.stride_at(subject.trajectory, since_us)
            speed = _walking_speed(transform, agents.velocities[row])
            made[subject.object_id] = figure.strode(
                stride, speed=speed / subject.scale[2], seconds=seconds
            )
        return Strides(made, agents.objects, walkers)


def _walkers(scene: Scene, objects: tuple[ObjectState, ...]) -> tuple[Walker, ...]:
    found = ((row, subject, figure_of(scene, subject)) for row, subject in enumerate(objects))
    return tuple((row, subject, figure) for row, subject, figure in found if figure is not None)


def _is_led(subject: ObjectState, transform: Float, t_us: int) -> bool:
    trajectory = subject.trajectory
    if not trajectory.covers(t_us):
        return False
    return bool(np.abs(trajectory.transform(t_us) - transform).max() < LED)


def _walking_speed(transform: Float, velocity: Float) -> float:
    """Speed over the ground [m/s]; 0 for pedestrians that are lying or airborne."""
    return math.hypot(velocity[0], velocity[1]) if transform[2, 2] > UPRIGHT else 0.0


# --- Events --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Event:
    """An event of a step, with the fields of the wire's Event.

    ``data`` by kind:

    - ``collision``: ``contact_us``, start time of the contact, within the step before ``t_us``;
      ``x``, ``y``, its position [m], world frame; ``relative_speed`` there [m/s]. With collision
      response also the rest of :meth:`.collision.impact.Impact.event_data`. ``object_id`` is None
      for the background. ``other_id`` is the second object if the ego is not involved.
    - ``left_log``, ``agents_react``: ``distance`` from the recording [m].
    - ``edited``: ``revision``.
    - ``storyboard``: ``element``, ``element_type`` and ``change``, see
      :class:`.storyboard.progress.ElementChange`.
    - ``looped``: ``lap``, and ``x``, ``y`` [m], ``turn`` [rad] of :class:`.path.LoopTransform`.
    """

    type: EventType
    t_us: int
    object_id: str | None = None
    other_id: str | None = None
    data: Mapping[str, float] = field(default_factory=dict)
    element: str | None = None
    element_type: str | None = None
    change: str | None = None

    def fields(self) -> dict[str, Any]:
        """The event as a plain map for the wire."""
        fields = {
            "type": self.type,
            "t_us": self.t_us,
            "object_id": self.object_id,
            "other_id": self.other_id,
            "data": dict(self.data),
        }
        if self.element is None:
            return fields
        told = {"element": self.element, "element_type": self.element_type, "change": self.change}
        return fields | told
