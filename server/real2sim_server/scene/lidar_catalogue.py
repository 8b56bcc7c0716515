"""LiDARs by name, and from a user's own JSON; one file of ``lidar_models/`` is one sensor.

``docs/lidar.md`` tells the format.
"""

from __future__ import annotations

import json
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, assert_never

import numpy as np
from pydantic import TypeAdapter, ValidationError

from real2sim_proto.ranging import (
    MAX_RAYS,
    GridBeams,
    LidarModel,
    RosetteBeams,
    SpinningBeams,
    TableBeams,
)

from ..geometry.transform import Float
from .errors import LidarError
from .lidar import Beams, Detection, Lidar

FOLDER = Path(__file__).parent / "lidar_models"
MAX_FILE_BYTES = 64 << 20
MOUNT = (0.9, 0.0, 1.73)
"""Of LiDARs whose model names no pose, from the vehicle's rear axle [m]."""


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
        model = TypeAdapter(LidarModel).validate_python(values)
    except ValidationError as error:
        reasons = [
            f"{'.'.join(map(str, issue['loc']))}: {issue['msg']}" for issue in error.errors()[:4]
        ]
        raise LidarError("; ".join(reasons)) from error
    return lidar_of(model)


def lidar_of(model: LidarModel) -> Lidar:
    """The sensor; at MOUNT where the model names no pose.

    Raises:
        LidarError: a value out of range, named with what is allowed.
    """
    pose = np.eye(4)
    pose[:3, 3] = MOUNT
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
    """In the order of time. The deflections of the prisms add up:
    (azimuth, elevation) = r/2 (e^(i a t) + e^(i b t))."""
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
