"""Lanes of a scene: reply of `GET /v1/scenes/{scene}/lanes`, and the file `lanes.json`.

All positions are in the world frame of the scene [m]; lanes point in driving direction.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

LaneKind = Literal["driving", "bus", "bicycle", "shoulder", "parking", "sidewalk", "other"]
AreaKind = Literal["drivable", "crosswalk", "junction", "parking", "sidewalk", "other"]
SignalKind = Literal["traffic_light", "stop", "yield", "speed_limit", "other"]
Place = tuple[float, float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class LaneInfo(_Part):
    """One lane."""

    lane_id: str
    kind: LaneKind
    centre: list[Place] = Field(min_length=2, description="centre line in driving direction [m]")
    widths: list[float] = Field(description="width at each point of the centre line [m]")
    speed_limit: float | None = Field(default=None, description="[m/s]; null: unknown")
    successors: list[str] = Field(default_factory=list)
    left: str | None = Field(default=None, description="neighbour in the same direction")
    right: str | None = None
    opposite: str | None = Field(default=None, description="neighbour in the opposite direction")
    may_change_left: bool = True
    may_change_right: bool = True
    junction: str | None = None


class AreaInfo(_Part):
    """A marked area on the ground."""

    area_id: str
    kind: AreaKind
    outline: list[Place] = Field(min_length=3)


class StopLineInfo(_Part):
    """Stop line of lanes."""

    stop_line_id: str
    points: list[Place] = Field(min_length=2)
    lanes: list[str] = Field(default_factory=list)


class SignalInfo(_Part):
    """A traffic light or sign, with the lanes that it controls."""

    signal_id: str
    kind: SignalKind
    position: Place
    heading: float = Field(default=0.0, description="heading of its face [rad]")
    lanes: list[str] = Field(default_factory=list)
    stop_line: str | None = Field(default=None, description="null: at the lanes' ends")
    value: float | None = Field(default=None, description="speed limit [m/s]")
    group: str | None = Field(default=None, description="the map's controller of a traffic light")


class RoadLaneInfo(_Part):
    """A section of a numbered lane of a road."""

    number: int = Field(description="negative to the right of the reference line")
    lane_id: str
    s: list[float] = Field(description="positions along the road [m]")
    inner: list[float] = Field(description="t of the rim towards the reference line [m]")
    outer: list[float]


class RoadInfo(_Part):
    """Reference line of numbered lanes."""

    road_id: str
    s: list[float]
    points: list[Place]
    headings: list[float] = Field(description="[rad]")
    rolls: list[float] = Field(description="superelevation [rad]")
    lanes: list[RoadLaneInfo] = Field(default_factory=list)
    junction: str | None = None
    drives_right: bool = True


class SceneLanes(_Part):
    """All lanes of a scene and their traffic rules."""

    format: Literal["real2sim-lanes"] = "real2sim-lanes"
    version: Literal[1] = 1
    source: str = Field(default="", description="format and file it was read from, or `log`")
    accuracy: float | None = Field(
        default=None, description="estimated median error of centre lines [m]; null: unknown"
    )
    geo_reference: str = ""
    lanes: list[LaneInfo] = Field(default_factory=list)
    areas: list[AreaInfo] = Field(default_factory=list)
    stop_lines: list[StopLineInfo] = Field(default_factory=list)
    signals: list[SignalInfo] = Field(default_factory=list)
    roads: list[RoadInfo] = Field(default_factory=list)
