"""Scores on a scene with a map: drivable area, lanes, directions and speed limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.scene import Lane, LaneGraph, Signal
from real2sim_server.world.scoring import (
    ScoringContext,
)
from real2sim_server.world.scoring.road import RoadMap

from .scored_drives import context, drive, scores


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


def test_the_drivable_area_comes_from_the_map():
    instants = drive(WAY, y=-1.2)  # inside the corridor of the log, beyond the lane edge
    assert scores(instants, context(40))["pdms"].terms["DAC"] == 1.0
    found = scores(instants, ON_MAP)
    assert found["pdms"].terms["DAC"] == 0.0
    assert ON_MAP.off_road(instants[5].ego)[0] == pytest.approx(1.2 + 0.925 - 1.75)


def test_driving_in_an_oncoming_lane_violates_the_direction():
    instants = drive(WAY, y=3.5)
    assert scores(instants, context(40, corridor=9.0))["nuplan_cls"].terms["DDC"] == 1.0
    found = scores(instants, ON_MAP)
    assert found["nuplan_cls"].terms["DDC"] == 0.0
    assert found["carla_ds"].terms["in_lanes"] == 0.0


def test_lane_speed_limits_apply_without_a_requested_limit():
    assert scores(drive(WAY), ON_MAP)["nuplan_cls"].terms["SL"] == pytest.approx(1 - 2 / 2.23)
    slow = replace(ON_MAP, speed_limit=20.0)
    assert scores(drive(WAY), slow)["nuplan_cls"].terms["SL"] == 1.0


def test_scores_name_their_map_and_keep_their_versions():
    light = Signal("l", "traffic_light", (50.0, 3.0, 4.0), lanes=("own",))
    with_light = replace(ON_MAP, road_map=RoadMap(street(signals=[light])))
    plain, mapped = scores(drive(WAY), context(40)), scores(drive(WAY), with_light)
    for name in ("pdms", "nuplan_cls", "hugsim_hd", "alpasim", "carla_ds"):
        assert any("opendrive town.xodr" in text for text in mapped[name].assumed)
        assert not any(text.startswith("map:") for text in plain[name].assumed)
        assert plain[name].version == mapped[name].version


def test_scoring_contexts_round_trip_with_and_without_a_map():
    assert "road_map" not in context(40).fields()
    again = ScoringContext.from_fields(ON_MAP.fields())
    before, after = (scores(drive(WAY, y=0.3), c) for c in (ON_MAP, again))
    assert {k: v.value for k, v in before.items()} == {k: v.value for k, v in after.items()}


def test_lanes_derived_from_the_log_are_not_used_for_scores():
    assert RoadMap.of(replace(street(), source="log")) is None
    assert RoadMap.of(None) is None
