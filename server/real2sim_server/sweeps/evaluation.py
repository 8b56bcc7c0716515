"""Scores of points for a search: their criticality, and whether failures are avoidable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim.planners import Needs
from real2sim_proto.plans import TrajectoryPlan

from ..policies.planner_process import PLAN_LIMIT_S, PlannerProcesses
from ..scene import Scene
from ..world import World
from .episode import (
    OPERATIONS,
    Drive,
    Driven,
    adversaries_of,
    begin,
    drive_episode,
    load,
    signed_gaps,
)
from .parameters import Value, drawn_parameters, values_at
from .spec import Space
from .sweep import Journal

# --- Reference driver ----------------------------------------------------------------------------

# The reference driver has perfect foresight. It tries manoeuvres in copies of the world, with the
# actual behaviour of all others. A collision that it avoids was avoidable.

CRUISE = 8.0
"""Free-flow cruising speed, unless the vehicle starts faster [m/s]."""
HORIZON, SPACING = 4.0, 0.2
"""Horizon of a tried manoeuvre, and spacing of the poses of its plan [s]."""
DECIDES_EVERY = 0.3
"""Interval of its decisions [s]."""
SIDEWAYS = 5.0
"""Acceleration of a swerve [m/s^2]. Combined with the hardest braking it is 7.1, below the limit of
8.8 of tyres on dry asphalt.
"""
KEEPS_FREE = 0.2
"""Minimum distance to all others, or the initial distance if that is smaller [m]."""
MIN_TIME = 1.0
"""Minimum time to collision at constant velocities at the end of a manoeuvre [s]."""


@dataclass(frozen=True)
class Manoeuvre:
    """A candidate manoeuvre.

    Attributes:
        aside: final lateral offset from the route, positive on the left [m].
        acceleration: acceleration along the route until standstill or ``most`` [m/s^2].
        most: maximum speed [m/s].
    """

    aside: float
    acceleration: float
    most: float

    @property
    def effort(self) -> float:
        """Sort key of manoeuvres; the mildest is preferred."""
        return abs(self.acceleration) + abs(self.aside)


@dataclass(frozen=True)
class Drove:
    """Outcome of the reference driver.

    Attributes:
        survived: whether it had no contact, stayed on the road and kept the minimum distance.
        gap: minimum distance to others [m].
        effort: maximum requested acceleration [m/s^2].
        steps: number of steps.
        world: world at the end.
    """

    survived: bool
    gap: float
    effort: float
    steps: int
    world: World


def manoeuvres(most: float) -> list[Manoeuvre]:
    """All manoeuvres, mildest first."""
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
    """Drive a world to its end; modifies the world.

    Args:
        world: a world with trajectories as plans, at any time.
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
    """Poses of a manoeuvre from the current time, along the route and next to it."""
    route, motion, point = world.route, world.motion, world.path_point
    shift = manoeuvre.aside - point.offset
    # A quintic lane change has a maximum lateral acceleration of 5.77 d / T^2.
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
        # A vehicle that barely moves cannot move sideways.
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
    """Minimum distance from the ego's box to another's [m]; infinite without others."""
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
    """The mildest successful manoeuvre, or the one that succeeds longest.

    The current manoeuvre is preferred.
    """
    best, best_end = tried[0], (-math.inf, -math.inf)
    # Try the mildest first, then the current one, to avoid oscillation.
    for manoeuvre in dict.fromkeys([tried[0], before, *tried]):
        end = _end(world, manoeuvre, wanted)
        if end[0] == math.inf:
            return manoeuvre
        if end > best_end:
            best, best_end = manoeuvre, end
    return best


def _end(world: World, manoeuvre: Manoeuvre, wanted: float) -> tuple[float, float]:
    """Time until a manoeuvre fails [s], infinite if it succeeds; and its minimum distance."""
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
    near = not copy.over and copy.accumulator.ttc < MIN_TIME
    return (HORIZON if near else math.inf), smallest


# --- Realism -------------------------------------------------------------------------------------

# Subtracted from the criticality of cases that are implausible in human driving.

Array = NDArray[np.float64]

HARDEST, SIDEWAYS_LIMIT, JERK = 8.0, 4.0, 20.0
"""Accelerations [m/s^2] along and across, and jerk [m/s^3], that people reach in emergencies."""
TIGHTEST = 0.2
"""Maximum curvature of a vehicle's path at any speed [1/m]: no vehicle turns within 5 m."""
START_GAP = 1.0
"""Minimum clearance around the ego at the start of the episode [m]."""
MIN_DRIVERS = 5
"""Minimum number of moving vehicles for driving statistics of a log."""
MIN_SPREAD = np.array([1.0, 0.5, 0.5])
"""Minimum standard deviations of speed [m/s] and accelerations [m/s^2]."""
ORDINARY = 3.0
"""No penalty within this many standard deviations."""


@dataclass(frozen=True)
class DrivingStatistics:
    """Driving statistics of the log: mean and spread of speed and accelerations.

    Attributes:
        mean, spread: [3] each; None if too few vehicles moved.
    """

    mean: Array | None
    spread: Array | None

    @classmethod
    def of(cls, scene: Scene) -> DrivingStatistics:
        """Statistics of the objects of a scene and of its recording vehicle."""
        tracks = [o.trajectory for o in scene.objects.values()] + [scene.ego]
        rows = []
        for track in tracks:
            times = np.asarray(track.times_us, np.float64) * 1e-6
            if len(times) < 4 or times[-1] - times[0] < 1.0:
                continue
            even = np.arange(times[0], times[-1], 0.2)
            places = np.asarray(track.positions)[:, :2]
            points = np.stack([np.interp(even, times, places[:, k]) for k in (0, 1)], axis=1)
            motion = _motion(points, 0.2)
            if len(motion) and motion[:, 0].max() > 1.0:
                rows.append(_features(motion))
        if len(rows) < MIN_DRIVERS:
            return cls(None, None)
        found = np.array(rows)
        return cls(found.mean(axis=0), np.maximum(found.std(axis=0), MIN_SPREAD))

    def distance(self, features: Array) -> float:
        """Mahalanobis distance beyond the normal range; 0 without statistics."""
        if self.mean is None or self.spread is None:
            return 0.0
        z = (features - self.mean) / self.spread
        return max(float(np.sqrt((z * z).mean())) - ORDINARY, 0.0)


@dataclass
class Watch:
    """Monitors the adversaries over an episode.

    Attributes:
        names: object ids of the adversaries.
        statistics: driving statistics of the log.
    """

    names: frozenset[str]
    statistics: DrivingStatistics
    _tracks: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _dt: float = 0.1
    _start_gap: float = math.inf

    def add(self, world: World) -> None:
        """Add the current instant of a world."""
        if world.steps == 0:
            self._start_gap, self._dt = gap_now(world), world.context.dt
        others = world.instant.others
        for k, name in enumerate(others.ids):
            if name in self.names:
                x, y = others.centres[k, :2].tolist()
                self._tracks.setdefault(name, []).append((x, y))

    def implausibility(self) -> float:
        """0 for normal human driving, about 1 for implausible driving.

        Implausible cases are allowed, but rank lower.
        """
        found = max(START_GAP - self._start_gap, 0.0) / START_GAP
        for track in self._tracks.values():
            motion = _motion(np.array(track), self._dt)
            if not len(motion):
                continue
            speed = motion[:, 0]
            moving = speed > 0.5
            if not moving.any():
                continue
            along, across = np.abs(motion[moving, 1]), np.abs(motion[moving, 2])
            jerk = np.abs(np.diff(motion[:, 1])) / self._dt
            found += (
                _beyond(along, HARDEST) + _beyond(across, SIDEWAYS_LIMIT) + _beyond(jerk, JERK) / 4
            )
            curvature = across / np.maximum(speed[moving], 0.5) ** 2
            found += _beyond(curvature[speed[moving] > 1.0], TIGHTEST)
            found += 0.2 * self.statistics.distance(_features(motion))
        return found


def _motion(points: Array, dt: float) -> Array:
    """[M, 3] speed, longitudinal and lateral acceleration; SI units.

    Args:
        points: [N, 2] positions [m].
        dt: time between positions [s].
    """
    velocity = np.diff(points, axis=0) / dt
    if len(velocity) < 3:
        return np.zeros((0, 3))
    # Smooth over three instants, because positions are rounded and drivers react at clock steps.
    smooth = (velocity[:-2] + velocity[1:-1] + velocity[2:]) / 3
    change = np.diff(smooth, axis=0) / dt
    speed = np.hypot(smooth[:-1, 0], smooth[:-1, 1])
    unit = smooth[:-1] / np.maximum(speed, 1e-6)[:, None]
    along = (change * unit).sum(axis=1)
    across = unit[:, 0] * change[:, 1] - unit[:, 1] * change[:, 0]
    return np.stack([speed, along, across], axis=1)


def _features(motion: Array) -> Array:
    moving = motion[motion[:, 0] > 0.5]
    if not len(moving):
        return np.zeros(3)
    hard = np.percentile(np.abs(moving[:, 1:]), 95, axis=0)
    return np.concatenate([[moving[:, 0].mean()], hard])


def _beyond(values: Array, most: float) -> float:
    """Relative excess of the 98th percentile of the values over a human limit."""
    if not len(values):
        return 0.0
    return max(float(np.percentile(values, 98)) / most - 1.0, 0.0)


UNAVOIDABLE, REFUSED = -1.0, -200.0
"""Scores of a failure that the reference cannot avoid, and of a case that cannot start."""
MAX_STRANGE = 0.5
"""Maximum implausibility of a finding."""
SPEED_BIN = 2.0
"""Width of the archive's cells [m/s]."""

Cell = tuple[str, str, str]
"""Contact position on the ego, impact speed, and kind of the other object."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """An evaluated point.

    Attributes:
        space: index of its space.
        point: coordinates from 0 to 1.
        values: values of the parameters.
        drive: the episode.
        score: score of the search; higher is closer to an avoidable failure, positive for one.
        criticality: criticality of the tested planner's episode.
        implausibility: subtracted from it.
        at_fault: whether the planner caused a collision.
        avoided: whether the reference survived the same case; None if it did not drive.
        cell: cell of the archive; None unless at fault.
        impact: columns of the collision.
        error: why the planner failed; None if it drove to the end.
    """

    space: int
    point: tuple[float, ...]
    values: Mapping[str, Value]
    drive: Drive
    score: float
    criticality: float
    implausibility: float
    at_fault: bool
    avoided: bool | None
    cell: Cell | None
    impact: Mapping[str, Any] = field(default_factory=dict)
    error: str | None = None

    @property
    def is_failure(self) -> bool:
        """Whether the planner was at fault for an avoidable collision, in a plausible case."""
        return self.at_fault and bool(self.avoided) and self.implausibility <= MAX_STRANGE


class Evaluator:
    """Drives points of spaces of one scene with one planner.

    Args:
        scene: scene of all spaces.
        spaces: spaces to search.
        planner: name of the tested planner.
        seed: seed of the episodes.
        journal: open journal with the outcomes of episodes; None keeps none.
        plan_limit_s: time limit for each answer of the planner [s].
    """

    def __init__(
        self,
        scene: Scene,
        spaces: Sequence[Space],
        planner: str,
        *,
        seed: int = 0,
        journal: Journal | None = None,
        plan_limit_s: float = PLAN_LIMIT_S,
    ) -> None:
        self.scene, self.spaces, self.planner, self.seed = scene, list(spaces), planner, seed
        self.statistics = DrivingStatistics.of(scene)
        self.journal = journal
        self._processes = PlannerProcesses(plan_limit_s)

    def dimensions(self, space: int) -> int:
        """Number of coordinates of a point of a space."""
        return len(drawn_parameters(self.spaces[space].parameters))

    def __call__(self, space: int, point: Sequence[float] | NDArray[np.float64]) -> Evaluation:
        """Drive a point, unless its episode is in the journal."""
        asked = self.spaces[space]
        inside = tuple(float(min(max(u, 0.0), 1.0)) for u in point)
        values = values_at(asked.parameters, inside)
        drive = Drive.of(asked.case_at(values), self.planner, self.seed)
        return Evaluation(space, inside, values, drive, **self._outcome(drive))

    def _outcome(self, drive: Drive) -> dict[str, Any]:
        """Fields of an evaluation that depend only on the episode."""
        if self.journal is None:
            return self._driven(drive)
        key = drive.key(self.scene.content_hash or "")
        if key not in self.journal.rows:
            self.journal.add(key, self._driven(drive))
        row = self.journal.rows[key]
        return row | {"cell": row["cell"] and tuple(row["cell"])}

    def drive(self, drive: Drive, **options: Any) -> Driven:
        """Let the planner drive an episode; options as for :func:`.drive_episode`."""
        planner = load(drive.planner, self._processes)
        return drive_episode(self.scene, drive, planner, **options)

    def close(self) -> None:
        """End the planner's process."""
        self._processes.close()

    def _driven(self, drive: Drive) -> dict[str, Any]:
        watch = Watch(adversaries_of(drive.reset), self.statistics)
        driven = self.drive(drive, on_world=watch.add)
        if driven.world is None:
            return _nothing()
        if driven.error is not None:
            return _nothing() | {"error": driven.error}
        strange = watch.implausibility()
        score, avoided = driven.criticality - strange, None
        if driven.at_fault:
            avoided = self.reference(drive).survived
            # A finding has a positive score; unavoidable and implausible collisions do not count.
            if not avoided:
                score = UNAVOIDABLE - strange
            elif strange > MAX_STRANGE:
                score = -strange
            else:
                score = max(score, 0.01)
        return {
            "score": score,
            "criticality": driven.criticality,
            "implausibility": strange,
            "at_fault": driven.at_fault,
            "avoided": avoided,
            "cell": cell_of(driven) if driven.at_fault else None,
            "impact": impact_of(driven) if driven.at_fault else {},
        }

    def reference(self, drive: Drive) -> Drove:
        """Drive the same episode with the reference driver."""
        world = begin(self.scene, drive, Needs(), privileged=False)
        if drive.operations:
            world.apply(OPERATIONS.validate_python([dict(o) for o in drive.operations]))
        return drive_reference(world)


def cell_of(driven: Driven) -> Cell:
    """Cell of an at-fault collision."""
    impact = impact_of(driven)
    low = SPEED_BIN * math.floor((impact["speed"] or 0.0) / SPEED_BIN)
    return impact["where"], f"{low:g} to {low + SPEED_BIN:g} m/s", impact["kind"]


def impact_of(driven: Driven) -> dict[str, Any]:
    """Columns of an at-fault collision: contact position on the ego, other object, speed."""
    assert driven.world is not None
    world = driven.world
    begun = [c for c in world.instant.contacts if c.begun]
    first = min(begun, key=lambda c: (c.since, c.object_id or "")) if begun else None
    speed = first.relative_speed if first else world.accumulator.first_impact
    drivers = world.spec.agents.drivers
    name = first.object_id if first else None
    kind = first.category if first else "unknown"
    if name is not None and name in drivers:
        kind = f"{kind}, {drivers[name].kind}"
    return {
        "time": world.steps * world.context.dt,
        "speed": speed,
        "side": first.side if first else None,
        "where": _where(world, name, first.side if first else "front"),
        "object": name,
        "kind": kind,
    }


def _where(world: World, name: str | None, side: str) -> str:
    """Third of the front, or side of the ego, at the contact."""
    others, ego, context = world.instant.others, world.instant.ego, world.context
    if name is None or name not in others.ids:
        return side
    k = others.ids.index(name)
    turned = float(others.yaws[k]) - ego.yaw
    dx, dy = (others.centres[k, :2] - np.array([ego.x, ego.y])).tolist()
    y = math.cos(ego.yaw) * dy - math.sin(ego.yaw) * dx
    length, width = others.sizes[k, :2].tolist()
    reach = (abs(math.sin(turned)) * length + abs(math.cos(turned)) * width) / 2
    half = context.ego_size[1] / 2
    if side not in {"front", "stopped_track"}:
        return "left" if y > 0 else "right"
    middle = (max(y - reach, -half) + min(y + reach, half)) / 2
    if abs(middle) <= half / 3:
        return "front"
    return "front left" if middle > 0 else "front right"


def _nothing() -> dict[str, Any]:
    return {
        "score": REFUSED,
        "criticality": REFUSED,
        "implausibility": 0.0,
        "at_fault": False,
        "avoided": None,
        "cell": None,
    }
