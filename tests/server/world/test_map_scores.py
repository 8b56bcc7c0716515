"""Scores on a scene with a map: its surface, lanes, directions and limits, and that they say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.scene import Lane, LaneGraph, Signal
from real2sim_server.world import scoring
from real2sim_server.world.scoring import (
    EgoSample,
    Instant,
    ObjectSamples,
    ScoringContext,
)
from real2sim_server.world.scoring.road_map import RoadMap

DT = 0.1
NOBODY = ObjectSamples((), (), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 2)))


def context(steps: int, **changes) -> ScoringContext:
    """A straight street along x; the recorded drive goes at 10 m/s."""
    made = ScoringContext(
        dt=DT,
        horizon=steps,
        ego_size=(4.6, 1.85, 1.6),
        rear_overhang=0.95,
        ego_mass=1500.0,
        route=np.stack([np.arange(0.0, 201.0), np.zeros(201)], axis=1),
        lanes=(),
        corridor=3.5,
        lane=1.75,
        speed_limit=None,
        start_s=0.0,
        route_end_s=10.0 * DT * steps,
        expert_s=tuple(10.0 * DT * k for k in range(steps + 1)),
        history=(),
    )
    return replace(made, **changes)


def ego(x: float, y: float = 0.0, *, speed: float = 10.0, yaw: float = 0.0) -> EgoSample:
    return EgoSample(x, y, yaw, speed, 0.0, 0.0, 0.0, 0.0, x, y, 0.0, 0.0)


def car(x: float, y: float = 0.0, *, speed: float = 0.0, category: str = "car") -> ObjectSamples:
    return ObjectSamples(
        ("car",),
        (category,),
        np.array([[x, y, 0.8]]),
        np.zeros(1),
        np.array([[4.0, 2.0, 1.6]]),
        np.array([[speed, 0.0]]),
    )


def drive(speeds: list[float], *, y: float = 0.0, others=None) -> list[Instant]:
    """Instants of a drive along y; ``others`` gives everybody else by step."""
    x, instants = 0.0, []
    for k, speed in enumerate(speeds):
        x += speed * DT if k else 0.0
        who = others(k) if others else NOBODY
        instants.append(Instant(k, k * 100_000, ego(x, y, speed=speed), who))
    return instants


def scores(instants: list[Instant], given: ScoringContext) -> dict[str, scoring.Score]:
    accumulator = scoring.begin_accumulator(instants[0], given)
    for instant in instants[1:]:
        accumulator = scoring.update_accumulator(accumulator, instant, given)
    return {s.name: s for s in scoring.scores_of(accumulator, given)}


def street(**parts):
    x = np.arange(-20.0, 221.0, 5.0)
    line = np.column_stack([x, 0 * x, 0 * x])
    width = np.full(len(x), 3.5)
    return LaneGraph.of(
        [
            Lane("own", "driving", line, width, speed_limit=8.0, opposite="back"),
            Lane("back", "driving", line[::-1] + np.array([0, 3.5, 0]), width),
        ],
        source="opendrive town.xodr",
        **parts,
    )


ON_MAP = context(40, road_map=RoadMap(street()))
WAY = [10.0] * 41


def test_the_drivable_area_is_that_of_the_map():
    instants = drive(WAY, y=-1.2)  # inside the corridor of the log, over the rim of the lane
    assert scores(instants, context(40))["pdms"].terms["DAC"] == 1.0
    found = scores(instants, ON_MAP)
    assert found["pdms"].terms["DAC"] == 0.0
    assert ON_MAP.off_road(instants[5].ego)[0] == pytest.approx(1.2 + 0.925 - 1.75)


def test_oncoming_lanes_are_against_the_direction_of_driving():
    instants = drive(WAY, y=3.5)
    assert scores(instants, context(40, corridor=9.0))["nuplan_cls"].terms["DDC"] == 1.0
    found = scores(instants, ON_MAP)
    assert found["nuplan_cls"].terms["DDC"] == 0.0
    assert found["carla_ds"].terms["in_lanes"] == 0.0


def test_limits_of_lanes_count_where_the_request_gives_none():
    assert scores(drive(WAY), ON_MAP)["nuplan_cls"].terms["SL"] == pytest.approx(1 - 2 / 2.23)
    slow = replace(ON_MAP, speed_limit=20.0)
    assert scores(drive(WAY), slow)["nuplan_cls"].terms["SL"] == 1.0


def test_scores_say_that_they_use_the_map_and_keep_their_versions():
    light = Signal("l", "traffic_light", (50.0, 3.0, 4.0), lanes=("own",))
    with_light = replace(ON_MAP, road_map=RoadMap(street(signals=[light])))
    plain, mapped = scores(drive(WAY), context(40)), scores(drive(WAY), with_light)
    for name in ("pdms", "nuplan_cls", "hugsim_hd", "alpasim", "carla_ds"):
        assert any("opendrive town.xodr" in text for text in mapped[name].assumed)
        assert not any(text.startswith("map:") for text in plain[name].assumed)
        assert plain[name].version == mapped[name].version


def test_a_recording_keeps_the_map_of_its_scores_and_tells_of_none_without():
    assert "road_map" not in context(40).fields()
    again = ScoringContext.from_fields(ON_MAP.fields())
    before, after = (scores(drive(WAY, y=0.3), c) for c in (ON_MAP, again))
    assert {k: v.value for k, v in before.items()} == {k: v.value for k, v in after.items()}


def test_lanes_made_of_the_log_leave_scores_as_they_are():
    assert RoadMap.of(replace(street(), source="log")) is None
    assert RoadMap.of(None) is None
