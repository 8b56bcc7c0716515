"""LiDARs and radars: the rays of a sweep, their times, and the detector.

``lidar_models/`` holds one JSON file per catalogued LiDAR; ``docs/lidar.md`` describes the format.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from os import PathLike
from pathlib import Path
from typing import Any, assert_never

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import TypeAdapter, ValidationError

from real2sim_proto.base import invalid_reason
from real2sim_proto.sensors import (
    MAX_RAYS,
    GridBeams,
    LidarModel,
    RadarModel,
    RosetteBeams,
    SpinningBeams,
    TableBeams,
)

from .._files import read_text
from ..geometry import Float, is_rigid, wrapped
from .errors import LidarError, RadarError

MAX_SLOTS = 2048
"""Maximum number of pose times per sweep: 0.05 ms apart at 10 Hz, 0.4 mm at 15 m/s."""
MAX_RANGE_M = 2000.0
MAX_DIVERGENCE = 0.1


@dataclass(frozen=True, eq=False)
class Beams:
    """The rays of one sweep in the sensor's frame (x forward, y left, z up).

    Attributes:
        azimuth: [...] float64 [rad], from x towards y.
        elevation: [...] float64 [rad], from the horizontal plane upwards.
        time_us: [...] float64, firing time of each ray, relative to the sweep's time stamp [us].

    The shape is [B, C] (row of the sensor, column of the turn) for spinning sensors and [R] for
    tables; results of a cast have the same shape.

    Raises:
        LidarError: shapes differ, values are not finite, elevations exceed 90 degrees, there is no
            ray, or there are more than MAX_RAYS.
    """

    azimuth: Float
    elevation: Float
    time_us: Float

    def __post_init__(self) -> None:
        arrays = {
            name: np.array(getattr(self, name), dtype=np.float64)
            for name in ("azimuth", "elevation", "time_us")
        }
        shapes = {name: array.shape for name, array in arrays.items()}
        if len(set(shapes.values())) != 1:
            raise LidarError(f"azimuth, elevation and time_us must be of one shape, not {shapes}")
        count = arrays["azimuth"].size
        if not 1 <= count <= MAX_RAYS:
            raise LidarError(f"a sweep of {count:,} rays; allowed are 1 to {MAX_RAYS:,}")
        for name, array in arrays.items():
            bad = int((~np.isfinite(array)).sum())
            if bad:
                raise LidarError(f"{bad:,} of {count:,} values of {name} are not finite")
        steepest = float(np.abs(arrays["elevation"]).max())
        if steepest > np.pi / 2 + 1e-9:
            raise LidarError(
                f"elevations reach {np.degrees(steepest):.1f} degrees; allowed are -90 to 90"
            )
        for name, array in arrays.items():
            object.__setattr__(self, name, array)

    @classmethod
    def spinning(
        cls,
        elevation: ArrayLike,
        *,
        columns: int,
        rate_hz: float = 10.0,
        azimuth_offset: ArrayLike = 0.0,
        clockwise: bool = True,
        start: float = np.pi,
        field_of_view: float = 2 * np.pi,
    ) -> Beams:
        """Rows that rotate about the sensor's z axis.

        Args:
            elevation: [B] of each row [rad].
            columns: azimuth steps of a sweep, C.
            rate_hz: turns per second; a sweep takes a whole turn.
            azimuth_offset: [B] or one number, of the rows relative to the column's azimuth [rad].
            clockwise: whether the sensor rotates clockwise seen from above.
            start: azimuth of the first column [rad].
            field_of_view: azimuth range of the columns [rad]; less than a turn is centred on the
                middle of the turn. The time stamp of a sweep is the middle of the turn.

        Raises:
            LidarError: counts or numbers out of range; the message names them.
        """
        rows = np.atleast_1d(np.asarray(elevation, dtype=np.float64))
        offsets = np.broadcast_to(np.asarray(azimuth_offset, dtype=np.float64), rows.shape)
        if not 1 <= len(rows) * int(columns) <= MAX_RAYS or columns < 1:
            raise LidarError(
                f"{len(rows)} rows of {columns:,} columns; allowed are 1 to {MAX_RAYS:,} rays"
            )
        _check_range("rate_hz", rate_hz, 0.1, 1000.0)
        _check_range("field_of_view", field_of_view, 1e-3, 2 * np.pi + 1e-9)
        part = field_of_view / (2 * np.pi)
        step = (np.arange(columns) + 0.5) / columns
        turn = 0.5 + (step - 0.5) * part
        direction = -1.0 if clockwise else 1.0
        azimuth = start + direction * 2 * np.pi * turn
        time_us = (turn - 0.5) * 1e6 / rate_hz
        shape = (len(rows), columns)
        return cls(
            wrapped(azimuth[None] + offsets[:, None]),
            np.broadcast_to(rows[:, None], shape),
            np.broadcast_to(time_us[None], shape),
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of all arrays and of a cast's results."""
        return tuple(self.azimuth.shape)

    @property
    def count(self) -> int:
        """Number of rays."""
        return int(self.azimuth.size)

    @cached_property
    def directions(self) -> Float:
        """[..., 3] unit vectors in the sensor's frame."""
        flat = np.cos(self.elevation)
        x, y = flat * np.cos(self.azimuth), flat * np.sin(self.azimuth)
        return np.stack([x, y, np.sin(self.elevation)], axis=-1)

    @cached_property
    def slots(self) -> tuple[Float, NDArray[np.int32]]:
        """Pose times [S] [us], increasing, and the slot of each ray [...].

        All distinct times if there are at most MAX_SLOTS, as with columns; otherwise MAX_SLOTS
        evenly spread ones.
        """
        times, index = np.unique(self.time_us.ravel(), return_inverse=True)
        if len(times) > MAX_SLOTS:
            step = (times[-1] - times[0]) / MAX_SLOTS
            index = np.minimum((self.time_us.ravel() - times[0]) / step, MAX_SLOTS - 1)
            times = times[0] + (np.arange(MAX_SLOTS) + 0.5) * step
        return times, index.astype(np.int32).reshape(self.shape)


@dataclass(frozen=True)
class Detection:
    """Thresholds of the detector for a return.

    Attributes:
        range_m, reflectivity: a diffuse surface of this reflectivity, in (0, 1], is just detected
            at this distance. Power falls with the square of the distance.
        loss: share of rays lost independent of the target, 0 to 1.
        softness: width of the transition from detected to lost, as a share of the limiting power.

    Raises:
        LidarError: a value is out of range.
    """

    range_m: float = 120.0
    reflectivity: float = 0.1
    loss: float = 0.0
    softness: float = 0.25

    def __post_init__(self) -> None:
        _check_range("detection range_m", self.range_m, 0.1, MAX_RANGE_M)
        _check_range("detection reflectivity", self.reflectivity, 1e-6, 1.0)
        _check_range("detection loss", self.loss, 0.0, 1.0)
        _check_range("detection softness", self.softness, 1e-6, 10.0)


@dataclass(frozen=True, eq=False)
class Lidar:
    """A LiDAR on the vehicle.

    Attributes:
        name: unique on its vehicle.
        beams: directions and times of the rays.
        T_vehicle_lidar: [4, 4] float64, sensor frame x forward, y left, z up.
        min_range, max_range: range of returns [m]; nearer surfaces are invisible and transparent.
        divergence: (horizontal, vertical) full angle of a beam at 1/e^2 of its power [rad]; its
            standard deviation on a surface is a quarter of its diameter there.
        returns: 1 (the median of the light), 2 (first and last) or 3 (and the strongest).
        pulse: echoes closer than this along the ray form one return [m].
        range_noise: standard deviation of a measured range [m].
        detection: thresholds.
        source: origin of the numbers.

    Raises:
        LidarError: a value is out of range; the message gives the allowed range.
    """

    name: str
    beams: Beams
    T_vehicle_lidar: Float = field(default_factory=lambda: np.eye(4))
    min_range: float = 0.5
    max_range: float = 120.0
    divergence: tuple[float, float] = (0.0, 0.0)
    returns: int = 1
    pulse: float = 0.4
    range_noise: float = 0.0
    detection: Detection = field(default_factory=Detection)
    source: str = ""

    def __post_init__(self) -> None:
        what = f"lidar {self.name!r}: "
        pose = np.array(self.T_vehicle_lidar, dtype=np.float64)
        if not is_rigid(pose):
            raise LidarError(f"{what}T_vehicle_lidar is not a rigid transform")
        object.__setattr__(self, "T_vehicle_lidar", pose)
        _check_range(f"{what}min_range", self.min_range, 0.0, MAX_RANGE_M)
        _check_range(f"{what}max_range", self.max_range, 0.1, MAX_RANGE_M)
        if self.min_range >= self.max_range:
            raise LidarError(
                f"{what}min_range {self.min_range} m must be below max_range {self.max_range} m"
            )
        if len(self.divergence) != 2:
            raise LidarError(f"{what}divergence must be (horizontal, vertical) in rad")
        for angle in self.divergence:
            _check_range(f"{what}divergence", angle, 0.0, MAX_DIVERGENCE)
        if self.returns not in (1, 2, 3):
            raise LidarError(f"{what}returns must be 1, 2 or 3, not {self.returns!r}")
        _check_range(f"{what}pulse", self.pulse, 0.01, 10.0)
        _check_range(f"{what}range_noise", self.range_noise, 0.0, 10.0)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a cast's results: [B, C] or [R]."""
        return self.beams.shape

    def placed(self, T_vehicle_lidar: ArrayLike) -> Lidar:
        """The same sensor at another pose on the vehicle."""
        return replace(self, T_vehicle_lidar=np.asarray(T_vehicle_lidar, dtype=np.float64))


def _check_range(what: str, value: float, low: float, high: float) -> None:
    if not (isinstance(value, (int, float)) and low <= value <= high):
        raise LidarError(f"{what} must be from {low:g} to {high:g}, not {value!r}")


# Catalogue of LiDARs.

LIDAR_FOLDER = Path(__file__).parent / "lidar_models"
MAX_LIDAR_FILE_BYTES = 64 << 20
LIDAR_MOUNT = (0.9, 0.0, 1.73)
"""Default position of LiDARs, from the vehicle's rear axle [m]."""


@cache
def lidar_names() -> tuple[str, ...]:
    """Names of the catalogue."""
    return tuple(sorted(path.stem for path in LIDAR_FOLDER.glob("*.json")))


@cache
def catalogue_lidar(name: str) -> Lidar:
    """The LiDAR of that name in the catalogue.

    Raises:
        LidarError: the name is unknown; the message lists the known ones.
    """
    if name not in lidar_names():
        known = ", ".join(lidar_names())
        raise LidarError(f"no LiDAR {name!r} in the catalogue; it has {known}")
    return read_lidar(LIDAR_FOLDER / f"{name}.json")


def find_lidar(name: str) -> Lidar:
    """Find a LiDAR by a catalogue name, or by the path of a JSON file (ending in ``.json``).

    Raises:
        LidarError: an unknown name, or a file without a LiDAR.
    """
    return read_lidar(name) if name.lower().endswith(".json") else catalogue_lidar(name)


def read_lidar(path: str | PathLike[str]) -> Lidar:
    """The LiDAR of a JSON file.

    Raises:
        LidarError: the file is missing, too large, or not a LiDAR; gives the location and reason.
    """
    file = Path(path)
    try:
        if file.stat().st_size > MAX_LIDAR_FILE_BYTES:
            raise LidarError(
                f"{file}: {file.stat().st_size:,} bytes; at most {MAX_LIDAR_FILE_BYTES:,}"
            )
        values = json.loads(read_text(file))
    except (OSError, ValueError, RecursionError) as error:
        raise LidarError(f"{file}: no readable JSON file: {error}") from error
    try:
        return lidar_from_values(values)
    except LidarError as error:
        raise LidarError(f"{file}: {error}") from error


def lidar_from_values(values: Any) -> Lidar:
    """The LiDAR of JSON values.

    Raises:
        LidarError: names the first invalid fields and the reasons.
    """
    try:
        model = TypeAdapter(LidarModel).validate_python(values)
    except ValidationError as error:
        reasons = [
            f"{'.'.join(map(str, issue['loc']))}: {invalid_reason(issue)}"
            for issue in error.errors()[:4]
        ]
        raise LidarError("; ".join(reasons)) from error
    return lidar_of(model)


def lidar_of(model: LidarModel) -> Lidar:
    """The sensor; at LIDAR_MOUNT if the model has no pose.

    Raises:
        LidarError: a value is out of range; the message gives the allowed range.
    """
    pose = np.eye(4)
    pose[:3, 3] = LIDAR_MOUNT
    if model.T_vehicle_lidar is not None:
        pose = _matrix(model.T_vehicle_lidar)
    horizontal, vertical = model.divergence_mrad
    return Lidar(
        name=model.name,
        beams=_beams_of(model.beams),
        T_vehicle_lidar=pose,
        min_range=model.range_m[0],
        max_range=model.range_m[1],
        divergence=(horizontal * 1e-3, vertical * 1e-3),
        returns=model.returns,
        pulse=model.pulse_m,
        range_noise=model.range_noise_m,
        detection=Detection(**model.detection.model_dump()),
        source=model.source,
    )


def _beams_of(beams: SpinningBeams | TableBeams | GridBeams | RosetteBeams) -> Beams:
    match beams:
        case SpinningBeams():
            return _spinning(beams)
        case TableBeams():
            azimuth, elevation = np.radians(beams.azimuth_deg), np.radians(beams.elevation_deg)
            return Beams(azimuth, elevation, np.array(beams.time_us))
        case GridBeams():
            return _grid(beams)
        case RosetteBeams():
            return _rosette(beams)
        case _:
            assert_never(beams)


def _spinning(beams: SpinningBeams) -> Beams:
    offsets = beams.azimuth_offset_deg or [0.0] * len(beams.elevation_deg)
    if len(offsets) != len(beams.elevation_deg):
        raise LidarError(
            f"{len(offsets)} azimuth_offset_deg for {len(beams.elevation_deg)} elevation_deg"
        )
    return Beams.spinning(
        np.radians(beams.elevation_deg),
        columns=beams.columns,
        rate_hz=beams.rate_hz,
        azimuth_offset=np.radians(offsets),
        clockwise=beams.clockwise,
        start=float(np.radians(beams.start_deg)),
        field_of_view=float(np.radians(beams.field_of_view_deg)),
    )


def _grid(beams: GridBeams) -> Beams:
    """Row by row."""
    if beams.rows * beams.columns > MAX_RAYS:
        raise LidarError(
            f"{beams.rows:,} rows of {beams.columns:,} columns; allowed are {MAX_RAYS:,} rays"
        )
    high, low = max(beams.elevation_deg), min(beams.elevation_deg)
    left, right = max(beams.azimuth_deg), min(beams.azimuth_deg)
    elevation = np.radians(_centres(high, low, beams.rows))
    azimuth = np.radians(_centres(left, right, beams.columns))
    row, column = np.divmod(np.arange(beams.rows * beams.columns), beams.columns)
    time_us = (np.arange(len(row)) + 0.5) / len(row) - 0.5
    return Beams(azimuth[column], elevation[row], time_us * 1e6 / beams.rate_hz)


def _rosette(beams: RosetteBeams) -> Beams:
    """Rosette scan in time order. The deflections of the prisms add up: (azimuth, elevation) = r/2
    (e^(i a t) + e^(i b t)).
    """
    seconds = ((np.arange(beams.rays) + 0.5) / beams.rays - 0.5) / beams.rate_hz
    first, second = (2 * np.pi * turns / 60 * seconds for turns in beams.turns_per_minute)
    half = np.radians(beams.radius_deg) / 2
    azimuth = half * (np.cos(first) + np.cos(second))
    elevation = half * (np.sin(first) + np.sin(second))
    return Beams(azimuth, elevation, seconds * 1e6)


def _centres(first: float, last: float, count: int) -> Float:
    """Centres of ``count`` even steps from one edge to the other."""
    return first + (last - first) * (np.arange(count) + 0.5) / count


def _matrix(rows: list[list[float]]) -> Float:
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise LidarError("T_vehicle_lidar must be four rows of four numbers")
    return np.array(rows, dtype=np.float64)


# Radars.

RADARS: Mapping[str, RadarModel] = {
    "mid-range": RadarModel(),
    "long-range": RadarModel(
        range_m=(0.5, 280.0),
        field_of_view_deg=(50.0, 12.0),
        azimuth_resolution_deg=1.0,
        elevation_resolution_deg=12.0,
        detection_range_m=250.0,
        ray_spacing_deg=0.2,
    ),
    "corner": RadarModel(
        range_m=(0.3, 80.0),
        field_of_view_deg=(150.0, 24.0),
        range_resolution_m=0.3,
        azimuth_resolution_deg=4.0,
        elevation_resolution_deg=24.0,
        detection_range_m=70.0,
        ray_spacing_deg=0.6,
    ),
    "imaging": RadarModel(
        range_m=(0.5, 250.0),
        field_of_view_deg=(110.0, 24.0),
        range_resolution_m=0.2,
        azimuth_resolution_deg=1.0,
        elevation_resolution_deg=2.0,
        detection_range_m=200.0,
        ray_spacing_deg=0.3,
    ),
}
"""Four kinds of 77 GHz radars with typical orders of magnitude, not data of a manufacturer."""

RADAR_MOUNT = (3.6, 0.0, 0.5)
"""Default position of radars, from the vehicle's rear axle [m]."""


def radar_mount() -> Float:
    """``T_vehicle_radar`` [4, 4] at RADAR_MOUNT, looking ahead."""
    pose = np.eye(4)
    pose[:3, 3] = RADAR_MOUNT
    return pose


def catalogue_radar(name: str) -> RadarModel:
    """The radar of that name in the catalogue.

    Raises:
        RadarError: it is not in the catalogue; lists the known ones.
    """
    if name not in RADARS:
        raise RadarError(f"no radar {name!r} in the catalogue; it has {', '.join(RADARS)}")
    return RADARS[name]


@dataclass(frozen=True, eq=False)
class Radar:
    """A radar on the vehicle.

    Attributes:
        name: unique on its vehicle.
        model: resolution and detection limits.
        T_vehicle_radar: [4, 4] float64, sensor frame x along its axis, y left, z up.

    Raises:
        RadarError: the pose is not a rigid transform.
    """

    name: str
    model: RadarModel
    T_vehicle_radar: Float = field(default_factory=radar_mount)

    def __post_init__(self) -> None:
        pose = np.array(self.T_vehicle_radar, dtype=np.float64)
        if not is_rigid(pose):
            raise RadarError(f"radar {self.name!r}: T_vehicle_radar is not a rigid transform")
        object.__setattr__(self, "T_vehicle_radar", pose)

    @cached_property
    def rays(self) -> Lidar:
        """The fan of rays that finds targets, all at one instant, [B, C]."""
        model = self.model
        wide, high = (
            max(round(angle / model.ray_spacing_deg), 1) for angle in model.field_of_view_deg
        )
        azimuth = _steps(model.field_of_view_deg[0], wide)
        elevation = _steps(model.field_of_view_deg[1], high)
        shape = (high, wide)
        beams = Beams(
            np.broadcast_to(azimuth, shape),
            np.broadcast_to(elevation[:, None], shape),
            np.zeros(shape),
        )
        near, far = model.range_m
        return Lidar(
            self.name,
            beams,
            self.T_vehicle_radar,
            min_range=near,
            max_range=far,
        )

    @property
    def solid_angle(self) -> float:
        """Solid angle of one ray on the axis [sr]."""
        wide, high = (
            np.radians(angle) / count
            for angle, count in zip(
                self.model.field_of_view_deg, self.rays.shape[::-1], strict=True
            )
        )
        return float(wide * high)


def _steps(degrees: float, count: int) -> Float:
    """Centres of ``count`` steps over an angle about 0 [rad]."""
    centres: Float = np.radians(degrees) * ((np.arange(count) + 0.5) / count - 0.5)
    return centres
