"""Ego and objects as planar rigid bodies, and the impacts between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

from real2sim_proto.episode import ContactSpec, EgoSpec

from ...edit import ObjectState
from ...simulation.structure import STRUCTURES, default_mass, stiffness_of, yaw_inertia
from ..boxes import REAR_OVERHANG
from ..driving import GRAVITY, vehicle_parameters
from ..ego_motion import Motion
from ..scoring.instant import Side
from ..traffic.driver import AgentPose, Surroundings

# --- Rigid bodies --------------------------------------------------------------------------------

# State, impulses, and sliding to rest.

SLIDING_SLIP = 0.1
"""Slip angle at which a tyre of a sliding car reaches its maximum friction [rad]."""

CREEP = 0.5
"""Speed below which friction decreases, so that bodies come to rest smoothly [m/s]."""

AT_REST = 0.05
"""Speed, or yaw rate times half the length, below which a body without drive is at rest [m/s]."""


@dataclass(frozen=True)
class BodyProperties:
    """Mass, shape, friction and stiffness of a body.

    Attributes:
        mass: [kg].
        inertia: about the vertical axis through the centre of mass [kg m^2].
        length, width: size of its box [m].
        box_ahead: distance from the centre of mass forward to the box centre [m].
        axles: distances of front and rear axle from the centre of mass [m]; None for bodies
            without wheels, which slide isotropically.
        friction: friction coefficient of tyres or body on the ground.
        drag: rolling deceleration per gravity.
        stiffness: stiffness of front, rear and sides per crushed width [N/m^2].
        vehicle: whether it has the crush characteristic of a vehicle.
    """

    mass: float
    inertia: float
    length: float
    width: float
    box_ahead: float = 0.0
    axles: tuple[float, float] | None = None
    friction: float = 0.7
    drag: float = 0.0
    stiffness: tuple[float, float, float] = (474e3, 430e3, 870e3)
    vehicle: bool = True

    def shortened(self, front: float, rear: float) -> BodyProperties:
        """The body with its front and rear shortened [m]."""
        length, ahead = self.length - front - rear, self.box_ahead + (rear - front) / 2
        return replace(self, length=length, box_ahead=ahead)


class BodyState(NamedTuple):
    """Planar state: centre of mass [m], heading [rad], world velocity [m/s], yaw rate [rad/s]."""

    x: float
    y: float
    yaw: float
    vx: float
    vy: float
    turn: float

    def velocity_at(self, x: float, y: float) -> tuple[float, float]:
        """World velocity [m/s] of the body point at (x, y)."""
        return self.vx - self.turn * (y - self.y), self.vy + self.turn * (x - self.x)

    def pushed(
        self, properties: BodyProperties, x: float, y: float, jx: float, jy: float
    ) -> BodyState:
        """The body after an impulse [N s] at (x, y)."""
        moment = (x - self.x) * jy - (y - self.y) * jx
        return self._replace(
            vx=self.vx + jx / properties.mass,
            vy=self.vy + jy / properties.mass,
            turn=self.turn + moment / properties.inertia,
        )

    def energy(self, properties: BodyProperties) -> float:
        """Kinetic energy [J]."""
        linear = properties.mass * (self.vx * self.vx + self.vy * self.vy)
        return (linear + properties.inertia * self.turn * self.turn) / 2


def integrate_sliding(
    body: BodyState,
    properties: BodyProperties,
    h: float,
    *,
    acceleration: float = 0.0,
    steering: float = 0.0,
) -> BodyState:
    """The body ``h`` seconds later, with rolling, slipping or sliding wheels.

    The lateral tyre force grows with the slip angle up to the friction limit, reduced by the
    longitudinal force (friction circle). Load transfer is neglected: after an impact the force
    directions are far less certain than the loads.

    Args:
        body, properties: the body.
        h: duration, at most 10 ms [s].
        acceleration: by engine or brakes, along the front wheels' axle frame [m/s^2].
        steering: road-wheel angle of the front axle [rad].
    """
    n = max(math.ceil(h / 0.005 - 1e-9), 1)
    for _ in range(n):
        body = _step(body, properties, h / n, acceleration, steering)
    return body


def _step(
    body: BodyState, properties: BodyProperties, h: float, acceleration: float, steering: float
) -> BodyState:
    if properties.axles is None:
        fx, fy, moment = _sliding_force(body, properties)
    else:
        fx, fy, moment = _wheel_forces(body, properties, acceleration, steering)
    vx, vy = body.vx + h * fx / properties.mass, body.vy + h * fy / properties.mass
    turn = body.turn + h * moment / properties.inertia
    resting = math.hypot(vx, vy) < AT_REST and abs(turn) * properties.length / 2 < AT_REST
    if resting and acceleration <= 0.0:
        vx = vy = turn = 0.0
    return BodyState(body.x + h * vx, body.y + h * vy, body.yaw + h * turn, vx, vy, turn)


def _sliding_force(body: BodyState, properties: BodyProperties) -> tuple[float, float, float]:
    """Force [N] and moment [N m] on a body that slides on the ground."""
    speed = math.hypot(body.vx, body.vy)
    grip = properties.friction * properties.mass * GRAVITY / max(speed, CREEP)
    reach = max(properties.length, properties.width) / 3
    spin = (
        properties.friction * properties.mass * GRAVITY * reach / max(abs(body.turn) * reach, CREEP)
    )
    return -grip * body.vx, -grip * body.vy, -spin * reach * body.turn


def _wheel_forces(
    body: BodyState, properties: BodyProperties, acceleration: float, steering: float
) -> tuple[float, float, float]:
    """Force [N] and moment [N m] on a body with a steered front axle and a straight rear axle."""
    assert properties.axles is not None
    front, rear = properties.axles
    wheelbase = front + rear
    total_x = total_y = moment = 0.0
    for ahead, load_fraction, angle in ((front, rear, steering), (-rear, front, 0.0)):
        cos, sin = math.cos(body.yaw + angle), math.sin(body.yaw + angle)
        x, y = body.x + ahead * math.cos(body.yaw), body.y + ahead * math.sin(body.yaw)
        vx, vy = body.velocity_at(x, y)
        rolling, slipping = vx * cos + vy * sin, vy * cos - vx * sin
        load = properties.mass * GRAVITY * load_fraction / wheelbase
        along, across = _tyre_force(rolling, slipping, load, properties, acceleration)
        fx, fy = along * cos - across * sin, along * sin + across * cos
        total_x, total_y = total_x + fx, total_y + fy
        moment += (x - body.x) * fy - (y - body.y) * fx
    return total_x, total_y, moment


def _tyre_force(
    rolling: float, slipping: float, load: float, properties: BodyProperties, acceleration: float
) -> tuple[float, float]:
    """Force [N] along and across a wheel."""
    limit = properties.friction * load
    fade = min(max(rolling / CREEP, -1.0), 1.0)
    brakes = acceleration < 0.0
    driven = (-abs(acceleration) * fade if brakes else acceleration) / GRAVITY
    along = min(max((driven - properties.drag * fade) * load, -limit), limit)
    left = math.sqrt(max(limit * limit - along * along, 0.0))
    angle = math.atan2(slipping, max(abs(rolling), CREEP))
    return along, -left * min(max(angle / SLIDING_SLIP, -1.0), 1.0)


ROLLING = frozenset({"car", "vehicle", "van", "truck", "bus"})
IMPACTED_DRAG = 0.15
"""Deceleration per gravity of a car along its wheels after an impact: out of gear, damaged,
unbraked."""


@dataclass(frozen=True, eq=False)
class ImpactedObject:
    """An object under physics control after an impact; an :class:`~..traffic.driver.AgentDriver`.

    Attributes:
        subject: the object before the impact.
        properties, body: rigid body.
        height: height of its box centre above the ground [m].
        pose: see :class:`~..traffic.driver.AgentDriver`.
    """

    subject: ObjectState
    properties: BodyProperties
    body: BodyState
    height: float
    pose: AgentPose
    present: bool = True

    def advance(self, surroundings: Surroundings) -> Self:
        """Returns itself; the collision solver moves it together with all other bodies."""
        return self

    def at(self, body: BodyState, pose: AgentPose, properties: BodyProperties) -> Self:
        """The object at another pose, with its shortened box."""
        return replace(self, body=body, pose=pose, properties=properties)


def object_properties(
    subject: ObjectState, contact: ContactSpec, *, friction: float, size: tuple[float, ...]
) -> BodyProperties:
    """An object as a rigid body.

    Objects other than vehicles have uniform density. The axles of cars are at 0.3 of their length
    from the centre.
    """
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
    """The ego motion of a body, with steering and actuators of ``before``."""
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
    """Whether a pushed vehicle rolls in the direction of its wheels again."""
    steered = motion.speed * math.tan(motion.steering) / spec.wheelbase
    return abs(motion.lateral_speed) < 0.2 and abs(motion.yaw_rate - steered) < 0.1


# --- Impacts -------------------------------------------------------------------------------------

MUTUAL_STIFFNESS = 405e3
"""Series stiffness of two cars for instantaneous impacts [N/m]: 405 +- 139 kN/m (Bonugli et al.
2017)."""


class ImpactParticipant(NamedTuple):
    """A body at the start of an impact; ``low``, ``high``: bottom and top of its box [m]."""

    properties: BodyProperties
    body: BodyState
    low: float
    high: float


@dataclass(frozen=True)
class Impact:
    """Impulse, energy loss and velocity changes of two bodies in one clock step.

    Attributes:
        object_id: id of the object; None for the background.
        other_id: id of the second object if the ego is not involved; else None.
        t_us: time of the step [us].
        point: centre of the contact at its start, world frame [m].
        normal: contact normal, out of the object into the other body.
        approach_speed: closing speed along the normal at the start [m/s].
        relative_speed: relative speed of the two centres [m/s].
        impulse: impulse on the ego, or on ``other_id``, summed over the step [N s].
        delta_v, object_delta_v: magnitude of the velocity change of the ego (or ``other_id``) and
            of the object [m/s].
        energy: kinetic energy lost [J].
        whole: magnitude of the impulse of the complete impact [N s], with its ``delta_v``,
            ``object_delta_v`` and ``energy``, by instantaneous impulse mechanics; None if the
            impact is instantaneous or started in an earlier step.
        stiffness: stiffness of the crushed structure [N/m].
        breadth: extent of the background to both sides of the point, across the normal [m]; None
            if it is not involved.
        side: side of the ego at which the contact started.
        speeds: speeds of the first body and of the object at the start [m/s].
        began_us: start time in this step [us].
        since: the same as a fraction of the step.
        participants: the ego (or ``other_id``) and the object at the start; None for the
            background.
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
    since: float = 1.0
    participants: tuple[ImpactParticipant, ImpactParticipant | None] | None = None
    whole: float | None = None
    stiffness: float = MUTUAL_STIFFNESS
    breadth: tuple[float, float] | None = None

    @property
    def crush(self) -> float:
        """Total crush depth of both bodies [m], if all lost energy went into a linear spring."""
        return math.sqrt(2 * max(self.energy, 0.0) / self.stiffness)

    def event_data(self) -> dict[str, float]:
        """Data of its event on the wire."""
        return {
            "relative_speed": self.relative_speed,
            "approach_speed": self.approach_speed,
            "impulse": math.hypot(*self.impulse) if self.whole is None else self.whole,
            "delta_v": self.delta_v,
            "object_delta_v": self.object_delta_v,
            "energy": self.energy,
            "crush": self.crush,
            "contact_us": float(self.began_us),
            "x": self.point[0],
            "y": self.point[1],
        }
