"""LiDARs by name, and from a user's own JSON; one file of ``lidar_models/`` is one sensor.

``docs/lidar.md`` tells the format.
"""

from __future__ import annotations

import json
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from ..geometry.rotation import Float
from .errors import LidarError
from .lidar import MAX_RAYS, Beams, Detection, Lidar

FOLDER = Path(__file__).parent / "lidar_models"
MAX_FILE_BYTES = 64 << 20
Numbers = Annotated[list[float], Field(min_length=1, max_length=MAX_RAYS)]
Span = tuple[float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SpinningPart(_Part):
    """Rows that turn, see :meth:`~.lidar.Beams.spinning`; angles in degrees."""

    kind: Literal["spinning"]
    elevation_deg: Numbers
    azimuth_offset_deg: Numbers | None = None
    columns: int
    rate_hz: float = 10.0
    clockwise: bool = True
    start_deg: float = 180.0
    field_of_view_deg: float = 360.0

    def build(self) -> Beams:
        """The rays."""
        offsets = self.azimuth_offset_deg or [0.0] * len(self.elevation_deg)
        if len(offsets) != len(self.elevation_deg):
            raise LidarError(
                f"{len(offsets)} azimuth_offset_deg for {len(self.elevation_deg)} elevation_deg"
            )
        return Beams.spinning(
            np.radians(self.elevation_deg),
            columns=self.columns,
            rate_hz=self.rate_hz,
            azimuth_offset=np.radians(offsets),
            clockwise=self.clockwise,
            start=float(np.radians(self.start_deg)),
            field_of_view=float(np.radians(self.field_of_view_deg)),
        )


class TablePart(_Part):
    """Every ray by itself."""

    kind: Literal["table"]
    azimuth_deg: Numbers
    elevation_deg: Numbers
    time_us: Numbers

    def build(self) -> Beams:
        """The rays."""
        azimuth, elevation = np.radians(self.azimuth_deg), np.radians(self.elevation_deg)
        return Beams(azimuth, elevation, np.array(self.time_us))


class GridPart(_Part):
    """A solid-state sensor that scans rows of even steps, top row first, left to right."""

    kind: Literal["grid"]
    azimuth_deg: Span
    elevation_deg: Span
    columns: Annotated[int, Field(ge=1, le=MAX_RAYS)]
    rows: Annotated[int, Field(ge=1, le=MAX_RAYS)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0

    def build(self) -> Beams:
        """The rays, row by row."""
        if self.rows * self.columns > MAX_RAYS:
            raise LidarError(
                f"{self.rows:,} rows of {self.columns:,} columns; allowed are {MAX_RAYS:,} rays"
            )
        high, low = max(self.elevation_deg), min(self.elevation_deg)
        left, right = max(self.azimuth_deg), min(self.azimuth_deg)
        elevation = np.radians(_centres(high, low, self.rows))
        azimuth = np.radians(_centres(left, right, self.columns))
        row, column = np.divmod(np.arange(self.rows * self.columns), self.columns)
        time_us = (np.arange(len(row)) + 0.5) / len(row) - 0.5
        return Beams(azimuth[column], elevation[row], time_us * 1e6 / self.rate_hz)


class RosettePart(_Part):
    """Two prisms that turn at different speeds: petals about the sensor's x axis.

    The deflections of the prisms add up: (azimuth, elevation) = r/2 (e^(i a t) + e^(i b t)).
    """

    kind: Literal["rosette"]
    radius_deg: Annotated[float, Field(gt=0, lt=90)]
    turns_per_minute: Span
    rays: Annotated[int, Field(ge=1, le=MAX_RAYS)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0

    def build(self) -> Beams:
        """The rays in the order of time."""
        seconds = ((np.arange(self.rays) + 0.5) / self.rays - 0.5) / self.rate_hz
        first, second = (2 * np.pi * turns / 60 * seconds for turns in self.turns_per_minute)
        half = np.radians(self.radius_deg) / 2
        azimuth = half * (np.cos(first) + np.cos(second))
        elevation = half * (np.sin(first) + np.sin(second))
        return Beams(azimuth, elevation, seconds * 1e6)


class DetectionPart(_Part):
    """See :class:`~.lidar.Detection`."""

    range_m: float = 120.0
    reflectivity: float = 0.1
    loss: float = 0.0
    softness: float = 0.25


class LidarDocument(_Part):
    """A LiDAR as JSON."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    source: str = ""
    beams: Annotated[SpinningPart | TablePart | GridPart | RosettePart, Field(discriminator="kind")]
    T_vehicle_lidar: list[list[float]] | None = None
    range_m: Span = (0.5, 120.0)
    divergence_mrad: Span = (0.0, 0.0)
    returns: int = 1
    pulse_m: float = 0.4
    range_noise_m: float = 0.0
    detection: DetectionPart = DetectionPart()

    def build(self) -> Lidar:
        """The sensor; by default 1.73 m above the vehicle's rear axle and 0.9 m before it."""
        pose = np.eye(4)
        pose[:3, 3] = (0.9, 0.0, 1.73)
        if self.T_vehicle_lidar is not None:
            pose = _matrix(self.T_vehicle_lidar)
        horizontal, vertical = self.divergence_mrad
        return Lidar(
            name=self.name,
            beams=self.beams.build(),
            T_vehicle_lidar=pose,
            min_range=self.range_m[0],
            max_range=self.range_m[1],
            divergence=(horizontal * 1e-3, vertical * 1e-3),
            returns=self.returns,
            pulse=self.pulse_m,
            range_noise=self.range_noise_m,
            detection=Detection(**self.detection.model_dump()),
            source=self.source,
        )


@cache
def lidar_names() -> tuple[str, ...]:
    """Names of the catalogue."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


@cache
def catalogue_lidar(name: str) -> Lidar:
    """The LiDAR of that name in the catalogue.

    Raises:
        LidarError: with the names there are.
    """
    if name not in lidar_names():
        known = ", ".join(lidar_names())
        raise LidarError(f"no LiDAR {name!r} in the catalogue; it has {known}")
    return read_lidar(FOLDER / f"{name}.json")


def find_lidar(name: str) -> Lidar:
    """By a name of the catalogue, or the path of a JSON file (which ends in ``.json``).

    Raises:
        LidarError: unknown, or a file that holds none.
    """
    return read_lidar(name) if name.endswith(".json") else catalogue_lidar(name)


def read_lidar(path: str | PathLike[str]) -> Lidar:
    """The LiDAR of a JSON file.

    Raises:
        LidarError: the file is missing, too large, or holds no LiDAR; with the place and reason.
    """
    file = Path(path)
    try:
        if file.stat().st_size > MAX_FILE_BYTES:
            raise LidarError(f"{file}: {file.stat().st_size:,} bytes; at most {MAX_FILE_BYTES:,}")
        values = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise LidarError(f"{file}: no readable JSON file: {error}") from error
    try:
        return lidar_from_values(values)
    except LidarError as error:
        raise LidarError(f"{file}: {error}") from error


def lidar_from_values(values: Any) -> Lidar:
    """The LiDAR of JSON values.

    Raises:
        LidarError: with the first fields that are wrong, and why.
    """
    try:
        document = TypeAdapter(LidarDocument).validate_python(values)
    except ValidationError as error:
        reasons = [
            f"{'.'.join(map(str, issue['loc']))}: {issue['msg']}" for issue in error.errors()[:4]
        ]
        raise LidarError("; ".join(reasons)) from error
    return document.build()


def _centres(first: float, last: float, count: int) -> Float:
    """Centres of ``count`` even steps from one edge to the other."""
    return first + (last - first) * (np.arange(count) + 0.5) / count


def _matrix(rows: list[list[float]]) -> Float:
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise LidarError("T_vehicle_lidar must be four rows of four numbers")
    return np.array(rows, dtype=np.float64)
