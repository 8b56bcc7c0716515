"""Ego and objects as rigid bodies, and objects that physics moves after an impact."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

from real2sim_proto.episode import ContactSpec, EgoSpec

from ...edit import ObjectState
from ...simulation.masses import default_mass, yaw_inertia
from ...simulation.structure import STRUCTURES, stiffness_of
from ..boxes import REAR_OVERHANG
from ..driving import vehicle_parameters
from ..ego.motion import Motion
from ..traffic.driver import AgentPose, Surroundings
from .rigid_body import BodyProperties, BodyState

ROLLING = frozenset({"car", "vehicle", "van", "truck", "bus"})
IMPACTED_DRAG = 0.15
"""Deceleration per gravity of a car along its wheels after an impact: out of gear, damaged,
unbraked."""


@dataclass(frozen=True, eq=False)
class ImpactedObject:
    """An object that physics moves after an impact; an :class:`~..traffic.driver.AgentDriver`.

    Attributes:
        subject: the object as it was before the impact.
        properties, body: rigid body.
        height: of its box centre above the ground [m].
        pose: see :class:`~..traffic.driver.AgentDriver`.
    """

    subject: ObjectState
    properties: BodyProperties
    body: BodyState
    height: float
    pose: AgentPose
    present: bool = True

    def advance(self, surroundings: Surroundings) -> Self:
        """Itself: the collision step moves it together with all bodies that it may hit."""
        return self

    def at(self, body: BodyState, pose: AgentPose, properties: BodyProperties) -> Self:
        """The object at another place, and as short as it is by now."""
        return replace(self, body=body, pose=pose, properties=properties)


def object_properties(
    subject: ObjectState, contact: ContactSpec, *, friction: float, size: tuple[float, ...]
) -> BodyProperties:
    """An object as a rigid body: a box, of even mass if it is no vehicle; cars have their axles at
    0.3 of their length."""
    length, width = size[0], size[1]
    given = subject.physics
    mass = contact.masses.get(subject.object_id, given.mass if given else None)
    if mass is None:
        mass = default_mass(subject.category, size, by_height=contact.weighed_by_height)
    if given is not None and given.friction is not None:
        friction = given.friction
    rolls = subject.category in ROLLING
    turns_as = subject.category if contact.residual_crush else ""
    return BodyProperties(
        mass=mass,
        inertia=yaw_inertia(turns_as, mass, size),
        length=length,
        width=width,
        axles=(0.3 * length, 0.3 * length) if rolls else None,
        friction=friction,
        drag=IMPACTED_DRAG if rolls else 0.0,
        stiffness=stiffness_of(subject.category),
        vehicle=subject.category in STRUCTURES,
    )


def ego_properties(spec: EgoSpec, size: tuple[float, float, float]) -> BodyProperties:
    """The controlled vehicle as a rigid body."""
    vehicle = vehicle_parameters(spec)
    return BodyProperties(
        mass=vehicle.mass,
        inertia=vehicle.inertia,
        length=size[0],
        width=size[1],
        box_ahead=size[0] / 2 - REAR_OVERHANG - vehicle.rear,
        axles=(vehicle.front, vehicle.rear),
        friction=vehicle.friction,
        drag=0.015,
        stiffness=stiffness_of("car"),
    )


def ego_body(motion: Motion, spec: EgoSpec) -> BodyState:
    """The body of a vehicle in motion."""
    rear = vehicle_parameters(spec).rear
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    across = motion.lateral_speed + rear * motion.yaw_rate
    return BodyState(
        x=motion.x + rear * cos,
        y=motion.y + rear * sin,
        yaw=motion.yaw,
        vx=motion.speed * cos - across * sin,
        vy=motion.speed * sin + across * cos,
        turn=motion.yaw_rate,
    )


def ego_motion(body: BodyState, before: Motion, spec: EgoSpec) -> Motion:
    """The motion of a body; steering and actuators as they were."""
    rear = vehicle_parameters(spec).rear
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    return before._replace(
        x=body.x - rear * cos,
        y=body.y - rear * sin,
        yaw=body.yaw,
        speed=body.vx * cos + body.vy * sin,
        lateral_speed=body.vy * cos - body.vx * sin - rear * body.turn,
        yaw_rate=body.turn,
    )


def is_rolling(motion: Motion, spec: EgoSpec) -> bool:
    """Whether a vehicle that was pushed goes where its wheels point again."""
    steered = motion.speed * math.tan(motion.steering) / spec.wheelbase
    return abs(motion.lateral_speed) < 0.2 and abs(motion.yaw_rate - steered) < 0.1
