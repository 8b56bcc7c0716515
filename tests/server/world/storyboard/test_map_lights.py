"""Phases of a map's traffic lights."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from real2sim_proto.cases import actor, at_time, case, event, in_lane, speed_to
from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import MapSignals, Storyboard
from real2sim_server.maps import read_map
from real2sim_server.scenarios import ScenarioError
from real2sim_server.scenarios.openscenario import write_openscenario
from real2sim_server.scene import LaneGraph, Signal
from real2sim_server.world import World, WorldError
from real2sim_server.world.scoring.metrics import light_compliance
from real2sim_server.world.storyboard.map_lights import with_map_signals
from real2sim_server.world.storyboard.program import shown_at

from .boards import condition, drive

SHORT = MapSignals(green=2.0, yellow=1.0, clearance=1.0)
EAST, NORTH, WEST, SOUTH = "east", "north", "west", "south"
ARMS = (EAST, NORTH, WEST, SOUTH)
IN_AND_OUT = """<left><lane id="1" type="driving"><link><successor id="1"/></link>
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>"""
IN = """<right><lane id="-1" type="driving"><link>{links}</link>
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>"""


def road(name, junction, start, heading, length, lanes, links="", more=""):
    x, y = start
    return f"""<road id="{name}" length="{length}" junction="{junction}"><link>{links}</link>
    <planView><geometry s="0" x="{x}" y="{y}" hdg="{heading}" length="{length}"><line/></geometry>
    </planView><lanes><laneSection s="0">{lanes}</laneSection></lanes>{more}</road>"""


def crossing(tmp_path, *, controllers=None, angles=(0, 90, 180, 270), inside=False, ids="9"):
    """Roads of 50 m towards a junction at the origin, a light 2 m before the end of each.

    Args:
        controllers: the lights of each controller.
        angles: of the arms, seen from the junction [deg].
        inside: put the lights on the roads through the junction.
        ids: of the junction; empty: a map without one.
    """
    made, connections = [], []
    for k, (arm, degrees) in enumerate(zip(ARMS, angles, strict=False)):
        a = math.radians(degrees)
        out, heading = (math.cos(a), math.sin(a)), a + math.pi
        light = (
            f'<signals><signal id="{arm}" s="{{s}}" t="-4" dynamic="yes" orientation="+" '
            'type="1000001"/><signal id="line" s="{s}" t="0" dynamic="no" orientation="+" '
            'type="294"/></signals>'
        )
        before, after = ("", light.format(s=0)) if inside else (light.format(s=48), "")
        link = f'<successor elementType="junction" elementId="{ids}"/>' if ids else ""
        ends = IN_AND_OUT + IN.format(links="")
        made.append(road(k, -1, (60 * out[0], 60 * out[1]), heading, 50, ends, link, before))
        if not ids:
            continue
        link = f'<predecessor elementType="road" elementId="{k}" contactPoint="end"/>'
        lanes = IN.format(links='<predecessor id="-1"/>')
        start = (10 * out[0], 10 * out[1])
        made.append(road(10 + k, ids, start, heading, 20, lanes, link, after))
        connections.append(
            f'<connection id="{k}" incomingRoad="{k}" connectingRoad="{10 + k}" '
            'contactPoint="start"><laneLink from="-1" to="-1"/></connection>'
        )
    groups = "".join(
        f'<controller id="c{n}">'
        + "".join(f'<control signalId="{s}"/>' for s in lights)
        + "</controller>"
        for n, lights in enumerate(controllers or ())
    )
    junction = f'<junction id="{ids}">{"".join(connections)}</junction>' if ids else ""
    path = tmp_path / "crossing.xodr"
    path.write_text(
        f'<OpenDRIVE><header revMajor="1" revMinor="7"/>{"".join(made)}{groups}{junction}'
        "</OpenDRIVE>"
    )
    return read_map(path)


def states(board, seconds):
    return shown_at(board, seconds, {}, {})[0]


def greens(board, seconds):
    return {name for name, state in states(board, seconds).items() if state != "red"}


def test_opposite_lights_are_green_together_and_crossing_ones_in_turn(tmp_path):
    board = with_map_signals(Storyboard(), SHORT, crossing(tmp_path))

    for seconds, one, other in [
        (0.0, "green", "red"), (1.99, "green", "red"), (2.0, "yellow", "red"),
        (3.0, "red", "red"), (4.0, "red", "green"), (6.0, "red", "yellow"), (7.0, "red", "red"),
        (8.0, "green", "red"), (804.5, "red", "green"),
    ]:  # fmt: skip
        expected = {EAST: one, WEST: one, NORTH: other, SOUTH: other}
        assert states(board, seconds) == expected, seconds


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, 2),
        ({"ids": ""}, 2),
        ({"inside": True}, 2),
        ({"angles": (0, 60, 120, 240)}, 3),
        ({"angles": (0, 29, 58, 87)}, 2),
        ({"controllers": [[EAST], [NORTH], [WEST], [SOUTH]]}, 4),
        ({"controllers": [[EAST, WEST], [NORTH, SOUTH]]}, 2),
        ({"controllers": [[EAST], [WEST]]}, 3),
        ({"controllers": [ARMS]}, 2),
    ],
)
def test_no_two_crossing_groups_are_green_at_any_instant(tmp_path, options, count):
    graph = crossing(tmp_path, **options)
    board = with_map_signals(Storyboard(), SHORT, graph)
    [controller] = board.controllers
    angles = dict(zip(ARMS, options.get("angles", (0, 90, 180, 270)), strict=True))
    apart = {
        s: n for n, lights in enumerate(options.get("controllers", ())) for s in lights
    }  # fmt: skip
    cycle = sum(p.duration for p in controller.phases)

    assert cycle == count * 4.0
    seen = set()
    for tick in range(round(cycle * 100)):
        shown = greens(board, tick / 100)
        seen |= shown
        for a in shown:
            for b in shown:
                assert abs((angles[a] - angles[b] + 90) % 180 - 90) <= 30, (tick, shown)
                assert apart.get(a) is None or apart.get(a) == apart.get(b, apart[a]), shown
    assert seen == set(ARMS)


def test_lights_of_the_same_lane_show_the_same(tmp_path):
    graph = crossing(tmp_path, controllers=[[EAST], [NORTH], [WEST], [SOUTH]])
    again = replace(graph.signals[EAST], signal_id="again", group="c1")
    both = LaneGraph.of(graph.lanes.values(), signals=[*graph.signals.values(), again],
                        stop_lines=graph.stop_lines.values())  # fmt: skip
    board = with_map_signals(Storyboard(), SHORT, both)

    assert all((found := states(board, t / 10))[EAST] == found["again"] for t in range(200))


def test_junctions_have_cycles_of_their_own(tmp_path):
    graph = crossing(tmp_path)
    far = graph.moved(0.0, (500.0, 0.0, 0.0))
    named = [replace(s, signal_id=f"far_{s.signal_id}", lanes=(), stop_line=None,
                     heading=s.heading + math.pi) for s in far.signals.values()]  # fmt: skip
    both = LaneGraph.of(graph.lanes.values(), stop_lines=graph.stop_lines.values(),
                        signals=[*graph.signals.values(), *named])  # fmt: skip
    board = with_map_signals(Storyboard(), SHORT, both)

    assert [c.name for c in board.controllers] == ["map_signals_1", "map_signals_2"]
    assert len(board.controllers[0].phases) == len(board.controllers[1].phases) == 6


def test_lights_that_the_storyboard_names_keep_its_states(tmp_path):
    graph = crossing(tmp_path)
    own = {
        "signals": [{"signal_id": EAST, "state": "yellow"}],
        "controllers": [
            {"name": "c", "phases": [{"name": "p", "duration": 1, "states": {WEST: "green"}}]}
        ],
    }
    board = with_map_signals(Storyboard.model_validate(own), SHORT, graph)

    shown = states(board, 5.0)
    assert (shown[EAST], shown[WEST]) == ("yellow", "green")
    assert set(board.controllers[1].phases[0].states) == {NORTH, SOUTH}


def test_stop_lines_are_those_of_the_map_in_the_frame_of_the_storyboard(tmp_path):
    graph = crossing(tmp_path)
    board = with_map_signals(Storyboard(origin=(5.0, 1.0, math.pi / 2)), SHORT, graph)
    line = next(h.stop_line for h in board.signals if h.signal_id == WEST)

    # In the world at x = -12, in the middle of the lane at y = -1.75, eastwards.
    assert (line.x, line.y) == pytest.approx((-2.75, 17.0))
    assert math.cos(line.h + math.pi / 2) == pytest.approx(1.0)


def test_lights_without_lanes_have_no_stop_line_and_the_phase_of_their_heading(tmp_path):
    graph = crossing(tmp_path)
    walk = Signal("walk", "traffic_light", (12.0, 6.0, 2.0), math.pi / 2)  # faces north
    both = LaneGraph.of(graph.lanes.values(), signals=[*graph.signals.values(), walk],
                        stop_lines=graph.stop_lines.values())  # fmt: skip
    board = with_map_signals(Storyboard(), SHORT, both)

    assert board.signals[-1].stop_line is None
    assert greens(board, 4.0) == {NORTH, SOUTH, "walk"}


def test_the_reader_keeps_controllers_and_names_lights_that_are_not_there(tmp_path):
    graph = crossing(tmp_path, controllers=[[EAST, "gone"], [EAST, WEST]])

    groups = {s.signal_id: s.group for s in graph.signals.values() if s.kind == "traffic_light"}
    assert groups == {EAST: "c0", NORTH: None, WEST: "c1", SOUTH: None}
    assert any("controlled signals that are not there: 1" in note for note in graph.notes)


# --- episodes -------------------------------------------------------------------------------------


@pytest.fixture
def world(make_world, moving, tmp_path):
    """The ego drives eastwards to the light, and reaches its line after some 4.5 s."""
    made = make_world(moving(-60, -1.75, speed=10.0), look=moving(500, 50))

    def of(board, graph=None):
        lanes = crossing(tmp_path) if graph is None else graph
        scene = replace(made.scene, lanes=lanes)
        return World(scene, made.state, ResetSpec(storyboard=board))

    return of


@pytest.mark.parametrize(("green", "compliance"), [(2.0, 0.0), (9.0, 1.0)])
def test_scores_hold_the_ego_to_the_lights_of_the_map(world, green, compliance):
    worlds = drive(world({"map_signals": SHORT.model_dump() | {"green": green}}), 60)

    assert light_compliance(worlds[60].accumulator) == compliance
    assert worlds[60].accumulator.lights.placed == set(ARMS)
    [west] = [s for s in worlds[30].observe().obs_fields()["signals"] if s["signal_id"] == WEST]
    assert west["stop_line"] == pytest.approx((-12.0, -1.75, 0.0))
    assert west["state"] == ("green" if green == 9.0 else "red")


def test_conditions_and_actions_name_the_lights_of_the_map(world):
    red = {"kind": "signal_state", "signal": WEST, "state": "red"}
    off = {"kind": "signal_state", "signal": WEST, "state": "off"}
    stop = event("stop", at_time(0.0), speed_to(0.0))
    board = case(actor("car", in_lane(30.0), 5.0, stop), map_signals=SHORT).model_dump()
    [change] = board["stories"][0]["acts"][0]["groups"][0]["maneuvers"][0]["events"]
    change["start"] = condition(red)
    change["actions"].append({"name": "off", "action": off})
    worlds = drive(world(board), 35)

    speeds = [w.storyboard.entities["car"].speed for w in worlds]
    assert [speeds[k] for k in (29, 32)] == [5.0, 0.0]
    shown = {s.signal_id: s.state for s in worlds[35].storyboard.signals()}
    assert (shown[WEST], shown[EAST]) == ("off", "red")


def test_durations_may_be_parameters(world):
    cycle = {"green": "$green", "yellow": 1.0, "clearance": 1.0}
    found = world({"parameters": {"green": 3.0}, "map_signals": cycle})

    assert found.storyboard.program.board.controllers[0].phases[0].duration == 3.0
    with pytest.raises(ValueError, match="map_signals: green is -1; it must be 0 or more"):
        Storyboard.model_validate({"map_signals": {"green": -1}})


def test_a_scene_without_lights_is_refused(world, tmp_path):
    graph = crossing(tmp_path)
    sign = Signal("sign", "stop", (0.0, 0.0, 2.0))
    unlit = LaneGraph.of(graph.lanes.values(), signals=[sign])

    with pytest.raises(WorldError, match="'street' has a map without traffic lights"):
        world({"map_signals": {}}, unlit)


def test_it_is_not_written_as_openscenario():
    with pytest.raises(ScenarioError, match="map_signals; leave it out"):
        write_openscenario(Storyboard(map_signals=MapSignals()))
