"""Traffic light compliance (TLC): stop lines crossed on red."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from real2sim_server.scene import Lane, LaneGraph, Signal
from real2sim_server.scene.lane import StopLine
from real2sim_server.world import scoring
from real2sim_server.world.recording import instant_row, read_instant
from real2sim_server.world.scoring.instant import shows_red
from real2sim_server.world.scoring.metrics import light_compliance, lights
from real2sim_server.world.scoring.road import RoadMap
from real2sim_server.world.storyboard.program import ShownSignal

from .scored_drives import context, drive
from .test_map_scores import street

WAY = [10.0] * 41
"""Speeds [m/s]. The front bumper moves from x = 3.65 to 43.65 m."""
AT = 20.0
"""Position of the stop line [m], crossed between steps 16 and 17."""


def judged(instants, given=None):
    given = context(40) if given is None else given
    accumulator = scoring.begin_accumulator(instants[0], given)
    for instant in instants[1:]:
        accumulator = scoring.update_accumulator(accumulator, instant, given)
    return accumulator


def with_signal(states, *, line=(AT, 0.0, 0.0), y=0.0, name="s"):
    """Instants of a drive at offset y past a signal with ``states(step)``."""
    instants = drive(WAY, y=y)
    return [replace(i, signals=(ShownSignal(name, states(i.step), line),)) for i in instants]


def always(state):
    return lambda _step: state


@pytest.mark.parametrize(
    ("state", "compliance"), [("red", 0.0), ("green", 1.0), ("amber", 1.0), ("off", 1.0)]
)
def test_only_red_forbids_crossing_a_stop_line(state, compliance):
    assert light_compliance(judged(with_signal(always(state)))) == compliance


def test_the_state_counts_when_the_front_crosses():
    turns = {
        at: judged(with_signal(lambda k, at=at: "red" if k < at else "green")) for at in (16, 18)
    }
    assert light_compliance(turns[16]) == 1.0
    assert light_compliance(turns[18]) == 0.0


def test_crossing_while_the_signal_changes_is_compliant():
    for before, after in (("red", "green"), ("green", "red")):
        changing = judged(with_signal(lambda k, a=before, b=after: a if k < 17 else b))
        assert light_compliance(changing) == 1.0


@pytest.mark.parametrize(
    ("line", "y"),
    [
        ((AT, 3.5, 0.0), 0.0),  # of the next lane
        ((AT, 0.0, math.pi), 0.0),  # of oncoming traffic
        ((AT, 0.0, math.pi / 2), 0.0),  # of crossing traffic
        ((60.0, 0.0, 0.0), 0.0),  # not reached
        ((2.0, 0.0, 0.0), 0.0),  # behind the front from the start
    ],
)
def test_stop_lines_of_others_do_not_count(line, y):
    assert light_compliance(judged(with_signal(always("red"), line=line, y=y))) == 1.0


@pytest.mark.parametrize(
    ("state", "red"),
    [
        ("red", True),
        ("Red", True),
        ("red;amber", True),
        ("stop", True),
        ("on;off;off", True),
        ("off;off;on", False),
        ("off;on;off", False),
        ("green", False),
        ("on", False),
        ("off", False),
        ("coloured", False),
    ],
)
def test_shows_red_recognises_red_states(state, red):
    assert shows_red(state) is red


def mapped(**parts) -> RoadMap:
    light = Signal("s", "traffic_light", (25.0, 3.0, 4.0), math.pi, **parts)
    line = StopLine("l", np.array([[AT, -1.75, 0.0], [AT, 1.75, 0.0]]), lanes=("own",))
    return RoadMap(street(signals=[light], stop_lines=[line]))


@pytest.mark.parametrize("parts", [{"stop_line": "l"}, {"stop_line": "l", "lanes": ("own",)}])
def test_a_map_signal_applies_at_the_map_stop_line(parts):
    given = context(40, road_map=mapped(**parts))
    instants = with_signal(always("red"), line=None)
    assert light_compliance(judged(instants, given)) == 0.0
    beside = with_signal(always("red"), line=None, y=2.0)
    assert light_compliance(judged(beside, given)) == 1.0


def test_a_signal_without_a_stop_line_applies_at_the_lane_end():
    far = context(40, road_map=mapped(lanes=("own",)))
    assert judged(with_signal(always("red"), line=None), far).lights.placed == {"s"}
    assert light_compliance(judged(with_signal(always("red"), line=None), far)) == 1.0


def test_a_signal_of_a_lane_in_a_junction_applies_at_the_start_of_the_lane():
    centre = np.array([[AT, 0.0, 0.0], [60.0, 0.0, 0.0]])
    crossing = Lane("through", "driving", centre, np.full(2, 3.5), junction="j")
    light = Signal("s", "traffic_light", (25.0, 3.0, 4.0), math.pi, lanes=("through",))
    given = context(40, road_map=RoadMap(LaneGraph.of([crossing], signals=[light])))

    assert light_compliance(judged(with_signal(always("red"), line=None), given)) == 0.0


def test_a_stop_line_of_the_map_keeps_its_width_in_a_storyboard():
    light = Signal("s", "traffic_light", (25.0, 3.0, 4.0), math.pi, stop_line="l")
    wide = StopLine("l", np.array([[AT, -1.75, 0.0], [AT, 5.25, 0.0]]), lanes=("own",))
    given = context(40, road_map=RoadMap(street(signals=[light], stop_lines=[wide])))

    for line, compliance in [((AT, 1.75, 0.0), 0.0), ((AT + 1.0, 1.75, 0.0), 1.0)]:
        instants = with_signal(always("red"), line=line, y=4.5)
        assert light_compliance(judged(instants, given)) == compliance


def test_assumptions_name_the_signals_that_counted():
    plain, on_map = context(40), context(40, road_map=mapped(stop_line="l"))
    assert lights(judged(drive(WAY)), plain) == "TLC: no traffic lights"
    assert "show no phases" in lights(judged(drive(WAY), on_map), on_map)
    placed = judged(with_signal(always("red")))
    assert lights(placed, plain) == "TLC: stop lines of 1 signals of the storyboard"
    unknown = judged(with_signal(always("red"), line=None, name="elsewhere"))
    assert "1 others have no known stop line" in lights(unknown, plain)
    other = with_signal(always("red"), name="elsewhere")
    assert "others of the map show no phases" in lights(judged(other, on_map), on_map)


def test_scores_without_traffic_lights_name_the_violations():
    given = context(40)
    found = {s.name: s for s in scoring.scores_of(judged(with_signal(always("red"))), given)}
    assert "stop lines crossed on red (1)" in found["pdms"].cannot_see
    assert "traffic lights" not in found["epdms"].cannot_see


def test_signals_round_trip_in_recordings():
    with_one = with_signal(always("red;amber"))[3]
    again, _ = read_instant(instant_row(with_one, "d"))
    assert again.signals == with_one.signals
    unknown = replace(with_one, signals=(ShownSignal("s", "red", None),))
    assert read_instant(instant_row(unknown, "d"))[0].signals == unknown.signals
    assert "signals" not in instant_row(drive(WAY)[3], "d")


@pytest.mark.parametrize("wrong", [["s", "red"], ["s", 3, None], ["s", "red", [1.0, 2.0]]])
def test_malformed_signals_in_a_recording_are_refused(wrong):
    row = instant_row(with_signal(always("red"))[0], "d") | {"signals": [wrong]}
    with pytest.raises((ValueError, TypeError)):
        read_instant(row)
