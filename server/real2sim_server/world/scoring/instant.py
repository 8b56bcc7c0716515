"""Score inputs: samples of an instant, episode context, time to collision and fault."""

# ruff: noqa: PLR0917 - compiled loops take each array as an argument

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..._numba import kernel
from ..._records import made_quickly
from ...scene.lane import StopLineAt
from ..path import Float, LoopTransform
from ..plan import PlannedTrajectory
from ..storyboard.program import ShownSignal
from .road import DENSITY, RoadMap, in_lane, off_road

Side = Literal["front", "rear", "lateral", "stopped_ego", "stopped_track"]
"""Side of the ego on which a contact began, after nuPlan's collision types."""

VRU = frozenset({"pedestrian", "cyclist", "motorcycle", "bicycle", "person"})
VEHICLES = frozenset({"car", "vehicle", "van", "truck", "bus", "trailer", "tram"})

Lines = tuple[Float, NDArray[np.int64]]
"""Concatenated points [P, 2] of several lines [m], and the end index of each line."""


class EgoSample(NamedTuple):
    """The ego at one instant, at its rear axle; SI units."""

    x: float
    y: float
    yaw: float
    speed: float
    lateral_speed: float
    acceleration: float
    yaw_rate: float
    steering: float
    s: float
    offset: float
    path_yaw: float
    z: float


@made_quickly
@dataclass(frozen=True, eq=False)
class ObjectSamples:
    """Objects at one instant, K of them.

    Attributes:
        ids, categories: by row.
        centres: [K, 3] float64, box centres, world frame [m].
        yaws: [K] float64 [rad].
        sizes: [K, 3] float64, (length, width, height) [m].
        velocities: [K, 2] float64, world frame [m/s].
    """

    ids: tuple[str, ...]
    categories: tuple[str, ...]
    centres: Float
    yaws: Float
    sizes: Float
    velocities: Float


@dataclass(frozen=True)
class ContactRecord:
    """A contact of the ego that began in this step, or continued to exchange momentum.

    Attributes:
        object_id: id of the object; None for the background.
        category: category of the object, or ``background``.
        side: side of the ego that was hit.
        relative_speed, ego_speed, object_speed: at the start of the contact [m/s].
        impulse: impulse on the ego [N s]; zero without collision response.
        begun: whether the contact began in this step.
        since: start of the contact as a fraction of the step.
    """

    object_id: str | None
    category: str
    side: Side
    relative_speed: float
    ego_speed: float
    object_speed: float
    impulse: tuple[float, float] = (0.0, 0.0)
    begun: bool = True
    since: float = 1.0


@made_quickly
@dataclass(frozen=True, eq=False)
class Instant:
    """One committed instant.

    Attributes:
        step, t_us: clock step and time [us].
        ego: the controlled vehicle.
        others: all objects.
        contacts: ego contacts of the last step.
        secondary: new contacts between objects in the last step.
        plan: new trajectory used for the last step, or None.
        loop: loop reset before the last move, to be applied to positions of the previous instant;
            None without a reset.
        signals: traffic signals of the storyboard with their states.
    """

    step: int
    t_us: int
    ego: EgoSample
    others: ObjectSamples
    contacts: tuple[ContactRecord, ...] = ()
    secondary: int = 0
    plan: PlannedTrajectory | None = None
    loop: LoopTransform | None = None
    signals: tuple[ShownSignal, ...] = ()


@dataclass(frozen=True, eq=False)
class ScoringContext:
    """Constants of an episode.

    Attributes:
        dt: time step [s].
        horizon: number of steps.
        ego_size: (length, width, height) [m].
        rear_overhang: distance from the rear axle to the rear end of the box [m].
        ego_mass: [kg].
        route: [R, 2] float64, recorded path [m].
        lanes: polylines [N, 2] of recorded vehicles [m], whose corridors are also drivable.
        corridor, lane: half widths of the route and of the lanes [m].
        speed_limit: [m/s] or None.
        start_s, route_end_s: route position of the log at the start and at the horizon [m].
        expert_s: route position of the log at each step [m]; ``horizon`` + 1 values.
        history: (speed, yaw) of the log before the start, one per clock step, oldest first.
        warmup_steps: steps in which the ego replays the recording; not scored.
        background: whether the ego can hit walls and poles of the background.
        reactive: whether any other road user reacts to the ego.
        no_action_impact: impact speed of a run in which the ego does not react [m/s]; None if
            unknown, 0 without an impact.
        road_map: road map of the scene; if None, corridor and lanes come from the recorded drive.
    """

    dt: float
    horizon: int
    ego_size: tuple[float, float, float]
    rear_overhang: float
    ego_mass: float
    route: Float
    lanes: tuple[Float, ...]
    corridor: float
    lane: float
    speed_limit: float | None
    start_s: float
    route_end_s: float
    expert_s: tuple[float, ...]
    history: tuple[tuple[float, float], ...]
    warmup_steps: int = 0
    background: bool = False
    reactive: bool = False
    no_action_impact: float | None = None
    road_map: RoadMap | None = None

    @property
    def centre_ahead(self) -> float:
        """Rear axle to the centre of the box [m]."""
        return self.ego_size[0] / 2 - self.rear_overhang

    @cached_property
    def _route_points(self) -> Lines:
        """Points of the route, extended straight beyond both ends."""
        return _lines([_extended(self.route)])

    @cached_property
    def _lane_points(self) -> Lines:
        return _lines([line for line in self.lanes if len(line) > 1])

    @property
    def road_lines(self) -> tuple[Lines, Lines]:
        """Points of the route and of the lanes, as :func:`.road.off_road` takes them."""
        return self._route_points, self._lane_points

    def off_road(self, ego: EgoSample) -> tuple[float, int]:
        """Distance of the worst corner of the ego box from the road [m], at most 0 on the road.

        Also the number of box quarters, 0 to 4, whose centres are on the road.
        """
        ahead = self.centre_ahead
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        if self.road_map is not None:
            return self.road_map.off_road((x, y, ego.yaw), self.ego_size)
        beyond, quarters = off_road(
            (x, y, ego.yaw),
            self.ego_size,
            self._route_points,
            self._lane_points,
            (self.corridor, self.lane),
        )
        return beyond, quarters

    def in_lane(self, ego: EgoSample) -> bool:
        """Whether the box centre is in the ego's lane or in a recorded lane of its direction."""
        if self.road_map is not None:
            return self.road_map.in_lane(ego, self.centre_ahead)
        if abs(ego.offset) <= self.lane:
            return True
        ahead = self.centre_ahead
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        return bool(in_lane((x, y, ego.path_yaw), self._lane_points, self.lane))

    def lane_offset(self, ego: EgoSample) -> float:
        """Offset from the centre of the map lane, or else of the route [m], positive left."""
        return ego.offset if self.road_map is None else self.road_map.lane_offset(ego)

    def distance_against_traffic(self, ego: EgoSample, way: float, gain: float) -> float:
        """Distance driven against traffic in a step of length ``way`` [m].

        With a map, the distance in oncoming lanes; otherwise the loss of route progress.
        """
        if self.road_map is None:
            return max(-gain, 0.0)
        return way if self.road_map.is_against(ego, self.centre_ahead) else 0.0

    def limit_at(self, ego: EgoSample) -> float | None:
        """The speed limit of the ego [m/s], from the request or else from the map."""
        if self.speed_limit is not None or self.road_map is None:
            return self.speed_limit
        return self.road_map.speed_limit(ego)

    @property
    def has_speed_limits(self) -> bool:
        """Whether any speed limit is known."""
        known = self.road_map is not None and self.road_map.has_speed_limits
        return self.speed_limit is not None or known

    def fields(self) -> dict[str, Any]:
        """Plain values for a recording; map fields are omitted without a map."""
        plain = {k: getattr(self, k) for k in self.__dataclass_fields__}
        road_map = plain.pop("road_map")
        if road_map is not None:
            plain["road_map"] = road_map.fields()
        return plain | {
            "route": self.route,
            "lanes": list(self.lanes),
            "expert_s": list(self.expert_s),
            "history": [list(h) for h in self.history],
            "ego_size": list(self.ego_size),
        }

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> ScoringContext:
        """Inverse of :meth:`fields`."""
        road_map = fields.get("road_map")
        return cls(
            **fields
            | {
                "road_map": None if road_map is None else RoadMap.from_fields(road_map),
                "lanes": tuple(np.asarray(line) for line in fields["lanes"]),
                "route": np.asarray(fields["route"]),
                "expert_s": tuple(fields["expert_s"]),
                "history": tuple((v, yaw) for v, yaw in fields["history"]),
                "ego_size": tuple(fields["ego_size"]),
            }
        )


def _lines(lines: Sequence[Float]) -> Lines:
    dense = [_dense(line) for line in lines]
    ends = np.cumsum([len(line) for line in dense], dtype=np.int64)
    return np.concatenate([np.zeros((0, 2)), *dense]), ends


def _extended(line: Float, *, back: float = 10.0, on: float = 60.0) -> Float:
    first = (line[0] - line[1]) / np.linalg.norm(line[0] - line[1])
    last = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    return np.vstack([line[0] + back * first, line, line[-1] + on * last])


def _dense(line: Float) -> Float:
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.append(np.arange(0.0, s[-1], DENSITY), s[-1])
    points: Sequence[Float] = [np.interp(at, s, line[:, k]) for k in (0, 1)]
    return np.stack(points, axis=1)


# --- Hazards -------------------------------------------------------------------------------------

# Time to collision, side and fault of contacts, and red light violations.

HORIZON, STEP = 3.0, 0.1
STEPS = 31
"""Number of times from 0 to the horizon."""

AHEAD, BEHIND = math.radians(30), math.radians(150)
"""Objects within the first bearing are ahead, those beyond the second are behind (nuPlan) [rad]."""


@kernel
def first_overlap_step(ego, size, centre_ahead, everywhere, others, ignored):
    """The first 0.1 s step, up to 3 s, at which the ego box overlaps that of an object.

    Args:
        ego: x, y [m], yaw [rad], speed, lateral speed [m/s] of the rear axle, ground height z [m].
        size: (length, width, height) of its box [m].
        centre_ahead: distance from the rear axle to the box centre [m].
        everywhere: whether to include all objects that are not behind the ego; else only those
            ahead.
        others: centres [K, 3] [m], yaws [K] [rad], sizes [K, 3] [m], velocities [K, 2] [m/s] of
            the objects, float64, world frame.
        ignored: [K] bool, objects to ignore.

    Returns:
        Number of steps; -1 without overlap.
    """
    x, y, yaw, forward, lateral, z = ego
    centres, yaws, sizes, velocities = others
    cos, sin = math.cos(yaw), math.sin(yaw)
    vx, vy = forward * cos - lateral * sin, forward * sin + lateral * cos
    middle_x, middle_y = x + centre_ahead * cos, y + centre_ahead * sin
    first = STEPS
    for k in range(len(yaws)):
        if ignored[k]:
            continue
        low = centres[k, 2] - sizes[k, 2] / 2
        if low >= z + size[2] or low + sizes[k, 2] <= z:
            continue
        dx, dy = centres[k, 0] - middle_x, centres[k, 1] - middle_y
        wx, wy = velocities[k, 0] - vx, velocities[k, 1] - vy
        reach = (math.hypot(size[0], size[1]) + math.hypot(sizes[k, 0], sizes[k, 1])) / 2
        if _closest(dx, dy, wx, wy) >= reach:
            continue
        bearing = math.atan2(centres[k, 1] - y, centres[k, 0] - x) - yaw
        bearing = abs((bearing + math.pi) % math.tau - math.pi)
        if bearing >= AHEAD and not (everywhere and bearing <= BEHIND):
            continue
        for step in range(first):
            t = step * STEP
            apart_x = centres[k, 0] + velocities[k, 0] * t - (middle_x + vx * t)
            apart_y = centres[k, 1] + velocities[k, 1] * t - (middle_y + vy * t)
            if _overlap(apart_x, apart_y, yaw, size, yaws[k], sizes[k]):
                first = step
                break
    return first if first < STEPS else -1


@kernel
def _closest(x, y, vx, vy):
    """Smallest distance [m] to the origin, within the horizon, of a point moving from (x, y)."""
    squared = max(vx * vx + vy * vy, 1e-12)
    t = min(max(-(x * vx + y * vy) / squared, 0.0), HORIZON)
    return math.hypot(x + vx * t, y + vy * t)


@kernel
def _overlap(x, y, yaw, size, other_yaw, other_size):
    """Whether two boxes overlap in the plane (separating axes).

    (x, y) is the centre of the second box relative to the first.
    """
    cos_a, sin_a = math.cos(yaw), math.sin(yaw)
    cos_b, sin_b = math.cos(other_yaw), math.sin(other_yaw)
    turn = other_yaw - yaw
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    la, wa, lb, wb = size[0], size[1], other_size[0], other_size[1]
    return (
        abs(x * cos_a + y * sin_a) < (la + lb * c + wb * s) / 2
        and abs(y * cos_a - x * sin_a) < (wa + lb * s + wb * c) / 2
        and abs(x * cos_b + y * sin_b) < (lb + la * c + wa * s) / 2
        and abs(y * cos_b - x * sin_b) < (wb + la * s + wa * c) / 2
    )


STANDSTILL = 5e-3
"""Minimum speed for a time to collision (NAVSIM) [m/s]."""

NEVER = math.inf


def time_to_collision(
    instant: Instant, context: ScoringContext, *, off_lane: bool, hit: frozenset[str]
) -> float:
    """Time to collision [s] at constant velocities, in steps of 0.1 s up to 3 s.

    Considers objects in the driving direction. If the ego is in several lanes or off the road, all
    objects except those behind it count (nuPlan, NAVSIM).

    Args:
        instant: current instant.
        context: provides the ego's size.
        off_lane: whether the ego is in several lanes or off the road.
        hit: objects already in contact, which are ignored.
    """
    ego, others = instant.ego, instant.others
    if not others.ids or math.hypot(ego.speed, ego.lateral_speed) < STANDSTILL:
        return NEVER
    moving = (ego.x, ego.y, ego.yaw, ego.speed, ego.lateral_speed, ego.z)
    ahead = context.centre_ahead
    if ego.speed < -STANDSTILL:
        # Mirrored, so that objects in the driving direction are ahead.
        moving = (ego.x, ego.y, ego.yaw + math.pi, -ego.speed, -ego.lateral_speed, ego.z)
        ahead = -ahead
    step: int = first_overlap_step(
        moving,
        context.ego_size,
        ahead,
        off_lane,
        (others.centres, others.yaws, others.sizes, others.velocities),
        np.array([i in hit for i in others.ids]) if hit else np.zeros(len(others.ids), np.bool_),
    )
    return NEVER if step < 0 else step * STEP


STOPPED = 5e-2
"""Maximum speed of a stopped vehicle (nuPlan) [m/s]."""


def side_of_contact(
    ego_box: tuple[float, float, float, float, float],
    ego_speed: float,
    box: tuple[float, float, float, float, float],
    speed: float,
    *,
    axle: float,
    reversing: bool = False,
) -> Side:
    """The side of the ego on which two boxes came into contact, after nuPlan's ``CollisionType``.

    Args:
        ego_box, box: centre x, y [m], yaw [rad], length, width [m].
        ego_speed, speed: before the contact, along and across [m/s].
        axle: distance from the centre of the ego box back to the rear axle, the reference for
            objects behind [m].
        reversing: whether the ego is in reverse gear, so that its rear counts as its front.
    """
    if abs(ego_speed) <= STOPPED:
        return "stopped_ego"
    if abs(speed) <= STOPPED:
        return "stopped_track"
    x, y, yaw, length, width = ego_box
    if reversing:
        yaw += math.pi
    cos, sin = math.cos(yaw), math.sin(yaw)
    bearing = math.atan2(box[1] - y + axle * sin, box[0] - x + axle * cos) - yaw
    if abs(math.remainder(bearing, math.tau)) > BEHIND:
        return "rear"
    half = width / 2
    bumper = [
        (x + u * cos - v * sin, y + u * sin + v * cos)
        for u, v in ((length / 2, half), (length / 2, -half))
    ]
    return "front" if _segment_intersects(bumper[0], bumper[1], box) else "lateral"


def _segment_intersects(
    a: tuple[float, float], b: tuple[float, float], box: tuple[float, float, float, float, float]
) -> bool:
    """Whether a segment intersects a box: clipped against its two slabs."""
    x, y, yaw, length, width = box
    cos, sin = math.cos(yaw), math.sin(yaw)
    first, last = 0.0, 1.0
    for axis_x, axis_y, half in ((cos, sin, length / 2), (-sin, cos, width / 2)):
        p = (a[0] - x) * axis_x + (a[1] - y) * axis_y
        q = (b[0] - x) * axis_x + (b[1] - y) * axis_y
        if abs(q - p) < 1e-12:
            if abs(p) > half:
                return False
            continue
        enter, leave = sorted(((-half - p) / (q - p), (half - p) / (q - p)))
        first, last = max(first, enter), min(last, leave)
    return first <= last


def ego_at_fault(record: ContactRecord, off_lane: bool) -> bool:
    """Whether the ego is at fault (nuPlan).

    The ego is at fault in front contacts, in contacts with stopped vehicles, and in lateral
    contacts outside its lane.
    """
    if record.side in {"front", "stopped_track"}:
        return True
    return record.side == "lateral" and off_lane


def fault_class(category: str) -> str:
    """``vru``, ``vehicle`` or ``object``."""
    if category in VRU:
        return "vru"
    return "vehicle" if category in VEHICLES else "object"


ALONG = 0.5
"""Minimum cosine between an ego's heading and the direction of a stop line."""

SAME_LINE_M = 0.01
"""Maximum distance between the centres of a stop line of the storyboard and the same of the map."""

LAMPS = {"on", "off", "flashing", "counting"}
"""Lamp states of a signal state such as ``off;off;on``, red first."""


@dataclass(frozen=True)
class TrafficLights:
    """Traffic light states so far and red light violations; immutable.

    Attributes:
        shown: states at the newest instant.
        ran: signals whose stop line the ego's front crossed while they were red.
        placed, unplaced: signals so far with a known stop line, and without.
    """

    shown: tuple[ShownSignal, ...] = ()
    ran: frozenset[str] = frozenset()
    placed: frozenset[str] = frozenset()
    unplaced: frozenset[str] = frozenset()

    @property
    def seen(self) -> bool:
        """Whether any signals have been seen."""
        return bool(self.placed or self.unplaced)

    def updated(
        self, before: EgoSample | None, instant: Instant, context: ScoringContext
    ) -> TrafficLights:
        """One instant later.

        Crossing a line is a violation if the signal was red at both ends of the step.

        Args:
            before: the ego at the previous instant; None at the first.
            instant, context: current instant and context of the scores.
        """
        if not instant.signals and not self.shown:
            return self
        red = {signal.signal_id for signal in self.shown if shows_red(signal.state)}
        ran, placed, unplaced = set(self.ran), set(self.placed), set(self.unplaced)
        for signal in instant.signals:
            name = signal.signal_id
            if name in placed or name in unplaced:
                lines = None
            else:
                lines = tuple(stop_lines(signal, context))
                (placed if lines else unplaced).add(name)
            if before is None or name not in red or not shows_red(signal.state):
                continue
            for line in stop_lines(signal, context) if lines is None else lines:
                if _crossed(line, before, instant.ego, context):
                    ran.add(name)
        sets = (frozenset(ran), frozenset(placed), frozenset(unplaced))
        return TrafficLights(instant.signals, *sets)


NO_LIGHTS = TrafficLights()


def shows_red(state: str) -> bool:
    """Whether a signal state means stop.

    Stop states are ``red``, even in combination (``red;amber``), ``stop``, and lamp lists with the
    first lamp on (``on;off;off``, red first as in OpenDRIVE).
    """
    words = re.findall(r"[a-z]+", state.lower())
    if words and set(words) <= LAMPS:
        return len(words) > 1 and words[0] == "on"
    return "red" in words or "stop" in words


def stop_lines(signal: ShownSignal, context: ScoringContext) -> Iterator[StopLineAt]:
    """Stop lines of a signal.

    Uses the line of the storyboard with the width of a lane. Without one, or if it is that of the
    map, uses the stop line of the map, or else the ends of the signal's lanes. Empty if none is
    known.
    """
    graph = None if context.road_map is None else context.road_map.graph
    mapped = () if graph is None else graph.stops.get(signal.signal_id, ())
    if signal.stop_line is None or any(
        math.dist(signal.stop_line[:2], line[:2]) < SAME_LINE_M for line in mapped
    ):
        yield from mapped
    else:
        x, y, heading = signal.stop_line
        found = None if graph is None else graph.nearest(x, y, heading, within=5.0)
        half = context.lane
        if graph is not None and found is not None:
            half = graph.lanes[found.lane_id].width(found.s) / 2
        yield StopLineAt(x, y, heading, half)


def _crossed(line: StopLineAt, before: EgoSample, now: EgoSample, context: ScoringContext) -> bool:
    """Whether the centre of the ego's front crossed a line in its direction within a step."""
    if math.cos(now.yaw - line.heading) <= ALONG:
        return False
    (s0, d0), (s1, d1) = (_front(line, ego, context) for ego in (before, now))
    if not s0 <= 0.0 < s1:
        return False
    return abs(d0 + (d1 - d0) * s0 / (s0 - s1)) <= line.half


def _front(line: StopLineAt, ego: EgoSample, context: ScoringContext) -> tuple[float, float]:
    """The centre of the ego's front: distance beyond the line and left of its centre [m]."""
    ahead = context.ego_size[0] - context.rear_overhang
    x = ego.x + ahead * math.cos(ego.yaw) - line.x
    y = ego.y + ahead * math.sin(ego.yaw) - line.y
    cos, sin = math.cos(line.heading), math.sin(line.heading)
    return x * cos + y * sin, y * cos - x * sin
