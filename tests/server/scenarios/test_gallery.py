"""Corner cases, of the gallery and own ones: each runs as its formulas say, and as a file."""

from __future__ import annotations

import json
import math
import runpy

import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_proto import cases
from real2sim_proto.cases import in_lane
from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import Storyboard
from real2sim_server.edit import ScenarioState
from real2sim_server.scenarios.flat_scene import fitted_to_scene, flat_scene
from real2sim_server.scenarios.gallery import GALLERY, corner_case
from real2sim_server.scenarios.openscenario import read_openscenario_text, write_openscenario
from real2sim_server.world import World
from tests.pages import REPOSITORY

from .definitions import CAR_REAR, DEFINITIONS, EGO_FRONT, EGO_SPEED, LANE, along

NEAR, SOON = 0.05, 0.05
"""How far from its formula [m, m/s], or how late [s], a case may be."""

OTHER = {
    "ccrb": {"braking": 2.0, "delay": 1.0},
    "cut_in": {"gap": 6.0, "speed": 5.0, "duration": 3.5},
    "cpfa": {"ahead": 60.0, "speed": 3.1, "impact": 0.2},
    "ccftap": {"ahead": 60.0, "radius": 9.0, "acceleration": 2.0},
    "lss_oncoming": {"drift": 3.0, "speed": 12.0},
    "junction_crossing": {"ahead": 55.0, "speed": 6.0},
}
"""Parameters but the default ones."""


@pytest.fixture(scope="module")
def scene():
    return flat_scene(with_speed(corner_case("ccrs").storyboard()))


def with_speed(board: Storyboard) -> Storyboard:
    speed = {"entity": "Ego", "action": {"kind": "speed", "speed": EGO_SPEED}}
    fields = board.model_dump()
    return Storyboard.model_validate(fields | {"init": [*fields["init"], speed]})


def run(scene, board, seconds=6.0):
    """The world at each step; the storyboard drives the ego at its speed."""
    board = fitted_to_scene(with_speed(board), scene).model_copy(update={"drives_ego": True})
    spec = ResetSpec(
        storyboard=board, horizon=round(seconds * 10), on_collision="continue", action="pose",
        contact={"dents": False},
    )  # fmt: skip
    world = World(scene, ScenarioState.of(scene), spec)
    worlds = [world.fork()]
    while not world.over:
        world.step()
        worlds.append(world.fork())
    return worlds


def starts(worlds):
    """When each event began [s]."""
    return {
        e.element.split("::")[-1]: (e.t_us - worlds[0].t_us) * 1e-6
        for w in worlds
        for e in w.observe().events
        if e.element_type == "event" and e.change == "start"
    }


def test_each_case_has_a_definition():
    assert list(DEFINITIONS) == list(GALLERY)
    families = {case.family for case in GALLERY.values()}
    assert families == {"ahead", "crossing", "lanes", "oncoming"}


@pytest.mark.parametrize(
    ("name", "parameters"),
    [*((name, {}) for name in GALLERY), *OTHER.items()],
    ids=[*GALLERY, *(f"{name}-other" for name in OTHER)],
)
def test_a_case_follows_its_formulas(scene, name, parameters):
    case = corner_case(name)
    definition = DEFINITIONS[name](**{**case.parameters, **parameters})
    end = max(definition.starts.values(), default=0.0) + 3.5
    worlds = run(scene, case.storyboard(**parameters), end)
    origin = worlds[0].motion

    assert starts(worlds) == pytest.approx(definition.starts, abs=SOON)
    courses = definition.courses
    names = [n for n in worlds[0].storyboard.entities if n != "Ego"] if "" in courses else courses
    for entity, course in zip(names, courses.values(), strict=True):
        for world in worlds:
            t = (world.t_us - worlds[0].t_us) * 1e-6
            actor = world.storyboard.entities[entity]
            x, y, speed = course(t)
            assert actor.x - origin.x == pytest.approx(x, abs=NEAR), (entity, t)
            assert actor.y - origin.y == pytest.approx(y, abs=NEAR), (entity, t)
            soon = [course(max(t + d, 0.0))[2] for d in (-SOON, SOON)]
            low, high = min(speed, *soon), max(speed, *soon)
            assert low - NEAR <= actor.speed <= high + NEAR, (entity, t)


def test_the_ego_starts_to_leave_its_lane(scene):
    """The planner's ego is put where lane keeping begins."""
    board = with_speed(corner_case("lss_keep").storyboard())
    spec = ResetSpec(storyboard=fitted_to_scene(board, scene), horizon=20)
    recorded = World(scene, ScenarioState.of(scene), ResetSpec(horizon=20)).motion
    motion = World(scene, ScenarioState.of(scene), spec).motion

    assert motion.y - recorded.y == pytest.approx(0.5)
    assert math.remainder(motion.yaw - recorded.yaw, math.tau) == pytest.approx(0.05)
    assert motion.speed * math.sin(motion.yaw - recorded.yaw) == pytest.approx(0.5, abs=0.001)


@pytest.mark.parametrize("name", GALLERY)
def test_a_case_written_as_a_file_gives_the_same_run(scene, name):
    board = corner_case(name).storyboard()
    data = write_openscenario(board)
    again = read_openscenario_text(data, f"{name}.xosc").board

    assert again == board
    assert write_openscenario(again) == data
    first, second = run(scene, board, 3.0)[-1], run(scene, again, 3.0)[-1]
    assert first.agents.positions.tobytes() == second.agents.positions.tobytes()


def test_unknown_cases_and_parameters_are_refused_by_name():
    with pytest.raises(ValueError, match="has no 'gallery:cut_on'"):
        corner_case("gallery:cut_on")
    with pytest.raises(ValueError, match="no parameter 'gab'"):
        corner_case("cut_in").storyboard(gab=3.0)


# --- Your own cases -------------------------------------------------------------------------------

FROM, SPEED = 35.0, 7.0
"""Where a car starts in the lane on the left, and how fast."""

CLOSING = (FROM - EGO_FRONT - CAR_REAR, EGO_SPEED - SPEED)
"""Gap at the start [m], and how fast it closes [m/s]."""


def own(*events):
    return cases.case(cases.actor("car", in_lane(FROM, lane=1), SPEED, *events))


@pytest.mark.parametrize(
    ("start", "at"),
    [
        (None, 0.0),
        (cases.at_time(2.0), 2.0),
        (cases.gap_below("car", 20.0), (CLOSING[0] - 20.0) / CLOSING[1]),
        (cases.time_gap_below("car", 2.5), (CLOSING[0] - 25.0) / CLOSING[1]),
        (cases.ttc_below("car", 8.0), (CLOSING[0] - 24.0) / CLOSING[1]),
        (cases.reached("car", in_lane(30.0, lane=1)), (FROM - 31.0) / CLOSING[1]),
        (cases.driven("Ego", 15.0), 1.5),
        (cases.driven("car", 14.0), 2.0),
        ([cases.at_time(1.0), cases.driven("car", 14.0)], 2.0),
    ],
    ids=["none", "time", "gap", "time_gap", "ttc", "reached", "ego_driven", "driven", "both"],
)
def test_an_event_starts_at_its_closed_form_time(scene, start, at):
    first = cases.event("first", start, cases.speed_to(SPEED - 1.0, seconds=0.5))
    second = cases.event("second", cases.completed("first"), cases.speed_to(0.0))
    found = starts(run(scene, own(first, second), at + 1.0))
    assert found == pytest.approx({"first": at, "second": at + 0.5}, abs=SOON)


SHIFT = math.pi * math.sqrt(0.5 / (2 * 0.8))
"""Time to shift by 0.5 m with at most 0.8 m/s^2 [s]."""


@pytest.mark.parametrize(
    ("action", "x", "y", "speed"),
    [
        (cases.speed_to(11.0, rate=2.0), FROM + 7.0 + 18.0 + 11.0, LANE, 11.0),
        (cases.speed_to(3.0, seconds=2.0), FROM + 7.0 + 10.0 + 3.0, LANE, 3.0),
        (cases.speed_to(0.0), FROM + 7.0, LANE, 0.0),
        (cases.change_lane(0, seconds=2.0), FROM + along(4.0, 1.0, 2.0, 7.0, LANE), 0.0, 7.0),
        (cases.change_lane(0), FROM + along(4.0, 1.0, 3.0, 7.0, LANE), 0.0, 7.0),
        (cases.change_lane(1, of="car", metres=10.0),
         FROM + 7.0 + along(21.0, 0.0, 10.0, 1.0, LANE), 2 * LANE, 7.0),
        (cases.shift(0.5), FROM + along(4.0, 1.0, SHIFT, 7.0, 0.5), LANE + 0.5, 7.0),
        (cases.follow(cases.from_entity("car", 0.0), cases.from_entity("car", 40.0, -30.0)),
         FROM + 7.0 + 0.8 * 21.0, LANE - 0.6 * 21.0, 7.0),
        (cases.teleport(in_lane(50.0)), EGO_SPEED + 50.0 + 21.0, 0.0, 7.0),
    ],
    ids=["rate", "seconds", "stop", "lane", "3_s", "metres", "shift", "follow", "teleport"],
)  # fmt: skip
def test_an_action_moves_its_actor_by_its_formula(scene, action, x, y, speed):
    worlds = run(scene, own(cases.event("move", cases.at_time(1.0), action)), 4.0)
    car, origin = worlds[-1].storyboard.entities["car"], worlds[0].motion
    found = (car.x - origin.x, car.y - origin.y, car.speed)
    assert found == pytest.approx((x, y, speed), abs=NEAR)


def test_a_hidden_actor_appears_and_vanishes(scene):
    board = cases.case(
        cases.actor(
            "car", in_lane(FROM), SPEED,
            cases.event("come", cases.at_time(1.0), cases.appear()),
            cases.event("go", cases.at_time(2.0), cases.vanish()),
            hidden=True,
        )
    )  # fmt: skip
    worlds = run(scene, board, 2.5)
    assert [worlds[k].storyboard.entities["car"].visible for k in (0, 8, 12, 18, 22)] == [
        False, False, True, True, False,
    ]  # fmt: skip


def test_the_example_cuts_in_at_its_closed_form_time(scene):
    """From 15 m behind, at 12 m/s, to within 1 m of 8 m ahead of an ego at 10 m/s."""
    board = runpy.run_path(str(REPOSITORY / "examples/own_case.py"))["CASE"]
    again = read_openscenario_text(write_openscenario(board), "own_case.xosc").board
    assert again == board

    worlds = run(scene, board, 16.0)
    moves, stops = (15.0 + 8.0 - 1.0) / (12.0 - EGO_SPEED), 2.0
    assert starts(worlds) == pytest.approx({"move_in": moves, "stop": moves + stops}, abs=SOON)
    car, origin = worlds[-1].storyboard.entities["cutter"], worlds[0].motion
    assert (car.y - origin.y, car.speed) == pytest.approx((0.0, 0.0), abs=NEAR)


def test_an_own_case_of_every_part_survives_a_file(scene):
    """Reading the file gives the same storyboard."""
    parts = [
        cases.event("a", cases.at_time("$start"), cases.speed_to(3.0, rate=2.0), cases.shift(0.2)),
        cases.event("b", cases.gap_below("car", 5.0), cases.change_lane(0, metres=20.0)),
        cases.event("c", cases.time_gap_below("car", 1.0), cases.teleport(in_lane(9.0, left=1.0))),
        cases.event("d", cases.ttc_below("car", 1.0), cases.vanish()),
        cases.event("e", cases.reached("car", cases.beside(9.0, -3.0)), cases.appear()),
        cases.event("f", [cases.driven("car", 5.0), cases.completed("a")],
                    cases.follow(in_lane(5.0), in_lane(9.0)), priority="parallel"),
    ]  # fmt: skip
    board = cases.case(
        cases.actor("car", in_lane(FROM, lane=1, heading=math.pi), SPEED, *parts, hidden=True),
        cases.ego(speed=9.0), name="own", parameters={"start": 1.0},
    )  # fmt: skip
    assert read_openscenario_text(write_openscenario(board), "own.xosc").board == board


# --- real2sim gallery -----------------------------------------------------------------------------


def gallery(*arguments: str) -> str:
    done = CliRunner().invoke(build_app(), ["gallery", *arguments], env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    return done.output


def test_the_command_lists_every_case_with_what_it_tests_and_its_parameters(tmp_path):
    output = gallery("--json", str(tmp_path / "cases.json"))
    listed = json.loads((tmp_path / "cases.json").read_text())["cases"]
    assert [case["name"] for case in listed] == list(GALLERY)
    for case in listed:
        assert case["name"] in output
        assert case["parameters"] == GALLERY[case["name"]].parameters


@pytest.mark.parametrize("name", GALLERY)
def test_a_printed_case_is_the_storyboard_itself(name):
    assert Storyboard.model_validate_json(gallery(name)) == corner_case(name).storyboard()


def test_the_command_writes_a_case_as_openscenario(tmp_path):
    gallery("cut_in", "--out", str(tmp_path / "cut_in.xosc"))
    written = (tmp_path / "cut_in.xosc").read_bytes()
    assert written == write_openscenario(corner_case("cut_in").storyboard())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["cut_off"], "has no 'cut_off'; it has: ccrs"), (["--out", "a.xosc"], "name one of ccrs")],
)
def test_the_command_names_the_cases_it_has(arguments, message):
    done = CliRunner().invoke(build_app(), ["gallery", *arguments])
    assert done.exit_code == 1
    assert message in done.output
