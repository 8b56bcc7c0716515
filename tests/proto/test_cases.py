"""Storyboards built in Python: what each function makes, and what is refused."""

from __future__ import annotations

import re

import pytest

from real2sim_proto.cases import (
    BODIES,
    actor,
    appear,
    at_time,
    beside,
    case,
    change_lane,
    completed,
    driven,
    ego,
    event,
    follow,
    gap_below,
    in_lane,
    reached,
    shift,
    speed_to,
    teleport,
    time_gap_below,
    ttc_below,
    vanish,
)

GAP = {"entities": ["Ego"], "entity": "car", "measure": "longitudinal", "freespace": True,
       "rule": "less_or_equal", "value": 5.0}  # fmt: skip
LANE = {"kind": "relative_lane", "entity": "Ego", "along": "road", "lanes": 1, "ds": 5.0}


def fields(model) -> dict:
    """Fields that differ from their defaults, and the kind."""
    return model.model_dump(exclude_defaults=True) | {"kind": model.kind}


@pytest.mark.parametrize(
    ("made", "kind", "expected"),
    [
        (at_time(5), "simulation_time", {"rule": "greater_or_equal", "value": 5.0}),
        (gap_below("car", 5), "relative_distance", GAP),
        (gap_below("car", 5, of="a"), "relative_distance", GAP | {"entities": ["a"]}),
        (time_gap_below("car", 5), "time_headway", GAP),
        (ttc_below("car", 5), "time_to_collision", GAP),
        (driven("car", 5), "traversed_distance", {"entities": ["car"], "value": 5.0}),
        (completed("e"), "element_state",
         {"element_type": "event", "element": "e", "state": "complete"}),
        (speed_to(5), "speed", {"speed": 5.0}),
        (speed_to(5, rate="$a"), "speed",
         {"speed": 5.0, "dynamics": {"dimension": "rate", "value": "$a"}}),
        (speed_to(5, seconds=2), "speed", {"speed": 5.0, "dynamics": {"value": 2.0}}),
        (change_lane(0), "lane_change", {"lane": 0, "relative_to": "Ego"}),
        (change_lane(-1, of="car", metres=9), "lane_change",
         {"lane": -1, "relative_to": "car",
          "dynamics": {"shape": "sinusoidal", "dimension": "distance", "value": 9.0}}),
        (shift(-0.5, acceleration=1), "lane_offset",
         {"offset": -0.5, "shape": "sinusoidal", "acceleration": 1.0}),
        (appear(), "visibility", {"visible": True}),
        (vanish(), "visibility", {"visible": False}),
    ],
)  # fmt: skip
def test_each_trigger_and_action_is_the_model_that_it_names(made, kind, expected):
    assert fields(made) == expected | {"kind": kind}


def test_positions_are_parts_of_triggers_and_actions():
    there = in_lane(5.0, lane=1)
    assert fields(there) == LANE
    assert reached("car", there, within=2.0).position == teleport(there).position == there
    path = follow(there, beside(5.0, -3.0))
    assert [v.position for v in path.curve.vertices] == [there, beside(5.0, -3.0)]
    assert path.timing is None


def test_an_actor_starts_at_a_place_with_a_speed():
    board = case(actor("car", in_lane(5.0, lane=1), 7.0), name="own", parameters={"gap": 3.0})

    assert [(e.name, e.kind, e.category) for e in board.entities] == [
        ("Ego", "ego", "car"), ("car", "new", "car"),
    ]  # fmt: skip
    assert {a.entity for a in board.init} == {"car"}
    assert [a.action for a in board.init] == [teleport(in_lane(5.0, lane=1)), speed_to(7.0)]
    assert (board.stories, board.name, board.parameters) == ([], "own", {"gap": 3.0})


@pytest.mark.parametrize("body", BODIES)
def test_an_actor_has_the_box_of_its_body_on_the_ground(body):
    entity = actor("it", in_lane(5.0), body=body, max_speed=3.0).entity
    assert entity.box.centre[2] == entity.box.size[2] / 2
    assert entity.max_speed == 3.0


def test_a_hidden_actor_and_an_ego_elsewhere_are_in_the_initial_actions():
    board = case(actor("car", in_lane(5.0), hidden=True), ego(in_lane(0.0, left=0.5), 9.0))
    assert [(a.entity, a.action.kind) for a in board.init] == [
        ("car", "teleport"), ("car", "speed"), ("car", "visibility"),
        ("Ego", "teleport"), ("Ego", "speed"),
    ]  # fmt: skip
    assert sum(e.kind == "ego" for e in board.entities) == 1


def test_conditions_in_a_list_must_all_hold():
    together = event("e", [at_time(1.0), driven("car", 3.0)], speed_to(0.0), priority="parallel")
    [group] = together.start.groups
    assert [c.test.kind for c in group.conditions] == ["simulation_time", "traversed_distance"]
    assert together.priority == "parallel"
    assert event("e", None, speed_to(0.0)).start is None


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: actor("x", 20.0), TypeError, "not a valid position: 20.0"),
        (lambda: actor("x", in_lane(2.0), body="vann"), ValueError, "'vann'; did you mean van"),
        (lambda: actor("x", in_lane(2.0), 3.0, at_time(1.0)), TypeError, "not a valid event"),
        (lambda: event("x", 2.0, speed_to(0.0)), TypeError, "not a valid condition: 2.0"),
        (lambda: event("x", speed_to(0.0), at_time(2.0)), TypeError, "not a valid condition"),
        (lambda: event("x", None, at_time(2.0)), TypeError, "not a valid action"),
        (lambda: speed_to(1.0, rate=2.0, seconds=3.0), ValueError, "rate=2.0 and seconds=3.0"),
        (lambda: change_lane(0, seconds=1.0, metres=2.0), ValueError, "give one of them"),
        (lambda: follow(in_lane(2.0)), ValueError, "1 positions; give at least 2"),
        (lambda: waiting("stopp"), ValueError, "no event 'stopp' to wait for; did you mean stop"),
        (lambda: waiting("stop", "stop"), ValueError, "2 events have the name 'stop'"),
        (lambda: case(actor("x", in_lane("$gap"))), ValueError, "'$gap' names no parameter"),
    ],
)
def test_what_is_wrong_is_named_with_what_is_allowed(build, error, message):
    with pytest.raises(error, match=re.escape(message)):
        build()


def waiting(awaited: str, name: str = "go_on"):
    stop = event("stop", at_time(1.0), speed_to(0.0))
    return case(actor("x", in_lane(9.0), 3.0, stop, event(name, completed(awaited), speed_to(3.0))))
