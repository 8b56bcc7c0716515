"""A driver who knows what comes: what was avoidable is what it avoids.

It tries manoeuvres in copies of the world, in which everybody else does what they will do, also in
answer to it, and takes the mildest that ends well. Its vehicle is that of the episode: plans go
through the same tracker, actuators and limits, and no manoeuvre asks for more than dry asphalt
gives.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from real2sim_proto.plans import TrajectoryPlan

from ...world import World
from ..gaps import signed_gaps

CRUISE = 8.0
"""Speed that it drives at where nothing hinders it, unless it begins faster [m/s]."""
HORIZON, SPACING = 4.0, 0.2
"""Of a manoeuvre that is tried, and between poses of its plan [s]."""
DECIDES_EVERY = 0.3
"""Seconds after which it looks for another manoeuvre."""
SIDEWAYS = 5.0
"""Acceleration of a swerve [m/s^2]; with the hardest braking beside it 7.1 of the 8.8 that tyres on
dry asphalt give."""
KEEPS_FREE = 0.2
"""To everybody, or what there was at the start where that was less [m]."""
LEAST_TIME = 1.0
"""To a collision at constant velocities when a manoeuvre ends [s]."""


@dataclass(frozen=True)
class Manoeuvre:
    """Something to try.

    Attributes:
        aside: where beside the route it ends, positive on the left [m].
        acceleration: along the route until standstill or ``most`` [m/s^2].
        most: speed [m/s].
    """

    aside: float
    acceleration: float
    most: float

    @property
    def effort(self) -> float:
        """By which the milder of two is taken."""
        return abs(self.acceleration) + abs(self.aside)


@dataclass(frozen=True)
class Drove:
    """How the reference drove.

    Attributes:
        survived: without contact, on the road, with room to spare.
        gap: smallest to anybody [m].
        effort: hardest acceleration that it asked for [m/s^2].
        steps: that it took.
        world: at the end.
    """

    survived: bool
    gap: float
    effort: float
    steps: int
    world: World


def manoeuvres(most: float) -> list[Manoeuvre]:
    """All of them, mildest first."""
    found = [Manoeuvre(0.0, 1.5, most)]
    found += [Manoeuvre(0.0, a, most) for a in (-1.5, -3.0, -5.0, -8.0)]
    found += [
        Manoeuvre(side * aside, a, most)
        for aside in (1.0, 2.0, 3.3)
        for side in (1.0, -1.0)
        for a in (1.5, 0.0, -2.5, -5.0)
    ]
    found += [Manoeuvre(0.0, 3.0, most + 4.0), Manoeuvre(0.0, 0.0, most)]
    return [found[0], *sorted(found[1:], key=lambda m: m.effort)]


def drive_reference(world: World) -> Drove:
    """Drive a world to its end; it is changed.

    Args:
        world: of plans as trajectories, at any instant.
    """
    start, free = world.steps, gap_now(world)
    most = max(CRUISE, world.motion.speed)
    tried = manoeuvres(most)
    wanted = min(KEEPS_FREE, 0.5 * max(free, 0.0))
    smallest, effort, since, chosen = free, 0.0, math.inf, tried[0]
    plan: TrajectoryPlan | None = None
    was_off = world.accumulator.off_road
    while not world.over:
        if since >= DECIDES_EVERY - 1e-9:
            chosen = _chosen(world, tried, chosen, wanted)
            plan, since = plan_of(world, chosen), 0.0
            effort = max(effort, abs(chosen.acceleration), SIDEWAYS if chosen.aside else 0.0)
        world.step(plan)
        plan = None
        since += world.context.dt
        smallest = min(smallest, gap_now(world))
    last = world.accumulator
    survived = not last.collisions and smallest >= wanted and (was_off or not last.off_road)
    return Drove(survived, smallest, effort, world.steps - start, world)


def plan_of(world: World, manoeuvre: Manoeuvre) -> TrajectoryPlan:
    """Poses of a manoeuvre from here on, along the route and beside it."""
    route, motion, point = world.route, world.motion, world.path_point
    shift = manoeuvre.aside - point.offset
    # A quintic change of lanes has 5.77 d / T^2 at most.
    change = max(math.sqrt(5.7735 * abs(shift) / SIDEWAYS), 1.0)
    poses, times = [], []
    s, speed, yaw = point.s, max(motion.speed, 0.0), motion.yaw
    before = (motion.x, motion.y)
    dt = SPACING / 4
    for k in range(1, round(HORIZON / SPACING) + 1):
        for _ in range(4):
            limit = manoeuvre.most if manoeuvre.acceleration > 0 else max(manoeuvre.most, speed)
            after = min(max(speed + manoeuvre.acceleration * dt, 0.0), max(limit, speed - 2.0 * dt))
            s, speed = s + 0.5 * (speed + after) * dt, after
        u = min(k * SPACING / change, 1.0)
        # One that hardly moves cannot move aside.
        offset = point.offset + shift * (u * u * u * (10 - 15 * u + 6 * u * u))
        x, y, _, heading = route.at(s)
        x, y = x - offset * math.sin(heading), y + offset * math.cos(heading)
        dx, dy = x - before[0], y - before[1]
        if speed > 0.2 and math.hypot(dx, dy) > 0.02:
            yaw, before = math.atan2(dy, dx), (x, y)
        else:
            x, y = before
        poses.append((x, y, yaw))
        times.append(world.t_us + round(k * SPACING * 1e6))
    return TrajectoryPlan(times_us=times, poses=poses, frame="world")


def gap_now(world: World) -> float:
    """Smallest from the ego's box to another's [m]; infinite where there is nobody."""
    instant, context = world.instant, world.context
    ego, others = instant.ego, instant.others
    if not others.ids:
        return math.inf
    ahead = context.centre_ahead
    x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
    length, width, _ = context.ego_size
    box = (x, y, ego.yaw, length, width)
    return float(np.min(signed_gaps(box, others.centres, others.yaws, others.sizes)))


def _chosen(
    world: World, tried: Sequence[Manoeuvre], before: Manoeuvre, wanted: float
) -> Manoeuvre:
    """The mildest that ends well, the one under way before others; else the one that goes well for
    longest."""
    best, best_end = tried[0], (-math.inf, -math.inf)
    # From the mild one at first, then what is under way, so that it does not dither.
    for manoeuvre in dict.fromkeys([tried[0], before, *tried]):
        end = _end(world, manoeuvre, wanted)
        if end[0] == math.inf:
            return manoeuvre
        if end > best_end:
            best, best_end = manoeuvre, end
    return best


def _end(world: World, manoeuvre: Manoeuvre, wanted: float) -> tuple[float, float]:
    """How long a manoeuvre goes well [s], infinite where that is to its end; and its smallest
    gap."""
    copy, plan = world.fork(), plan_of(world, manoeuvre)
    was_off, smallest = copy.accumulator.off_road, math.inf
    for step in range(round(HORIZON / copy.context.dt)):
        if copy.over:
            break
        copy.step(plan if step == 0 else None)
        smallest = min(smallest, gap_now(copy))
        left = copy.accumulator.off_road and not was_off
        if copy.accumulator.collisions or left or smallest < wanted:
            return step * copy.context.dt, smallest
    near = not copy.over and copy.accumulator.ttc < LEAST_TIME
    return (HORIZON if near else math.inf), smallest
