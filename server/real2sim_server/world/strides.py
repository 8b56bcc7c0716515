"""How people walk whom a driver, a storyboard or a crash has led away from their trajectories."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..edit import ObjectState
from ..edit.compose import figure_of
from ..geometry.rotation import Float
from ..scene import Figure, Scene, Stride
from .agents import Agents

LED = 1e-3
"""Who is this near to where the trajectory leads walks as that says [m], and as near in the entries
of its rotation."""
UPRIGHT = 0.9
"""Cosine of the angle to the vertical beyond which nobody walks."""

Walker = tuple[int, ObjectState, Figure]


@dataclass(frozen=True, eq=False)
class Strides:
    """Strides of people at one instant; a part of a world, so replayed and forked with it.

    Attributes:
        made: by object id, of those whom no trajectory leads.
        objects: of the world, in their order.
        walkers: row, object and figure of those among them that are people.
    """

    made: Mapping[str, Stride] = field(default_factory=dict)
    objects: tuple[ObjectState, ...] = ()
    walkers: tuple[Walker, ...] = ()

    def after(self, scene: Scene, agents: Agents, *, since_us: int, t_us: int) -> Strides:
        """One step on.

        Args:
            scene: that the objects are of.
            agents: where everybody is now.
            since_us, t_us: the last instant and now [us].
        """
        walkers = self.walkers
        # Traffic makes a new tuple with every step, mostly of the same objects.
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
    """Over the ground [m/s]; none of who lies or flies."""
    return math.hypot(velocity[0], velocity[1]) if transform[2, 2] > UPRIGHT else 0.0
