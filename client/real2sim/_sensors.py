"""How callers say what they want to see and how an episode runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypedDict

from real2sim_proto.episode import (
    AgentsSpec,
    ContactSpec,
    EgoSpec,
    LatencySpec,
    Randomization,
    ResetSpec,
    ScoringSpec,
    SensorSpec,
)

from ._call import checked

Sensor: TypeAlias = str | SensorSpec | Mapping[str, Any]
"""A camera: its name, or a spec, or a spec's fields: ``{"camera": "front", "width": 640}``."""


class ResetOptions(TypedDict, total=False):
    """Options of reset, besides its sensors; meaning and defaults as in ``ResetSpec``."""

    seed: int
    randomization: Randomization | Mapping[str, Any]
    start_us: int | None
    dt_us: int
    horizon: int | None
    beyond_log: Literal["end", "loop", "extend"]
    warmup_us: int
    ego: EgoSpec | Mapping[str, Any]
    action: Literal["trajectory", "control", "pose"]
    agents: AgentsSpec | Mapping[str, Any]
    privileged: bool
    deadline_ms: int | None
    on_timeout: Literal["hold_plan", "brake", "pause", "fail"]
    wall_clock_s: float | None
    latency: LatencySpec | Mapping[str, Any]
    on_collision: Literal["terminate", "continue"]
    contact: ContactSpec | Mapping[str, Any]
    scoring: ScoringSpec | Mapping[str, Any]


def sensor_specs(sensors: Sequence[Sensor], codec: str) -> list[SensorSpec]:
    """Specs of sensors; ``codec`` holds for those that do not name one.

    Raises:
        ValueError: a field that is not allowed.
    """
    if isinstance(sensors, str):
        raise ValueError(f"sensors is the string {sensors!r}; give a list, as [{sensors!r}]")
    return [_sensor_spec(sensor, codec) for sensor in sensors]


def reset_spec(sensors: Sequence[Sensor], codec: str, options: ResetOptions) -> ResetSpec:
    """The spec of an episode.

    Raises:
        ValueError: a field that is not allowed.
    """
    return checked(ResetSpec, sensors=sensor_specs(sensors, codec), **options)


def _sensor_spec(sensor: Sensor, codec: str) -> SensorSpec:
    if isinstance(sensor, SensorSpec):
        return sensor
    fields = {"camera": sensor} if isinstance(sensor, str) else dict(sensor)
    return checked(SensorSpec, **({"codec": codec} | fields))
