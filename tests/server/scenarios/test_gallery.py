"""Corner cases of the gallery: each runs on a plain scene as its formulas say, and as a file."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import Storyboard
from real2sim_server.edit import ScenarioState
from real2sim_server.scenarios.fit import fitted_to_scene
from real2sim_server.scenarios.flat_scene import flat_scene
from real2sim_server.scenarios.gallery import GALLERY, corner_case
from real2sim_server.scenarios.openscenario import read_openscenario_text, write_openscenario
from real2sim_server.world import World

EGO_SPEED = 10.0
FRONT, REAR = 3.6, 0.9
"""From the ego's rear axle to its front, and from a car's rear axle to its rear end [m]."""


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


def track(worlds, name):
    """x and y from where the ego began, and speed, at each step."""
    ego = worlds[0].motion
    found = [w.storyboard.entities[name] for w in worlds]
    return np.array([(a.x - ego.x, a.y - ego.y, a.speed) for a in found])


def started(worlds, event):
    return [
        (e.t_us - worlds[0].t_us) * 1e-6
        for w in worlds
        for e in w.observe().events
        if e.element and e.element.endswith(f"::{event}") and e.change == "start"
    ]


@pytest.mark.parametrize("name", GALLERY)
def test_a_case_is_written_as_a_file_and_read_back_to_the_same_run(scene, name):
    board = corner_case(name).storyboard()
    data = write_openscenario(board)
    again = read_openscenario_text(data, f"{name}.xosc").board

    assert again == board
    assert write_openscenario(again) == data
    first, second = run(scene, board, 3.0)[-1], run(scene, again, 3.0)[-1]
    assert first.agents.positions.tobytes() == second.agents.positions.tobytes()


@pytest.mark.parametrize(("name", "speed"), [("ccrs", 0.0), ("ccrm", 5.6), ("cbla", 4.2)])
def test_a_target_goes_ahead_at_its_speed(scene, name, speed):
    gap = corner_case(name).parameters["gap"]
    target = "cyclist" if name == "cbla" else "target"
    found = track(run(scene, corner_case(name).storyboard(), 3.0), target)

    assert found[:, 0] == pytest.approx(gap + speed * np.arange(31) / 10, abs=0.05)


@pytest.mark.parametrize(("braking", "delay"), [(6.0, 2.0), (2.0, 1.0)])
def test_the_car_ahead_brakes_when_and_as_hard_as_it_says(scene, braking, delay):
    worlds = run(scene, corner_case("ccrb").storyboard(braking=braking, delay=delay), 8.0)
    found = track(worlds, "target")

    assert started(worlds, "brake") == pytest.approx([delay], abs=0.05)
    stop = 26.0 + 10.0 * delay + 10.0**2 / (2 * braking)
    assert found[-1, 0] == pytest.approx(stop, abs=0.05)
    k = round(delay * 10) + 5
    assert found[k, 2] == pytest.approx(10.0 - braking * 0.5, abs=0.01)


def test_a_car_cuts_in_at_its_gap_by_its_form(scene):
    worlds = run(scene, corner_case("cut_in").storyboard(), 9.0)
    found = track(worlds, "cutter")
    begin = (35.0 - FRONT - REAR - 12.0) / 3.0

    assert started(worlds, "move_in") == pytest.approx([begin], abs=0.05)
    for k in range(91):
        u = min(max((k / 10 - begin) / 2.0, 0.0), 1.0)
        y = 3.5 * (1 + np.cos(np.pi * u)) / 2
        assert found[k, 1] == pytest.approx(y, abs=0.05)


@pytest.mark.parametrize("name", ["cpna", "cpfa", "cbna", "cbfa", "occluded_pedestrian"])
def test_who_crosses_is_in_the_ego_s_way_when_it_comes(scene, name):
    case = corner_case(name)
    worlds = run(scene, case.storyboard(), 6.0)
    ahead, distance, speed = (case.parameters[k] for k in ("ahead", "distance", "speed"))
    side = 1.0 if name in {"cpfa", "cbfa"} else -1.0
    begin = ahead / EGO_SPEED - distance / speed

    assert started(worlds, "cross") == pytest.approx([begin], abs=0.05)
    found = track(worlds, "crosser")
    at = np.interp(ahead / EGO_SPEED, np.arange(len(found)) / 10, found[:, 1])
    assert at == pytest.approx(0.0, abs=0.05)
    assert found[0, 1] == pytest.approx(side * distance)


def test_cars_meet_at_the_junction(scene):
    worlds = run(scene, corner_case("junction_crossing").storyboard(), 5.0)

    x, y, speed = track(worlds, "crosser")[45]
    assert (x, y) == pytest.approx((45.0, 0.0), abs=0.05)
    assert speed == pytest.approx(8.0, abs=0.05)


def test_unknown_cases_and_parameters_are_refused_by_name():
    with pytest.raises(ValueError, match="has no 'gallery:cut_on'"):
        corner_case("gallery:cut_on")
    with pytest.raises(ValueError, match="no parameter 'gab'"):
        corner_case("cut_in").storyboard(gab=3.0)
