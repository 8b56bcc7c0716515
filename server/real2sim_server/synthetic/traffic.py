"""Traffic of a synthetic drive: the ego vehicle's path, other vehicles, pedestrians, cyclists.

People are planned after the vehicles and yield to them, so people do not change the vehicles of a
street.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Pose, body_model, joint_transforms, keypoints, skin
from ..body.bicycle import Ride, plan_ride
from ..body.gait import Gait, GaitStyle, plan_gait
from ..body.model import joint_positions
from ..geometry import Float, slerp, transform_from, yaw_quaternion
from ..scene import Trajectory
from .materials import PARKING_BAY
from .street import EGO_OFFSET, KERB, KERB_HEIGHT, LANE, Street, SyntheticConfig, lay_street
from .vehicles import SHAPES

# People.

Colour = tuple[float, float, float]

SKIN = ((0.62, 0.4, 0.29), (0.5, 0.3, 0.2), (0.3, 0.16, 0.095), (0.14, 0.07, 0.045))
HAIR = ((0.02, 0.015, 0.012), (0.07, 0.035, 0.018), (0.25, 0.15, 0.06), (0.35, 0.34, 0.33))
TOPS = (
    (0.5, 0.04, 0.04), (0.05, 0.12, 0.4), (0.6, 0.58, 0.55), (0.03, 0.03, 0.035),
    (0.55, 0.4, 0.05), (0.06, 0.22, 0.1), (0.2, 0.2, 0.21), (0.35, 0.12, 0.3), (0.55, 0.24, 0.06),
)  # fmt: skip
TROUSERS = (
    (0.03, 0.05, 0.12), (0.02, 0.02, 0.022), (0.25, 0.2, 0.13), (0.12, 0.12, 0.13),
    (0.08, 0.12, 0.2),
)  # fmt: skip
SHOES = ((0.02, 0.02, 0.02), (0.5, 0.5, 0.5), (0.1, 0.05, 0.025), (0.4, 0.06, 0.05))
FRAMES = ((0.02, 0.02, 0.022), (0.35, 0.03, 0.03), (0.03, 0.12, 0.3), (0.05, 0.2, 0.1))

ADULTS = (
    "woman", "man", "tall_woman", "slim_man", "heavy_man", "slim_woman", "old_woman",
    "old_man", "strong_man", "heavy_woman", "short_woman", "tall_man",
)  # fmt: skip
CHILDREN = ("girl", "boy", "small_girl", "small_boy")
WOMEN = ("woman", "girl")
HEIGHTS = {"tall_man": 1.92, "tall_woman": 1.8}
"""Heights of builds that are too tall by default [m]."""

LOW, HIGH = 7.1, 8.5
"""Range of distances from the centre line for walking on a pavement [m]."""
WAITING = KERB + 0.35
CYCLE_OFFSET = 3.2
PASS = 0.65
"""Minimum distance between two people [m]."""
_TRIES = 40

Path = tuple[Float, Float, Float, Float]
"""s, d, height and heading against the street's at the times of a plan."""


@dataclass(frozen=True, eq=False)
class Looks:
    """Clothing of a person: extra triangles, and a colour (linear RGB) for each part."""

    groups: tuple[str, ...]
    colours: dict[str, Colour]
    bicycle: Colour


@dataclass(frozen=True, eq=False)
class PlannedPerson:
    """A pedestrian or cyclist.

    Attributes:
        category: "pedestrian" or "cyclist".
        doing: "walks", "waits", "crosses", "turns", "runs" or "rides".
        motion: gait or ride; its times are those of the drive in seconds.
        looks: clothes and colours.
        trajectory: ``T_world_object`` of the box, which is fixed in the body's frame.
        size: (length, width, height) of a box that contains every pose of the drive [m].
        middle: height of the box's centre above the origin of the body's frame [m].
    """

    category: str
    doing: str
    motion: Gait | Ride
    looks: Looks
    trajectory: Trajectory
    size: tuple[float, float, float]
    middle: float

    def vertices(self, times: Float) -> Float:
        """Body, and bicycle if there is one, [T, V, 3] in the box's frame at times [T] [s]."""
        body = self.motion.body
        out = skin(body, joint_transforms(body, self.motion.pose(times)))
        if isinstance(self.motion, Ride):
            out = np.concatenate([out, self.motion.bicycle_vertices(times)], axis=1)
        return out - [0.0, 0.0, self.middle]

    def joints(self, times: Float) -> tuple[Float, Float]:
        """Joints [T, 22, 3] and COCO's keypoints [T, 17, 3] in the box's frame."""
        body = self.motion.body
        transforms = joint_transforms(body, self.motion.pose(times))
        down = np.array([0.0, 0.0, self.middle])
        points = keypoints(body, skin(body, transforms), transforms)
        return joint_positions(body, transforms) - down, points - down

    def pose(self, times: Float) -> Pose:
        """Pose of the body [T]; its frame is ``middle`` below the box's centre."""
        return self.motion.pose(times)


def plan_people(
    config: SyntheticConfig,
    street: Street,
    times_us: NDArray[np.int64],
    traffic: list[tuple[Trajectory, float, float]],
) -> tuple[PlannedPerson, ...]:
    """People and cyclists, in this order.

    Args:
        config: configuration of the drive.
        street: its course.
        times_us: [F] frames [us].
        traffic: path, length and width [m] of all moving and parked vehicles.
    """
    if config.pedestrians + config.cyclists == 0:
        return ()
    rng = np.random.default_rng([config.seed, 5])
    planner = _Planner(street, times_us, traffic, rng, reach=config.speed * config.duration)
    people = [planner.walker(what) for what in _first(config.pedestrians, planner.doings())]
    people += [planner.rider(number) for number in range(config.cyclists)]
    return tuple(people)


def _first(count: int, names: Iterator[str]) -> list[str]:
    return [next(names) for _ in range(count)]


class _Planner:
    """Plans paths without conflicts."""

    def __init__(
        self,
        street: Street,
        times_us: NDArray[np.int64],
        traffic: list[tuple[Trajectory, float, float]],
        rng: np.random.Generator,
        *,
        reach: float,
    ) -> None:
        self.street, self.times_us, self.rng, self.reach = street, times_us, rng, reach
        self.t: Float = times_us.astype(np.float64) * 1e-6
        self.traffic = [
            (np.stack([path.transform(int(t)) for t in times_us]), length, width)
            for path, length, width in traffic
        ]
        self.taken: list[Float] = []
        self.number = 0

    def doings(self) -> Iterator[str]:
        return cycle(
            ("crosses", "walks", "waits", "walks", "turns", "walks", "runs", "walks", "crosses",
             "walks")
        )  # fmt: skip

    def walker(self, doing: str) -> PlannedPerson:
        """A pedestrian; without a free path, one standing at the kerb."""
        body = self._somebody()
        style = GaitStyle(
            stride=float(self.rng.uniform(0.94, 1.06)),
            arms=float(self.rng.uniform(0.7, 1.25)),
            lean=float(self.rng.uniform(-0.02, 0.05)),
            width=float(self.rng.uniform(0.85, 1.2)),
            phase=float(self.rng.integers(2)),
        )
        ways: dict[str, Callable[[Body], Path]] = {
            "walks": self._walk, "runs": self._run, "waits": self._wait,
            "crosses": self._cross, "turns": self._turn,
        }  # fmt: skip
        for _ in range(_TRIES):
            path = ways[doing](body)
            places = self._places(path)
            if self._is_free(places):
                break
        else:
            doing = "waits"
            for _ in range(4 * _TRIES):
                path = self._wait(body)
                places = self._places(path)
                if self._is_free(places):
                    break
        yaw = self.street.heading(path[0]) + path[3]
        gait = plan_gait(body, self.t, places, yaw, style)
        return self._person("pedestrian", doing, gait, places, yaw)

    def rider(self, number: int) -> PlannedPerson:
        """A cyclist, alternately with and against the ego vehicle's direction."""
        names = ADULTS if number % 3 < 2 else ("girl", "boy")
        build = str(self.rng.choice(names))
        body = body_model().shaped(build, height=HEIGHTS.get(build))
        with_us = number % 2 == 0
        for _ in range(_TRIES):
            speed = self.rng.uniform(3.5, 6.0)
            start = self.rng.uniform(8, 16) if with_us else self.rng.uniform(26, 45)
            start += 9.0 * (number // 2)
            along = start + (speed if with_us else -speed) * self.t
            weave = 0.06 * np.sin(1.1 * self.t + self.rng.uniform(0, 6))
            side = -CYCLE_OFFSET if with_us else CYCLE_OFFSET
            turn = 0.0 if with_us else np.pi
            path = (along, side + weave, np.zeros_like(along), np.full_like(along, turn))
            places = self._places(path)
            if self._is_free(places, PASS + 0.6):
                break
        yaw = self._course(places, self.street.heading(along) + turn)
        ride = plan_ride(body, self.t, places, yaw)
        return self._person("cyclist", "rides", ride, places, yaw)

    def _somebody(self) -> Body:
        child = self.number % 5 == 3
        build = str(self.rng.choice(CHILDREN if child else ADULTS))
        body = body_model().shaped(build)
        height = HEIGHTS.get(build, body.height) * self.rng.uniform(0.97, 1.03)
        self.number += 1
        return body_model().shaped(build, height=float(height))

    def _walk(self, body: Body) -> Path:
        pace = np.sqrt(9.81 * body.leg_length)
        return self._along(self.rng.uniform(0.32, 0.5) * pace)

    def _run(self, body: Body) -> Path:
        return self._along(self.rng.uniform(0.9, 1.1) * np.sqrt(9.81 * body.leg_length))

    def _along(self, speed: float) -> Path:
        side, way = self.rng.choice([-1.0, 1.0], 2)
        start = self.rng.uniform(7, 18 + 0.8 * self.reach) - 0.3 * way * speed * self.t[-1]
        s = start + way * speed * self.t
        d = side * self.rng.uniform(LOW, HIGH) + 0.05 * np.sin(
            0.8 * self.t + self.rng.uniform(0, 6)
        )
        return s, d, np.full_like(s, KERB_HEIGHT), np.full_like(s, 0.0 if way > 0 else np.pi)

    def _wait(self, body: Body) -> Path:
        side = self.rng.choice([-1.0, 1.0])
        s = np.full_like(self.t, self.street.crossing + self.rng.uniform(-4.0, 4.0))
        d = np.full_like(s, side * (WAITING + self.rng.uniform(0.0, 1.2)))
        facing = -side * np.pi / 2 + self.rng.normal(scale=0.3)
        return s, d, np.full_like(s, KERB_HEIGHT), np.full_like(s, facing)

    def _cross(self, body: Body) -> Path:
        """A walk over the crossing, after a moment at the kerb or already moving."""
        side = self.rng.choice([-1.0, 1.0])
        speed = self.rng.uniform(0.38, 0.5) * np.sqrt(9.81 * body.leg_length)
        begin = self.rng.uniform(-8.0, max(self.t[-1] - 1.0, -2.0))
        gone = _started(self.t - begin, speed, rise=0.6)
        d = side * (WAITING + 0.1 - np.clip(gone, 0.0, 2 * WAITING + 2.0))
        s = np.full_like(d, self.street.crossing + self.rng.uniform(-1.2, 1.2))
        return s, d, _pavement(d), np.full_like(s, -side * np.pi / 2)

    def _turn(self, body: Body) -> Path:
        """A walk along the pavement and around a corner to the kerb, with a halt there."""
        side, way = self.rng.choice([-1.0, 1.0], 2)
        speed = self.rng.uniform(0.38, 0.48) * np.sqrt(9.81 * body.leg_length)
        lane, radius = self.rng.uniform(7.6, HIGH), 0.9
        corner = self.street.crossing + self.rng.uniform(-1.5, 1.5)
        to_kerb = lane - WAITING - radius
        bend = radius * np.pi / 2
        at_corner = self.rng.uniform(0.15, 0.6) * self.t[-1]
        total = speed * at_corner + bend + max(to_kerb, 0.0)
        gone = total - _started((at_corner + (bend + to_kerb) / speed) - self.t, speed, rise=0.8)
        past = gone - speed * at_corner
        angle = np.clip(past / radius, 0.0, np.pi / 2)
        s = corner + way * (np.minimum(past, 0.0) - radius + radius * np.sin(angle))
        d = lane - radius * (1 - np.cos(angle)) - np.maximum(past - bend, 0.0)
        facing = np.where(way > 0, 0.0, np.pi) - side * way * angle
        return s, side * d, np.full_like(s, KERB_HEIGHT), facing

    def _places(self, path: Path) -> Float:
        s, d, z, _ = path
        return np.column_stack([self.street.point(s, d), z])

    def _course(self, places: Float, known: Float) -> Float:
        """Headings along positions with motion."""
        if len(places) < 2:
            return known
        step = np.gradient(places[:, :2], axis=0)
        return np.unwrap(np.arctan2(step[:, 1], step[:, 0]))

    def _is_free(self, places: Float, apart: float = PASS) -> bool:
        for other in self.taken:
            if (np.linalg.norm(places[:, :2] - other[:, :2], axis=1) < apart).any():
                return False
        for poses, length, width in self.traffic:
            local = np.einsum("tji,tj->ti", poses[:, :2, :2], places[:, :2] - poses[:, :2, 3])
            near = (np.abs(local[:, 0]) < length / 2 + 0.7) & (
                np.abs(local[:, 1]) < width / 2 + 0.35
            )
            if near.any():
                return False
        return True

    def _person(
        self, category: str, doing: str, motion: Gait | Ride, places: Float, yaw: Float
    ) -> PlannedPerson:
        self.taken.append(places)
        drafted = PlannedPerson(
            category, doing, motion, self._dress(motion.body),
            Trajectory(self.times_us, places, yaw_quaternion(yaw)), (0.0, 0.0, 0.0), 0.0,
        )  # fmt: skip
        low, high = _extent(drafted, self.t)
        middle = float(low[2] + high[2]) / 2
        size = (*(2 * np.maximum(-low, high)[:2]), high[2] - low[2])
        raised = places + np.array([0.0, 0.0, middle])
        return PlannedPerson(
            category, doing, motion, drafted.looks,
            Trajectory(self.times_us, raised, yaw_quaternion(yaw)),
            (float(size[0]), float(size[1]), float(size[2])), middle,
        )  # fmt: skip

    def _dress(self, body: Body) -> Looks:
        rng = self.rng
        skin_, hair, top, legs, shoes, skirt, frame = (
            _picked(colours, rng) for colours in (SKIN, HAIR, TOPS, TROUSERS, SHOES, TOPS, FRAMES)
        )
        groups = tuple(g for g in ("long_hair", "skirt") if rng.random() < 0.35)
        if not _is_female(body):
            groups = ()
        sleeves = top if rng.random() < 0.7 else skin_
        trousers = legs if "skirt" not in groups or rng.random() < 0.5 else skin_
        colours = {
            "head": skin_, "hair": hair, "eyes": (0.03, 0.02, 0.015), "torso": top,
            "hips": legs, "skirt": skirt,
            **{f"upper_arm_{s}": top for s in "lr"}, **{f"forearm_{s}": sleeves for s in "lr"},
            **{f"hand_{s}": skin_ for s in "lr"}, **{f"thigh_{s}": trousers for s in "lr"},
            **{f"calf_{s}": trousers for s in "lr"}, **{f"foot_{s}": shoes for s in "lr"},
        }  # fmt: skip
        return Looks(groups, colours, frame)


def _started(t: Float, speed: float, *, rise: float) -> Float:
    """Distance at times after a start; acceleration to ``speed`` is constant over ``rise`` [s]."""
    t = np.maximum(t, 0.0)
    return speed * np.where(t < rise, t * t / (2 * rise), t - rise / 2)


def _pavement(d: Float) -> Float:
    """Height of the ground, smoothed over a stride at kerbs [m]."""
    over = np.clip((np.abs(d) - (KERB - 0.3)) / 0.6, 0.0, 1.0)
    return KERB_HEIGHT * over


def _is_female(body: Body) -> bool:
    builds = body.model.builds
    return any(np.array_equal(body.shape, builds[n]) for n in builds if n.endswith(WOMEN))


def _picked(colours: tuple[Colour, ...], rng: np.random.Generator) -> Colour:
    """A random colour of a list, slightly lighter or darker."""
    r, g, b = np.array(colours[rng.integers(len(colours))]) * rng.uniform(0.85, 1.15)
    return float(r), float(g), float(b)


def _extent(person: PlannedPerson, t: Float) -> tuple[Float, Float]:
    """Lowest and highest corner of all poses of a drive, with a centimetre to spare."""
    times = np.arange(t[0] - 0.06, t[-1] + 0.06, 0.05)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for part in np.array_split(times, max(len(times) // 16, 1)):
        vertices = person.vertices(part)
        low = np.minimum(low, vertices.min(axis=(0, 1)))
        high = np.maximum(high, vertices.max(axis=(0, 1)))
    return low - 0.01, high + 0.01


PARKED_OFFSET = (LANE + KERB) / 2 + 0.05
EGO_SPACE = (7.6, 1.9)
"""Clearance for the ego vehicle, length and width about its rear axle [m]."""
COLOURS = (
    (0.62, 0.62, 0.61), (0.62, 0.62, 0.61), (0.3, 0.31, 0.32), (0.1, 0.105, 0.11),
    (0.022, 0.022, 0.025), (0.32, 0.02, 0.018), (0.025, 0.07, 0.24), (0.06, 0.16, 0.3),
    (0.03, 0.09, 0.05), (0.36, 0.3, 0.2), (0.5, 0.22, 0.02),
)  # fmt: skip

Distance = Callable[[Float], Float]


@dataclass(frozen=True, eq=False)
class DrivePlan:
    """The plan of a drive, without its appearance.

    Attributes:
        street: its course.
        frame_times_us: [F] int64 [us].
        ego: ``T_world_vehicle``.
        vehicles: all others, moving ones first.
        people: on foot, then on bicycles.
    """

    street: Street
    frame_times_us: NDArray[np.int64]
    ego: Trajectory
    vehicles: tuple[PlannedVehicle, ...]
    people: tuple[PlannedPerson, ...] = ()


@dataclass(frozen=True, eq=False)
class PlannedVehicle:
    """A vehicle on the street.

    Attributes:
        shape: index into ``vehicles.SHAPES``.
        colour: colour of the body, linear RGB.
        trajectory: ``T_world_object`` of its box.
    """

    shape: int
    colour: tuple[float, float, float]
    trajectory: Trajectory


def plan_drive(config: SyntheticConfig) -> DrivePlan:
    """Lay the street and plan all traffic."""
    street_rng, traffic_rng = (np.random.default_rng([config.seed, i]) for i in range(2))
    times_us = np.arange(config.frames, dtype=np.int64) * config.frame_period_us
    distance = _drive_distance(config, traffic_rng)
    street = lay_street(street_rng, drive_length=float(distance(np.array(config.duration))))
    ego = _drive_ego(street, distance, times_us)
    vehicles = _place_vehicles(street, distance, config, times_us, traffic_rng)
    driving = [(v.trajectory, *SHAPES[v.shape].size[:2]) for v in vehicles]
    people = plan_people(config, street, times_us, [(ego, *EGO_SPACE), *driving])
    return DrivePlan(street, times_us, ego, tuple(vehicles), people)


def _drive_distance(config: SyntheticConfig, rng: np.random.Generator) -> Distance:
    """Distance [m] driven by the ego vehicle at times [s], at varying speed."""
    period, phase = rng.uniform(6, 10), rng.uniform(0, 2 * np.pi)
    rate = 2 * np.pi / period

    def distance(t: Float) -> Float:
        driven: Float = t + 0.22 / rate * (np.cos(phase) - np.cos(rate * t + phase))
        return config.speed * driven

    return distance


def _drive_ego(street: Street, distance: Distance, times_us: NDArray[np.int64]) -> Trajectory:
    """``T_world_vehicle``: in the middle of the right lane."""
    s = distance(_seconds(times_us))
    return _follow(street, s, np.full_like(s, EGO_OFFSET), times_us, turn=0.0, z=0.0)


def _follow(
    street: Street, s: Float, d: Float, times_us: NDArray[np.int64], *, turn: float, z: float
) -> Trajectory:
    """Motion along street coordinates s, d [T], facing ``turn`` [rad] to the street's heading."""
    xy = street.point(s, d)
    positions = np.concatenate([xy, np.full((len(xy), 1), z)], axis=1)
    return Trajectory(times_us, positions, yaw_quaternion(street.heading(s) + turn))


def _place_vehicles(
    street: Street,
    distance: Distance,
    config: SyntheticConfig,
    times_us: NDArray[np.int64],
    rng: np.random.Generator,
) -> list[PlannedVehicle]:
    """All vehicles, moving ones first."""
    ahead = (config.moving_cars + 1) // 2
    return [
        *_drive_ahead(ahead, street, distance, times_us, rng),
        *_drive_towards(config.moving_cars - ahead, street, config, times_us, rng),
        *_park(street, distance, config, times_us, rng),
    ]


def _drive_ahead(
    count: int,
    street: Street,
    distance: Distance,
    times_us: NDArray[np.int64],
    rng: np.random.Generator,
) -> list[PlannedVehicle]:
    vehicles = []
    t = _seconds(times_us)
    gap = rng.uniform(11, 14)
    for _ in range(count):
        shape = _pick(rng, longest=6.0)
        length = SHAPES[shape].size[0]
        gap += length / 2
        s = distance(t) + gap + 0.45 * t + 0.6 * np.sin(0.7 * t + rng.uniform(0, 6))
        vehicles.append(_moving(shape, street, s, times_us, rng, turn=0.0))
        gap += length / 2 + rng.uniform(9, 16)
    return vehicles


def _drive_towards(
    count: int,
    street: Street,
    config: SyntheticConfig,
    times_us: NDArray[np.int64],
    rng: np.random.Generator,
) -> list[PlannedVehicle]:
    vehicles = []
    speed = rng.uniform(0.8, 1.1) * config.speed
    start = rng.uniform(24, 32)
    for i in range(count):
        # Every second vehicle is large, so that even short drives contain trucks and buses.
        shape = _pick(rng, longest=6.0) if i % 2 == 0 else _pick(rng, shortest=6.0)
        length = SHAPES[shape].size[0]
        start += length / 2
        s = start - speed * _seconds(times_us)
        vehicles.append(_moving(shape, street, s, times_us, rng, turn=np.pi))
        start += length / 2 + rng.uniform(10, 22)
    return vehicles


def _moving(
    shape: int,
    street: Street,
    s: Float,
    times_us: NDArray[np.int64],
    rng: np.random.Generator,
    *,
    turn: float,
) -> PlannedVehicle:
    z = SHAPES[shape].size[2] / 2
    # Traffic keeps right, so oncoming vehicles drive left of the centre line.
    d = EGO_OFFSET if turn == 0.0 else -EGO_OFFSET
    trajectory = _follow(street, s, np.full_like(s, d), times_us, turn=turn, z=z)
    return PlannedVehicle(shape, _colour(rng), trajectory)


def _park(
    street: Street,
    distance: Distance,
    config: SyntheticConfig,
    times_us: NDArray[np.int64],
    rng: np.random.Generator,
) -> list[PlannedVehicle]:
    farthest = float(distance(np.array(config.duration))) + 50.0
    bays = np.arange(np.floor(-8.0 / PARKING_BAY), np.floor(farthest / PARKING_BAY))
    middles = (bays + 0.5) * PARKING_BAY
    middles = middles[np.abs(middles - street.crossing) > 7.5]
    places = [(float(s), side) for s in middles for side in (-1.0, 1.0)]
    chosen = rng.permutation(len(places))[: config.parked_cars]
    ends = np.unique(times_us[[0, -1]])
    vehicles = []
    for place in sorted(chosen):
        s, side = places[place]
        shape = _pick(rng, longest=6.0)
        at = np.full(len(ends), s + rng.uniform(-0.3, 0.3))
        offset = np.full(len(ends), side * (PARKED_OFFSET + rng.uniform(-0.08, 0.1)))
        turn = (np.pi if side > 0 else 0.0) + rng.normal(scale=0.012)
        z = SHAPES[shape].size[2] / 2
        trajectory = _follow(street, at, offset, ends, turn=turn, z=z)
        vehicles.append(PlannedVehicle(shape, _colour(rng), trajectory))
    return vehicles


def _pick(rng: np.random.Generator, *, shortest: float = 0.0, longest: float = float("inf")) -> int:
    fitting = [i for i, s in enumerate(SHAPES) if shortest <= s.size[0] <= longest]
    weights = np.array([SHAPES[i].weight for i in fitting])
    return fitting[int(rng.choice(len(fitting), p=weights / weights.sum()))]


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    r, g, b = np.array(COLOURS[rng.integers(len(COLOURS))]) * rng.uniform(0.9, 1.1)
    return float(r), float(g), float(b)


def _seconds(times_us: NDArray[np.int64]) -> Float:
    return times_us.astype(np.float64) * 1e-6


def poses_at(trajectory: Trajectory, times_us: Float) -> Float:
    """``T_fixed_moving`` [T, 4, 4] at any times [T] [us].

    Between time stamps as in :class:`Trajectory`; outside, straight ahead with the velocity of the
    nearest segment.
    """
    known = trajectory.times_us
    if len(known) == 1:
        pose = transform_from(trajectory.positions[0], trajectory.quaternions[0])
        return np.broadcast_to(pose, (len(times_us), 4, 4))
    before = np.clip(np.searchsorted(known, times_us, side="right") - 1, 0, len(known) - 2)
    fraction = (times_us - known[before]) / (known[before + 1] - known[before])
    start, end = trajectory.positions[before], trajectory.positions[before + 1]
    position = start + fraction[:, None] * (end - start)
    quaternion = slerp(
        trajectory.quaternions[before],
        trajectory.quaternions[before + 1],
        np.clip(fraction, 0.0, 1.0),
    )
    return transform_from(position, quaternion)
