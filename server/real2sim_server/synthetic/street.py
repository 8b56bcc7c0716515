"""The street of a synthetic drive: configuration, course, cross-section and true lanes.

Street coordinates are (s, d): s along the centre line, d to its left [m]. Traffic keeps right.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from real2sim_proto.lanes import LaneKind

from ..geometry import Float, transform_from, yaw_quaternion
from ..scene import Area, Camera, CameraRig, Lane, LaneGraph, StopLine
from ..scene.camera import T_VEHICLE_OPTICAL

# Configuration.


@dataclass(frozen=True)
class CameraSpec:
    """A camera of the rig.

    Attributes:
        name: unique on the rig.
        yaw: viewing direction about the vehicle's z axis [rad], 0 = ahead, positive = left.
        fov: horizontal field of view [rad].
        position: position in the vehicle frame [m].
    """

    name: str
    yaw: float = 0.0
    fov: float = math.radians(70)
    position: tuple[float, float, float] = (1.7, 0.0, 1.6)


DEFAULT_CAMERAS = (
    CameraSpec("front"),
    CameraSpec("front_left", yaw=math.radians(50), position=(1.6, 0.25, 1.6)),
    CameraSpec("front_right", yaw=math.radians(-50), position=(1.6, -0.25, 1.6)),
)


@dataclass(frozen=True)
class SyntheticConfig:
    """Configuration of a synthetic drive; the same values give the same bits.

    Attributes:
        seed: seed of all randomness: street, traffic, textures, LiDAR noise.
        frames: number of frames.
        hz: frames per second, and turns of the LiDAR per second.
        width, height: image size of every camera [px].
        cameras: the rig.
        samples: rays per pixel along each image axis, at edges.
        moving_cars: number of moving vehicles, ahead of the ego vehicle and oncoming.
        parked_cars: number of vehicles at the kerbs; fewer if the street has less room.
        speed: mean speed of the ego vehicle [m/s].
        lidar_beams, lidar_columns: beams, and azimuth steps per turn; 0 beams for no LiDAR.
        lidar_range: maximum range [m].
        lidar_noise: standard deviation of the measured range [m].
        pedestrians, cyclists: number of people on foot and on bicycles; they do not change the
            vehicles of a street.

    Raises:
        ValueError: an invalid value.
    """

    seed: int = 0
    frames: int = 60
    hz: float = 10.0
    width: int = 480
    height: int = 320
    cameras: tuple[CameraSpec, ...] = DEFAULT_CAMERAS
    samples: int = 2
    moving_cars: int = 4
    parked_cars: int = 14
    speed: float = 8.0
    lidar_beams: int = 64
    lidar_columns: int = 1024
    lidar_range: float = 80.0
    lidar_noise: float = 0.02
    pedestrians: int = 0
    cyclists: int = 0

    def __post_init__(self) -> None:
        least = {
            "seed": 0,
            "frames": 1,
            "width": 1,
            "height": 1,
            "samples": 1,
            "moving_cars": 0,
            "parked_cars": 0,
            "lidar_beams": 0,
            "lidar_columns": 1,
            "lidar_noise": 0,
            "pedestrians": 0,
            "cyclists": 0,
        }
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f"{name} must be at least {bound}, not {getattr(self, name)!r}")
        for name, bound, limit in (("hz", 0, 1000), ("speed", 0, 40), ("lidar_range", 0, 1000)):
            if not bound < getattr(self, name) <= limit:
                raise ValueError(
                    f"{name} must be above {bound} and at most {limit}, not {getattr(self, name)!r}"
                )
        if not self.cameras:
            raise ValueError("cameras must name at least one camera")
        for camera in self.cameras:
            if not 0 < camera.fov < math.pi:
                raise ValueError(f"fov of {camera.name!r} must be in (0, pi), not {camera.fov!r}")

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> SyntheticConfig:
        """From the JSON values of ``dataclasses.asdict``, as in a log's provenance.

        Raises:
            KeyError, TypeError, ValueError: values of another version of this class.
        """
        cameras = tuple(
            CameraSpec(**{**camera, "position": tuple(camera["position"])})
            for camera in values["cameras"]
        )
        return cls(**{**values, "cameras": cameras})

    @property
    def frame_period_us(self) -> int:
        """Time between frames [us]."""
        return round(1e6 / self.hz)

    @property
    def duration(self) -> float:
        """Time from the first to the last frame [s]."""
        return (self.frames - 1) * self.frame_period_us * 1e-6

    def rig(self) -> CameraRig:
        """The calibrated cameras."""
        return CameraRig(tuple(self._camera(spec) for spec in self.cameras))

    def _camera(self, spec: CameraSpec) -> Camera:
        focal = self.width / (2 * math.tan(spec.fov / 2))
        k = np.array([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1]])
        pose = transform_from(spec.position, yaw_quaternion(spec.yaw)) @ T_VEHICLE_OPTICAL
        return Camera(spec.name, self.width, self.height, k, pose)


LANE = 3.4
"""Width of a driving lane [m]."""

KERB = 5.7
"""Distance of the kerbs from the centre line [m]: a lane and a parking strip."""

KERB_HEIGHT = 0.12
FACADE = 9.2
"""Distance of the building line from the centre line [m]."""

EGO_OFFSET = -LANE / 2
"""Lateral position of the ego vehicle, d [m]."""

_STEP = 0.5
_BEHIND, _AHEAD = 55.0, 105.0


@dataclass(frozen=True, eq=False)
class Street:
    """A gently winding centre line.

    Attributes:
        stations: [n] s of the samples [m].
        points: [n, 2] x, y in the world [m].
        headings: [n] direction of travel [rad].
        crossing: s of the pedestrian crossing [m].
    """

    stations: Float
    points: Float
    headings: Float
    crossing: float

    @property
    def start(self) -> float:
        """First s [m]."""
        return float(self.stations[0])

    @property
    def end(self) -> float:
        """Last s [m]."""
        return float(self.stations[-1])

    def heading(self, s: ArrayLike) -> Float:
        """Direction of travel [...] [rad] at s [...]."""
        return np.interp(np.asarray(s, dtype=np.float64), self.stations, self.headings)

    def point(self, s: ArrayLike, d: ArrayLike) -> Float:
        """World x, y [..., 2] of street coordinates [...]."""
        s, d = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(d, np.float64))
        heading = self.heading(s)
        x = np.interp(s, self.stations, self.points[:, 0]) - d * np.sin(heading)
        y = np.interp(s, self.stations, self.points[:, 1]) + d * np.cos(heading)
        return np.stack([x, y], axis=-1)


def lay_street(rng: np.random.Generator, *, drive_length: float) -> Street:
    """A street for a drive of ``drive_length`` [m] that starts at s = 0.

    The ego vehicle's lane passes the world's origin along x there.
    """
    stations = np.arange(-_BEHIND, drive_length + _AHEAD + _STEP, _STEP)
    bend = rng.choice([-1.0, 1.0]) * rng.uniform(1 / 260, 1 / 150)
    wave_length = rng.uniform(220, 320)
    curvature = bend * np.sin(2 * np.pi * (stations + rng.uniform(10, 30)) / wave_length)
    headings = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * _STEP)])
    headings -= np.interp(0, stations, headings)
    middle = (headings[1:] + headings[:-1]) / 2
    steps = np.stack([np.cos(middle), np.sin(middle)], axis=1) * _STEP
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    origin = [np.interp(0, stations, points[:, i]) for i in range(2)]
    points += np.array([0.0, -EGO_OFFSET]) - origin
    return Street(stations, points, headings, crossing=rng.uniform(22, 34))


# Lanes.

WALK_WIDTH = FACADE - KERB
STOP_LINE_M, CROSSING_M = 3.15, 1.8
"""Extent of the paint before and around the middle of the pedestrian crossing [m]."""
SPEED_LIMIT = 13.9


def street_lanes(street: Street) -> LaneGraph:
    """Driving lanes, parking strips, sidewalks, the crossing and its stop lines."""
    s = np.arange(street.start, street.end + 1e-9, 1.0)
    parking = KERB - LANE
    strips: list[tuple[str, LaneKind, float, float]] = [
        ("lane", "driving", LANE / 2, LANE),
        ("parking", "parking", LANE + parking / 2, parking),
        ("walk", "sidewalk", KERB + WALK_WIDTH / 2, WALK_WIDTH),
    ]
    lanes = []
    for name, kind, d, width in strips:
        for side, sign in (("right", -1), ("left", 1)):
            line = _line(street, s, sign * d)
            lanes.append(
                Lane(
                    f"{name}_{side}",
                    kind,
                    line if sign < 0 else line[::-1],
                    np.full(len(s), width),
                    speed_limit=SPEED_LIMIT if kind == "driving" else None,
                    opposite=f"lane_{'left' if sign < 0 else 'right'}" if name == "lane" else None,
                    right=f"parking_{side}" if name == "lane" else None,
                    may_change_right=False,
                )
            )
    crossing = _corners(street, street.crossing, CROSSING_M, KERB - 0.4)
    stops = [
        StopLine(
            f"stop_{side}",
            _line(
                street,
                np.full(2, street.crossing + sign * STOP_LINE_M),
                sign * np.array([0.15, LANE - 0.1]),
            ),
            (f"lane_{side}",),
        )
        for side, sign in (("right", -1), ("left", 1))
    ]
    return LaneGraph.of(
        lanes,
        areas=[Area("crossing", "crosswalk", crossing)],
        stop_lines=stops,
        source="synthetic street",
        accuracy=0.0,
    )


def _line(street: Street, s: Float, d: float | Float) -> Float:
    places = street.point(s, d)
    return np.column_stack([places, np.zeros(len(places))])


def _corners(street: Street, s: float, along: float, aside: float) -> Float:
    return _line(
        street,
        np.array([s - along, s + along, s + along, s - along]),
        np.array([-aside, -aside, aside, aside]),
    )
