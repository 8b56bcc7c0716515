"""LiDARs and radars of an episode: specifications, motion during a sweep, and point clouds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose
from real2sim_proto.sensors import LidarModel, LidarSpec, RadarModel, RadarSpec

from ..geometry import (
    Float,
    matrix_to_quaternion,
    quaternion_to_matrix,
    slerp,
    transform_from,
    yaw_quaternion,
)
from ..scene import Beams, Lidar, LidarError, Radar, RadarError
from ..scene.range_sensors import catalogue_lidar, catalogue_radar, lidar_of
from .agents import Agents, rows_of
from .common import WorldError


@dataclass(frozen=True, eq=False)
class Cloud:
    """Point cloud of one sensor at one instant.

    Attributes:
        sensor: name of the sensor.
        modality: ``lidar`` or ``radar``.
        t_us: time of the cloud, the end of the sweep [us].
        duration_us: time from the first ray to the last [us]; 0 for radars.
        frame: frame of ``points``: ``sensor`` or ``vehicle``.
        compensated: whether points are motion-compensated to the pose at ``t_us``.
        T_vehicle_sensor: [4, 4] float64.
        T_world_sensor: [4, 4] float64, at ``t_us``.
        columns: by name, [N] or [N, width] each, ``points`` [N, 3] float32 [m] first.
        codec: transport encoding, ``raw`` or ``deflate``.
    """

    sensor: str
    modality: str
    t_us: int
    duration_us: int
    frame: str
    compensated: bool
    T_vehicle_sensor: Float
    T_world_sensor: Float
    columns: Mapping[str, NDArray[Any]]
    codec: str = "raw"

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.columns["points"])


def in_frame(points: Float, frame: str, T_vehicle_sensor: Float) -> NDArray[np.float32]:
    """Transform points [N, 3] from the sensor frame to ``frame``."""
    if frame == "vehicle":
        points = points @ T_vehicle_sensor[:3, :3].T + T_vehicle_sensor[:3, 3]
    return points.astype(np.float32)


MIN_HISTORY_US = 100_000
"""Minimum duration of the history, whatever the sensors [us]."""


@dataclass(frozen=True, eq=False)
class MotionSegment:
    """Motion during one step of the clock.

    Attributes:
        since_us, until_us: start and end [us].
        ego: (before, after) ``T_world_body`` [4, 4].
        agents: (before, after) poses of the other objects.
    """

    since_us: int
    until_us: int
    ego: tuple[Float, Float]
    agents: tuple[Agents, Agents]


@dataclass(frozen=True, eq=False)
class MotionHistory:
    """Motion of the last steps, oldest first; empty before the first step.

    Attributes:
        keep_us: minimum duration to cover, once enough steps have passed [us].
        segments: one per step.
    """

    keep_us: int
    segments: tuple[MotionSegment, ...] = ()

    @classmethod
    def of(cls, longest_us: int) -> MotionHistory:
        """An empty history for an episode whose sweeps take up to ``longest_us``."""
        return cls(max(longest_us, MIN_HISTORY_US))

    def after(self, segment: MotionSegment) -> MotionHistory:
        """The history with one more step."""
        since = segment.until_us - self.keep_us
        segments, old = self.segments, 0
        while old < len(segments) and segments[old].until_us <= since:
            old += 1
        return MotionHistory(self.keep_us, (*segments[old:], segment))

    def ego_poses(self, times_us: Float, *, t_us: int, now: Float, twist: Float) -> Float:
        """``T_world_body`` [S, 4, 4] at ``times_us`` [S] [us].

        Args:
            times_us: absolute times, none later than ``t_us``.
            t_us: current time [us].
            now: [4, 4] current pose.
            twist: [6] current velocity [m/s] and angular velocity [rad/s], for times before the
                first step.
        """
        if not self.segments:
            return _on(now, twist[:3], float(twist[5]), (times_us - t_us) * 1e-6)
        return _along(times_us, self.segments, [segment.ego for segment in self.segments])

    def object_poses(self, object_id: str, times_us: Float, *, t_us: int, now: Agents) -> Float:
        """``T_world_object`` [S, 4, 4] of a currently present object at ``times_us`` [S] [us]."""
        row = rows_of(now)[object_id]
        ends = [_ends(segment, object_id) for segment in self.segments]
        first = next((k for k, pair in enumerate(ends) if pair is not None), len(ends))
        whole = [pair for pair in ends[first:] if pair is not None]
        pose = now.transforms[row]
        if not whole or len(whole) < len(ends) - first or not np.array_equal(whole[-1][1], pose):
            # An edit has placed the object at this pose.
            return _on(pose, now.velocities[row], 0.0, (times_us - t_us) * 1e-6)
        return _along(times_us, self.segments[first:], whole)


def _ends(segment: MotionSegment, object_id: str) -> tuple[Float, Float] | None:
    """Poses of an object before and after a step; None if it was not present."""
    before, after = (rows_of(agents).get(object_id) for agents in segment.agents)
    if before is None or after is None:
        return None
    return segment.agents[0].transforms[before], segment.agents[1].transforms[after]


def _along(
    times_us: Float, segments: Sequence[MotionSegment], ends: Sequence[tuple[Float, Float]]
) -> Float:
    """Poses along segments, linearly extrapolated before the first one."""
    found = np.empty((len(times_us), 4, 4))
    for number, (segment, (before, after)) in enumerate(zip(segments, ends, strict=True)):
        inside = times_us <= segment.until_us
        if number:
            inside &= times_us > segment.since_us
        if inside.any():
            part = (times_us[inside] - segment.since_us) / (segment.until_us - segment.since_us)
            found[inside] = _between(before, after, part)
    return found


def _between(before: Float, after: Float, part: Float) -> Float:
    """Poses [P, 4, 4] at fractions ``part`` [P] of a segment.

    Fractions below 0 extrapolate the position and hold the orientation.
    """
    turns = matrix_to_quaternion(np.stack([before[:3, :3], after[:3, :3]]))
    places = before[:3, 3] + part[:, None] * (after[:3, 3] - before[:3, 3])
    return transform_from(places, slerp(turns[0], turns[1], np.clip(part, 0.0, 1.0)))


def _on(pose: Float, velocity: Float, yaw_rate: float, seconds: Float) -> Float:
    """Poses [S, 4, 4] ``seconds`` [S] after ``pose``, at constant velocity and yaw rate."""
    found = np.broadcast_to(pose, (len(seconds), 4, 4)).copy()
    found[:, :3, 3] += seconds[:, None] * velocity
    if yaw_rate:
        turns = quaternion_to_matrix(yaw_quaternion(seconds * yaw_rate))
        found[:, :3, :3] = turns @ pose[:3, :3]
    return found


KEPT_LIDARS = 32
"""Number of sensors with cached rays for later episodes."""
MAX_SWEEP_US = 1_000_000
"""Maximum duration of a sweep [us]."""


@dataclass(frozen=True, eq=False)
class MountedLidar:
    """A LiDAR of an episode.

    Attributes:
        spec: the requested sensor.
        lidar: the sensor; its last ray is fired at time 0.
        period_us: time between sweeps [us].
    """

    spec: LidarSpec
    lidar: Lidar
    period_us: int

    @property
    def name(self) -> str:
        """Name of its clouds."""
        return self.spec.lidar

    @property
    def duration_us(self) -> int:
        """Time from the first to the last ray of a sweep [us]."""
        return span_us(self.lidar.beams)

    @property
    def rays(self) -> int:
        """Number of rays of a sweep."""
        return self.lidar.beams.count

    @property
    def most_returns(self) -> int:
        """Maximum number of returns of a ray."""
        return self.lidar.returns


@dataclass(frozen=True, eq=False)
class MountedRadar:
    """A radar of an episode.

    Attributes:
        spec: the requested sensor.
        radar: the sensor.
        period_us: time between scans [us].
    """

    spec: RadarSpec
    radar: Radar
    period_us: int

    @property
    def name(self) -> str:
        """Name of its clouds."""
        return self.spec.radar

    @property
    def rays(self) -> int:
        """Number of rays of a scan."""
        return self.radar.rays.beams.count

    @property
    def most_returns(self) -> int:
        """Maximum number of returns of a ray: the target and a ghost."""
        return 2


Mounted = MountedLidar | MountedRadar


@dataclass(frozen=True, eq=False)
class RangingSensors:
    """All LiDARs and radars of an episode; falsy if there are none."""

    lidars: tuple[MountedLidar, ...] = ()
    radars: tuple[MountedRadar, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.lidars or self.radars)

    @property
    def all(self) -> tuple[Mounted, ...]:
        """All sensors, LiDARs first."""
        return (*self.lidars, *self.radars)

    @property
    def longest_us(self) -> int:
        """Duration of the longest sweep [us]."""
        return max((m.duration_us for m in self.lidars), default=0)

    def due(self, elapsed_us: int) -> tuple[Mounted, ...]:
        """The sensors whose cloud is complete ``elapsed_us`` after the start."""
        return tuple(m for m in self.all if elapsed_us % m.period_us == 0)


NO_SENSORS = RangingSensors()


def mounted_sensors(
    lidars: Sequence[LidarSpec], radars: Sequence[RadarSpec], dt_us: int
) -> RangingSensors:
    """The sensors of an episode with steps of ``dt_us``.

    Raises:
        WorldError: INVALID_REQUEST for invalid or unknown models, periods that are not a multiple
            of the step or shorter than a sweep, and duplicate names.
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
    """Time from the first to the last ray [us]."""
    return int(np.ceil(np.ptp(beams.time_us)))


def _mounted_lidar(spec: LidarSpec, dt_us: int) -> MountedLidar:
    what = f"LiDAR {spec.lidar!r}"
    lidar = _lidar(spec)
    duration_us = span_us(lidar.beams)
    period_us = spec.period_us or max(-(-duration_us // dt_us), 1) * dt_us
    _check_period(what, period_us, dt_us)
    if duration_us > MAX_SWEEP_US:
        raise _refused(f"{what}: a sweep of {duration_us} us; {MAX_SWEEP_US} us at most")
    if period_us < duration_us:
        raise _refused(
            f"{what}: a sweep takes {duration_us} us, longer than the period of {period_us} us",
            hint=f"set period_us to at least {duration_us}, or a higher rate_hz",
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
            f"period_us {period_us} of {what} is not a multiple of dt_us {dt_us}",
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
    """The sensor with its validated rays."""
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
    """The sensor with its name, pose and sweep rate; its last ray is fired at time 0."""
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
    """Time between sweeps: the span of the rays plus one firing interval."""
    instants = beams.slots[0]
    return float(np.ptp(instants)) * len(instants) / max(len(instants) - 1, 1)


def _transform(pose: Pose) -> Float:
    return transform_from(np.array(pose.position), np.array(pose.quaternion))


def _refused(detail: str, *, hint: str | None = None) -> WorldError:
    return WorldError(ErrorCode.INVALID_REQUEST, detail, hint=hint)
