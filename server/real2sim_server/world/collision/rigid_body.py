"""Rigid bodies on the plane: state, impulses, and sliding to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from ..driving import GRAVITY

SLIDING_SLIP = 0.1
"""Slip angle from which on a tyre of a sliding car gives all its friction [rad]."""

CREEP = 0.5
"""Speed below which friction fades, so that bodies come to rest without a jerk [m/s]."""

AT_REST = 0.05
"""Speed, and yaw rate times half a length, below which a body without drive is at rest [m/s]."""


@dataclass(frozen=True)
class BodyProperties:
    """Mass, shape and friction of a body.

    Attributes:
        mass: [kg].
        inertia: about the vertical axis through the centre of mass [kg m^2].
        length, width: of its box [m].
        box_ahead: from the centre of mass forward to the centre of the box [m].
        axles: distances of front and rear axle from the centre of mass [m]; None for bodies
            without wheels, which slide alike in all directions.
        friction: of tyres or body on the ground.
        drag: deceleration per gravity along rolling wheels.
        stiffness: of its front, rear and sides, per width of what is crushed [N/m^2].
        vehicle: whether it yields as a vehicle does.
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
        """With its ends so much nearer to its middle [m]."""
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
        """World velocity [m/s] of the body's point that is at (x, y)."""
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
    """The body ``h`` seconds later, its wheels rolling, slipping or sliding.

    A tyre's lateral force grows with the slip angle up to the friction limit, less what drag,
    brakes or engine take of the friction circle. Load transfer is left out: after an impact the
    directions of all forces are far less certain than the loads.

    Args:
        body, properties: the body.
        h: at most 10 ms.
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
