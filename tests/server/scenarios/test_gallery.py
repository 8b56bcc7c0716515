"""Corner cases of the gallery: each runs on a plain scene as its formulas say, and as a file."""

from __future__ import annotations

import json
import math

import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import Storyboard
from real2sim_server.edit import ScenarioState
from real2sim_server.scenarios.flat_scene import fitted_to_scene, flat_scene
from real2sim_server.scenarios.gallery import GALLERY, corner_case
from real2sim_server.scenarios.openscenario import read_openscenario_text, write_openscenario
from real2sim_server.world import World

from .definitions import DEFINITIONS, EGO_SPEED

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
