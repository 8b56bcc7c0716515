"""Rigid bodies on the plane, and how they slide to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from ..driving import GRAVITY

SLIDING_SLIP = 0.1
"""Slip angle from which on a tyre of a sliding car gives all its friction [rad]."""

CREEP = 0.5
"""Speed below which friction fades, so that bodies come to rest without a jerk [m/s]."""

AT_REST = 0.05
"""Speed, and yaw rate times half a length, below which a body without drive is at rest [m/s]."""


@dataclass(frozen=True)
class Solid:
    """What does not change about a body.

    Attributes:
        mass: [kg].
        inertia: about the vertical axis through the centre of mass [kg m^2].
        length, width: of its box [m].
        box_ahead: from the centre of mass forward to the centre of the box [m].
        axles: distances of front and rear axle from the centre of mass [m]; None for bodies
            without wheels, which slide alike in all directions.
        friction: of tyres or body on the ground.
        drag: deceleration per gravity along rolling wheels.
    """

    mass: float
    inertia: float
    length: float
    width: float
    box_ahead: float = 0.0
    axles: tuple[float, float] | None = None
    friction: float = 0.7
    drag: float = 0.0


class Body(NamedTuple):
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

    def pushed(self, solid: Solid, x: float, y: float, jx: float, jy: float) -> Body:
        """The body after an impulse [N s] at (x, y)."""
        moment = (x - self.x) * jy - (y - self.y) * jx
        return self._replace(
            vx=self.vx + jx / solid.mass,
            vy=self.vy + jy / solid.mass,
            turn=self.turn + moment / solid.inertia,
        )

    def energy(self, solid: Solid) -> float:
        """Kinetic energy [J]."""
        linear = solid.mass * (self.vx * self.vx + self.vy * self.vy)
        return (linear + solid.inertia * self.turn * self.turn) / 2


def integrate_sliding(
    body: Body, solid: Solid, h: float, *, acceleration: float = 0.0, steering: float = 0.0
) -> Body:
    """The body ``h`` seconds later, its wheels rolling, slipping or sliding.

    A tyre's lateral force grows with the slip angle up to the friction limit, less what drag,
    brakes or engine take of the friction circle. Load transfer is left out: after an impact the
    directions of all forces are far less certain than the loads.

    Args:
        body, solid: the body.
        h: at most 10 ms.
        acceleration: by engine or brakes, along the front wheels' axle frame [m/s^2].
        steering: road-wheel angle of the front axle [rad].
    """
    n = max(math.ceil(h / 0.005 - 1e-9), 1)
    for _ in range(n):
        body = _step(body, solid, h / n, acceleration, steering)
    return body


def _step(body: Body, solid: Solid, h: float, acceleration: float, steering: float) -> Body:
    if solid.axles is None:
        fx, fy, moment = _dragged(body, solid)
    else:
        fx, fy, moment = _rolled(body, solid, acceleration, steering)
    vx, vy = body.vx + h * fx / solid.mass, body.vy + h * fy / solid.mass
    turn = body.turn + h * moment / solid.inertia
    resting = math.hypot(vx, vy) < AT_REST and abs(turn) * solid.length / 2 < AT_REST
    if resting and acceleration <= 0.0:
        vx = vy = turn = 0.0
    return Body(body.x + h * vx, body.y + h * vy, body.yaw + h * turn, vx, vy, turn)


def _dragged(body: Body, solid: Solid) -> tuple[float, float, float]:
    """Force [N] and moment [N m] on a body that slides on the ground."""
    speed = math.hypot(body.vx, body.vy)
    grip = solid.friction * solid.mass * GRAVITY / max(speed, CREEP)
    reach = max(solid.length, solid.width) / 3
    spin = solid.friction * solid.mass * GRAVITY * reach / max(abs(body.turn) * reach, CREEP)
    return -grip * body.vx, -grip * body.vy, -spin * reach * body.turn


def _rolled(
    body: Body, solid: Solid, acceleration: float, steering: float
) -> tuple[float, float, float]:
    """Force [N] and moment [N m] on a body with a steered front axle and a straight rear axle."""
    assert solid.axles is not None
    front, rear = solid.axles
    wheelbase = front + rear
    total_x = total_y = moment = 0.0
    for ahead, load_share, angle in ((front, rear, steering), (-rear, front, 0.0)):
        cos, sin = math.cos(body.yaw + angle), math.sin(body.yaw + angle)
        x, y = body.x + ahead * math.cos(body.yaw), body.y + ahead * math.sin(body.yaw)
        vx, vy = body.velocity_at(x, y)
        rolling, slipping = vx * cos + vy * sin, vy * cos - vx * sin
        load = solid.mass * GRAVITY * load_share / wheelbase
        along, across = _tyre(rolling, slipping, load, solid, acceleration)
        fx, fy = along * cos - across * sin, along * sin + across * cos
        total_x, total_y = total_x + fx, total_y + fy
        moment += (x - body.x) * fy - (y - body.y) * fx
    return total_x, total_y, moment


def _tyre(
    rolling: float, slipping: float, load: float, solid: Solid, acceleration: float
) -> tuple[float, float]:
    """Force [N] along and across a wheel."""
    limit = solid.friction * load
    fade = min(max(rolling / CREEP, -1.0), 1.0)
    brakes = acceleration < 0.0
    driven = (-abs(acceleration) * fade if brakes else acceleration) / GRAVITY
    along = min(max((driven - solid.drag * fade) * load, -limit), limit)
    left = math.sqrt(max(limit * limit - along * along, 0.0))
    angle = math.atan2(slipping, max(abs(rolling), CREEP))
    return along, -left * min(max(angle / SLIDING_SLIP, -1.0), 1.0)
