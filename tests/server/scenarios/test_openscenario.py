"""OpenSCENARIO files: what is read, and what is refused by name and line."""

from __future__ import annotations

import re

import pytest

from real2sim_proto.storyboard import Storyboard, resolved, story_actions
from real2sim_server.scenarios import ScenarioError
from real2sim_server.scenarios.gallery import corner_case
from real2sim_server.scenarios.openscenario import (
    ReadOptions,
    read_openscenario,
    read_openscenario_text,
    write_openscenario,
)
from tests.server.world.storyboard.boards import board, condition, event

CASE = write_openscenario(corner_case("ccrb").storyboard()).decode()


def read(text, **options):
    return read_openscenario_text(text.encode(), "case.xosc", ReadOptions(**options)).board


def line_of(text, part):
    return text[: text.index(part)].count("\n") + 1


def test_an_element_that_is_not_supported_is_refused_by_name_and_line():
    text = CASE.replace("<LongitudinalAction>", "<TrafficAction>", 1).replace(
        "</LongitudinalAction>", "</TrafficAction>", 1
    )
    line = line_of(text, "<TrafficAction>")

    with pytest.raises(ScenarioError, match=f"line {line}: <TrafficAction> is not supported"):
        read(text)
    assert len(read(text, leave_out=frozenset({"TrafficAction"})).init) == 1


def test_an_attribute_that_is_not_supported_is_refused_by_name_and_line():
    text = CASE.replace("dynamicsShape=", 'wobble="2" dynamicsShape=', 1)
    line = line_of(text, "wobble")

    with pytest.raises(ScenarioError, match=f"line {line}: attribute wobble"):
        read(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<OpenSCENARIO>", "is not an XML file"),
        ('<?xml version="1.0" encoding="utf-0"?><OpenSCENARIO/>', "is not an XML file.*utf-0"),
        ("<OpenDRIVE/>", "expected <OpenSCENARIO>"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><OpenSCENARIO/>', "document type"),
        ("<a>" * 300, "nested deeper|not an XML"),
        (CASE.replace('revMajor="1"', 'revMajor="2"'), "version 2"),
        (CASE.replace('revMajor="1"', 'revMajor="NaN"'), "'NaN'; it must be a whole number"),
        (CASE.replace('revMajor="1"', 'revMajor="INF"'), "'INF'; it must be a whole number"),
        (CASE.replace('"$gap', '"$gab').replace("$gap", "$gab"), "names no parameter"),
    ],
)
def test_broken_files_are_refused(text, message):
    with pytest.raises(ScenarioError, match=message):
        read(text)


def test_given_values_override_those_of_the_file():
    assert read(CASE, parameters={"braking": 3.0}).parameters["braking"] == 3.0
    with pytest.raises(ScenarioError, match="no parameter 'brakes'"):
        read(CASE, parameters={"brakes": 3.0})


def test_derived_parameters_become_expressions():
    text = CASE.replace(
        "</ParameterDeclarations>",
        '<ParameterDeclaration name="far" parameterType="double" value="${2 * $gap}" />'
        "</ParameterDeclarations>",
    ).replace('ds="${$gap + 6}"', 'ds="${$far + 1}"')
    board = read(text)

    assert "far" not in board.parameters
    assert board.init[0].action.position.ds == "${(2 * $gap) + 1}"


def test_catalogs_and_distributions_are_read_from_their_folders(tmp_path):
    vehicle = CASE[CASE.index("<Vehicle ") : CASE.index("</Vehicle>") + len("</Vehicle>")]
    header = CASE[CASE.index("<FileHeader") : CASE.index("/>", CASE.index("<FileHeader")) + 2]
    (tmp_path / "catalogs").mkdir()
    (tmp_path / "catalogs" / "cars.xosc").write_text(
        f'<OpenSCENARIO>{header}<Catalog name="cars">{vehicle}</Catalog></OpenSCENARIO>'
    )
    text = CASE.replace(vehicle, '<CatalogReference catalogName="cars" entryName="ego" />').replace(
        "<CatalogLocations />",
        '<CatalogLocations><VehicleCatalog><Directory path="catalogs" /></VehicleCatalog>'
        "</CatalogLocations>",
    )
    (tmp_path / "case.xosc").write_text(text)
    values = "".join(f'<Element value="{v}" />' for v in (2, 6))
    (tmp_path / "sweep.xosc").write_text(
        f'<OpenSCENARIO>{header}<ParameterValueDistribution><ScenarioFile filepath="case.xosc" />'
        '<Deterministic><DeterministicSingleParameterDistribution parameterName="braking">'
        f"<DistributionSet>{values}</DistributionSet></DeterministicSingleParameterDistribution>"
        "</Deterministic></ParameterValueDistribution></OpenSCENARIO>"
    )
    found = read_openscenario(tmp_path / "sweep.xosc")

    assert found.cases == ({"braking": 2.0}, {"braking": 6.0})
    assert found.board.parameters["braking"] == 2.0
    assert found.board.entities[0].model == "ego"


@pytest.mark.parametrize(
    ("before", "after", "encoding"),
    [
        ("<", "<", "utf-8-sig"),
        ("<", "<", "utf-16"),
        ("<", "<", "utf-16-le"),
        ("\n", "\r\n", "utf-8"),
        ("<?xml", "\n<!-- by hand -->\n<?xml", "utf-8"),
        ("<OpenSCENARIO", '<OpenSCENARIO xmlns="http://example.org/osc"', "utf-8"),
        ("<OpenSCENARIO", '<s:OpenSCENARIO xmlns:s="http://example.org/osc"', "utf-8"),
    ],
)
def test_encodings_line_ends_and_namespaces_make_no_difference(before, after, encoding):
    text = CASE.replace(before, after)
    if "<s:" in after:
        text = re.sub(r"<(/?)(?=[A-Z])", r"<\1s:", text)
    declared = "utf-8" if encoding.startswith("utf-8") else "utf-16"
    text = re.sub("encoding='[^']*'", f"encoding='{declared}'", text)
    found = read_openscenario_text(text.encode(encoding), "case.xosc")
    assert found.board == read(CASE)


def test_lines_count_from_the_first_line_of_the_file():
    text = "\n<!-- by hand -->\n" + CASE.replace("dynamicsShape=", 'wobble="2" dynamicsShape=', 1)
    with pytest.raises(ScenarioError, match=f"line {line_of(text, 'wobble')}: attribute wobble"):
        read(text)


def with_catalogs(folder, path, text=CASE):
    """The case with its car in a catalog, and a road network; ``path`` names their folder."""
    vehicle = CASE[CASE.index("<Vehicle ") : CASE.index("</Vehicle>") + len("</Vehicle>")]
    header = CASE[CASE.index("<FileHeader") : CASE.index("/>", CASE.index("<FileHeader")) + 2]
    (folder / "Data").mkdir()
    (folder / "Data" / "road.xodr").touch()
    (folder / "Data" / "cars.XOSC").write_text(
        f'<OpenSCENARIO>{header}<Catalog name="cars">{vehicle}</Catalog></OpenSCENARIO>'
    )
    text = text.replace(vehicle, '<CatalogReference catalogName="cars" entryName="ego" />')
    text = text.replace(
        "<CatalogLocations />",
        f'<CatalogLocations><VehicleCatalog><Directory path="{path}" /></VehicleCatalog>'
        "</CatalogLocations>",
    ).replace(
        "<RoadNetwork />", f'<RoadNetwork><LogicFile filepath="{path}/road.xodr" /></RoadNetwork>'
    )
    (folder / "cases").mkdir()
    (folder / "cases" / "case.XOSC").write_text(text)
    return folder / "cases" / "case.XOSC"


@pytest.mark.parametrize("path", ["../Data", r"..\Data", r".\..\Data", "../data"])
def test_paths_may_have_backslashes_and_names_of_another_case(tmp_path, path):
    found = read_openscenario(with_catalogs(tmp_path, path))
    assert found.road_file == (tmp_path / "Data" / "road.xodr").resolve()
    assert found.board.entities[0].model == "ego"
    assert any("differs in case" in note for note in found.notes) == ("data" in path)


def test_names_that_fit_several_files_are_not_guessed(tmp_path):
    file = with_catalogs(tmp_path, "../data")
    (tmp_path / "DATA").mkdir()
    if len(list(tmp_path.glob("[Dd]*"))) < 2:
        pytest.skip("the file system ignores case")
    with pytest.raises(ScenarioError, match=f"{tmp_path.resolve()}/data is not a folder"):
        read_openscenario(file)


def test_a_damaged_catalog_costs_no_other(tmp_path):
    file = with_catalogs(tmp_path, "../Data")
    (tmp_path / "Data" / "bikes.xosc").write_text("<OpenSCENARIO>")
    found = read_openscenario(file)
    assert found.board.entities[0].model == "ego"
    [note] = [note for note in found.notes if "catalog is left out" in note]
    assert "bikes.xosc: is not an XML file" in note
    (tmp_path / "Data" / "cars.XOSC").unlink()
    with pytest.raises(ScenarioError, match=r"no catalog has the Vehicle cars/ego.*bikes.xosc"):
        read_openscenario(file)


def test_files_from_another_program_mean_the_same(tmp_path):
    """``scenariogeneration`` writes a lane change that takes 3 s from 1 s on."""
    xosc = pytest.importorskip("scenariogeneration.xosc", reason="needs scenariogeneration")
    box = xosc.BoundingBox(1.9, 4.5, 1.5, 1.35, 0, 0.75)
    car = xosc.Vehicle(
        "car", xosc.VehicleCategory.car, box, xosc.Axle(0.5, 0.6, 1.6, 2.7, 0.3),
        xosc.Axle(0, 0.6, 1.6, 0, 0.3), 60, 10, 10,
    )  # fmt: skip
    entities = xosc.Entities()
    entities.add_scenario_object("Ego", car)
    entities.add_scenario_object("other", car)
    init = xosc.Init()
    for name, s in (("Ego", 10), ("other", 40)):
        init.add_init_action(name, xosc.TeleportAction(xosc.LanePosition(s, 0, -1, "0")))
        step = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
        init.add_init_action(name, xosc.AbsoluteSpeedAction(10, step))
    smooth = xosc.TransitionDynamics(xosc.DynamicsShapes.sinusoidal, xosc.DynamicsDimension.time, 3)
    at = xosc.ValueTrigger(
        "at", 0, xosc.ConditionEdge.none, xosc.SimulationTimeCondition(1, xosc.Rule.greaterThan)
    )
    event = xosc.Event("change", xosc.Priority.override)
    event.add_trigger(at)
    event.add_action("change", xosc.AbsoluteLaneChangeAction(-2, smooth))
    maneuver = xosc.Maneuver("maneuver")
    maneuver.add_event(event)
    board = xosc.StoryBoard(init)
    board.add_maneuver(maneuver, "other")
    scenario = xosc.Scenario(
        "case", "test", xosc.ParameterDeclarations(), entities, board, xosc.RoadNetwork(),
        xosc.Catalog(),
    )  # fmt: skip
    scenario.write_xml(str(tmp_path / "case.xosc"))
    found = read_openscenario(tmp_path / "case.xosc").board

    act = found.stories[0].acts[0]
    change = act.groups[0].maneuvers[0].events[0]
    assert change.actions[0].action.lane == -2
    assert change.actions[0].action.dynamics.shape == "sinusoidal"
    assert change.start.groups[0].conditions[0].test.value == 1.0


def test_lamps_are_read_back_as_written_and_other_lights_are_noted():
    lights = [
        {"kind": "light_state", "lamp": "brake"},
        {"kind": "light_state", "lamp": "indicator_left", "mode": "flashing"},
        {"kind": "light_state", "lamp": "indicator_right", "mode": "flashing", "on_time": 0.3},
        {"kind": "light_state", "lamp": "hazard", "mode": "off"},
    ]
    fields = board(event("lamps", *lights), init=[("car", lights[1])])
    fields["entities"] = [{**e, "box": fields["entities"][1]["box"]} for e in fields["entities"]]
    written = Storyboard.model_validate(fields)
    text = write_openscenario(written).decode()

    again = read_openscenario_text(text.encode(), "case.xosc")
    assert (again.board.init, again.board.stories) == (written.init, written.stories)
    assert not again.notes

    looks = text.replace("<LightStateAction>", '<LightStateAction transitionTime="0.2">')
    looks = looks.replace(
        'mode="on" />',
        'mode="on" luminousIntensity="900"><Color colorType="red"><ColorRgb red="1" green="0" '
        'blue="0" /></Color></LightState>',
    )
    noted = read_openscenario_text(looks.encode(), "case.xosc")
    assert noted.board.stories == written.stories
    assert [n.split(" is ignored")[0] for n in sorted(noted.notes)] == [
        "<Color>", "luminousIntensity of <LightState>", "transitionTime of <LightStateAction>",
    ]  # fmt: skip

    fog = read_openscenario_text(text.replace("brakeLights", "fogLights").encode(), "case.xosc")
    kinds = [action.kind for _, action in story_actions(fog.board)]
    assert kinds == ["custom", "light_state", "light_state", "light_state"]
    assert any("<LightStateAction> is ignored" in note for note in fog.notes)


def test_curves_and_clearances_are_read_back_as_written():
    place = {"kind": "world", "x": 40.0, "y": 20.0, "h": 0.3}
    lane = {"kind": "lane", "road": "1", "lane": -1, "s": 60.0}
    vertices = [
        {"position": place, "oriented": True},
        {"position": {**place, "x": 60.0, "h": 0.0}},
        {"position": {**lane, "orientation": {"h": 0.2, "relative": True}}, "oriented": True},
        {"position": {**lane, "s": 80.0}},
    ]
    piece = {"start": 0.0, "end": 0.1, "length": 5.0, "time": 2.0}
    pieces = [piece, {**piece, "turn": 0.2, "position": place}]
    clear = {
        "kind": "relative_clearance", "entities": ["car"], "ahead": 20.0, "behind": 5.0,
        "lanes": [(-1, 1)], "others": ["Ego"], "freespace": True,
    }  # fmt: skip
    follow = [
        {"kind": "follow_trajectory", "curve": {"shape": "polyline", "vertices": vertices}},
        {"kind": "follow_trajectory", "curve": {"shape": "clothoid_spline", "pieces": pieces}},
    ]
    start = condition(clear, name="clear")
    events = [event(f"follow_{k}", action, start=start) for k, action in enumerate(follow)]
    fields = board(*events)
    fields["entities"] = [{**e, "box": fields["entities"][1]["box"]} for e in fields["entities"]]
    written = Storyboard.model_validate(fields)

    again = read_openscenario_text(write_openscenario(written), "case.xosc").board
    assert again.stories == written.stories


PLACES = """<WorldPosition x="1" y="{s}2" h="{s}0.5" />
<RelativeWorldPosition entityRef="Ego" dx="1" dy="{s}2">
  <Orientation type="relative" h="{s}0.5" /></RelativeWorldPosition>
<RelativeObjectPosition entityRef="Ego" dx="1" dy="{s}2" />
<RoadPosition roadId="1" s="3" t="{s}2"><Orientation type="absolute" h="{s}0.5" /></RoadPosition>
<RelativeRoadPosition entityRef="Ego" ds="3" dt="{s}2" />
<LanePosition roadId="1" laneId="-1" s="3" offset="{s}0.5" />
<RelativeLanePosition entityRef="Ego" dLane="1" ds="3" offset="{s}0.5" />"""


def with_places(sign, description):
    """A file with places in a trajectory and with lateral values of other elements."""
    places = PLACES.format(s=sign).replace("\n  <Orient", "<Orient").splitlines()
    vertices = "".join(f'<Vertex time="0"><Position>{p}</Position></Vertex>' for p in places)
    actions = f"""<FollowTrajectoryAction><Trajectory name="t" closed="false"><Shape>
    <Polyline>{vertices}</Polyline></Shape></Trajectory></FollowTrajectoryAction>|
    <LaneOffsetAction continuous="true"><LaneOffsetActionDynamics dynamicsShape="step" />
    <LaneOffsetTarget><AbsoluteTargetLaneOffset value="{sign}2" /></LaneOffsetTarget>
    </LaneOffsetAction>|<TeleportAction><Position>
    <WorldPosition x="0" y="{sign}$gap" h="${{{sign}1 * $gap}}" /></Position></TeleportAction>|
    <LaneChangeAction targetLaneOffset="{sign}0.25"><LaneChangeActionDynamics dynamicsShape="step"
    dynamicsDimension="time" value="0" /><LaneChangeTarget><RelativeTargetLane entityRef="Ego"
    value="1" /></LaneChangeTarget></LaneChangeAction>"""
    kinds = ("RoutingAction", "LateralAction", None, "LateralAction")
    made = "".join(
        f"<PrivateAction><{k}>{a}</{k}></PrivateAction>"
        if k
        else f"<PrivateAction>{a}</PrivateAction>"
        for k, a in zip(kinds, actions.split("|"), strict=True)
    ).replace('"-$gap"', '"${-1 * $gap}"')
    at = CASE.index("</Private>")
    text = CASE[:at] + made + CASE[at:]
    start = text.index(' description="') + len(' description="')
    return text[:start] + description + text[text.index('"', start) :]


def test_files_with_the_coordinates_of_carla_are_mirrored():
    left = read(with_places("", "case"))
    text = with_places("-", "CARLA:case").encode()
    found = read_openscenario_text(text, "case.xosc")

    assert resolved(found.board) == resolved(left)
    assert [n for n in found.notes if "left-handed" in n] == [
        "coordinates are left-handed, as CARLA's: they are mirrored"
    ]
    back = read(write_openscenario(found.board).decode())
    assert resolved(back) == resolved(left)


def test_offsets_in_left_lanes_of_carla_are_to_the_right_of_the_traffic():
    text = with_places("-", "CARLA:case").replace('laneId="-1"', 'laneId="1"')
    vertices = read(text).init[-4].action.curve.vertices

    assert vertices[5].position.offset == -0.5


def test_a_name_that_marks_the_coordinates_of_carla_is_not_written():
    with pytest.raises(ScenarioError, match="rename it"):
        write_openscenario(Storyboard(name="CARLA:case"))


def test_a_random_route_is_read_and_written():
    route = "<RoutingAction><RandomRouteAction /></RoutingAction>"
    at = CASE.index("</Private>")
    found = read(f"{CASE[:at]}<PrivateAction>{route}</PrivateAction>{CASE[at:]}")

    assert "random_route" in [entry.action.kind for entry in found.init]
    assert read(write_openscenario(found).decode()) == found
