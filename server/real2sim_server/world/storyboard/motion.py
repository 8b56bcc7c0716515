"""Motion of entities: transition shapes, lateral and longitudinal controllers, integration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from real2sim_proto.episode import IdmDriver
from real2sim_proto.storyboard_actions import (
    Dynamics,
    LateralDistanceAction,
    LongitudinalDistanceAction,
    Shape,
    SpeedLimits,
)

from ..common import copy_with
from ..traffic.driver import acceleration as idm_acceleration
from ..traffic.driver import advance_along, leading_agent
from .roads import Place
from .view import (
    EntityState,
    Moved,
    Shifted,
    View,
    across,
    coasting,
    distance_ahead,
    offsets,
)

STEEPEST = {"linear": 1.0, "cubic": 1.5, "sinusoidal": math.pi / 2, "quintic": 1.875}
"""Maximum slope of each shape f(u), u from 0 to 1."""

CURVIEST = {
    "linear": 6.0, "cubic": 6.0, "sinusoidal": math.pi**2 / 2, "quintic": 10.0 / math.sqrt(3.0),
}  # fmt: skip
"""Maximum second derivative of each shape; linear, whose ends have none, takes that of cubic."""


def progress(shape: Shape, u: float) -> float:
    """f(u): 0 to 1 for u from 0 to 1, see :class:`Dynamics`."""
    if shape == "step" or u >= 1.0:
        return 1.0
    u = max(u, 0.0)
    if shape == "linear":
        return u
    if shape == "cubic":
        return u * u * (3.0 - 2.0 * u)
    if shape == "sinusoidal":
        return (1.0 - math.cos(math.pi * u)) / 2.0
    return u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)


def integral(shape: Shape, u: float) -> float:
    """F(u), the integral of f from 0 to u; f is 1 beyond u = 1."""
    if shape == "step":
        return u
    if u >= 1.0:
        return 0.5 + (u - 1.0)
    u = max(u, 0.0)
    if shape == "linear":
        return u * u / 2.0
    if shape == "cubic":
        return u**3 - u**4 / 2.0
    if shape == "sinusoidal":
        return u / 2.0 - math.sin(math.pi * u) / (2.0 * math.pi)
    return 2.5 * u**4 - 3.0 * u**5 + u**6


def duration(dynamics: Dynamics, change: float) -> float:
    """Duration of a change by time or rate [s]; 0 for a step. Not for the dimension 'distance'."""
    value = float(dynamics.value)
    if dynamics.shape == "step" or change == 0.0:
        return 0.0
    if dynamics.dimension == "time":
        return value
    return duration_at(dynamics.shape, change, value) if value > 0 else 0.0


def duration_at(shape: Shape, change: float, rate: float) -> float:
    """Duration of a change whose rate is ``rate`` at most [s]; not for a step."""
    return STEEPEST[shape] * abs(change) / max(rate, 1e-6)


def gentle_duration(shape: Shape, change: float, acceleration: float | None) -> float:
    """Duration of a change with a limited second derivative [s]; 0 for a step."""
    if shape == "step" or acceleration is None or change == 0.0:
        return 0.0
    return math.sqrt(CURVIEST[shape] * abs(change) / max(acceleration, 1e-6))


@dataclass(frozen=True)
class OffsetChange:
    """Changes the offset with a shape over time or distance.

    The speed is that of the whole motion, or that along the path (``beside``).
    """

    token: int
    shape: Shape
    start: float
    end: float
    extent: float
    by_way: bool = False
    beside: bool = False
    done: float = 0.0

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """The change after ``h`` seconds and ``way`` metres."""
        done = self.done + (abs(way) if self.by_way else h)
        u = done / self.extent
        offset = self.start + (self.end - self.start) * progress(self.shape, u)
        return Shifted(offset, None if u >= 1.0 - DONE else replace(self, done=done))


@dataclass(frozen=True)
class FollowOffset:
    """Keeps a lateral distance to another entity."""

    token: int
    other: str
    value: float

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """The change after ``h`` seconds and ``way`` metres."""
        return Shifted(offset_of(view.entities[self.other], actor, view, self.value), self)


@dataclass(frozen=True)
class HoldOffset:
    """Keeps its offset from the lane centre."""

    token: int
    value: float

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """The change after ``h`` seconds and ``way`` metres."""
        return Shifted(self.value, self)


@dataclass(frozen=True)
class KeepAside:
    """Keeps a lateral distance to another entity, within limits of speed and acceleration."""

    token: int
    action: LateralDistanceAction
    side: float

    def step(self, actor: EntityState, view: View, way: float, h: float) -> Shifted:
        """The change after ``h`` seconds and ``way`` metres."""
        other, limits = view.entities[self.action.entity], self.action.limits
        distance = float(self.action.distance)
        if self.action.freespace:
            distance += (actor.size[1] + other.size[1]) / 2
        yaw = actor.h if actor.way is None else actor.way.path.at(actor.s)[3]
        now = across(yaw, actor.x - other.x, actor.y - other.y)
        error = self.side * distance - now
        speed = math.inf if limits.speed is None else float(limits.speed)
        if limits.acceleration is not None:
            # Limited by braking before the target and by the acceleration so far.
            gain = float(limits.acceleration)
            speed = min(speed, math.sqrt(2.0 * gain * abs(error)), abs(actor.drift) + gain * h)
        step = min(max(error, -speed * h), speed * h)
        there = abs(error - step) < AT_PLACE
        return Shifted(actor.offset + step, None if there and not self.action.continuous else self)


def offset_of(other: EntityState, actor: EntityState, view: View, left: float) -> float:
    """Offset from an entity's path of a place ``left`` metres to the left of another entity [m]."""
    to_other = offsets(actor, Place(other.x, other.y, other.h), "lane", view.network)[1]
    return actor.offset + to_other + math.copysign(left, left * math.cos(other.h - actor.h))


DONE = 1e-9
"""Times and distances below this count as zero [s], [m]."""

AT_PLACE, AT_SPEED = 0.05, 0.05
"""Tolerances of a target distance and speed [m], [m/s]."""

MIN_MASTER_SPEED = 0.05
"""Minimum speed of a master with a known arrival time [m/s]."""


@dataclass(frozen=True)
class SpeedChange:
    """Changes the speed with a shape over time."""

    token: int
    shape: Shape
    start: float
    end: float
    duration: float
    elapsed: float = 0.0

    def step(self, actor: EntityState, view: View, h: float) -> Moved:
        """The motion after ``h`` seconds; the distance is the integral of the speed."""
        before, after = self.elapsed / self.duration, (self.elapsed + h) / self.duration
        change = self.end - self.start
        covered = integral(self.shape, after) - integral(self.shape, before)
        way = self.start * h + change * self.duration * covered
        speed = self.start + change * progress(self.shape, after)
        over = after >= 1.0 - DONE
        return Moved(way, speed, None if over else replace(self, elapsed=self.elapsed + h))


@dataclass(frozen=True)
class SpeedCourse:
    """Follows speeds at times since its start, linear in between."""

    token: int
    points: tuple[tuple[float, float], ...]
    elapsed: float = 0.0

    def step(self, actor: EntityState, view: View, h: float) -> Moved:
        """The motion after ``h`` seconds."""
        t0, t1 = self.elapsed, self.elapsed + h
        inner = [t for t, _ in self.points if t0 < t < t1]
        times = [t0, *inner, t1]
        speeds = [self._speed(t) for t in times]
        way = sum(
            (b - a) * (u + v) / 2
            for a, b, u, v in zip(times, times[1:], speeds, speeds[1:], strict=False)
        )
        over = t1 >= self.points[-1][0] - DONE
        return Moved(way, speeds[-1], None if over else replace(self, elapsed=t1))

    def _speed(self, t: float) -> float:
        for (a, u), (b, v) in zip(self.points, self.points[1:], strict=False):
            if t <= b:
                return v if b <= a else u + (v - u) * (t - a) / (b - a)
        return self.points[-1][1]


@dataclass(frozen=True)
class FollowSpeed:
    """Changes to a speed relative to another entity's current speed, and keeps it if continuous.

    The speed changes within the performance of the entity.
    """

    token: int
    other: str
    relation: str
    value: float
    dynamics: Dynamics
    start: float
    continuous: bool
    elapsed: float = 0.0

    def wanted(self, view: View) -> float:
        """Target speed at this instant [m/s]."""
        speed = view.entities[self.other].speed
        return speed + self.value if self.relation == "delta" else speed * self.value

    def step(self, actor: EntityState, view: View, h: float) -> Moved:
        """The motion after ``h`` seconds."""
        target, elapsed = self.wanted(view), self.elapsed + h
        speed, seconds = target, speed_duration(self.dynamics, self.start, target)
        if elapsed < seconds - DONE:
            share = progress(self.dynamics.shape, elapsed / seconds)
            speed = self.start + (target - self.start) * share
        end = within_performance(actor, speed, h)
        reached = elapsed >= seconds - DONE and abs(end - target) <= DONE
        then = None if reached and not self.continuous else replace(self, elapsed=elapsed)
        return Moved((actor.speed + end) / 2 * h, end, then)


def speed_duration(dynamics: Dynamics, start: float, end: float) -> float:
    """Duration of a speed change [s].

    All shapes have the mean of both speeds as their mean, so a distance determines the duration.
    """
    if dynamics.dimension != "distance" or dynamics.shape == "step":
        return duration(dynamics, end - start)
    mean = (start + end) / 2
    return float(dynamics.value) / mean if mean > 0 else 0.0


def within_performance(actor: EntityState, speed: float, h: float) -> float:
    """Speed after ``h`` seconds towards a wanted speed, within the limits of the entity."""
    limits = actor.performance
    if limits.speed is not None:
        speed = min(max(speed, -float(limits.speed)), float(limits.speed))
    if limits.deceleration is not None:
        speed = max(speed, actor.speed - float(limits.deceleration) * h)
    if limits.acceleration is not None:
        speed = min(speed, actor.speed + float(limits.acceleration) * h)
    return speed


@dataclass(frozen=True)
class KeepDistance:
    """Keeps a distance or time gap along the road to another entity."""

    token: int
    action: LongitudinalDistanceAction
    leading: bool

    def step(self, actor: EntityState, view: View, h: float) -> Moved:
        """The motion after ``h`` seconds, as fast as the limits allow without overshoot."""
        other, error = view.entities[self.action.entity], self.error(actor, view)
        closing = error + other.speed * h
        limits = self.action.limits
        if limits.acceleration is None and limits.deceleration is None:
            # Unlimited: reach the target at the end of the step.
            most = math.inf if limits.speed is None else float(limits.speed)
            way = closing if math.isinf(most) else min(max(closing, 0.0), most * h)
            speed = min(other.speed, most) if abs(way - closing) < DONE else way / h
            return Moved(way, speed, self._then(0.0 if way == closing else error, 0.0))
        speed = _approach(actor.speed, other.speed, error, h, limits)
        left = error + (other.speed - (actor.speed + speed) / 2) * h
        way = (actor.speed + speed) / 2 * h
        return Moved(way, speed, self._then(left, speed - other.speed))

    def error(self, actor: EntityState, view: View) -> float:
        """Distance by which it is behind its target, along its path [m]."""
        other = view.entities[self.action.entity]
        ahead = distance_ahead(actor, other.x, other.y, view.network)
        return ahead - self._wanted(actor, other)

    def _wanted(self, actor: EntityState, other: EntityState) -> float:
        """Target distance of the other entity ahead; negative if this one leads."""
        aim = self.action
        if aim.distance is not None:
            distance = float(aim.distance)
        else:
            follower = other if self.leading else actor
            distance = float(aim.time_gap or 0.0) * follower.speed
        if aim.freespace:
            behind, front = (other, actor) if not self.leading else (actor, other)
            distance += front.size[0] / 2 + front.centre[0]
            distance += behind.size[0] / 2 - behind.centre[0]
        return -distance if self.leading else distance

    def _then(self, error: float, difference: float) -> KeepDistance | None:
        there = abs(error) < AT_PLACE and abs(difference) < AT_SPEED
        return None if there and not self.action.continuous else self


def _approach(speed: float, other: float, error: float, h: float, limits: SpeedLimits) -> float:
    """Speed after ``h`` seconds that closes a gap ``error`` [m] to another entity."""
    gain = float(limits.acceleration) if limits.acceleration is not None else 10.0
    loss = float(limits.deceleration) if limits.deceleration is not None else 10.0
    # The speed difference that the opposite limit can still remove in time; linear near the target.
    back = loss if error > 0 else gain
    excess = min(math.sqrt(2.0 * 0.8 * back * abs(error)), abs(error) * 2.0)
    wanted = max(other + math.copysign(excess, error), 0.0)
    if limits.speed is not None:
        wanted = min(wanted, float(limits.speed))
    return min(max(wanted, speed - loss * h), speed + gain * h)


@dataclass(frozen=True)
class Synchronize:
    """Arrives at its target position when the master arrives at its own; solved in every step.

    Without a final speed the acceleration is constant, a = 2 (d - v T) / T^2. With a final speed it
    has one magnitude and changes its sign once, at the speed d / T +- sqrt((d / T)^2 -
    d (v + v_f) / T + (v^2 + v_f^2) / 2), which needs the smallest acceleration; d and T end before
    the steady part. If that speed is negative, the entity stops and waits.
    """

    token: int
    master: str
    master_target: Place
    target: Place
    final_speed: float | None
    relative: bool
    tolerances: tuple[float, float]
    steady: tuple[float, float]
    limits: SpeedLimits

    def step(self, actor: EntityState, view: View, h: float) -> Moved:
        """The motion after ``h`` seconds."""
        master = view.entities[self.master]
        ahead = _left(master, self.master_target, view)
        to_go = -ahead if master.speed < 0.0 else ahead
        left = _left(actor, self.target, view)
        v, stands = actor.speed, abs(master.speed) <= MIN_MASTER_SPEED
        # A master at rest may still reverse to a target behind it.
        arrived = (abs(to_go) if stands else to_go) <= self.tolerances[0] + DONE
        if arrived or left <= self.tolerances[1] + DONE:
            return Moved(v * h, self._final(master, v), None)
        if stands:
            return Moved(v * h, v, self)
        time = to_go / abs(master.speed)
        rate = self._solved(left, v, time)
        if self.limits != SpeedLimits():
            way, speed = advance_along(0.0, v, self._limited(v, rate, h), h)
            return Moved(way, speed, self if time > h else None)
        if self.final_speed is not None:
            return self._towards_final(actor, left, time, self._final(master, v), h)
        if time <= h:
            end = max(v + rate * time, 0.0)
            return Moved(left + end * (h - time), end, None)
        way, speed = advance_along(0.0, v, rate, h)
        return Moved(way, speed, self)

    def _towards_final(
        self, actor: EntityState, left: float, time: float, final: float, h: float
    ) -> Moved:
        """With a final speed: constant acceleration in two phases, then constant speed."""
        v, (distance, seconds) = actor.speed, self.steady
        if seconds > 0.0:
            distance = seconds * final
        elif final > DONE:
            seconds = distance / final
        d, t = left - distance, time - seconds
        then = self if time > h else None
        if t <= DONE or d <= DONE:
            return Moved(final * h, final, then)
        if v <= DONE and final > DONE and t > 2.0 * d / final:
            wait = min(t - 2.0 * d / final, h)
            if wait >= h:
                return Moved(0.0, 0.0, self)
            rate, left_h = final * final / (2.0 * d), h - wait
            return Moved(rate * left_h * left_h / 2, rate * left_h, self)
        if t <= h:
            return Moved(d + final * (h - t), final, then)
        mean = d / t
        side = 1.0 if mean >= (v + final) / 2 else -1.0
        square = mean * mean - mean * (v + final) + (v * v + final * final) / 2
        peak = mean + side * math.sqrt(max(square, 0.0))
        if peak < 0.0:
            # It stops early and waits, with the same rate before and after.
            way, speed = advance_along(0.0, v, -(v * v + final * final) / (2 * d), h)
            return Moved(way, speed, self)
        rate = (2 * peak - v - final) / t
        first = min(max((peak - v) / rate, 0.0), h) if abs(rate) > DONE else 0.0
        turned = v + rate * first
        speed = turned - rate * (h - first)
        return Moved((v + turned) / 2 * first + (turned + speed) / 2 * (h - first), speed, self)

    def _solved(self, d: float, v: float, time: float) -> float:
        """Constant acceleration to arrive in time."""
        rate = 2 * (d - v * time) / time**2
        if v + rate * time < 0.0:
            # A constant acceleration would overshoot and return, so the entity stops at its target.
            return -v * v / (2 * max(d, DONE))
        return rate

    def _limited(self, speed: float, rate: float, h: float) -> float:
        """An acceleration within the limits."""
        most, least, fastest = self.limits.acceleration, self.limits.deceleration, self.limits.speed
        rate = rate if most is None else min(rate, float(most))
        rate = rate if least is None else max(rate, -float(least))
        return rate if fastest is None else min(rate, max(float(fastest) - speed, 0.0) / h)

    def _final(self, master: EntityState, speed: float) -> float:
        if self.final_speed is None:
            return speed
        return self.final_speed + (master.speed if self.relative else 0.0)


def _left(actor: EntityState, target: Place, view: View) -> float:
    """Remaining distance to a place [m]."""
    if actor.trajectory is not None:
        return actor.trajectory.ahead(target.x, target.y)
    return distance_ahead(actor, target.x, target.y, view.network)


@dataclass(frozen=True)
class FollowIdm:
    """The intelligent driver model behind the leader on its path."""

    token: int
    spec: IdmDriver
    desired: float
    rate: float = 0.0

    def step(self, actor: EntityState, view: View, h: float) -> Moved:
        """The motion after ``h`` seconds; the leader is searched once per clock step."""
        rate = self._rate(actor, view) if view.first else self.rate
        way, speed = advance_along(0.0, actor.speed, rate, h)
        return Moved(way, speed, replace(self, rate=rate))

    def _rate(self, actor: EntityState, view: View) -> float:
        if actor.way is None or actor.subject is None:
            return 0.0
        length, width, _ = actor.size
        path, s = actor.way.path, actor.s + actor.centre[0]
        leader = leading_agent(
            path,
            s,
            offset=actor.offset,
            length=length,
            width=width,
            object_id=actor.subject.object_id,
            surroundings=view.surroundings,
        )
        bend = path.sharpest_turn(s, 2.0 * actor.speed)
        desired = min(self.desired, math.sqrt(self.spec.lateral / max(bend, 1e-4)))
        return idm_acceleration(self.spec, actor.speed, desired, leader)


def advanced(actor: EntityState, view: View, h: float) -> EntityState:
    """An entity ``h`` seconds later, moved by its actions; a planner's ego keeps its motion."""
    if not actor.present:
        return actor
    if not actor.scripted:
        return coasting(actor, h)
    control = actor.longitudinal
    held = Moved(actor.speed * h, actor.speed, None)
    moved = held if control is None else control.step(actor, view, h)
    finished = actor.finished
    if control is not None and moved.then is None:
        finished |= {control.token}
    rate = (moved.speed - actor.speed) / h
    actor = copy_with(
        actor, longitudinal=moved.then, speed=moved.speed, acceleration=rate, finished=finished
    )
    if actor.trajectory is not None:
        return _on_trajectory(actor, view, moved.way, h)
    return _on_way(actor, view, moved.way, h)


def _on_way(actor: EntityState, view: View, way: float, h: float) -> EntityState:
    control, offset, then, finished = actor.lateral, actor.offset, None, actor.finished
    if control is not None:
        offset, then = control.step(actor, view, way, h)
        if then is None:
            finished |= {control.token}
    aside, ahead = offset - actor.offset, way
    if not (isinstance(control, OffsetChange) and control.beside):
        aside = min(max(aside, -abs(way)), abs(way))
        ahead = math.copysign(math.sqrt(way * way - aside * aside), way)
    whole = math.hypot(ahead, aside)
    moved = copy_with(
        actor,
        s=actor.s + ahead / _stretch(actor),
        offset=offset,
        turn=actor.turn if control is None else 0.0,
        # The lateral motion of a change is over at its end, also if its shape ends abruptly.
        drift=aside / whole * abs(actor.speed) if then is not None and whole > 0.0 else 0.0,
        lateral=then,
        finished=finished,
        travelled=actor.travelled + whole,
    )
    return _within_road(moved, view).placed()


def _stretch(actor: EntityState) -> float:
    """Distance that an entity covers beside its path, per distance along the path."""
    if abs(actor.offset) <= AT_PLACE:
        return 1.0
    assert actor.way is not None
    path, reach = actor.way.path, 0.5
    turn = path.at(actor.s + reach)[3] - path.at(actor.s - reach)[3]
    bend = math.remainder(turn, math.tau) / (2 * reach)
    return max(1.0 - bend * actor.offset, 0.1)


def _within_road(actor: EntityState, view: View) -> EntityState:
    """The entity on the next lane if its path has ended.

    Without a next lane, it stops at the end of a road, and goes straight on from that of a route.
    """
    way = actor.way
    assert way is not None
    end = way.path.length if actor.follows_route else way.length
    beyond = actor.s - end
    if beyond <= 0.0:
        return actor
    route = None if actor.follows_route else actor.route
    onward = copy_with(actor, s=end, drift=0.0, route=route).placed().on_lane(view.network)
    change, shift = actor.lateral, onward.offset - actor.offset
    if isinstance(change, OffsetChange):
        change = replace(change, start=change.start + shift, end=change.end + shift)
        onward = copy_with(onward, lateral=change)
    assert onward.way is not None
    if onward.way.lane and onward.way.length - onward.s > beyond:
        return copy_with(onward, s=onward.s + beyond, drift=actor.drift)
    if math.isinf(way.length):
        return actor
    return copy_with(actor, s=end, speed=0.0, drift=0.0)


def _on_trajectory(actor: EntityState, view: View, way: float, h: float) -> EntityState:
    before = actor.trajectory
    assert before is not None
    way, then = before.step(way, h)
    travelled = actor.travelled + abs(way)
    if before.timing is not None:
        speed = way / h
        actor = copy_with(actor, speed=speed, acceleration=(speed - actor.speed) / h)
    if then is not None:
        place = then.place() if then.begun() else None
        if place is None:
            return copy_with(actor, trajectory=then)
        return copy_with(
            actor, trajectory=then, x=place.x, y=place.y, h=place.h, travelled=travelled, drift=0.0
        )
    last, beyond = before.course.length, 0.0
    if before.timing is None:
        past = before.s + before.sense * way
        last = 0.0 if past <= 0.0 else last
        beyond = math.copysign(abs(past - last), way)
    end = before.course.at(last)
    done = copy_with(actor, finished=actor.finished | {before.token}, travelled=travelled)
    put = done.put(end, view.network)
    return copy_with(put, s=put.s + beyond).placed() if put.way is not None and beyond else put
