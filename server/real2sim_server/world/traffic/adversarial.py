"""Road users that make it hard for the ego: they cut in, brake, or cross.

After the side, front and stationary scenarios of NeuroNCAP (Ljungbergh et al. 2024) and the
attacking agents of HUGSIM (Zhou et al. 2024), with closed rules instead of sampled trajectories.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

from real2sim_proto.episode import CutInDriver, HardBrakeDriver, JunctionCrossingDriver

from ...edit import ObjectState
from ...scene import Ground
from ..path import LoggedPath
from .driver import AgentPose, Surroundings, level_quaternion, pose_on_path, recorded_pose
from .idm import advance_along

PACE = 1.0
"""Time constant with which a car beside the ego closes up to its place [s]."""
PACE_ACCELERATION = 4.0
CUT_BRAKING = 3.0
"""Acceleration limits of the car that cuts in, before and after it does [m/s^2]."""


@dataclass(frozen=True, eq=False)
class CutIn:
    """Keeps its place beside the ego's route ahead of the ego, then swerves in front of it.

    Attributes:
        subject, spec: the object and its parameters.
        s, offset, speed: along and beside the ego's route [m], [m/s].
        began: offset and speed when it began to move in, and for how long it has [s]; or None.
        pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    spec: CutInDriver
    s: float
    offset: float
    speed: float
    pose: AgentPose
    began: tuple[float, float, float] | None = None
    present: bool = True

    @classmethod
    def begin(cls, subject: ObjectState, spec: CutInDriver, surroundings: Surroundings) -> CutIn:
        """Beside the ego, ``gap`` ahead of it and as fast."""
        s = surroundings.ego.s + surroundings.ego.front + spec.gap + subject.scaled_size[0] / 2
        speed = surroundings.ego.speed
        pose = _on_route(surroundings, subject, (s, spec.offset), (speed, 0.0))
        return cls(subject, spec, s, spec.offset, speed, pose)

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        began = self.began
        place = (
            surroundings.ego.s
            + surroundings.ego.front
            + self.spec.gap
            + self.subject.scaled_size[0] / 2
        )
        if began is None and surroundings.elapsed >= self.spec.delay and abs(place - self.s) < 2.0:
            began = (self.offset, max(surroundings.ego.speed + self.spec.speed_change, 0.0), 0.0)
        if began is None:
            wanted = surroundings.ego.speed + (place - self.s) / PACE
            rate = _towards(self.speed, wanted, PACE_ACCELERATION, surroundings.dt)
            offset = self.offset
        else:
            start, after, since = began
            began = (start, after, since + surroundings.dt)
            offset = start * (1.0 - _smooth(began[2] / self.spec.duration))
            rate = _towards(self.speed, after, CUT_BRAKING, surroundings.dt)
        s, speed = advance_along(self.s, self.speed, rate, surroundings.dt)
        drift = (offset - self.offset) / surroundings.dt
        pose = _on_route(surroundings, self.subject, (s, offset), (speed, drift))
        return replace(self, s=s, speed=speed, offset=offset, began=began, pose=pose)


@dataclass(frozen=True, eq=False)
class HardBrake:
    """Drives its recorded path as recorded, until it brakes to a stop in front of the ego.

    Attributes:
        subject, spec: the object and its parameters.
        path: recorded.
        s, speed: along it [m], [m/s].
        braking: whether it has begun to.
        pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    spec: HardBrakeDriver
    path: LoggedPath
    s: float
    speed: float
    pose: AgentPose
    braking: bool = False
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, spec: HardBrakeDriver, surroundings: Surroundings
    ) -> HardBrake:
        """From where and how the object moves now."""
        path, now = LoggedPath(subject.trajectory), recorded_pose(subject, surroundings.t_us)
        near = path.nearest(now.position[0], now.position[1])
        speed = math.hypot(now.velocity[0], now.velocity[1])
        return cls(subject, spec, path, near.s, speed, now)

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        braking = self.braking or (
            surroundings.elapsed >= self.spec.delay and self._near(surroundings)
        )
        t_us, trajectory = surroundings.t_us + surroundings.dt_us, self.subject.trajectory
        if not braking and t_us <= trajectory.end_us:
            now = recorded_pose(self.subject, t_us)
            near = self.path.nearest(now.position[0], now.position[1], near_s=self.s)
            speed = math.hypot(now.velocity[0], now.velocity[1])
            return replace(self, s=near.s, speed=speed, pose=now)
        s, speed = advance_along(
            self.s, self.speed, -self.spec.braking if braking else 0.0, surroundings.dt
        )
        pose = pose_on_path(self.path, s, speed)
        return replace(self, s=s, speed=speed, pose=pose, braking=braking)

    def _near(self, surroundings: Surroundings) -> bool:
        """Whether the ego is behind, in the same lane, within the distance that triggers."""
        ego, (x, y, _), yaw = surroundings.ego, self.pose.position, self.pose.yaw
        dx, dy = x - ego.x, y - ego.y
        ahead_of = dx * math.cos(yaw) + dy * math.sin(yaw)
        # The path may begin here; then the line straight back from it counts.
        aside = abs(self.path.nearest(ego.x, ego.y).offset)
        gap = ahead_of - (self.subject.scaled_size[0] + ego.length) / 2
        return aside < 3.0 and 0.0 <= gap <= self.spec.gap


@dataclass(frozen=True, eq=False)
class JunctionCrossing:
    """Crosses the ego's route on a straight line, timed so that both are there at once.

    Attributes:
        subject, spec: the object and its parameters.
        crossing_s: of the crossing point along the route [m].
        crossing: the point x, y [m].
        heading: of its line [rad].
        left: way to the crossing point, negative beyond it [m].
        speed: [m/s].
        pose, present: see :class:`~.driver.AgentDriver`.
    """

    subject: ObjectState
    spec: JunctionCrossingDriver
    crossing_s: float
    crossing: tuple[float, float]
    heading: float
    left: float
    speed: float
    pose: AgentPose
    present: bool = True

    @classmethod
    def begin(
        cls, subject: ObjectState, spec: JunctionCrossingDriver, surroundings: Surroundings
    ) -> JunctionCrossing:
        """As far from the crossing as it goes at its speed in the time the ego needs."""
        crossing_s = surroundings.ego.s + spec.ahead
        x, y, _, yaw = surroundings.route.at(crossing_s)
        eta = (spec.ahead - surroundings.ego.front) / max(surroundings.ego.speed, 1.0)
        made = cls(
            subject=subject,
            spec=spec,
            crossing_s=crossing_s,
            crossing=(x, y),
            heading=yaw + spec.angle,
            left=max(eta, 0.0) * spec.speed,
            speed=spec.speed,
            pose=recorded_pose(subject, subject.trajectory.start_us),
        )
        return replace(made, pose=made._placed(made.left, made.speed, surroundings.ground))

    def advance(self, surroundings: Surroundings) -> Self:
        """The driver one step later."""
        eta = (self.crossing_s - surroundings.ego.s - surroundings.ego.front) / max(
            surroundings.ego.speed, 0.5
        )
        rate = 0.0
        if self.left > 0.0 and eta > self.spec.commit:
            wanted = min(self.left / eta, self.spec.max_speed)
            rate = _towards(self.speed, wanted, self.spec.acceleration, surroundings.dt)
        way, speed = advance_along(0.0, self.speed, rate, surroundings.dt)
        left = self.left - way
        pose = self._placed(left, speed, surroundings.ground)
        return replace(self, left=left, speed=speed, pose=pose)

    def _placed(self, left: float, speed: float, ground: Ground) -> AgentPose:
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        x, y = self.crossing[0] - left * cos, self.crossing[1] - left * sin
        return AgentPose(
            (x, y, ground.height(x, y) + self.subject.scaled_size[2] / 2),
            level_quaternion(self.heading),
            self.heading,
            (speed * cos, speed * sin, 0.0),
        )


def _on_route(
    surroundings: Surroundings,
    subject: ObjectState,
    place: tuple[float, float],
    moving: tuple[float, float],
) -> AgentPose:
    """An object beside the ego's route, standing on the ground.

    Args:
        surroundings: has the route.
        subject: the object.
        place: along the route and to its left [m].
        moving: speed along it and to its left [m/s].
    """
    s, offset = place
    pose = pose_on_path(surroundings.route, s, moving[0], offset=offset, drift=moving[1])
    x, y, _ = pose.position
    z = surroundings.ground.height(x, y) + subject.scaled_size[2] / 2
    return pose._replace(position=(x, y, z))


def _towards(speed: float, wanted: float, most: float, dt: float) -> float:
    """Acceleration [m/s^2] to a wanted speed within a limit."""
    return min(max((wanted - speed) / dt, -most), most)


def _smooth(progress: float) -> float:
    """0 to 1 with slopes and curvatures of 0 at both ends: a lane change in unit time."""
    u = min(max(progress, 0.0), 1.0)
    return u * u * u * (10 - 15 * u + 6 * u * u)
