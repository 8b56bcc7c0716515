"""When elements of a storyboard begin and end."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_server.edit import ScenarioState
from real2sim_server.world import World

from .boards import actor, after, board, changes, condition, drive, event, places, speeds

SOON = 0.011
"""Elements begin within a tick of 10 ms of what sets them off [s]."""


@pytest.fixture
def run(make_world, moving):
    def made(*events, steps=60, init=(), **options):
        world = make_world(
            moving(0, 0, speed=10.0),
            look=moving(500, 50),
            spec={"storyboard": board(*events, init=init, **options)},
        )
        return drive(world, steps)

    return made


def to_speed(speed, seconds=1.0):
    dynamics = {"shape": "linear", "dimension": "time", "value": seconds}
    return {"kind": "speed", "speed": speed, "dynamics": dynamics}


def times_of(worlds, element, change="start"):
    return [t for t, name, what in changes(worlds) if name == element and what == change]


def test_an_event_begins_at_its_time_and_ends_with_its_actions(run):
    worlds = run(event("slow", to_speed(12.0), start=after(1.234)))

    assert times_of(worlds, "slow") == pytest.approx([1.24])
    assert times_of(worlds, "slow", "end") == pytest.approx([2.24])
    assert times_of(worlds, "story", "end") == pytest.approx([2.24])


def test_conditions_of_a_group_hold_together_and_groups_instead_of_each_other(run):
    time = {"kind": "simulation_time", "rule": "greater_than"}
    first = [{"test": {**time, "value": 1.0}}, {"test": {**time, "value": 3.0}}]
    both = {"groups": [{"conditions": first}]}
    either = {"groups": [{"conditions": [c]} for c in first]}
    parallel = {"priority": "parallel"}
    worlds = run(
        event("both", to_speed(12.0), start=both, **parallel),
        event("either", to_speed(12.0), start=either, **parallel),
    )

    assert times_of(worlds, "either") == pytest.approx([1.01])
    assert times_of(worlds, "both") == pytest.approx([3.01])


@pytest.mark.parametrize(
    ("edge", "expected"), [("rising", 2.0), ("falling", 3.0), ("rising_or_falling", 2.0)]
)
def test_edges_and_delays(run, edge, expected):
    fast = {"kind": "speed", "entities": ["car"], "rule": "greater_than", "value": 11.0}
    up, down = to_speed(12.0, 0.0), to_speed(9.0, 0.0)
    worlds = run(
        event("up", up, start=after(2.0), priority="parallel"),
        event("down", down, start=after(3.0), priority="parallel"),
        event(
            "seen",
            {"kind": "visibility", "visible": True},
            start=condition(fast, edge=edge, delay=0.5),
            priority="parallel",
        ),
    )

    assert times_of(worlds, "seen") == pytest.approx([expected + 0.5], abs=2 * SOON)


def test_an_event_that_overrides_stops_those_that_run(run):
    worlds = run(
        event("long", to_speed(20.0, 4.0), start=after(1.0)),
        event("short", to_speed(10.0, 0.5), start=after(2.0)),
    )

    assert times_of(worlds, "long", "stop") == pytest.approx([2.0])
    assert not times_of(worlds, "long", "end")
    assert speeds(worlds)[-1] == pytest.approx(10.0)


def test_who_leaves_a_trajectory_goes_on_from_where_it_is(run):
    vertices = [{"position": {"kind": "world", "x": x, "y": 9.0}} for x in (100.0, 100.1)]
    vertices.append({"position": {"kind": "world", "x": 100.1, "y": 60.0}})
    follow = {"kind": "follow_trajectory", "curve": {"shape": "polyline", "vertices": vertices}}
    worlds = run(
        event("aside", follow, start=after(1.0)),
        event("slow", to_speed(8.0), start=after(2.0)),
    )

    assert places(worlds)[20, 1] == pytest.approx(19.0, abs=0.2)
    steps = np.hypot(*np.diff(places(worlds)[11:, :2], axis=0).T)
    assert steps.max() < 1.01


def test_an_event_that_skips_does_not_happen_while_another_runs(run):
    worlds = run(
        event("long", to_speed(20.0, 2.0), start=after(1.0)),
        event("skipped", to_speed(5.0, 0.5), start=after(2.0), priority="skip"),
    )

    assert times_of(worlds, "skipped", "skip") == pytest.approx([2.0])
    assert not times_of(worlds, "skipped")
    assert speeds(worlds)[-1] == pytest.approx(20.0)


def test_an_event_happens_as_often_as_it_may(run):
    fast = {"kind": "speed", "entities": ["car"], "rule": "greater_than", "value": 9.0}
    worlds = run(event("again", to_speed(12.0, 0.0), start=condition(fast), times=3))

    assert len(times_of(worlds, "again")) == 3


def test_an_act_stops_what_it_holds(run):
    stopping = board(event("long", to_speed(20.0, 4.0), start=after(1.0)))
    stopping["stories"][0]["acts"][0]["stop"] = after(2.0)
    worlds = run(stories=stopping["stories"])

    assert times_of(worlds, "long", "stop") == pytest.approx([2.0])
    assert speeds(worlds)[-1] == pytest.approx(12.5, abs=0.06)


def test_an_element_sets_off_another(run):
    ended = {
        "kind": "element_state",
        "element_type": "event",
        "element": "first",
        "state": "end_transition",
    }
    worlds = run(
        event("first", to_speed(12.0, 1.0), start=after(1.0)),
        event("second", to_speed(8.0, 1.0), start=condition(ended)),
    )

    assert times_of(worlds, "second") == pytest.approx([2.0], abs=SOON)


def test_a_transition_sets_off_an_event_at_the_same_instant(run):
    started = {
        "kind": "element_state", "element_type": "act", "element": "act",
        "state": "start_transition",
    }  # fmt: skip
    story = board(event("with_it", to_speed(12.0), start=condition(started), times=9))["stories"]
    story[0]["acts"][0]["start"] = after(1.0)
    worlds = run(stories=story)

    assert times_of(worlds, "act") == times_of(worlds, "with_it") == pytest.approx([1.0])


def test_a_delay_begins_anew_with_each_run_of_a_group(run):
    ended = {
        "kind": "element_state", "element_type": "event", "element": "first", "state": "complete",
    }  # fmt: skip
    story = board(
        event("first", to_speed(12.0, 0.5), start=after(1.0)),
        event("second", to_speed(10.0, 0.5), start=condition(ended, delay=1.0)),
    )["stories"]
    story[0]["acts"][0]["groups"][0]["times"] = 2
    worlds = run(stories=story)

    assert times_of(worlds, "first") == pytest.approx([1.0, 3.0], abs=3 * SOON)
    assert times_of(worlds, "second") == pytest.approx([2.5, 4.5], abs=3 * SOON)


@pytest.mark.parametrize(
    ("test", "at"),
    [
        # The ego goes at 10 m/s, the car stands 100 m ahead; its box reaches 2.3 m back.
        ({"kind": "relative_distance", "entity": "Ego", "rule": "less_than", "value": 70.0}, 3.0),
        ({"kind": "time_to_collision", "entity": "Ego", "rule": "less_than", "value": 7.0}, 3.0),
        (
            {
                "kind": "distance", "rule": "less_than", "value": 70.0,
                "position": {"kind": "relative_object", "entity": "Ego", "dx": 0, "dy": 0},
            },
            3.0,
        ),
        ({"kind": "stand_still", "duration": 2.5}, 2.5),
        ({"kind": "collision", "entity": "Ego"}, None),
    ],
)  # fmt: skip
def test_conditions_of_entities_hold_from_when_they_say(run, test, at):
    still = ("car", {"kind": "speed", "speed": 0.0})
    start = condition({"entities": ["car"], **test})
    worlds = run(event("seen", to_speed(0.0, 0.0), start=start), init=[still], steps=50)

    found = times_of(worlds, "seen")
    assert found == (pytest.approx([at], abs=2 * SOON) if at is not None else [])


def test_a_headway_is_of_who_follows(run):
    behind = {"kind": "time_headway", "entities": ["Ego"], "entity": "car", "rule": "less_than"}
    still = ("car", {"kind": "speed", "speed": 0.0})
    start = condition({**behind, "value": 6.0})
    worlds = run(event("seen", to_speed(0.0, 0.0), start=start), init=[still], steps=50)

    assert times_of(worlds, "seen") == pytest.approx([4.0], abs=2 * SOON)


def test_a_traversed_distance_counts_from_when_it_is_asked_for(run):
    far = {"kind": "traversed_distance", "entities": ["car"], "value": 20.0}
    worlds = run(event("seen", to_speed(5.0, 0.0), start=condition(far)))

    assert times_of(worlds, "seen") == pytest.approx([2.0], abs=SOON)


def test_expressions_of_parameters_are_values(run):
    worlds = run(
        event("slow", to_speed("${$speed / 2}"), start=after("$when")),
        parameters={"speed": 8.0, "when": 1.5},
    )

    assert times_of(worlds, "slow") == pytest.approx([1.5])
    assert speeds(worlds)[-1] == pytest.approx(4.0)


def test_a_fork_goes_on_alike_and_leaves_its_origin(make_world, moving):
    spec = {"storyboard": board(event("slow", to_speed(4.0, 3.0), start=after(1.0)))}
    world = make_world(moving(0, 0, speed=10.0), look=moving(500, 50), spec=spec)
    drive(world, 15)
    fork, before = world.fork(), actor(world)
    ahead = drive(fork, 20)

    assert actor(world) is before
    assert places(drive(world, 20)).tobytes() == places(ahead).tobytes()


def test_distributions_are_drawn_by_the_seed(make_scene, moving):
    uniform = {"when": {"kind": "uniform", "low": 1.0, "high": 3.0}}
    made = board(
        event("slow", to_speed(4.0), start=after("$when")),
        parameters={"when": 1.0},
        distributions=uniform,
    )
    scene = make_scene(moving(0, 0, speed=10.0), look=moving(500, 50))

    def drawn(seed):
        spec = ResetSpec(seed=seed, storyboard=made)
        return World(scene, ScenarioState.of(scene), spec).sampled["storyboard.parameters.when"]

    assert 1.0 <= drawn(1) < 3.0
    assert drawn(1) == drawn(1) != drawn(2)


def test_actions_of_an_ego_that_the_planner_drives_end_at_once(run):
    made = board(event("slow", to_speed(4.0, 2.0), start=after(1.0)))
    made["stories"][0]["acts"][0]["groups"][0]["entities"] = ["Ego"]
    worlds = run(stories=made["stories"])

    assert times_of(worlds, "slow", "end") == times_of(worlds, "slow") == [pytest.approx(1.0)]
    assert worlds[20].motion.speed == pytest.approx(10.0)


def test_a_storyboard_may_drive_the_ego(run):
    made = board(event("slow", to_speed(4.0, 2.0), start=after(1.0)))
    made["stories"][0]["acts"][0]["groups"][0]["entities"] = ["Ego"]
    worlds = run(stories=made["stories"], drives_ego=True, init=[("Ego", to_speed(8.0, 0.0))])

    assert worlds[0].motion.speed == pytest.approx(8.0)
    assert worlds[30].motion.speed == pytest.approx(4.0)
    assert worlds[40].motion.x == pytest.approx(8 + 12 + 4, abs=0.05)


def test_signals_go_through_their_phases(run):
    phases = [
        {"name": "go", "duration": 2.0, "states": {"s": "green"}},
        {"name": "stop", "duration": 1.0, "states": {"s": "red"}},
    ]
    red = {"kind": "signal_state", "signal": "s", "state": "red"}
    worlds = run(
        event("seen", to_speed(9.0, 0.0), start=condition(red)),
        signals=[{"signal_id": "s", "stop_line": {"kind": "world", "x": 50, "y": 0}}],
        controllers=[{"name": "c", "phases": phases}],
    )

    shown = [w.observe().obs_fields()["signals"][0] for w in worlds]
    assert [s["state"] for s in shown[::10]] == ["green", "green", "red"] * 2 + ["green"]
    assert shown[0]["stop_line"] == (50.0, 0.0, 0.0)
    assert times_of(worlds, "seen") == pytest.approx([2.0], abs=SOON)


@pytest.mark.parametrize(
    ("first", "second", "ran"), [("red", "green", {"s"}), ("green", "red", set())]
)
def test_scores_hold_the_ego_to_what_signals_show_when_it_crosses(run, first, second, ran):
    # The ego's front is at the line after some 4.6 s, in the second turn of the first phase.
    phases = [
        {"name": "one", "duration": 2.0, "states": {"s": first}},
        {"name": "two", "duration": 1.0, "states": {"s": second}},
    ]
    worlds = run(
        signals=[{"signal_id": "s", "stop_line": {"kind": "world", "x": 50, "y": 0}}],
        controllers=[{"name": "c", "phases": phases}],
    )
    assert worlds[40].accumulator.lights.ran == set()
    assert worlds[60].accumulator.lights.ran == ran
