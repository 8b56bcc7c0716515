"""Who drives and parks where: the ego vehicle's path and all other vehicles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.transform import Float, slerp, transform_from, yaw_quaternion
from ..scene import Trajectory
from .config import SyntheticConfig
from .materials import PARKING_BAY
from .people import PlannedPerson, plan_people
from .street import EGO_OFFSET, KERB, LANE, Street, lay_street
from .vehicles import SHAPES

PARKED_OFFSET = (LANE + KERB) / 2 + 0.05
EGO_SPACE = (7.6, 1.9)
"""Length and width that people leave to the ego vehicle, whose origin is its rear axle [m]."""
COLOURS = (
    (0.62, 0.62, 0.61), (0.62, 0.62, 0.61), (0.3, 0.31, 0.32), (0.1, 0.105, 0.11),
    (0.022, 0.022, 0.025), (0.32, 0.02, 0.018), (0.025, 0.07, 0.24), (0.06, 0.16, 0.3),
    (0.03, 0.09, 0.05), (0.36, 0.3, 0.2), (0.5, 0.22, 0.02),
)  # fmt: skip

Distance = Callable[[Float], Float]


@dataclass(frozen=True, eq=False)
class DrivePlan:
    """Everything about a drive but what it looks like.

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
        colour: of the body, linear RGB.
        trajectory: ``T_world_object`` of its box.
    """

    shape: int
    colour: tuple[float, float, float]
    trajectory: Trajectory


def plan_drive(config: SyntheticConfig) -> DrivePlan:
    """Lay the street and plan who drives and parks where."""
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
    """Distance [m] the ego vehicle has driven at times [s]; it slows down and speeds up."""
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
        # Every second one is large, so that trucks and buses are seen on short drives too.
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
    # Both directions keep right, so those who come towards us drive left of the centre line.
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

    Between time stamps as :class:`Trajectory` does it; before and after them straight on with
    the velocity of the nearest segment.
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
