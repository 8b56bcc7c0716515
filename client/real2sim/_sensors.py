"""How callers say what they want to see and how an episode runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypedDict, TypeVar, cast

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
from real2sim_proto.ranging import LidarSpec, RadarSpec

from ._call import checked

Sensor: TypeAlias = str | SensorSpec | Mapping[str, Any]
"""A camera: its name, or a spec, or a spec's fields: ``{"camera": "front", "width": 640}``."""

R = TypeVar("R", LidarSpec, RadarSpec)

LidarSensor: TypeAlias = str | LidarSpec | Mapping[str, Any]
"""A LiDAR: a name of the worker's catalogue, or a spec, or a spec's fields:
``{"lidar": "top", "model": "os1-128", "rate_hz": 20}``."""

RadarSensor: TypeAlias = str | RadarSpec | Mapping[str, Any]
"""A radar: a name of the worker's catalogue, or a spec, or a spec's fields:
``{"radar": "front", "model": "long-range"}``."""


class ResetOptions(TypedDict, total=False):
    """Options of reset, besides its sensors; meaning and defaults as in ``ResetSpec``."""

    lidars: Sequence[LidarSensor]
    radars: Sequence[RadarSensor]
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
    return [_sensor_spec(sensor, codec) for sensor in _several(sensors)]


def reset_spec(sensors: Sequence[Sensor], codec: str, options: ResetOptions) -> ResetSpec:
    """The spec of an episode.

    Raises:
        ValueError: a field that is not allowed.
    """
    given: dict[str, Any] = dict(options)
    given |= ranging_specs(options.get("lidars", ()), options.get("radars", ()))
    return checked(ResetSpec, sensors=sensor_specs(sensors, codec), **given)


def ranging_specs(
    lidars: Sequence[LidarSensor], radars: Sequence[RadarSensor]
) -> dict[str, list[LidarSpec] | list[RadarSpec]]:
    """Specs of LiDARs and radars as members of a message, which has those alone that are given.

    Raises:
        ValueError: a field that is not allowed.
    """
    found: dict[str, list[LidarSpec] | list[RadarSpec]] = {}
    if lidars:
        found["lidars"] = [_ranging_spec(LidarSpec, "lidar", s) for s in _several(lidars)]
    if radars:
        found["radars"] = [_ranging_spec(RadarSpec, "radar", s) for s in _several(radars)]
    return found


def _several(sensors: Any) -> Sequence[Any]:
    """Sensors as a sequence, also where one alone is given."""
    return sensors if isinstance(sensors, Sequence) and not isinstance(sensors, str) else [sensors]


def _ranging_spec(kind: type[R], name: str, sensor: object) -> R:
    if isinstance(sensor, kind):
        return sensor
    fields = {name: sensor} if isinstance(sensor, str) else dict(cast(Mapping[str, Any], sensor))
    return checked(kind, **fields)


def _sensor_spec(sensor: Sensor, codec: str) -> SensorSpec:
    if isinstance(sensor, SensorSpec):
        return sensor
    fields = {"camera": sensor} if isinstance(sensor, str) else dict(sensor)
    return checked(SensorSpec, **({"codec": codec} | fields))
