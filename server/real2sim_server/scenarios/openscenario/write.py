"""Storyboards as OpenSCENARIO XML 1.3."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

from real2sim_proto.storyboard import MapRoads, Storyboard

from .. import ScenarioError
from .elements import (
    CARLA,
    DIMENSIONS,
    EDGES,
    ELEMENTS,
    FRAMES,
    LAMPS,
    MEASURES,
    PLACES,
    PRIORITIES,
    RULES,
    SHAPES,
    SIDES,
    STATES,
    VEHICLES,
    back,
)

Element = ET.Element


def write_openscenario(board: Storyboard) -> bytes:
    """The storyboard as a file that reads back identically.

    OpenSCENARIO cannot express roads along a route: lanes are then those of the scene.

    Raises:
        ScenarioError: content that OpenSCENARIO cannot express: the form 'quintic', limits of a
            synchronised arrival, a controller's parameters, objects of a scene, distributions.
    """
    _check(board)
    root = Element("OpenSCENARIO")
    _add(root, "FileHeader", revMajor=1, revMinor=3, date=board.date or "2026-01-01T00:00:00",
         author=board.author, description=board.name)  # fmt: skip
    declarations = _add(root, "ParameterDeclarations")
    for name, value in board.parameters.items():
        _add(
            declarations, "ParameterDeclaration", name=name, parameterType=_type(value), value=value
        )
    if board.variables:
        variables = _add(root, "VariableDeclarations")
        for name, value in board.variables.items():
            _add(
                variables, "VariableDeclaration", name=name, variableType=_type(value), value=value
            )
    _add(root, "CatalogLocations")
    _road_network(root, board)
    entities = _add(root, "Entities")
    for entity in board.model_dump()["entities"]:
        _entity(entities, entity)
    part = _add(root, "Storyboard")
    _init(part, board)
    fields = board.model_dump()
    for story in fields["stories"]:
        _story(part, story)
    _trigger(part, "StopTrigger", fields["stop"] or {"groups": []})
    ET.indent(root)
    content: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return content


def _check(board: Storyboard) -> None:
    for entity in board.entities:
        if entity.kind == "object" or entity.asset_id or entity.look:
            raise _wordless(f"entity {entity.name!r} is bound to an object or asset of a scene")
        if entity.box is None:
            raise _wordless(f"entity {entity.name!r} has no box; give it one")
    if board.map_signals is not None:
        raise _wordless(
            "map_signals; leave it out, or list the map's lights in signals and controllers"
        )
    if board.name.startswith(CARLA):
        raise ScenarioError(
            f"the storyboard's name {board.name!r} begins with {CARLA!r}, which marks files with "
            "left-handed coordinates; rename it"
        )
    if board.distributions:
        raise _wordless("distributions belong in a separate file; leave them out")


def _wordless(what: str) -> ScenarioError:
    return ScenarioError(f"OpenSCENARIO 1.3 has no words for this: {what}")


def _add(parent: Element, tag: str, **attributes: Any) -> Element:
    given = {k: _text(v) for k, v in attributes.items() if v is not None}
    return ET.SubElement(parent, tag, given)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def _type(value: Any) -> str:
    if isinstance(value, bool):
        return "boolean"
    return "double" if isinstance(value, int | float) else "string"


def _road_network(root: Element, board: Storyboard) -> None:
    part = _add(root, "RoadNetwork")
    if isinstance(board.roads, MapRoads):
        _add(part, "LogicFile", filepath=board.roads.file)
    if board.controllers:
        signals = _add(part, "TrafficSignals")
        for c in board.controllers:
            made = _add(signals, "TrafficSignalController", name=c.name, delay=c.delay,
                        reference=c.reference)  # fmt: skip
            for phase in c.phases:
                states = _add(made, "Phase", name=phase.name, duration=phase.duration)
                for signal, state in phase.states.items():
                    _add(states, "TrafficSignalState", trafficSignalId=signal, state=state)


def _entity(parent: Element, e: Mapping[str, Any]) -> None:
    holder = _add(parent, "ScenarioObject", name=e["name"])
    name, category = e["model"] or e["name"], e["category"]
    (length, width, height), (x, y, z) = e["box"]["size"], e["box"]["centre"]
    if category in {"pedestrian", "animal"}:
        part = _add(
            holder, "Pedestrian", name=name, mass=_mass(e, 75.0), pedestrianCategory=category
        )
    elif category in VEHICLES.values():
        part = _add(holder, "Vehicle", name=name, mass=e["mass"],
                    vehicleCategory=back(VEHICLES, category))  # fmt: skip
    else:
        part = _add(
            holder, "MiscObject", name=name, mass=_mass(e, 10.0), miscObjectCategory=category
        )
    box = _add(part, "BoundingBox")
    _add(box, "Center", x=x, y=y, z=z)
    _add(box, "Dimensions", width=width, length=length, height=height)
    if part.tag != "Vehicle":
        return
    _add(part, "Performance", maxSpeed=e["max_speed"], maxAcceleration=e["max_acceleration"],
         maxDeceleration=e["max_deceleration"])  # fmt: skip
    axles = _add(part, "Axles")
    base = 2.0 * float(x) if not isinstance(x, str) and float(x) > 0 else 1.0
    wheel = {"wheelDiameter": 0.6, "trackWidth": 1.5, "positionZ": 0.3}
    _add(axles, "FrontAxle", maxSteering=0.6, positionX=base, **wheel)
    _add(axles, "RearAxle", maxSteering=0.0, positionX=0.0, **wheel)


def _mass(e: Mapping[str, Any], default: float) -> Any:
    return default if e["mass"] is None else e["mass"]


def _init(parent: Element, board: Storyboard) -> None:
    actions = _add(_add(parent, "Init"), "Actions")
    for action in board.model_dump()["global_init"]:
        _action(_add(actions, "GlobalAction"), action)
    private, last = None, None
    for entry in board.model_dump()["init"]:
        if private is None or entry["entity"] != last:
            private, last = _add(actions, "Private", entityRef=entry["entity"]), entry["entity"]
        _action(_add(private, "PrivateAction"), entry["action"])


def _story(parent: Element, story: Mapping[str, Any]) -> None:
    made = _add(parent, "Story", name=story["name"])
    for act in story["acts"]:
        part = _add(made, "Act", name=act["name"])
        for group in act["groups"]:
            _group(part, group)
        _trigger(part, "StartTrigger", act["start"])
        _trigger(part, "StopTrigger", act["stop"])


def _group(parent: Element, group: Mapping[str, Any]) -> None:
    part = _add(parent, "ManeuverGroup", name=group["name"], maximumExecutionCount=group["times"])
    who = _add(part, "Actors", selectTriggeringEntities=False)
    for name in group["entities"]:
        _add(who, "EntityRef", entityRef=name)
    for maneuver in group["maneuvers"]:
        made = _add(part, "Maneuver", name=maneuver["name"])
        for event in maneuver["events"]:
            held = _add(made, "Event", name=event["name"],
                        priority=back(PRIORITIES, event["priority"]),
                        maximumExecutionCount=event["times"])  # fmt: skip
            for action in event["actions"]:
                inside, kind = _add(held, "Action", name=action["name"]), action["action"]["kind"]
                if kind != "custom":
                    inside = _add(inside, "GlobalAction" if kind in _GLOBAL else "PrivateAction")
                _action(inside, action["action"])
            _trigger(held, "StartTrigger", event["start"])


# --- actions ----------------------------------------------------------------------------------


def _action(parent: Element, a: Mapping[str, Any]) -> None:
    _WRITE[a["kind"]](parent, a)


def _speed(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "LongitudinalAction"), "SpeedAction")
    _dynamics(part, "SpeedActionDynamics", a["dynamics"])
    target = _add(part, "SpeedActionTarget")
    if a["relative_to"] is None:
        _add(target, "AbsoluteTargetSpeed", value=a["speed"])
        return
    _add(target, "RelativeTargetSpeed", entityRef=a["relative_to"], value=a["speed"],
         speedTargetValueType=a["relation"], continuous=a["continuous"])  # fmt: skip


def _speed_profile(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "LongitudinalAction"), "SpeedProfileAction",
                followingMode="position", entityRef=a["relative_to"])  # fmt: skip
    for point in a["points"]:
        _add(part, "SpeedProfileEntry", time=point["time"], speed=point["speed"])


def _longitudinal_distance(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "LongitudinalAction"), "LongitudinalDistanceAction",
                entityRef=a["entity"], distance=a["distance"], timeGap=a["time_gap"],
                freespace=a["freespace"], continuous=a["continuous"],
                displacement=back(PLACES, a["place"]))  # fmt: skip
    _limits(part, a["limits"])


def _lane_change(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "LateralAction"), "LaneChangeAction", targetLaneOffset=a["offset"])
    _dynamics(part, "LaneChangeActionDynamics", a["dynamics"])
    target, lane = _add(part, "LaneChangeTarget"), _whole(a["lane"])
    if a["relative_to"] is None:
        _add(target, "AbsoluteTargetLane", value=lane)
    else:
        _add(target, "RelativeTargetLane", entityRef=a["relative_to"], value=lane)


def _lane_offset(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "LateralAction"), "LaneOffsetAction", continuous=a["continuous"])
    _add(part, "LaneOffsetActionDynamics", dynamicsShape=_shape(a["shape"]),
         maxLateralAcc=a["acceleration"])  # fmt: skip
    target = _add(part, "LaneOffsetTarget")
    if a["relative_to"] is None:
        _add(target, "AbsoluteTargetLaneOffset", value=a["offset"])
    else:
        _add(target, "RelativeTargetLaneOffset", entityRef=a["relative_to"], value=a["offset"])


def _lateral_distance(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "LateralAction"), "LateralDistanceAction", entityRef=a["entity"],
                distance=a["distance"], freespace=a["freespace"], continuous=a["continuous"],
                displacement=back(SIDES, a["side"]))  # fmt: skip
    _limits(part, a["limits"])


def _synchronize(parent: Element, a: Mapping[str, Any]) -> None:
    if any(v is not None for v in a["limits"].values()):
        raise _wordless("limits of a synchronize action")
    part = _add(parent, "SynchronizeAction", masterEntityRef=a["master"],
                targetToleranceMaster=a["master_tolerance"],
                targetTolerance=a["tolerance"])  # fmt: skip
    _position(_add(part, "TargetPositionMaster"), a["master_target"])
    _position(_add(part, "TargetPosition"), a["target"])
    if a["final_speed"] is None:
        return
    final = _add(part, "FinalSpeed")
    if a["relative"]:
        speed = _add(final, "RelativeSpeedToMaster", value=a["final_speed"],
                     speedTargetValueType="delta")  # fmt: skip
    else:
        speed = _add(final, "AbsoluteSpeed", value=a["final_speed"])
    if a["steady_distance"] is not None:
        _add(speed, "TargetDistanceSteadyState", distance=a["steady_distance"])
    if a["steady_time"] is not None:
        _add(speed, "TargetTimeSteadyState", time=a["steady_time"])


def _follow_trajectory(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "RoutingAction"), "FollowTrajectoryAction",
                initialDistanceOffset=a["offset"] or None)  # fmt: skip
    reference, timing = _add(part, "TimeReference"), a["timing"]
    if timing is None:
        _add(reference, "None")
    else:
        _add(reference, "Timing", domainAbsoluteRelative=timing["domain"], scale=timing["scale"],
             offset=timing["offset"])  # fmt: skip
    _add(part, "TrajectoryFollowingMode", followingMode="position")
    _trajectory(_add(part, "TrajectoryRef"), a["curve"], a["name"], a["closed"])


def _assign_route(parent: Element, a: Mapping[str, Any]) -> None:
    _route(_add(_add(parent, "RoutingAction"), "AssignRouteAction"), a["route"])


def _random_route(parent: Element, _a: Mapping[str, Any]) -> None:
    _add(_add(parent, "RoutingAction"), "RandomRouteAction")


def _acquire_position(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "RoutingAction"), "AcquirePositionAction")
    _position(_add(part, "Position"), a["position"])


def _teleport(parent: Element, a: Mapping[str, Any]) -> None:
    _position(_add(_add(parent, "TeleportAction"), "Position"), a["position"])


def _visibility(parent: Element, a: Mapping[str, Any]) -> None:
    shown = a["visible"]
    _add(parent, "VisibilityAction", graphics=shown, sensors=shown, traffic=shown)


def _light_state(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "AppearanceAction"), "LightStateAction")
    _add(_add(part, "LightType"), "VehicleLight", vehicleLightType=back(LAMPS, a["lamp"]))
    flashing = a["mode"] == "flashing" or (a["on_time"], a["off_time"]) != (0.5, 0.5)
    _add(part, "LightState", mode=a["mode"],
         flashingOnDuration=a["on_time"] if flashing else None,
         flashingOffDuration=a["off_time"] if flashing else None)  # fmt: skip


def _controller(parent: Element, a: Mapping[str, Any]) -> None:
    raise _wordless("a controller's parameters")


def _add_entity(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "EntityAction", entityRef=a["entity"]), "AddEntityAction")
    _position(_add(part, "Position"), a["position"])


def _delete_entity(parent: Element, a: Mapping[str, Any]) -> None:
    _add(_add(parent, "EntityAction", entityRef=a["entity"]), "DeleteEntityAction")


def _signal(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(_add(parent, "InfrastructureAction"), "TrafficSignalAction")
    if a["kind"] == "signal_state":
        _add(part, "TrafficSignalStateAction", name=a["signal"], state=a["state"])
    else:
        _add(part, "TrafficSignalControllerAction", phase=a["phase"],
             trafficSignalControllerRef=a["controller"])  # fmt: skip


def _custom(parent: Element, a: Mapping[str, Any]) -> None:
    _add(_add(parent, "UserDefinedAction"), "CustomCommandAction", type=a["type"])


def _variable(parent: Element, a: Mapping[str, Any]) -> None:
    part = _add(parent, "VariableAction", variableRef=a["variable"])
    if a["rule"] == "set":
        _add(part, "SetAction", value=a["value"])
        return
    rule = _add(_add(part, "ModifyAction"), "Rule")
    _add(rule, "AddValue" if a["rule"] == "add" else "MultiplyByValue", value=a["value"])


_GLOBAL = frozenset({"add_entity", "delete_entity", "signal_state", "signal_phase", "set_variable"})
_WRITE = {
    "speed": _speed,
    "speed_profile": _speed_profile,
    "longitudinal_distance": _longitudinal_distance,
    "lane_change": _lane_change,
    "lane_offset": _lane_offset,
    "lateral_distance": _lateral_distance,
    "synchronize": _synchronize,
    "follow_trajectory": _follow_trajectory,
    "assign_route": _assign_route,
    "random_route": _random_route,
    "acquire_position": _acquire_position,
    "teleport": _teleport,
    "visibility": _visibility,
    "light_state": _light_state,
    "controller": _controller,
    "add_entity": _add_entity,
    "delete_entity": _delete_entity,
    "signal_state": _signal,
    "signal_phase": _signal,
    "set_variable": _variable,
    "custom": _custom,
}


def _dynamics(parent: Element, tag: str, d: Mapping[str, Any]) -> None:
    _add(parent, tag, dynamicsShape=_shape(d["shape"]), value=d["value"],
         dynamicsDimension=back(DIMENSIONS, d["dimension"]))  # fmt: skip


def _shape(shape: str) -> str:
    if shape not in SHAPES:
        raise _wordless(f"the form {shape!r}; it has {', '.join(SHAPES)}")
    return shape


def _limits(parent: Element, limits: Mapping[str, Any]) -> None:
    if any(v is not None for v in limits.values()):
        _add(parent, "DynamicConstraints", maxAcceleration=limits["acceleration"],
             maxDeceleration=limits["deceleration"], maxSpeed=limits["speed"])  # fmt: skip


def _whole(value: Any) -> Any:
    return value if isinstance(value, str) else int(value)


# --- positions --------------------------------------------------------------------------------


def _position(parent: Element, p: Mapping[str, Any]) -> None:
    kind = p["kind"]
    if kind == "world":
        _add(parent, "WorldPosition", x=p["x"], y=p["y"], z=p["z"], h=p["h"])
        return
    if kind == "route":
        part = _add(parent, "RoutePosition")
        _route(_add(part, "RouteRef"), p["route"])
        where = _add(part, "InRoutePosition")
        if p["lane"] is None:
            _add(where, "FromRoadCoordinates", pathS=p["s"], t=p["t"])
        else:
            _add(where, "FromLaneCoordinates", pathS=p["s"], laneId=_whole(p["lane"]),
                 laneOffset=p["t"])  # fmt: skip
    elif kind == "trajectory":
        part = _add(parent, "TrajectoryPosition", s=p["s"], t=p["t"])
        _trajectory(_add(part, "TrajectoryRef"), p["curve"], "trajectory", False)
    else:
        tag, attributes = _PLAIN[kind](p)
        part = _add(parent, tag, **attributes)
    orientation = p["orientation"]
    if orientation is not None and orientation != _DEFAULT_ORIENTATIONS.get(kind):
        kind = "relative" if orientation["relative"] else "absolute"
        found = _add(part, "Orientation", type=kind, h=orientation["h"])
        if part.tag in {"RoutePosition", "TrajectoryPosition"}:
            part.remove(found)
            part.insert(1, found)


_DEFAULT_ORIENTATIONS = {
    "relative_world": {"h": 0.0, "relative": True},
    "relative_object": {"h": 0.0, "relative": True},
}
_PLAIN: dict[str, Any] = {
    "relative_world": lambda p: (
        "RelativeWorldPosition", {"entityRef": p["entity"], "dx": p["dx"], "dy": p["dy"]}
    ),
    "relative_object": lambda p: (
        "RelativeObjectPosition", {"entityRef": p["entity"], "dx": p["dx"], "dy": p["dy"]}
    ),
    "road": lambda p: ("RoadPosition", {"roadId": p["road"], "s": p["s"], "t": p["t"]}),
    "relative_road": lambda p: (
        "RelativeRoadPosition", {"entityRef": p["entity"], "ds": p["ds"], "dt": p["dt"]}
    ),
    "lane": lambda p: (
        "LanePosition",
        {"roadId": p["road"], "laneId": _whole(p["lane"]), "s": p["s"], "offset": p["offset"]},
    ),
    "relative_lane": lambda p: (
        "RelativeLanePosition",
        {
            "entityRef": p["entity"], "dLane": _whole(p["lanes"]), "offset": p["offset"],
            ("dsLane" if p["along"] == "lane" else "ds"): p["ds"],
        },
    ),
}  # fmt: skip


def _route(parent: Element, route: Mapping[str, Any]) -> None:
    part = _add(parent, "Route", name=route["name"], closed=route["closed"])
    for place in route["waypoints"]:
        _position(_add(_add(part, "Waypoint", routeStrategy="shortest"), "Position"), place)


def _trajectory(parent: Element, curve: Mapping[str, Any], name: str, closed: bool) -> None:
    part = _add(parent, "Trajectory", name=name, closed=closed)
    shape, kind = _add(part, "Shape"), curve["shape"]
    if kind == "polyline":
        line = _add(shape, "Polyline")
        for vertex in curve["vertices"]:
            place = _add(_add(line, "Vertex", time=vertex["time"]), "Position")
            _position(place, vertex["position"])
            if not vertex["oriented"]:
                place[0].attrib.pop("h", None)
                for orientation in place[0].findall("Orientation"):
                    place[0].remove(orientation)
            elif place[0].tag != "WorldPosition" and place[0].find("Orientation") is None:
                _add(place[0], "Orientation", type="relative", h=0.0)
    elif kind == "clothoid":
        made = _add(shape, "Clothoid", curvature=curve["curvature"], length=curve["length"],
                    curvaturePrime=curve["curvature_rate"], startTime=curve["start_time"],
                    stopTime=curve["stop_time"])  # fmt: skip
        _position(_add(made, "Position"), curve["position"])
    elif kind == "clothoid_spline":
        spline = _add(shape, "ClothoidSpline", timeEnd=curve["end_time"])
        for piece in curve["pieces"]:
            made = _add(spline, "ClothoidSplineSegment", curvatureStart=piece["start"],
                        curvatureEnd=piece["end"], length=piece["length"],
                        timeStart=piece["time"], hOffset=piece["turn"])  # fmt: skip
            if piece["position"] is not None:
                _position(_add(made, "PositionStart"), piece["position"])
    else:
        made = _add(shape, "Nurbs", order=curve["order"])
        for point in curve["points"]:
            held = _add(made, "ControlPoint", time=point["time"], weight=point["weight"])
            _position(_add(held, "Position"), point["position"])
        for knot in curve["knots"]:
            _add(made, "Knot", value=knot)


# --- conditions -------------------------------------------------------------------------------


def _trigger(parent: Element, tag: str, trigger: Mapping[str, Any] | None) -> None:
    if trigger is None:
        return
    part = _add(parent, tag)
    for number, group in enumerate(trigger["groups"]):
        held = _add(part, "ConditionGroup")
        for k, condition in enumerate(group["conditions"]):
            name = condition["name"] or f"condition_{number}_{k}"
            made = _add(held, "Condition", name=name, delay=condition["delay"],
                        conditionEdge=back(EDGES, condition["edge"]))  # fmt: skip
            _test(made, condition["test"])


def _test(parent: Element, t: Mapping[str, Any]) -> None:
    kind = t["kind"]
    if "entities" not in t:
        _BY_VALUE[kind](_add(parent, "ByValueCondition"), t)
        return
    part = _add(parent, "ByEntityCondition")
    who = _add(part, "TriggeringEntities", triggeringEntitiesRule=t["of"])
    for name in t["entities"]:
        _add(who, "EntityRef", entityRef=name)
    _by_entity(_add(part, "EntityCondition"), kind, t)


_BY_VALUE: dict[str, Any] = {
    "simulation_time": lambda e, t: _add(e, "SimulationTimeCondition", **_ruled(t)),
    "element_state": lambda e, t: _add(
        e, "StoryboardElementStateCondition",
        storyboardElementType=back(ELEMENTS, t["element_type"]),
        storyboardElementRef=t["element"], state=back(STATES, t["state"]),
    ),
    "variable": lambda e, t: _add(
        e, "VariableCondition", variableRef=t["variable"], rule=back(RULES, t["rule"]),
        value=t["value"],
    ),
    "signal_state": lambda e, t: _add(
        e, "TrafficSignalCondition", name=t["signal"], state=t["state"]
    ),
    "signal_phase": lambda e, t: _add(
        e, "TrafficSignalControllerCondition", trafficSignalControllerRef=t["controller"],
        phase=t["phase"],
    ),
}  # fmt: skip


def _by_entity(parent: Element, kind: str, t: Mapping[str, Any]) -> None:  # noqa: PLR0912
    if kind == "time_to_collision":
        part = _add(parent, "TimeToCollisionCondition", **_ruled(t), **_measured(t))
        target = _add(part, "TimeToCollisionConditionTarget")
        if t["entity"] is not None:
            _add(target, "EntityRef", entityRef=t["entity"])
        else:
            _position(_add(target, "Position"), t["position"])
    elif kind in {"time_headway", "relative_distance"}:
        tag = "TimeHeadwayCondition" if kind == "time_headway" else "RelativeDistanceCondition"
        _add(parent, tag, entityRef=t["entity"], **_ruled(t), **_measured(t))
    elif kind == "distance":
        part = _add(parent, "DistanceCondition", **_ruled(t), **_measured(t))
        _position(_add(part, "Position"), t["position"])
    elif kind == "relative_clearance":
        part = _add(parent, "RelativeClearanceCondition", distanceForward=t["ahead"],
                    distanceBackward=t["behind"], freeSpace=t["freespace"],
                    oppositeLanes=t["opposite"])  # fmt: skip
        for low, high in t["lanes"]:
            _add(part, "RelativeLaneRange", **{"from": low, "to": high})
        for name in t["others"]:
            _add(part, "EntityRef", entityRef=name)
    elif kind == "reach_position":
        part = _add(parent, "ReachPositionCondition", tolerance=t["tolerance"])
        _position(_add(part, "Position"), t["position"])
    elif kind == "speed":
        tag = "SpeedCondition" if t["relative_to"] is None else "RelativeSpeedCondition"
        _add(parent, tag, entityRef=t["relative_to"], direction=t["direction"], **_ruled(t))
    elif kind == "acceleration":
        _add(parent, "AccelerationCondition", direction=t["direction"], **_ruled(t))
    elif kind == "traversed_distance":
        _add(parent, "TraveledDistanceCondition", value=t["value"])
    elif kind == "angle":
        _angle(parent, t)
    elif kind == "collision":
        _collision(parent, t)
    else:
        tags = {"stand_still": "StandStill", "offroad": "Offroad", "end_of_road": "EndOfRoad"}
        _add(parent, f"{tags[kind]}Condition", duration=t["duration"])


def _collision(parent: Element, t: Mapping[str, Any]) -> None:
    part = _add(parent, "CollisionCondition")
    if t["entity"] is not None:
        _add(part, "EntityRef", entityRef=t["entity"])
    else:
        _add(part, "ByType", type="pedestrian" if t["category"] == "pedestrian" else "vehicle")


def _angle(parent: Element, t: Mapping[str, Any]) -> None:
    fields = {"angleType": "heading", "angle": t["angle"], "angleTolerance": t["tolerance"]}
    if t["entity"] is None:
        _add(parent, "AngleCondition", coordinateSystem="world", **fields)
    else:
        _add(parent, "RelativeAngleCondition", entityRef=t["entity"], coordinateSystem="entity",
             **fields)  # fmt: skip


def _ruled(t: Mapping[str, Any]) -> dict[str, Any]:
    return {"rule": back(RULES, t["rule"]), "value": t["value"]}


def _measured(t: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "freespace": t["freespace"], "coordinateSystem": back(FRAMES, t["frame"]),
        "relativeDistanceType": back(MEASURES, t["measure"]),
    }  # fmt: skip
