"""Bodies of an episode: what they weigh, and how the ego and objects become them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, Self

from real2sim_proto.episode import ContactSpec, EgoSpec

from ...edit import ObjectState
from ...render.types import Instance
from ...simulation.masses import default_mass
from ..driving import vehicle_of
from ..ego.vehicle import Motion
from ..scoring.instant import Side
from ..traffic.driver import AgentPose, Surroundings
from .body import Body, Solid
from .contact import REAR_OVERHANG

ROLLING = frozenset({"car", "vehicle", "van", "truck", "bus"})
STRUCK_DRAG = 0.15
"""Deceleration per gravity of a struck car along its wheels: out of gear, damaged, unbraked."""

MUTUAL_STIFFNESS = 405e3
"""Of two cars in series, for the estimate of crush: 405 +- 139 kN/m (Bonugli et al. 2017)."""


class Party(NamedTuple):
    """A body as it was when an impact began; ``low``, ``high``: of its box [m]."""

    solid: Solid
    body: Body
    low: float
    high: float


@dataclass(frozen=True)
class Impact:
    """What two bodies did to each other in one step of the clock.

    Attributes:
        object_id: of the object; None for the background.
        other_id: second object, where the ego had no part in it; else None.
        t_us: of the step in which it was [us].
        point: middle of the contact when it began, world [m].
        normal: out of the object into the other body.
        approach_speed: along the normal when it began [m/s].
        relative_speed: of the two centres [m/s].
        impulse: on the ego, or on ``other_id``, summed over the step [N s].
        delta_v, object_delta_v: length of the change of velocity of the ego (or ``other_id``) and
            of the object [m/s].
        energy: kinetic energy lost [J].
        side: how ego and object met.
        speeds: of the first body and of the object when they met [m/s].
        began_us: when they met in this step [us].
        parties: the ego (or ``other_id``) and the object when they met; None for the background.
    """

    object_id: str | None
    other_id: str | None
    t_us: int
    point: tuple[float, float]
    normal: tuple[float, float]
    approach_speed: float
    relative_speed: float
    impulse: tuple[float, float]
    delta_v: float
    object_delta_v: float
    energy: float
    side: Side = "lateral"
    speeds: tuple[float, float] = (0.0, 0.0)
    began_us: int = 0
    parties: tuple[Party, Party | None] | None = None

    @property
    def crush(self) -> float:
        """Depth of both dents together [m], if all energy lost went into a linear spring."""
        return math.sqrt(2 * max(self.energy, 0.0) / MUTUAL_STIFFNESS)

    def figures(self) -> dict[str, float]:
        """For events."""
        return {
            "relative_speed": self.relative_speed,
            "approach_speed": self.approach_speed,
            "impulse": math.hypot(*self.impulse),
            "delta_v": self.delta_v,
            "object_delta_v": self.object_delta_v,
            "energy": self.energy,
            "crush": self.crush,
        }


class Deformation(Protocol):
    """Dents struck bodies. Immutable: what happens makes a new one, so that worlds can fork.

    The world moves struck objects as rigid bodies; whoever deforms them is told of every impact,
    and says what is drawn instead of an object's own Gaussians.
    """

    def struck(self, impact: Impact, subjects: Mapping[str, ObjectState]) -> Self:
        """After an impact; ``subjects``: all objects by id."""

    def work_out(self) -> None:
        """Find the shapes that are not known yet, so that ``shown`` does not have to."""

    def shown(self, object_id: str, instance: Instance, t_us: int) -> Instance:
        """What is drawn of an object; the given instance where it is not deformed."""


@dataclass(frozen=True, eq=False)
class ImpactedObject:
    """An object that physics moves: an :class:`~..traffic.driver.AgentDriver` without a will.

    Attributes:
        subject: the object as it was when it was struck.
        solid, body: rigid body.
        height: of its box centre above the ground [m].
        pose: see :class:`~..traffic.driver.AgentDriver`.
    """

    subject: ObjectState
    solid: Solid
    body: Body
    height: float
    pose: AgentPose
    present: bool = field(default=True)

    def advance(self, seen: Surroundings) -> Self:
        """Itself: it is moved together with everything that it may hit."""
        return self

    def at(self, body: Body, pose: AgentPose) -> Self:
        """The wreck at another place."""
        return replace(self, body=body, pose=pose)


def solid_of(
    subject: ObjectState, contact: ContactSpec, *, friction: float, size: tuple[float, ...]
) -> Solid:
    """An object as a rigid body: a box of even mass; cars with axles at 0.3 of their length."""
    length, width = size[0], size[1]
    given = subject.physics
    mass = contact.masses.get(subject.object_id, given.mass if given else None)
    if mass is None:
        mass = default_mass(subject.category, size)
    if given is not None and given.friction is not None:
        friction = given.friction
    rolls = subject.category in ROLLING
    return Solid(
        mass=mass,
        inertia=mass * (length * length + width * width) / 12,
        length=length,
        width=width,
        axles=(0.3 * length, 0.3 * length) if rolls else None,
        friction=friction,
        drag=STRUCK_DRAG if rolls else 0.0,
    )


def ego_solid(spec: EgoSpec, size: tuple[float, float, float]) -> Solid:
    """The controlled vehicle as a rigid body."""
    vehicle = vehicle_of(spec)
    return Solid(
        mass=vehicle.mass,
        inertia=vehicle.inertia,
        length=size[0],
        width=size[1],
        box_ahead=size[0] / 2 - REAR_OVERHANG - vehicle.rear,
        axles=(vehicle.front, vehicle.rear),
        friction=vehicle.friction,
        drag=0.015,
    )


def ego_body(motion: Motion, spec: EgoSpec) -> Body:
    """The body of a vehicle in motion."""
    rear = vehicle_of(spec).rear
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)
    across = motion.lateral_speed + rear * motion.yaw_rate
    return Body(
        x=motion.x + rear * cos,
        y=motion.y + rear * sin,
        yaw=motion.yaw,
        vx=motion.speed * cos - across * sin,
        vy=motion.speed * sin + across * cos,
        turn=motion.yaw_rate,
    )


def ego_motion(body: Body, before: Motion, spec: EgoSpec) -> Motion:
    """The motion of a body; steering and actuators as they were."""
    rear = vehicle_of(spec).rear
    cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    return before._replace(
        x=body.x - rear * cos,
        y=body.y - rear * sin,
        yaw=body.yaw,
        speed=body.vx * cos + body.vy * sin,
        lateral_speed=body.vy * cos - body.vx * sin - rear * body.turn,
        yaw_rate=body.turn,
    )


def rolls_again(motion: Motion, spec: EgoSpec) -> bool:
    """Whether a vehicle that was pushed goes where its wheels point again."""
    steered = motion.speed * math.tan(motion.steering) / spec.wheelbase
    return abs(motion.lateral_speed) < 0.2 and abs(motion.yaw_rate - steered) < 0.1
