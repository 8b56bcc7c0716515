"""LiDARs and radars that a reset names, found in their catalogues and checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose
from real2sim_proto.ranging import LidarModel, LidarSpec, RadarModel, RadarSpec

from ...geometry.rotation import Float
from ...geometry.transform import transform_from
from ...scene import Beams, Lidar, LidarError, Radar, RadarError
from ...scene.lidar_catalogue import catalogue_lidar, lidar_of
from ...scene.radar import catalogue_radar
from ..errors import WorldError

KEPT_LIDARS = 32
"""Sensors whose rays are kept for the next episode."""
LONGEST_US = 1_000_000
"""Of sweeps; what happened before is forgotten."""


@dataclass(frozen=True, eq=False)
class MountedLidar:
    """A LiDAR of an episode.

    Attributes:
        spec: as asked for.
        lidar: its last ray is fired at time 0.
        period_us: between sweeps.
    """

    spec: LidarSpec
    lidar: Lidar
    period_us: int

    @property
    def name(self) -> str:
        """Of its clouds."""
        return self.spec.lidar

    @property
    def duration_us(self) -> int:
        """From the first ray of a sweep to the last."""
        return span_us(self.lidar.beams)

    @property
    def rays(self) -> int:
        """Of one sweep."""
        return self.lidar.beams.count

    @property
    def most_returns(self) -> int:
        """Of one ray."""
        return self.lidar.returns


@dataclass(frozen=True, eq=False)
class MountedRadar:
    """A radar of an episode.

    Attributes:
        spec: as asked for.
        radar: the sensor.
        period_us: between scans.
    """

    spec: RadarSpec
    radar: Radar
    period_us: int

    @property
    def name(self) -> str:
        """Of its clouds."""
        return self.spec.radar

    @property
    def rays(self) -> int:
        """Of one scan."""
        return self.radar.rays.beams.count

    @property
    def most_returns(self) -> int:
        """Of one ray: itself and a ghost."""
        return 2


Mounted = MountedLidar | MountedRadar


@dataclass(frozen=True, eq=False)
class RangingSensors:
    """All LiDARs and radars of an episode; false where there are none."""

    lidars: tuple[MountedLidar, ...] = ()
    radars: tuple[MountedRadar, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.lidars or self.radars)

    @property
    def all(self) -> tuple[Mounted, ...]:
        """LiDARs first."""
        return (*self.lidars, *self.radars)

    @property
    def longest_us(self) -> int:
        """Of their sweeps."""
        return max((m.duration_us for m in self.lidars), default=0)

    def due(self, elapsed_us: int) -> tuple[Mounted, ...]:
        """Those whose cloud is complete so long after the beginning."""
        return tuple(m for m in self.all if elapsed_us % m.period_us == 0)


NO_SENSORS = RangingSensors()


def mounted_sensors(
    lidars: Sequence[LidarSpec], radars: Sequence[RadarSpec], dt_us: int
) -> RangingSensors:
    """The sensors of an episode with steps of ``dt_us``.

    Raises:
        WorldError: INVALID_REQUEST for models that are none or unknown, periods that are no
            multiple of the step or too short for a sweep, and names that two sensors have.
    """
    if not lidars and not radars:
        return NO_SENSORS
    names = Counter([*(s.lidar for s in lidars), *(s.radar for s in radars)])
    if twice := sorted(name for name, count in names.items() if count > 1):
        raise _refused(
            f"LiDARs and radars {twice} have one name", hint="give each sensor its own name"
        )
    return RangingSensors(
        tuple(_mounted_lidar(spec, dt_us) for spec in lidars),
        tuple(_mounted_radar(spec, dt_us) for spec in radars),
    )


def span_us(beams: Beams) -> int:
    """From the first ray to the last."""
    return int(np.ceil(np.ptp(beams.time_us)))


def _mounted_lidar(spec: LidarSpec, dt_us: int) -> MountedLidar:
    what = f"LiDAR {spec.lidar!r}"
    lidar = _lidar(spec)
    duration_us = span_us(lidar.beams)
    period_us = spec.period_us or max(-(-duration_us // dt_us), 1) * dt_us
    _check_period(what, period_us, dt_us)
    if duration_us > LONGEST_US:
        raise _refused(f"{what}: a sweep of {duration_us} us; {LONGEST_US} us at most")
    if period_us < duration_us:
        raise _refused(
            f"{what}: a sweep takes {duration_us} us and is asked for every {period_us} us",
            hint=f"give period_us from {duration_us} on, or a higher rate_hz",
        )
    return MountedLidar(spec, lidar, period_us)


def _mounted_radar(spec: RadarSpec, dt_us: int) -> MountedRadar:
    what = f"radar {spec.radar!r}"
    model = spec.model or spec.radar
    try:
        known = catalogue_radar(model) if isinstance(model, str) else model
        radar = _radar(spec.radar, known, spec.pose)
    except (RadarError, LidarError) as error:
        raise _refused(f"{what}: {error}") from error
    period_us = spec.period_us or dt_us
    _check_period(what, period_us, dt_us)
    return MountedRadar(spec, radar, period_us)


def _check_period(what: str, period_us: int, dt_us: int) -> None:
    if period_us % dt_us:
        raise _refused(
            f"period_us {period_us} of {what} is no multiple of dt_us {dt_us}",
            hint="clouds are complete at committed instants; choose a period of whole clock steps",
        )


def _lidar(spec: LidarSpec) -> Lidar:
    model = spec.model or spec.lidar
    try:
        if isinstance(model, str):
            return _placed(*_key(spec), model)
        return _built(*_key(spec), model.model_dump_json())
    except LidarError as error:
        raise _refused(f"LiDAR {spec.lidar!r}: {error}") from error


def _key(spec: LidarSpec) -> tuple[str, Pose | None, float | None]:
    return spec.lidar, spec.pose, spec.rate_hz


@lru_cache(maxsize=KEPT_LIDARS)
def _radar(name: str, model: RadarModel, pose: Pose | None) -> Radar:
    """With its rays, so that they are refused here where they are none."""
    radar = Radar(name, model) if pose is None else Radar(name, model, _transform(pose))
    assert radar.rays.beams.count == model.ray_count
    return radar


@lru_cache(maxsize=KEPT_LIDARS)
def _placed(name: str, pose: Pose | None, rate_hz: float | None, model: str) -> Lidar:
    return _as_mounted(catalogue_lidar(model), name, pose, rate_hz)


@lru_cache(maxsize=KEPT_LIDARS)
def _built(name: str, pose: Pose | None, rate_hz: float | None, model: str) -> Lidar:
    found = lidar_of(LidarModel.model_validate_json(model))
    return _as_mounted(found, name, pose, rate_hz)


def _as_mounted(lidar: Lidar, name: str, pose: Pose | None, rate_hz: float | None) -> Lidar:
    """The sensor with its name and pose, its sweep of another rate, its last ray at time 0."""
    beams = lidar.beams
    times = beams.time_us - beams.time_us.max()
    if rate_hz is not None:
        span = span_us(beams)
        if span == 0:
            raise LidarError("all rays are fired at once; it has no rate_hz")
        times *= (1e6 / rate_hz) / _turn_us(beams)
    placed = lidar.T_vehicle_lidar if pose is None else _transform(pose)
    timed = Beams(beams.azimuth, beams.elevation, times)
    return replace(lidar, name=name, beams=timed, T_vehicle_lidar=placed)


def _turn_us(beams: Beams) -> float:
    """From one sweep to the next: the rays' span and the step between two of its instants."""
    instants = beams.slots[0]
    return float(np.ptp(instants)) * len(instants) / max(len(instants) - 1, 1)


def _transform(pose: Pose) -> Float:
    return transform_from(np.array(pose.position), np.array(pose.quaternion))


def _refused(detail: str, *, hint: str | None = None) -> WorldError:
    return WorldError(ErrorCode.INVALID_REQUEST, detail, hint=hint)
