"""Validation of a reset, and the clock of its episode."""

from __future__ import annotations

from dataclasses import dataclass

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec, SensorSpec

from ..scene import Scene
from .common import WorldError


@dataclass(frozen=True)
class EpisodeClock:
    """Times of an episode.

    Attributes:
        start_us: time of step 0 [us].
        dt_us: from step to step [us].
        horizon: number of steps after which the episode is cut off.
    """

    start_us: int
    dt_us: int
    horizon: int

    def at(self, step: int) -> int:
        """Time of a step [us]."""
        return self.start_us + step * self.dt_us


def episode_clock(scene: Scene, spec: ResetSpec) -> EpisodeClock:
    """The clock of an episode on ``scene``.

    Raises:
        WorldError: TIME_OUT_OF_RANGE when start or horizon leave the log; UNKNOWN_CAMERA;
            INVALID_REQUEST when a sensor's period and the clock step do not divide, a camera
            is listed twice, or a start is drawn for a warm-up.
    """
    clock = _clock(scene, spec)
    for sensor in spec.sensors:
        _check_sensor(scene, spec, sensor)
    cameras = [s.camera for s in spec.sensors]
    twice = {c for c in cameras if cameras.count(c) > 1}
    if twice:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"cameras {sorted(twice)} are listed more than once",
            hint="list a camera once, with all its modalities",
        )
    return clock


def takes_effect_us(
    spec: ResetSpec, clock: EpisodeClock, t_us: int, latency_us: int, *, jitter_us: int = 0
) -> int:
    """When a plan that comes at ``t_us`` takes effect [us]: after its latency and the warm-up.

    Args:
        spec: names the latency model.
        clock: of the episode.
        t_us: now [us].
        latency_us: measured time to make the plan [us].
        jitter_us: wait that the seed drew, on top of the model's [us].
    """
    latency = spec.latency
    wait_us = {
        "zero": 0,
        "fixed": latency.fixed_us,
        "measured": min(max(latency_us, 0), latency.longest_us),
    }[latency.model]
    return max(t_us + wait_us + jitter_us, clock.start_us + spec.warmup_us)


def _clock(scene: Scene, spec: ResetSpec) -> EpisodeClock:
    start = scene.start_us if spec.start_us is None else spec.start_us
    latest = scene.end_us - spec.dt_us
    if not scene.start_us <= start <= latest:
        raise WorldError(
            ErrorCode.TIME_OUT_OF_RANGE,
            f"an episode from start_us={start} with steps of {spec.dt_us} us does not fit the log, "
            f"which covers [{scene.start_us}, {scene.end_us}]",
            hint=f"start between {scene.start_us} and {latest}"
            if latest >= scene.start_us
            else f"the log is only {scene.end_us - scene.start_us} us long; take a smaller dt_us",
        )
    longest = (scene.end_us - start) // spec.dt_us
    if spec.warmup_us % spec.dt_us or spec.warmup_us > longest * spec.dt_us:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"warmup_us {spec.warmup_us} is no whole number of steps of {spec.dt_us} us within "
            f"the {longest} that are left of the log",
            hint="the warm-up follows the log in clock steps; choose a multiple of dt_us",
        )
    if spec.warmup_us and any(spec.randomization.start.model_dump().values()):
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a warm-up follows the log, and randomization.start begins beside it",
            hint="leave out one of warmup_us and randomization.start",
        )
    if spec.beyond_log == "end" and spec.horizon is not None and spec.horizon > longest:
        raise WorldError(
            ErrorCode.TIME_OUT_OF_RANGE,
            f"horizon {spec.horizon} is longer than the {longest} steps of {spec.dt_us} us that "
            f"are left of the log after {start}",
            hint=f"ask for {longest} steps at most, leave horizon out, or let beyond_log be "
            "'loop' or 'extend'",
        )
    return EpisodeClock(start, spec.dt_us, spec.horizon or longest)


def _check_sensor(scene: Scene, spec: ResetSpec, sensor: SensorSpec) -> None:
    if sensor.camera not in scene.rig.names:
        raise WorldError(
            ErrorCode.UNKNOWN_CAMERA,
            f"scene {scene.name!r} has no camera {sensor.camera!r}",
            hint=f"cameras of this scene: {', '.join(scene.rig.names)}",
        )
    if sensor.period_us is not None and sensor.period_us % spec.dt_us:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"period_us {sensor.period_us} of camera {sensor.camera!r} is no multiple of dt_us "
            f"{spec.dt_us}",
            hint="all sensors show committed instants; choose a period of whole clock steps",
        )
