"""``real2sim run FILE`` drives what the file describes."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from real2sim.cli import build_app
from real2sim_server.cli.drive import _print
from real2sim_server.world.recording import Recording, load_recording

DT = 0.1
"""Step of an episode [s]."""

RADIUS = 100.0


def road(number: int, start: str, length: float, shape: str, link: str) -> str:
    """A road with lanes 1, -1 and -2, linked with those of the other road."""

    def lane_of(lane: int) -> str:
        return f"""<lane id="{lane}" type="driving"><link><{link} id="{lane}"/></link>
        <width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>"""

    return f"""<road id="{number}" junction="-1" length="{length}" rule="RHT">
    <link><{link} elementType="road" elementId="{3 - number}"
    contactPoint="{"start" if link == "successor" else "end"}"/></link>
    <planView><geometry s="0" {start} length="{length}">{shape}</geometry></planView>
    <lanes><laneSection s="0"><left>{lane_of(1)}</left><center><lane id="0" type="none"/></center>
    <right>{lane_of(-1)}{lane_of(-2)}</right></laneSection></lanes></road>"""


ROAD = f"""<OpenDRIVE><header revMajor="1" revMinor="5"/>
{road(1, 'x="0" y="0" hdg="0"', 600.0, "<line/>", "successor")}
{road(2, 'x="600" y="0" hdg="0"', 50 * math.pi, f'<arc curvature="{1 / RADIUS}"/>', "predecessor")}
</OpenDRIVE>"""
"""600 m straight on, then a quarter of a circle to the left."""

CUT_IN = """<LateralAction><LaneChangeAction>
<LaneChangeActionDynamics dynamicsShape="sinusoidal" dynamicsDimension="time" value="2"/>
<LaneChangeTarget><AbsoluteTargetLane value="-2"/></LaneChangeTarget>
</LaneChangeAction></LateralAction>"""
AT_HALF_A_SECOND = """<StartTrigger><ConditionGroup>
<Condition name="t" delay="0" conditionEdge="none"><ByValueCondition>
<SimulationTimeCondition value="0.5" rule="greaterThan"/></ByValueCondition></Condition>
</ConditionGroup></StartTrigger>"""


def vehicle(name: str, box: str = "", inside: str = "") -> str:
    box = box or '<Center x="2" y="0" z="0.9"/><Dimensions width="2" length="5" height="1.8"/>'
    return f"""<ScenarioObject name="{name}"><Vehicle name="car" vehicleCategory="car">{inside}
    <BoundingBox>{box}</BoundingBox>
    <Performance maxSpeed="69" maxAcceleration="10" maxDeceleration="10"/>
    <Axles><FrontAxle maxSteering="0.5" wheelDiameter="0.8" trackWidth="1.7" positionX="2.98"
    positionZ="0.4"/><RearAxle maxSteering="0.5" wheelDiameter="0.8" trackWidth="1.7" positionX="0"
    positionZ="0.4"/></Axles></Vehicle></ScenarioObject>"""


def speed(value: Any, how: str = "") -> str:
    how = how or 'dynamicsShape="step" dynamicsDimension="time" value="0"'
    return f"""<LongitudinalAction><SpeedAction><SpeedActionDynamics {how}/><SpeedActionTarget>
    <AbsoluteTargetSpeed value="{value}"/></SpeedActionTarget></SpeedAction></LongitudinalAction>"""


def put(position: str) -> str:
    return f"<TeleportAction><Position>{position}</Position></TeleportAction>"


def lane(number: int, s: float, road: int = 1) -> str:
    return f'<LanePosition roadId="{road}" laneId="{number}" s="{s}"/>'


def private(entity: str, *actions: str) -> str:
    made = "".join(f"<PrivateAction>{a}</PrivateAction>" for a in actions)
    return f'<Private entityRef="{entity}">{made}</Private>'


def of_target(condition: str, inside: str = "") -> str:
    """A start trigger of an entity condition of the target."""
    tag = condition.split(maxsplit=1)[0]
    return f"""<StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="none">
    <ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any">
    <EntityRef entityRef="Target"/></TriggeringEntities><EntityCondition>
    <{condition}>{inside}</{tag}>
    </EntityCondition></ByEntityCondition></Condition></ConditionGroup></StartTrigger>"""


EGO = private("Ego", put(lane(-2, 50.0)), speed(10.0))
TARGET = private("Target", put(lane(-1, 110.0)), speed(10.0))


def scenario(
    *,
    init: str = EGO + TARGET,
    actor: str = "Target",
    action: str = CUT_IN,
    event_start: str = AT_HALF_A_SECOND,
    act_start: str = "",
    stop: str = "",
    entities: str = "",
    inside_story: str = "",
) -> str:
    entities = entities or vehicle("Ego") + vehicle("Target")
    return f"""<OpenSCENARIO><FileHeader description="a" author="b" revMajor="1" revMinor="3"
    date="2026-01-01T00:00:00"/><CatalogLocations/>
    <RoadNetwork><LogicFile filepath="road.xodr"/></RoadNetwork><Entities>{entities}</Entities>
    <Storyboard><Init><Actions>{init}</Actions></Init>
    <Story name="story">{inside_story}<Act name="act"><ManeuverGroup name="group"
    maximumExecutionCount="1"><Actors selectTriggeringEntities="false">
    <EntityRef entityRef="{actor}"/></Actors><Maneuver name="maneuver">
    <Event name="event" priority="parallel" maximumExecutionCount="1"><Action name="action">
    <PrivateAction>{action}</PrivateAction></Action>{event_start}</Event></Maneuver></ManeuverGroup>
    {act_start}</Act></Story><StopTrigger>{stop}</StopTrigger></Storyboard></OpenSCENARIO>"""


@dataclass(frozen=True)
class Run:
    """What a run has printed and written."""

    output: str
    exit_code: int
    figures: dict[str, Any]
    recording: Recording | None

    @property
    def ego(self) -> list[Any]:
        """At each step."""
        assert self.recording is not None, self.output
        return [i.ego for i in self.recording.instants]

    def begins(self, event: str) -> list[float]:
        """When an event began [s]."""
        return [
            e["t"]
            for e in self.figures["events"]
            if e["what"].endswith(event) and e["change"] == "start"
        ]


@pytest.fixture
def run(tmp_path):
    """Run a file that stands beside its road."""

    def made(text: str, *options: str, planner: str = "storyboard", seconds: float = 5.0) -> Run:
        (tmp_path / "road.xodr").write_text(ROAD)
        file, figures = tmp_path / "case.xosc", tmp_path / "figures.json"
        recording = tmp_path / "case.r2e"
        for old in (figures, recording):
            old.unlink(missing_ok=True)
        file.write_text(text)
        words = ["run", str(file), "--planner", planner, "--seconds", str(seconds)]
        words += ["--json", str(figures), "--save", str(recording), *options]
        result = CliRunner().invoke(build_app(), words)
        found = json.loads(figures.read_text()) if figures.is_file() else {}
        return Run(
            result.output + str(result.exception or ""), result.exit_code, found,
            load_recording(Path(recording)) if recording.is_file() else None,
        )  # fmt: skip

    return made


def test_an_episode_lasts_until_the_stop_trigger(run):
    stop = AT_HALF_A_SECOND.replace('value="0.5"', 'value="4"').replace("StartTrigger", "X")
    stop = stop.removeprefix("<X>").removesuffix("</X>")
    for planner in ("storyboard", "idm"):
        found = run(scenario(stop=stop), planner=planner, seconds=8.0)
        assert found.figures["seconds"] == pytest.approx(4.1), planner
        assert found.figures["reason"] == "storyboard"


@pytest.mark.parametrize("element", ["act", "event"])
def test_an_empty_start_trigger_starts_at_once_and_is_noted(run, element):
    found = run(scenario(**{f"{element}_start": "<StartTrigger/>"}), seconds=1.0)

    first = 0.0 if element == "event" else 0.51
    assert found.begins("event") == [pytest.approx(first, abs=0.011)]
    assert "starts at once" in " ".join(found.output.split())


@pytest.mark.parametrize("rate", [4.0, -4.0])
def test_only_the_magnitude_of_a_rate_counts(run, rate):
    how = f'dynamicsShape="linear" dynamicsDimension="rate" value="{rate}"'
    found = run(scenario(actor="Ego", action=speed(2.0, how)))

    v = [e.speed for e in found.ego]
    assert min(b - a for a, b in itertools.pairwise(v)) == pytest.approx(-0.4, abs=1e-6)
    assert v[-1] == pytest.approx(2.0)


@pytest.mark.parametrize("dimension", ["time", "distance"])
def test_a_negative_time_or_distance_is_refused_by_name_and_line(run, dimension):
    how = f'dynamicsShape="linear" dynamicsDimension="{dimension}" value="-4"'
    text = scenario(actor="Ego", action=speed(2.0, how))
    line = text[: text.index('value="-4"')].count("\n") + 1
    found = run(text)

    assert found.exit_code != 0
    told = " ".join(found.output.split())
    assert f"line {line}: value of <SpeedActionDynamics> is -4" in told


def test_a_route_outlasts_a_teleport_onto_it(run):
    waypoint = '<Waypoint routeStrategy="shortest"><Position>{}</Position></Waypoint>'
    # Without a map it goes straight from place to place, here off the road to the left.
    there = ((50.0, -3.5), (150.0, -3.5), (150.0, 100.0))
    places = [f'<WorldPosition x="{x}" y="{y}"/>' for x, y in there]
    route = "".join(waypoint.format(p) for p in places)
    route = f"""<RoutingAction><AssignRouteAction><Route name="r" closed="false">{route}</Route>
    </AssignRouteAction></RoutingAction>"""
    before = private("Ego", put(lane(-2, 50.0)), route, put(lane(-2, 100.0)), speed(20.0))
    text = scenario(init=before + private("Target", put(lane(-1, 400.0))))
    found = run(text.replace('<LogicFile filepath="road.xodr"/>', ""))

    ego = found.ego[-1]
    assert (ego.x, ego.y) == (pytest.approx(150.0, abs=1.0), pytest.approx(46.5, abs=1.0))


def test_a_lane_change_on_a_route_keeps_the_route(run):
    # Without a map the route turns to the left off the road, at x = 150 m.
    there = ((50.0, -3.5), (150.0, -3.5), (150.0, 100.0))
    points = "".join(
        f'<Waypoint routeStrategy="shortest"><Position><WorldPosition x="{x}" y="{y}"/></Position>'
        "</Waypoint>"
        for x, y in there
    )
    route = f"""<RoutingAction><AssignRouteAction><Route name="r" closed="false">{points}</Route>
    </AssignRouteAction></RoutingAction>"""
    init = private("Ego", put(lane(-2, 50.0)), route, speed(30.0))
    text = scenario(
        init=init + private("Target", put(lane(-2, 400.0))),
        actor="Ego", action=CUT_IN.replace('value="-2"', 'value="-1"'),
    )  # fmt: skip
    ego = run(text.replace('<LogicFile filepath="road.xodr"/>', "")).ego[-1]

    # It drives along its route, a lane further to the left.
    assert ego.yaw == pytest.approx(math.pi / 2)
    assert ego.x == pytest.approx(146.5, abs=1e-6)


def test_a_parked_entity_with_a_route_stays_as_it_is_parked(run):
    points = "".join(
        f'<Waypoint routeStrategy="shortest"><Position>{p}</Position></Waypoint>'
        for p in (lane(-2, 40.0), lane(-2, 300.0))
    )
    route = f"""<RoutingAction><AssignRouteAction><Route name="r" closed="false">{points}</Route>
    </AssignRouteAction></RoutingAction>"""
    across = lane(-2, 50.0).replace("/>", '><Orientation type="relative" h="1.5"/></LanePosition>')
    found = run(scenario(init=private("Ego", put(across), route) + TARGET), seconds=1.0).ego

    assert [e.yaw for e in found] == pytest.approx([1.5] * len(found))


def test_a_lane_change_goes_on_where_a_route_ends(run):
    points = "".join(
        f'<Waypoint routeStrategy="shortest"><Position>{p}</Position></Waypoint>'
        for p in (lane(-2, 40.0), lane(-2, 65.0))
    )
    route = f"""<RoutingAction><AssignRouteAction><Route name="r" closed="false">{points}</Route>
    </AssignRouteAction></RoutingAction>"""
    change = CUT_IN.replace('value="-2"', 'value="-1"')
    init = private("Ego", put(lane(-2, 50.0)), route, speed(10.0)) + TARGET
    ego = run(scenario(init=init, actor="Ego", action=change), seconds=3.0).ego

    # Half of the change is done 10 m on, where the route ends after 15 m.
    assert ego[15].y == pytest.approx(-3.5, abs=0.15)
    assert max(b.y - a.y for a, b in itertools.pairwise(ego)) < 0.3
    assert ego[-1].y == pytest.approx(-1.75)


def test_an_ego_without_a_speed_stands_still(run):
    init = private("Ego", put(lane(-2, 50.0))) + TARGET

    assert max(abs(e.speed) for e in run(scenario(init=init)).ego) == 0.0
    assert run(scenario(init=init), planner="idm").ego[0].speed == 0.0


def test_an_initial_speed_that_takes_time_starts_from_zero(run):
    how = 'dynamicsShape="linear" dynamicsDimension="time" value="4"'
    init = private("Ego", put(lane(-2, 50.0)), speed(8.0, how)) + TARGET
    found = run(scenario(init=init))

    for step, ego in enumerate(found.ego):
        assert ego.speed == pytest.approx(min(2.0 * step * DT, 8.0), abs=1e-6)
    assert run(scenario(init=init), planner="idm").ego[0].speed == 0.0


def test_speeds_that_refer_to_each_other_take_effect_in_the_order_of_the_file(run):
    def relative(entity: str, value: float) -> str:
        return speed("x").replace(
            '<AbsoluteTargetSpeed value="x"/>',
            f'<RelativeTargetSpeed entityRef="{entity}" value="{value}" continuous="false" '
            'speedTargetValueType="delta"/>',
        )

    init = private("Ego", put(lane(-2, 50.0)), relative("Target", 2.0))
    init += private("Target", put(lane(-1, 50.0)), relative("Ego", 3.0))
    found = run(scenario(init=init), seconds=0.5)

    assert found.ego[0].speed == pytest.approx(2.0)


def test_lane_0_is_the_centre_line_of_the_road(run):
    init = private("Ego", put(lane(0, 50.0)), speed(0.0)) + TARGET
    ego = run(scenario(init=init), seconds=0.2).ego[0]

    assert (ego.y, ego.yaw) == pytest.approx((0.0, 0.0))


def test_the_ego_has_the_bounding_box_of_the_file(run):
    box = '<Center x="3.5" y="0" z="1.5"/><Dimensions width="2.5" length="12" height="3"/>'
    entities = vehicle("Ego", box) + vehicle("Target")
    init = EGO + private("Target", put(lane(-2, 110.0)), speed(0.0))
    found = run(scenario(init=init, entities=entities), seconds=8.0)

    assert found.recording.context.ego_size == (12.0, 2.5, 3.0)
    assert found.figures["reason"] == "collision"
    # Its front, 9.5 m ahead of where the file has it, meets the target's rear, 0.5 m behind where
    # the file has that; its rear axle is taken to be 0.95 m before its rear end.
    reference = 10.0 * found.figures["seconds"] + 50.0
    assert reference + 9.5 == pytest.approx(109.5, abs=1.01)
    assert found.ego[0].x == pytest.approx(50.0 + 3.5 - 6.0 + 0.95)


def test_an_ego_can_be_placed_relative_to_a_later_entity(run):
    relative = put('<RelativeLanePosition entityRef="Target" dLane="-1" ds="-30"/>')
    found = run(scenario(init=private("Ego", relative, speed(10.0)) + TARGET), seconds=1.0)

    axle = 50.0 + 30.0 + 2.0 - (2.5 - 0.95)
    assert (found.ego[0].x, found.ego[0].y) == (pytest.approx(axle), pytest.approx(-5.25))


def test_entities_placed_relative_to_each_other_are_refused(run):
    relative = '<RelativeLanePosition entityRef="{}" dLane="0" ds="-30"/>'
    init = private("Ego", put(relative.format("Target"))) + private(
        "Target", put(relative.format("Ego"))
    )
    found = run(scenario(init=init))

    assert found.exit_code != 0
    assert "'Ego' and 'Target' have initial positions relative to each other" in " ".join(
        found.output.split()
    )


EMPTY = "<ParameterDeclarations/>"


def declared(**values: Any) -> str:
    made = "".join(
        f'<ParameterDeclaration name="{k}" parameterType="double" value="{v}"/>'
        for k, v in values.items()
    )
    return f"<ParameterDeclarations>{made}</ParameterDeclarations>"


def test_empty_declarations_below_the_top_level_change_nothing(run):
    entities = vehicle("Ego", inside=EMPTY) + vehicle("Target", inside=EMPTY)
    text = scenario(inside_story=EMPTY, entities=entities)
    text = text.replace('<Maneuver name="maneuver">', f'<Maneuver name="maneuver">{EMPTY}')

    assert run(text, seconds=1.0).figures == run(scenario(), seconds=1.0).figures


def test_nested_declarations_shadow_outer_ones(run):
    text = scenario(
        actor="Ego", action=speed("${$v / $share}"), inside_story=declared(v=4.0, share=2.0)
    )
    text = text.replace(
        '<Maneuver name="maneuver">', f'<Maneuver name="maneuver">{declared(v=6.0)}'
    ).replace("<CatalogLocations/>", f"{declared(v=1.0, share=1.0)}<CatalogLocations/>")
    found = run(text, seconds=1.0)

    assert math.isclose(found.ego[-1].speed, 3.0), found.output


IGNORED = {
    "TrailerHitch": '<TrailerHitch dx="-1"/>',
    "ObjectController": '<ObjectController name="c"><Controller name="c"/></ObjectController>',
    "LightStateAction": """<AppearanceAction><LightStateAction><LightType><VehicleLight
    vehicleLightType="lowBeam"/></LightType><LightState mode="on"/></LightStateAction>
    </AppearanceAction>""",
    "AnimationAction": """<AppearanceAction><AnimationAction><AnimationType/></AnimationAction>
    </AppearanceAction>""",
    "ActivateControllerAction": '<ActivateControllerAction lateral="true" longitudinal="true"/>',
    "ControllerAction": """<ControllerAction><AssignControllerAction/>
    <OverrideControllerValueAction/></ControllerAction>""",
    "EnvironmentAction": """<EnvironmentAction><Environment name="rain"><Weather/>
    <RoadCondition frictionScaleFactor="1.0"/></Environment></EnvironmentAction>""",
    "UserDefinedAction": """<UserDefinedAction><CustomCommandAction type="x">y
    </CustomCommandAction></UserDefinedAction>""",
}


def with_ignored(tag: str) -> str:
    """The scenario with an element that has no effect, in the place where files have it."""
    element = IGNORED[tag]
    if tag == "TrailerHitch":
        return scenario(entities=vehicle("Ego") + vehicle("Target", inside=element))
    if tag == "ObjectController":
        target = vehicle("Target").replace("</ScenarioObject>", f"{element}</ScenarioObject>")
        return scenario(entities=vehicle("Ego") + target)
    holder = {"EnvironmentAction": "GlobalAction", "UserDefinedAction": ""}.get(
        tag, "PrivateAction"
    )
    element = f"<{holder}>{element}</{holder}>" if holder else element
    return scenario().replace("</Action>", f'</Action><Action name="other">{element}</Action>', 1)


@pytest.mark.parametrize("tag", IGNORED)
def test_an_element_without_effect_is_noted_and_the_drive_stays_the_same(run, tag):
    text, plain = with_ignored(tag), run(scenario())
    found = run(text)
    line = text[: text.index(f"<{tag}")].count("\n") + 1

    assert found.exit_code == 0, found.output
    noted = " ".join(found.output.split())
    assert f"note: <{tag}> is ignored:" in noted
    assert f"(line {line})" in noted
    drives = [[i.others.centres.tolist() for i in r.recording.instants] for r in (found, plain)]
    assert drives[0] == drives[1]


def test_a_friction_is_noted(run):
    slippery = with_ignored("EnvironmentAction").replace('Factor="1.0"', 'Factor="0.5"')
    found = run(slippery)

    assert "frictionScaleFactor of <RoadCondition> is ignored:" in " ".join(found.output.split())
    assert found.exit_code == 0


@pytest.mark.parametrize("tag", IGNORED)
def test_a_strict_run_refuses_an_element_without_effect(run, tag):
    found = run(with_ignored(tag), "--strict")

    assert found.exit_code == 1
    assert f"<{tag}> is not supported" in " ".join(found.output.split())


def test_repeated_elements_without_effect_have_one_note_with_their_count(run):
    hitch = IGNORED["TrailerHitch"]
    both = vehicle("Ego", inside=hitch) + vehicle("Target", inside=hitch)

    found = run(scenario(entities=both))

    assert " ".join(found.output.split()).count("<TrailerHitch> is ignored") == 1
    assert "(2 times, line" in " ".join(found.output.split())


def test_names_are_labels_and_not_expressions(run):
    text = scenario().replace('<Condition name="t"', '<Condition name="${speed limit}"')

    assert run(text).begins("event") == [0.51]


def test_a_condition_on_a_parameter_without_a_name_never_holds(run):
    never = """<ConditionGroup><Condition name="criteria" delay="0" conditionEdge="rising">
    <ByValueCondition><ParameterCondition parameterRef="" value="" rule="lessThan"/>
    </ByValueCondition></Condition></ConditionGroup>"""
    found = run(scenario(stop=never), seconds=2.0)

    assert found.figures["seconds"] == pytest.approx(2.0)
    assert "<ParameterCondition> is ignored" in " ".join(found.output.split())


def test_text_parameters_with_numbers_count_as_numbers_in_expressions(run):
    declared = """<ParameterDeclarations><ParameterDeclaration name="twice" parameterType="string"
    value="5"/></ParameterDeclarations>"""
    text = scenario(init=EGO + private("Target", put(lane(-1, 110.0)), speed("${2 * $twice}")))
    text = text.replace("<CatalogLocations/>", f"{declared}<CatalogLocations/>")
    others = run(text).recording.instants[0].others

    assert others.velocities[:, 0].max() == pytest.approx(10.0)


def test_the_planner_takes_over_from_actions_of_the_ego(run):
    found = run(scenario(actor="Ego", action=speed(0.0)), planner="idm", seconds=2.0)

    assert found.exit_code == 0, found.output
    assert "scripted actions of the ego end at once" in " ".join(found.output.split())
    assert found.ego[-1].speed > 5.0


def test_a_distribution_starts_with_its_first_case_that_the_constraints_allow(run, tmp_path):
    text = scenario(init=EGO + private("Target", put(lane(-1, 110.0)), speed("$v")))
    declared = """<ParameterDeclarations><ParameterDeclaration name="v" parameterType="double"
    value="9"><ConstraintGroup><ValueConstraint rule="greaterThan" value="4"/></ConstraintGroup>
    </ParameterDeclaration></ParameterDeclarations>"""
    (tmp_path / "template.xosc").write_text(
        text.replace("<CatalogLocations/>", f"{declared}<CatalogLocations/>")
    )
    cases = """<OpenSCENARIO><FileHeader description="a" author="b" revMajor="1" revMinor="3"
    date="2026-01-01T00:00:00"/><ParameterValueDistribution>
    <ScenarioFile filepath="template.xosc"/><Deterministic>
    <DeterministicSingleParameterDistribution parameterName="v"><DistributionRange stepWidth="2">
    <Range lowerLimit="2" upperLimit="8"/></DistributionRange>
    </DeterministicSingleParameterDistribution></Deterministic></ParameterValueDistribution>
    </OpenSCENARIO>"""
    found = run(cases)

    others = found.recording.instants[0].others
    assert others.velocities[:, 0].max() == pytest.approx(6.0)
    assert "2 cases of the distribution are skipped" in " ".join(found.output.split())


def test_another_road_network_can_be_given(run, tmp_path):
    (tmp_path / "mine.xodr").write_text(ROAD)
    text = scenario().replace('filepath="road.xodr"', 'filepath="Town01"')

    roads = ("--roads", str(tmp_path / "mine.xodr"))
    without = text.replace('<RoadNetwork><LogicFile filepath="Town01"/></RoadNetwork>', "")

    assert run(text).exit_code == 1
    assert run(text, *roads).exit_code == 0
    assert "names no road network" in " ".join(run(without, *roads).output.split())


def test_a_collision_with_any_vehicle_includes_trucks(run):
    hit = """<StartTrigger><ConditionGroup><Condition name="hit" delay="0" conditionEdge="none">
    <ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any">
    <EntityRef entityRef="Ego"/></TriggeringEntities><EntityCondition><CollisionCondition>
    <ByType type="vehicle"/></CollisionCondition></EntityCondition></ByEntityCondition>
    </Condition></ConditionGroup></StartTrigger>"""
    truck = vehicle("Target").replace('vehicleCategory="car"', 'vehicleCategory="truck"')
    init = EGO + private("Target", put(lane(-2, 80.0)), speed(0.0))
    found = run(scenario(entities=vehicle("Ego") + truck, init=init, event_start=hit))

    # The gap is 30 m between the reference points, less 4.5 m of front and 0.5 m of rear.
    assert found.begins("event") == [pytest.approx(2.5, abs=0.02)]


@pytest.mark.parametrize(
    ("condition", "starts"),
    [
        ('<AngleCondition angleType="pitch" angle="0.1" angleTolerance="0.2"/>', True),
        ('<AngleCondition angleType="roll" angle="0.3" angleTolerance="0.2"/>', False),
        ('<SpeedCondition value="1" rule="lessThan" direction="vertical"/>', True),
        ('<SpeedCondition value="1" rule="greaterThan" direction="vertical"/>', False),
    ],
)
def test_objects_stay_level_in_conditions(run, condition, starts):
    start = f"""<StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="none">
    <ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any">
    <EntityRef entityRef="Target"/></TriggeringEntities><EntityCondition>{condition}
    </EntityCondition></ByEntityCondition></Condition></ConditionGroup></StartTrigger>"""

    assert run(scenario(event_start=start), seconds=1.0).begins("event") == [0.0] * starts


TURNED = '<Orientation type="relative" h="3.141592653589793"/>'


@pytest.mark.parametrize(
    ("tag", "attributes", "forwards"),
    [
        ("LanePosition", 'roadId="1" laneId="1" s="300"', False),
        ("RoadPosition", 'roadId="1" s="300" t="1.75"', True),
        ("RelativeLanePosition", 'entityRef="Target" dLane="1" ds="0"', True),
        ("RelativeLanePosition", 'entityRef="Target" dLane="1" dsLane="0"', False),
        ("RelativeRoadPosition", 'entityRef="Target" ds="0" dt="3.5"', True),
    ],
)
@pytest.mark.parametrize("orientation", ["", '<Orientation type="relative" h="0"/>', TURNED])
def test_no_orientation_is_a_relative_one_of_zero(run, tag, attributes, forwards, orientation):
    init = private("Target", put(lane(-1, 300.0)), speed(10.0))
    init += private("Ego", put(f"<{tag} {attributes}>{orientation}</{tag}>"), speed(10.0))
    found = run(scenario(init=init), seconds=1.0).ego

    along = forwards != (orientation == TURNED)
    assert found[-1].x - found[0].x == pytest.approx(9.0 if along else -9.0, abs=1.1)


@pytest.mark.parametrize(
    "position",
    [
        '<RelativeRoadPosition entityRef="Target" ds="-10" dt="-3.5"/>',
        '<RelativeLanePosition entityRef="Target" ds="-10" dLane="-1"/>',
        '<RelativeLanePosition entityRef="Target" dsLane="10" dLane="1"/>',
    ],
)
def test_only_lane_coordinates_follow_an_entity_that_drives_against_its_road(run, position):
    init = private("Target", put(lane(1, 300.0)), speed(0.0)) + private("Ego", put(position))
    ego = run(scenario(init=init), seconds=0.5).ego[0]

    axle = 2.0 - (2.5 - 0.95)
    assert ego.x - axle * math.cos(ego.yaw) == pytest.approx(290.0)
    assert ego.y == pytest.approx(-1.75)


@pytest.mark.parametrize(("minor", "yaw"), [(2, 0.0), (3, math.pi)])
def test_an_orientation_without_a_type_is_relative_since_version_1_3(run, minor, yaw):
    position = '<LanePosition roadId="1" laneId="1" s="300"><Orientation h="0"/></LanePosition>'
    text = scenario(init=private("Ego", put(position), speed(0.0)) + TARGET)
    found = run(text.replace('revMinor="3"', f'revMinor="{minor}"'), seconds=0.5)

    assert math.remainder(found.ego[0].yaw - yaw, math.tau) == pytest.approx(0.0, abs=1e-9)


def trajectory(*points: tuple[float, float]) -> str:
    vertices = "".join(
        f'<Vertex time="0"><Position><WorldPosition x="{x}" y="{y}"/></Position></Vertex>'
        for x, y in points
    )
    return f"""<RoutingAction><FollowTrajectoryAction><TrajectoryRef><Trajectory name="t"
    closed="false"><Shape><Polyline>{vertices}</Polyline></Shape></Trajectory></TrajectoryRef>
    <TimeReference><None/></TimeReference><TrajectoryFollowingMode followingMode="position"/>
    </FollowTrajectoryAction></RoutingAction>"""


def test_the_heading_at_the_end_of_a_trajectory_is_kept(run):
    path = trajectory((60.0, -5.25), (70.0, -4.25))
    found = run(scenario(actor="Ego", action=path)).ego[30:]

    assert [e.yaw for e in found] == pytest.approx([math.atan2(1.0, 10.0)] * len(found))
    assert found[-1].y == pytest.approx(found[0].y)


def test_an_entity_arrives_with_one_that_reverses(run):
    there = "<{0}>{1}</{0}>"
    action = f"""<LongitudinalAction><SynchronizeAction masterEntityRef="Target">
    {there.format("TargetPositionMaster", lane(-1, 80.0))}
    {there.format("TargetPosition", lane(-2, 110.0))}
    </SynchronizeAction></LongitudinalAction>"""
    init = EGO + private("Target", put(lane(-1, 110.0)), speed(-5.0))
    found = run(scenario(actor="Ego", action=action, init=init), seconds=8.0)

    axle = 2.0 - (2.5 - 0.95)
    assert found.ego[60].x == pytest.approx(110.0 + axle, abs=0.1)


def test_a_time_gap_is_driven_by_who_follows(run):
    action = """<LongitudinalAction><LongitudinalDistanceAction entityRef="Target" timeGap="2"
    continuous="true" freespace="false" displacement="leadingReferencedEntity"/>
    </LongitudinalAction>"""
    init = private("Ego", put(lane(-2, 100.0)), speed(20.0))
    init += private("Target", put(lane(-2, 60.0)), speed(10.0))
    found = run(scenario(actor="Ego", action=action, init=init))

    axle = 2.0 - (2.5 - 0.95)
    assert found.ego[-1].x - axle == pytest.approx(60.0 + 10.0 * (len(found.ego) - 1) * DT + 20.0)


def test_an_action_beyond_the_performance_of_its_vehicle_is_noted(run):
    steep = 'dynamicsShape="linear" dynamicsDimension="rate" value="12"'
    noted = " ".join(run(scenario(action=speed(80.0, steep)), seconds=0.2).output.split())

    assert "'Target' keeps its maxSpeed of 69 m/s, although actions ask for up to 80 m/s" in noted
    assert "at most 10 m/s^2, although actions ask for up to 12 m/s^2" in noted
    assert "keeps its" not in run(scenario(action=speed(60.0)), seconds=0.2).output


@pytest.mark.parametrize(
    ("value", "limit", "seconds"),
    [(30.0, 'maxAcceleration="5"', 4.0), (0.0, 'maxDeceleration="2"', 5.0)],
)
def test_a_speed_changes_within_the_performance_of_its_vehicle(run, value, limit, seconds):
    how = 'dynamicsShape="linear" dynamicsDimension="time" value="1"'
    name = limit.partition("=")[0]
    slow = vehicle("Ego").replace(f'{name}="10"', limit)
    text = scenario(actor="Ego", action=speed(value, how), entities=slow + vehicle("Target"))
    found = run(text, seconds=7.0).ego

    for step, ego in enumerate(found):
        share = min(max((step * DT - 0.5) / seconds, 0.0), 1.0)
        assert ego.speed == pytest.approx(10.0 + (value - 10.0) * share, abs=0.06)


def test_a_continuous_relative_speed_has_its_transition(run):
    how = 'dynamicsShape="linear" dynamicsDimension="time" value="2"'
    action = speed(0.0, how).replace(
        '<AbsoluteTargetSpeed value="0.0"/>',
        '<RelativeTargetSpeed entityRef="Target" value="2" speedTargetValueType="delta" '
        'continuous="true"/>',
    )
    found = run(scenario(actor="Ego", action=action)).ego

    assert found[15].speed == pytest.approx(11.0, abs=0.02)
    assert found[-1].speed == pytest.approx(12.0)


def test_a_relative_speed_is_reached_at_the_other_s_speed_at_that_time(run):
    how = 'dynamicsShape="linear" dynamicsDimension="rate" value="{}"'
    action = speed(0.0, how.format(3)).replace(
        '<AbsoluteTargetSpeed value="0.0"/>',
        '<RelativeTargetSpeed entityRef="Target" value="0" speedTargetValueType="delta" '
        'continuous="false"/>',
    )
    init = private("Ego", put(lane(-2, 50.0)))
    init += private("Target", put(lane(-1, 60.0)), speed(30.0, how.format(2)))
    found = run(scenario(actor="Ego", action=action, init=init), seconds=4.0).ego

    # 3 (t - 0.5) = 2 t at t = 1.5 s, when both drive 3 m/s.
    assert found[10].speed == pytest.approx(1.5, abs=0.05)
    assert found[-1].speed == pytest.approx(3.0, abs=0.05)


def test_an_entity_drives_on_to_the_next_road_and_stops_at_its_end(run):
    init = private("Ego", put(lane(-2, 580.0)), speed(20.0)) + TARGET
    found = run(scenario(init=init), seconds=12.0).ego

    # Its reference point is 0.45 m behind the rear axle.
    assert math.hypot(found[-1].x - (600.0 + RADIUS + 5.25), found[-1].y - (RADIUS + 0.45)) < 0.05
    assert (found[60].speed, found[-1].speed) == (pytest.approx(20.0), 0.0)


@pytest.mark.parametrize(
    ("attributes", "angle", "radius"),
    [
        ('entityRef="Target" ds="100" dLane="-1"', 0.5, 105.25),
        ('entityRef="Target" dsLane="100" dLane="0"', 0.5, 101.75),
    ],
)
def test_a_relative_position_continues_on_the_next_road(run, attributes, angle, radius):
    position = f"<RelativeLanePosition {attributes}/>"
    init = private("Ego", put(position)) + private("Target", put(lane(-1, 550.0)), speed(0.0))
    ego = run(scenario(init=init), seconds=0.5).ego[0]

    x, y = ego.x - 0.45 * math.cos(angle), ego.y - 0.45 * math.sin(angle)
    assert ego.yaw == pytest.approx(angle)
    assert x == pytest.approx(600.0 + radius * math.sin(angle), abs=0.01)
    assert y == pytest.approx(RADIUS - radius * math.cos(angle), abs=0.01)


def test_a_position_beyond_its_road_is_noted_and_moved_to_its_end(run):
    init = private("Ego", put(lane(-2, 700.0)), speed(0.0)) + TARGET
    found = run(scenario(init=init), seconds=0.5)

    assert found.ego[0].x == pytest.approx(600.45)
    assert "s = 700 m is not on road '1', which is 600 m long" in " ".join(found.output.split())


def test_an_offset_relative_to_an_entity_is_measured_from_the_entity(run):
    action = """<LateralAction><LaneOffsetAction continuous="false">
    <LaneOffsetActionDynamics dynamicsShape="step"/><LaneOffsetTarget>
    <RelativeTargetLaneOffset entityRef="Target" value="-1"/></LaneOffsetTarget>
    </LaneOffsetAction></LateralAction>"""
    found = run(scenario(actor="Ego", action=action)).ego

    assert found[-1].y == pytest.approx(-1.75 - 1.0)


def test_beside_the_lane_centre_of_a_bend_the_speed_is_that_of_the_motion(run):
    start = '<LanePosition roadId="2" laneId="-1" s="10" offset="1.5"/>'
    target = private("Target", put(lane(1, 100.0)))
    ego = run(scenario(init=private("Ego", put(start), speed(10.0)) + target), seconds=3.0).ego

    angles = [math.atan2(e.x - 600.0, RADIUS - e.y) for e in ego]
    assert angles[-1] - angles[0] == pytest.approx(30.0 / (RADIUS + 1.75 - 1.5), abs=2e-4)


def test_a_heading_in_a_lane_is_that_of_its_centre_line(run, tmp_path):
    widening = ROAD.replace('a="3.5" b="0"', 'a="3.5" b="0.02"')
    (tmp_path / "widening.xodr").write_text(widening)
    init = private("Ego", put(lane(-1, 50.0))) + private("Target", put(lane(1, 100.0)))
    ego = run(scenario(init=init), "--roads", str(tmp_path / "widening.xodr"), seconds=1.0).ego[0]

    # The centre line of the lane moves away from the reference line by half of its width.
    assert ego.yaw == pytest.approx(-math.atan(0.01), abs=1e-3)


@pytest.mark.parametrize(
    ("condition", "begins"),
    [
        # The ego passes at 10 m/s, from left to right of the target, which heads to the left.
        ('rule="greaterThan" value="9" direction="lateral"', [0.0]),
        ('rule="lessThan" value="-1" direction="longitudinal"', []),
        ('rule="lessThan" value="-9"', [0.0]),
    ],
)
def test_a_relative_speed_has_directions_of_the_triggering_entity(run, condition, begins):
    across = lane(-1, 110.0).replace("/>", '><Orientation type="relative" h="1.5707963"/>')
    init = EGO + private("Target", put(across + "</LanePosition>"), speed(0.0))
    begin = of_target(f'RelativeSpeedCondition entityRef="Ego" {condition}')
    found = run(scenario(init=init, event_start=begin), seconds=0.5)

    assert found.begins("event") == pytest.approx(begins, abs=0.011)


@pytest.mark.parametrize(
    ("attributes", "begins"),
    [
        # Beside each other in neighbouring lanes: 3.5 m at 10 m/s, or 0 m along the road.
        ("", []),
        ('alongRoute="false"', []),
        ('alongRoute="true"', [0.0]),
        ('alongRoute="true" relativeDistanceType="euclidianDistance"', []),
        ('relativeDistanceType="longitudinal"', [0.0]),
    ],
)
def test_a_headway_is_that_of_the_straight_distance_unless_a_type_is_given(run, attributes, begins):
    ruled = 'entityRef="Ego" freespace="false" rule="lessThan" value="0.3"'
    start = of_target(f"TimeHeadwayCondition {ruled} {attributes}")
    init = private("Ego", put(lane(-2, 50.0)), speed(10.0))
    init += private("Target", put(lane(-1, 50.0)), speed(10.0))
    found = run(scenario(init=init, event_start=start), seconds=0.5)

    assert found.begins("event") == pytest.approx(begins, abs=0.011)


@pytest.mark.parametrize(
    ("lanes", "opposite", "begins"),
    [
        # The ego is 10 m behind in the same lane and falls back by 10 m/s.
        ((0, 0), "false", [1.01]),
        ((-1, -1), "false", [0.0]),
        ((1, 1), "false", []),
        ((1, 1), "true", [0.0]),
    ],
)
def test_a_clearance_needs_a_lane_without_entities(run, lanes, opposite, begins):
    clear = of_target(
        'RelativeClearanceCondition distanceForward="5" distanceBackward="20" freeSpace="false" '
        f'oppositeLanes="{opposite}"',
        f'<RelativeLaneRange from="{lanes[0]}" to="{lanes[1]}"/>',
    )
    init = private("Ego", put(lane(-1, 100.0)), speed(0.0))
    init += private("Target", put(lane(-1, 110.0)), speed(10.0))
    found = run(scenario(init=init, event_start=clear), seconds=2.0)

    assert found.begins("event") == pytest.approx(begins, abs=0.011)


def test_off_the_road_is_outside_its_drivable_lanes(run, tmp_path):
    (tmp_path / "verge.xodr").write_text(
        ROAD.replace('id="-2" type="driving"', 'id="-2" type="none"')
    )
    off = """<StartTrigger><ConditionGroup><Condition name="off" delay="0" conditionEdge="none">
    <ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any">
    <EntityRef entityRef="Ego"/></TriggeringEntities><EntityCondition>
    <OffroadCondition duration="0.5"/></EntityCondition></ByEntityCondition></Condition>
    </ConditionGroup></StartTrigger>"""
    text, roads = scenario(event_start=off), ("--roads", str(tmp_path / "verge.xodr"))

    assert run(text, *roads, seconds=1.0).begins("event") == pytest.approx([0.5], abs=0.011)
    assert run(text, seconds=1.0).begins("event") == []


def test_a_clothoid_spline_starts_where_its_pieces_say(run):
    segment = """<ClothoidSplineSegment curvatureStart="0" curvatureEnd="0" length="{}"{}>{}
    </ClothoidSplineSegment>"""
    there = '<PositionStart><WorldPosition x="80" y="20" h="0"/></PositionStart>'
    action = f"""<RoutingAction><FollowTrajectoryAction><TrajectoryRef>
    <Trajectory name="t" closed="false"><Shape><ClothoidSpline>
    {segment.format(10, "", "")}{segment.format(10, ' hOffset="0.5"', there)}</ClothoidSpline>
    </Shape></Trajectory></TrajectoryRef><TimeReference><None/></TimeReference>
    <TrajectoryFollowingMode followingMode="position"/></FollowTrajectoryAction></RoutingAction>"""
    ego = run(scenario(actor="Ego", action=action, event_start=""), seconds=1.8).ego

    # 10 m straight on from where it is, then 8 m from the start of the second piece.
    assert (ego[8].x - ego[0].x, ego[8].y - ego[0].y) == pytest.approx((8.0, 0.0), abs=0.01)
    last, way = ego[18], 8.0 + ego[0].x - 50.0
    assert last.yaw == pytest.approx(0.5)
    assert (last.x, last.y) == pytest.approx(
        (80.0 + way * math.cos(0.5), 20.0 + way * math.sin(0.5)), abs=0.15
    )


def test_a_route_changes_lanes_without_turning_back(run):
    points = "".join(
        f'<Waypoint routeStrategy="shortest"><Position>{p}</Position></Waypoint>'
        for p in (lane(-2, 55.1), lane(-1, 300.0))
    )
    action = f"""<RoutingAction><AssignRouteAction><Route name="r" closed="false">{points}</Route>
    </AssignRouteAction></RoutingAction>"""
    found = run(scenario(actor="Ego", action=action, init=EGO)).ego

    steps = [b.x - a.x for a, b in itertools.pairwise(found)]
    assert min(steps) > 0.9
    assert found[-1].y == pytest.approx(-1.75)


@pytest.mark.parametrize("s", [60.0, 95.0])
def test_a_distance_without_limits_is_there_from_the_start(run, s):
    action = """<LongitudinalAction><LongitudinalDistanceAction entityRef="Target" distance="20"
    continuous="false" freespace="false" displacement="trailingReferencedEntity"/>
    </LongitudinalAction>"""
    init = private("Target", put(lane(-2, 110.0)), speed(10.0))
    init += private("Ego", put(lane(-2, s)), speed(10.0), action)
    found = run(scenario(init=init), seconds=1.0).ego

    axle = 2.0 - (2.5 - 0.95)
    assert found[0].x == pytest.approx(90.0 + axle)
    assert found[-1].speed == pytest.approx(10.0)


def test_events_at_one_instant_are_all_printed(capsys):
    events = [
        {"t": 1.0, "what": "story::brake", "change": "start", "type": "storyboard"},
        {"t": 1.0, "what": "story::turn", "change": "start", "type": "storyboard"},
        {"t": 1.0, "what": "car", "change": None, "type": "collision"},
    ]
    _print("a.xosc", {"events": events, "seconds": 2.0, "reason": "steps"})
    printed = capsys.readouterr().out
    assert [name in printed for name in ("brake start", "turn start", "car collision")] == [
        True
    ] * 3
