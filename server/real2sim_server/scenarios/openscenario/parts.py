"""Parts of OpenSCENARIO files: positions, routes, triggers, conditions and actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .elements import (
    DIMENSIONS,
    EDGES,
    ELEMENTS,
    FRAMES,
    LAMPS,
    MEASURES,
    PLACES,
    RULES,
    SHAPES,
    SIDES,
    STATES,
    Part,
    declared_name,
    embedded,
    holds,
    read_all,
    scoped,
)

# --- Positions -----------------------------------------------------------------------------------

Fields = dict[str, Any]
"""Fields of a storyboard model."""

Resolve = Callable[[Part, str], Part]
"""The catalog entry of a type that an element refers to."""


class Positions:
    """Reads positions.

    Args:
        entry: looks up catalog entries.
        orientation: type of an orientation without one, which depends on the version of the file.
        mirrored: y, t, offsets and angles are positive to the right, as in CARLA.
    """

    def __init__(self, entry: Resolve, orientation: str, *, mirrored: bool = False) -> None:
        self.entry, self._default, self.mirrored = entry, orientation, mirrored

    def left(self, part: Part, name: str, default: float | None = None) -> float | str:
        """A lateral coordinate, an angle or a curvature, positive to the left."""
        number = part.number(name, default)
        if not self.mirrored:
            return number
        return f"${{-{embedded(number)}}}" if isinstance(number, str) else 0.0 - number

    def position(self, part: Part) -> Fields:
        """The position in an element."""
        found = part.only(_POSITIONS)
        fields: Fields = _POSITIONS[found.tag](self, found)
        return fields

    def route(self, part: Part) -> Fields:
        """Fields of ``RouteRef`` or ``AssignRouteAction``: an inline route, or a catalog entry."""
        found = part.only({"Route", "CatalogReference"})
        is_named = found.tag == "CatalogReference"
        found = self.entry(found, "Route") if is_named else scoped(found)
        points = found.children("Waypoint")
        for point in points:
            point.optional("routeStrategy")
        return {
            "name": found.label("name", "route"),
            "closed": found.flag("closed", False),
            "waypoints": [self.position(p.child("Position")) for p in points],
        }

    def trajectory(self, part: Part) -> Fields:
        """Fields of ``TrajectoryRef``: name, closed and curve."""
        found = part.only({"Trajectory", "CatalogReference"})
        is_named = found.tag == "CatalogReference"
        found = self.entry(found, "Trajectory") if is_named else scoped(found)
        shape = found.child("Shape").only(_SHAPES)
        return {
            "name": found.label("name", "trajectory"),
            "closed": found.flag("closed", False),
            "curve": _SHAPES[shape.tag](self, shape),
        }

    def _orientation(self, part: Part) -> Fields | None:
        found = part.find("Orientation")
        if found is None:
            return None
        _level(found)
        relative = found.choice("type", {"relative": True, "absolute": False}, self._default)
        return {"h": self.left(found, "h", 0.0), "relative": relative}

    def _world(self, part: Part) -> Fields:
        _level(part)
        z = part.number_or_none("z")
        return {
            "kind": "world", "x": part.number("x"), "y": self.left(part, "y"),
            "h": self.left(part, "h", 0.0),
            **({"z": z} if z not in {None, 0.0} else {}),
        }  # fmt: skip

    def _relative(self, part: Part) -> Fields:
        _flat(part, "dz")  # objects stand on the ground
        kind = "relative_world" if part.tag == "RelativeWorldPosition" else "relative_object"
        return _with(
            {
                "kind": kind, "entity": part.text("entityRef"),
                "dx": part.number("dx"), "dy": self.left(part, "dy"),
            },
            self._orientation(part),
        )  # fmt: skip

    def _road(self, part: Part) -> Fields:
        fields = {
            "kind": "road", "road": part.text("roadId"),
            "s": part.number("s"), "t": self.left(part, "t"),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _relative_road(self, part: Part) -> Fields:
        fields = {
            "kind": "relative_road", "entity": part.text("entityRef"),
            "ds": part.number("ds"), "dt": self.left(part, "dt"),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _lane(self, part: Part) -> Fields:
        lane = part.integer("laneId")
        # CARLA measures it to the right of the traffic, which is left of the line in left lanes.
        offset = part.number("offset", 0.0) if lane > 0 else self.left(part, "offset", 0.0)
        fields = {
            "kind": "lane", "road": part.text("roadId"), "lane": lane,
            "s": part.number("s"), "offset": offset,
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _relative_lane(self, part: Part) -> Fields:
        along = "lane" if "dsLane" in part.raw.attributes else "road"
        fields = {
            "kind": "relative_lane", "entity": part.text("entityRef"),
            "lanes": part.integer("dLane"), "along": along,
            "ds": part.number("dsLane" if along == "lane" else "ds", 0.0),
            "offset": self.left(part, "offset", 0.0),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _route_position(self, part: Part) -> Fields:
        where = part.child("InRoutePosition").only({"FromLaneCoordinates", "FromRoadCoordinates"})
        fields = {
            "kind": "route", "route": self.route(part.child("RouteRef")),
            "s": where.number("pathS"),
        }  # fmt: skip
        if where.tag == "FromRoadCoordinates":
            fields["t"] = self.left(where, "t", 0.0)
        else:
            fields |= {"lane": where.integer("laneId"), "t": self.left(where, "laneOffset", 0.0)}
        return _with(fields, self._orientation(part))

    def _trajectory_position(self, part: Part) -> Fields:
        fields = {
            "kind": "trajectory", "curve": self.trajectory(part.child("TrajectoryRef"))["curve"],
            "s": part.number("s"), "t": self.left(part, "t", 0.0),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    # --- shapes ---------------------------------------------------------------------------------

    def _polyline(self, part: Part) -> Fields:
        vertices = [
            {
                "time": v.number("time", 0.0),
                "position": self.position(v.child("Position")),
                "oriented": _is_oriented(v.child("Position")),
            }
            for v in part.children("Vertex")
        ]
        return {"shape": "polyline", "vertices": vertices}

    def _clothoid(self, part: Part) -> Fields:
        rate = "curvaturePrime" if "curvaturePrime" in part.raw.attributes else "curvatureDot"
        return {
            "shape": "clothoid",
            "position": self.position(part.child("Position")),
            "curvature": self.left(part, "curvature"),
            "curvature_rate": self.left(part, rate, 0.0),
            "length": part.magnitude("length"),
            "start_time": part.number_or_none("startTime"),
            "stop_time": part.number_or_none("stopTime"),
        }

    def _spline(self, part: Part) -> Fields:
        segments = part.children("ClothoidSplineSegment")
        if not segments:
            raise part.error("<ClothoidSpline> has no <ClothoidSplineSegment>")
        pieces = [
            {
                "start": self.left(s, "curvatureStart"), "end": self.left(s, "curvatureEnd"),
                "length": s.number("length"), "time": s.number_or_none("timeStart"),
                "turn": self.left(s, "hOffset", 0.0),
                "position": None if start is None else self.position(start),
            }
            for s, start in ((s, s.find("PositionStart")) for s in segments)
        ]  # fmt: skip
        end_time = part.number_or_none("timeEnd")
        return {"shape": "clothoid_spline", "pieces": pieces, "end_time": end_time}

    def _nurbs(self, part: Part) -> Fields:
        points = [
            {
                "position": self.position(p.child("Position")), "weight": p.number("weight", 1.0),
                "time": p.number_or_none("time"),
            }
            for p in part.children("ControlPoint")
        ]  # fmt: skip
        knots = [k.number("value") for k in part.children("Knot")]
        order = part.integer("order")
        return {"shape": "nurbs", "order": order, "points": points, "knots": knots}


def _with(fields: Fields, orientation: Fields | None) -> Fields:
    return fields if orientation is None else {**fields, "orientation": orientation}


def _level(part: Part) -> None:
    """Objects are level: other angles are ignored."""
    for name in ("p", "r"):
        _flat(part, name)


def _flat(part: Part, name: str) -> None:
    if name in part.raw.attributes and part.number(name) != 0.0:
        part.ignore_attribute(name, "objects stand level on the ground")


_POSITIONS: dict[str, Callable[[Positions, Part], Fields]] = {
    "WorldPosition": Positions._world,
    "RelativeWorldPosition": Positions._relative,
    "RelativeObjectPosition": Positions._relative,
    "RoadPosition": Positions._road,
    "RelativeRoadPosition": Positions._relative_road,
    "LanePosition": Positions._lane,
    "RelativeLanePosition": Positions._relative_lane,
    "RoutePosition": Positions._route_position,
    "TrajectoryPosition": Positions._trajectory_position,
}
_SHAPES: dict[str, Callable[[Positions, Part], Fields]] = {
    "Polyline": Positions._polyline,
    "Clothoid": Positions._clothoid,
    "ClothoidSpline": Positions._spline,
    "Nurbs": Positions._nurbs,
}


def _is_oriented(position: Part) -> bool:
    """Whether a position in the file gives a heading."""
    return any(
        "h" in found.attributes
        for kind in position.raw.children
        for found in (kind, *kind.children)
        if found.tag in {"WorldPosition", "Orientation"}
    )


def signal_state(part: Part) -> Fields:
    """The state of a traffic signal, set by an action or expected by a condition."""
    return {"kind": "signal_state", "signal": part.text("name"), "state": part.text("state")}


def signal_phase(part: Part) -> Fields:
    """The phase of a signal controller, set by an action or expected by a condition."""
    controller = part.text("trafficSignalControllerRef")
    return {"kind": "signal_phase", "controller": controller, "phase": part.text("phase")}


def plain_value(text: str) -> bool | float | str:
    """A text converted to a boolean or number if possible."""
    if text in {"true", "false"}:
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text


NEVER: Fields = {"kind": "simulation_time", "rule": "less_than", "value": -1.0}
ALWAYS: Fields = {"kind": "simulation_time", "rule": "greater_than", "value": -1.0}
"""Conditions that never or always hold."""


class Conditions:
    """Reads triggers; ``positions`` reads their positions."""

    def __init__(self, positions: Positions) -> None:
        self._positions = positions

    def trigger(self, part: Part | None) -> Fields | None:
        """A trigger, or None."""
        if part is None:
            return None
        groups = []
        for group in part.children("ConditionGroup"):
            groups.append({"conditions": [self._condition(c) for c in group.children("Condition")]})
        return {"groups": groups}

    def _condition(self, part: Part) -> Fields:
        edge, delay = part.choice("conditionEdge", EDGES, "none"), part.magnitude("delay", 0.0)
        kind = part.only({"ByEntityCondition", "ByValueCondition"})
        if kind.tag == "ByValueCondition":
            found = kind.only(_BY_VALUE)
            test = _BY_VALUE[found.tag](self, found)
        else:
            who = kind.child("TriggeringEntities")
            entities = [e.text("entityRef") for e in who.children("EntityRef")]
            of = who.choice("triggeringEntitiesRule", {"any": "any", "all": "all"})
            found = kind.child("EntityCondition").only(_BY_ENTITY)
            test = _BY_ENTITY[found.tag](self, found)
            if test is not ALWAYS and test is not NEVER:
                test |= {"entities": entities, "of": of}
        return {"name": part.label("name", ""), "edge": edge, "delay": delay, "test": test}

    # --- of values ------------------------------------------------------------------------------

    def _simulation_time(self, part: Part) -> Fields:
        return {"kind": "simulation_time", **_ruled(part)}

    def _element_state(self, part: Part) -> Fields:
        return {
            "kind": "element_state",
            "element_type": part.choice("storyboardElementType", ELEMENTS),
            "element": part.text("storyboardElementRef"),
            "state": part.choice("state", STATES),
        }

    def _variable(self, part: Part) -> Fields:
        name = declared_name(
            part, "variableRef" if part.tag == "VariableCondition" else "parameterRef"
        )
        if not name:
            part.ignore("a condition on a parameter without a name never holds")
            return NEVER
        value = plain_value(part.text("value"))
        return {
            "kind": "variable", "variable": name, "rule": part.choice("rule", RULES),
            "value": value,
        }  # fmt: skip

    def _signal(self, part: Part) -> Fields:
        return signal_state(part)

    def _controller(self, part: Part) -> Fields:
        return signal_phase(part)

    # --- of entities ----------------------------------------------------------------------------

    def _time_to_collision(self, part: Part) -> Fields:
        target = part.child("TimeToCollisionConditionTarget").only({"EntityRef", "Position"})
        of: Fields = (
            {"entity": target.text("entityRef")}
            if target.tag == "EntityRef"
            else {"position": self._positions.position(target)}
        )
        return {"kind": "time_to_collision", **of, **_ruled(part), **_measured(part)}

    def _headway(self, part: Part) -> Fields:
        of = {"entity": part.text("entityRef")}
        return {"kind": "time_headway", **of, **_ruled(part), **_measured(part)}

    def _relative_distance(self, part: Part) -> Fields:
        of = {"entity": part.text("entityRef")}
        return {"kind": "relative_distance", **of, **_ruled(part), **_measured(part)}

    def _distance(self, part: Part) -> Fields:
        place = self._positions.position(part.child("Position"))
        return {"kind": "distance", "position": place, **_ruled(part), **_measured(part)}

    def _clearance(self, part: Part) -> Fields:
        lanes = [(r.integer("from"), r.integer("to")) for r in part.children("RelativeLaneRange")]
        return {
            "kind": "relative_clearance", "lanes": lanes,
            "ahead": part.number("distanceForward", 0.0),
            "behind": part.number("distanceBackward", 0.0),
            "opposite": part.flag("oppositeLanes"), "freespace": part.flag("freeSpace"),
            "others": [e.text("entityRef") for e in part.children("EntityRef")],
        }  # fmt: skip

    def _reach(self, part: Part) -> Fields:
        place = self._positions.position(part.child("Position"))
        return {
            "kind": "reach_position", "position": place, "tolerance": part.magnitude("tolerance"),
        }  # fmt: skip

    def _speed(self, part: Part) -> Fields:
        fields: Fields = {"kind": "speed", **_ruled(part)}
        if part.tag == "RelativeSpeedCondition":
            fields["relative_to"] = part.text("entityRef")
        return self._directed(part, fields)

    def _acceleration(self, part: Part) -> Fields:
        return self._directed(part, {"kind": "acceleration", **_ruled(part)})

    def _directed(self, part: Part, fields: Fields) -> Fields:
        """The condition in a direction, if one is given; nothing moves vertically."""
        if "direction" not in part.raw.attributes:
            return fields
        words = {"longitudinal": "longitudinal", "lateral": "lateral", "vertical": None}
        direction = part.choice("direction", words)
        if direction == "lateral" and self._positions.mirrored:
            raise part.error("direction 'lateral' is not supported in CARLA's coordinates")
        if direction is not None:
            return {**fields, "direction": direction}
        part.ignore_attribute("direction", "nothing moves vertically")
        return ALWAYS if holds(0.0, fields["rule"], part.text("value")) else NEVER

    def _collision(self, part: Part) -> Fields:
        target = part.only({"EntityRef", "ByType"})
        if target.tag == "EntityRef":
            return {"kind": "collision", "entity": target.text("entityRef")}
        kind = target.choice("type", {"vehicle": "vehicle", "pedestrian": "pedestrian"})
        return {"kind": "collision", "category": kind}

    def _traversed(self, part: Part) -> Fields:
        return {"kind": "traversed_distance", "value": part.magnitude("value")}

    def _lasting(self, part: Part) -> Fields:
        kinds = {
            "StandStillCondition": "stand_still",
            "OffroadCondition": "offroad",
            "EndOfRoadCondition": "end_of_road",
        }
        return {"kind": kinds[part.tag], "duration": part.magnitude("duration")}

    def _angle(self, part: Part) -> Fields:
        turned = part.choice("angleType", {"heading": True, "pitch": False, "roll": False})
        systems = {"entity": "entity", "road": "road", "lane": "road", "world": "world"}
        frame = part.choice("coordinateSystem", systems, "world")
        fields: Fields = {"entity": part.text("entityRef")} if "Rel" in part.tag else {}
        if frame == "road" and not fields:
            raise part.error("coordinateSystem of <AngleCondition> is supported as 'world'")
        angle = self._positions.left(part, "angle")
        tolerance = part.number("angleTolerance")
        if not turned:
            part.ignore_attribute("angleType", "objects stay level, so pitch and roll are 0")
            level = abs(float(part.text("angle"))) <= float(part.text("angleTolerance"))
            return ALWAYS if level else NEVER
        return {**fields, "kind": "angle", "angle": angle, "tolerance": tolerance}


def _ruled(part: Part) -> Fields:
    return {"rule": part.choice("rule", RULES), "value": part.number("value")}


def _measured(part: Part) -> Fields:
    """Distance measure; newer attributes override ``alongRoute``, that of version 1.0."""
    along = part.flag("alongRoute", False)
    measure = part.choice("relativeDistanceType", MEASURES, "euclidianDistance")
    frame = part.choice("coordinateSystem", FRAMES, "entity")
    part.optional("routingAlgorithm")
    if along and not {"relativeDistanceType", "coordinateSystem"} & part.raw.attributes.keys():
        measure, frame = "longitudinal", "lane"
    return {"measure": measure, "frame": frame, "freespace": part.flag("freespace", False)}


_BY_VALUE: dict[str, Any] = {
    "SimulationTimeCondition": Conditions._simulation_time,
    "StoryboardElementStateCondition": Conditions._element_state,
    "VariableCondition": Conditions._variable,
    "ParameterCondition": Conditions._variable,
    "TrafficSignalCondition": Conditions._signal,
    "TrafficSignalControllerCondition": Conditions._controller,
}
_BY_ENTITY: dict[str, Any] = {
    "TimeToCollisionCondition": Conditions._time_to_collision,
    "TimeHeadwayCondition": Conditions._headway,
    "RelativeDistanceCondition": Conditions._relative_distance,
    "DistanceCondition": Conditions._distance,
    "RelativeClearanceCondition": Conditions._clearance,
    "ReachPositionCondition": Conditions._reach,
    "SpeedCondition": Conditions._speed,
    "RelativeSpeedCondition": Conditions._speed,
    "AccelerationCondition": Conditions._acceleration,
    "CollisionCondition": Conditions._collision,
    "TraveledDistanceCondition": Conditions._traversed,
    "StandStillCondition": Conditions._lasting,
    "OffroadCondition": Conditions._lasting,
    "EndOfRoadCondition": Conditions._lasting,
    "AngleCondition": Conditions._angle,
    "RelativeAngleCondition": Conditions._angle,
}


# --- Actions --------------------------------------------------------------------------------------

MODES = {"position": "position", "follow": "follow"}
"""Both modes are followed exactly: 'follow' permits deviations but does not require them."""


class Actions:
    """Reads actions; ``positions`` reads their positions."""

    def __init__(self, positions: Positions) -> None:
        self._positions = positions

    def action(self, part: Part) -> list[Fields]:
        """The action of an event's ``Action``, of ``PrivateAction`` or ``GlobalAction``."""
        if not part.children():
            part.ignore("it is empty")
            return [{"kind": "custom", "type": part.tag}]
        found = part.only(None)
        while found.tag in _NESTED:
            found = found.only(None)
        if found.tag in _WITHOUT_EFFECT:
            found.ignore(_WITHOUT_EFFECT[found.tag])
            return [{"kind": "custom", "type": found.tag}]
        if found.tag not in _ACTIONS:
            raise found.refused(_ACTIONS)
        fields = _ACTIONS[found.tag](self, found)
        return fields if isinstance(fields, list) else [fields]

    # --- longitudinal ---------------------------------------------------------------------------

    def _speed(self, part: Part) -> Fields:
        kinds = {"AbsoluteTargetSpeed", "RelativeTargetSpeed"}
        target = part.child("SpeedActionTarget").only(kinds)
        fields: Fields = {"kind": "speed", "speed": target.number("value")}
        if target.tag == "RelativeTargetSpeed":
            fields |= {
                "relative_to": target.text("entityRef"),
                "relation": target.choice(
                    "speedTargetValueType", {"delta": "delta", "factor": "factor"}
                ),
                "continuous": target.flag("continuous", False),
            }
        return {**fields, "dynamics": _dynamics(part.child("SpeedActionDynamics"))}

    def _speed_profile(self, part: Part) -> Fields:
        part.choice("followingMode", MODES, "position")
        points = [
            {"time": p.magnitude("time", 0.0), "speed": p.number("speed")}
            for p in part.children("SpeedProfileEntry")
        ]
        return {
            "kind": "speed_profile", "points": points, "relative_to": part.optional("entityRef"),
        }  # fmt: skip

    def _longitudinal_distance(self, part: Part) -> Fields:
        part.choice("coordinateSystem", FRAMES, "lane")
        return {
            "kind": "longitudinal_distance",
            "entity": part.text("entityRef"),
            "distance": part.magnitude_or_none("distance"),
            "time_gap": part.magnitude_or_none("timeGap"),
            "place": part.choice("displacement", PLACES, "any"),
            "freespace": part.flag("freespace"),
            "continuous": part.flag("continuous"),
            "limits": _limits(part),
        }

    # --- lateral --------------------------------------------------------------------------------

    def _lane_change(self, part: Part) -> Fields:
        target = part.child("LaneChangeTarget").only({"AbsoluteTargetLane", "RelativeTargetLane"})
        fields: Fields = {
            "kind": "lane_change", "lane": target.integer("value"),
            "offset": self._positions.left(part, "targetLaneOffset", 0.0),
            "dynamics": _dynamics(part.child("LaneChangeActionDynamics")),
        }  # fmt: skip
        if target.tag == "RelativeTargetLane":
            fields["relative_to"] = target.text("entityRef")
        return fields

    def _lane_offset(self, part: Part) -> Fields:
        target = part.child("LaneOffsetTarget").only(
            {"AbsoluteTargetLaneOffset", "RelativeTargetLaneOffset"}
        )
        how = part.child("LaneOffsetActionDynamics")
        fields: Fields = {
            "kind": "lane_offset",
            "offset": self._positions.left(target, "value"),
            "continuous": part.flag("continuous"),
            "shape": how.choice("dynamicsShape", SHAPES),
            "acceleration": how.number_or_none("maxLateralAcc"),
        }
        if target.tag == "RelativeTargetLaneOffset":
            fields["relative_to"] = target.text("entityRef")
        return fields

    def _lateral_distance(self, part: Part) -> Fields:
        part.choice("coordinateSystem", FRAMES, "lane")
        return {
            "kind": "lateral_distance",
            "entity": part.text("entityRef"),
            "distance": part.magnitude("distance", 0.0),
            "side": part.choice("displacement", SIDES, "any"),
            "freespace": part.flag("freespace"),
            "continuous": part.flag("continuous"),
            "limits": _limits(part),
        }

    # --- longitudinal and lateral ---------------------------------------------------------------

    def _synchronize(self, part: Part) -> Fields:
        fields: Fields = {
            "kind": "synchronize",
            "master": part.text("masterEntityRef"),
            "master_target": self._positions.position(part.child("TargetPositionMaster")),
            "target": self._positions.position(part.child("TargetPosition")),
            "master_tolerance": part.magnitude("targetToleranceMaster", 0.0),
            "tolerance": part.magnitude("targetTolerance", 0.0),
        }
        final = part.find("FinalSpeed")
        if final is None:
            return fields
        speed = final.only({"AbsoluteSpeed", "RelativeSpeedToMaster"})
        absolute = speed.tag == "AbsoluteSpeed"
        fields |= {
            "final_speed": speed.number("value"), "relative": not absolute,
        }  # fmt: skip
        if not absolute:
            speed.choice("speedTargetValueType", {"delta": "delta"}, "delta")
        distance, time = (
            speed.find("TargetDistanceSteadyState"),
            speed.find("TargetTimeSteadyState"),
        )
        if distance is not None:
            fields["steady_distance"] = distance.magnitude("distance")
        if time is not None:
            fields["steady_time"] = time.magnitude("time")
        return fields

    def _follow_trajectory(self, part: Part) -> Fields:
        mode = part.find("TrajectoryFollowingMode")
        if mode is not None:
            mode.choice("followingMode", MODES)
        reference = part.find("TimeReference")
        holder = part.find("TrajectoryRef")
        fields: Fields = {
            "kind": "follow_trajectory",
            **self._positions.trajectory(holder if holder is not None else _inline(part)),
            "offset": part.number("initialDistanceOffset", 0.0),
        }
        timing = reference.only({"None", "Timing"}) if reference is not None else None
        if timing is not None and timing.tag == "Timing":
            domains = {"absolute": "absolute", "relative": "relative"}
            fields["timing"] = {
                "domain": timing.choice("domainAbsoluteRelative", domains),
                "scale": timing.number("scale"),
                "offset": timing.number("offset"),
            }
        return fields

    def _assign_route(self, part: Part) -> Fields:
        return {"kind": "assign_route", "route": self._positions.route(part)}

    def _random_route(self, _part: Part) -> Fields:
        return {"kind": "random_route"}

    def _acquire_position(self, part: Part) -> Fields:
        place = self._positions.position(part.child("Position"))
        return {"kind": "acquire_position", "position": place}

    def _teleport(self, part: Part) -> Fields:
        return {"kind": "teleport", "position": self._positions.position(part.child("Position"))}

    def _visibility(self, part: Part) -> Fields:
        visible = part.flag("sensors")
        for name in ("graphics", "traffic"):
            if part.flag(name) != visible:
                part.ignore_attribute(name, "images and traffic see what sensors see")
        return {"kind": "visibility", "visible": visible}

    def _light_state(self, part: Part) -> Fields:
        ignored = {"kind": "custom", "type": part.tag}
        light = part.child("LightType").only({"VehicleLight", "UserDefinedLight"})
        if light.tag == "UserDefinedLight":
            part.ignore(ONLY_LAMPS)
            return ignored
        lamp = light.text("vehicleLightType")
        if lamp not in LAMPS:
            part.ignore(ONLY_LAMPS)
            return ignored
        state = part.child("LightState")
        if part.number("transitionTime", 0.0) != 0.0:
            part.ignore_attribute("transitionTime", "lamps change at once")
        if "luminousIntensity" in state.raw.attributes:
            state.ignore_attribute("luminousIntensity", "the brightness of lamps is fixed")
        if (colour := state.find("Color")) is not None:
            colour.ignore("the colour of lamps is fixed")
        return {
            "kind": "light_state",
            "lamp": LAMPS[lamp],
            "mode": state.choice("mode", {m: m for m in ("on", "off", "flashing")}),
            "on_time": state.magnitude("flashingOnDuration", 0.5),
            "off_time": state.magnitude("flashingOffDuration", 0.5),
        }

    # --- global ---------------------------------------------------------------------------------

    def _environment(self, part: Part) -> Fields:
        """Weather and friction have no effect on the entities, which follow their actions."""
        found = part.only({"Environment", "CatalogReference"})
        is_named = found.tag == "CatalogReference"
        found = self._positions.entry(found, "Environment") if is_named else scoped(found)
        road = found.find("RoadCondition")
        if road is not None and road.number("frictionScaleFactor", 1.0) != 1.0:
            road.ignore_attribute(
                "frictionScaleFactor",
                "entities follow their actions; `vehicle.friction` of a reset is that of the ego's "
                "tyres",
            )
        part.ignore("images show the scene in its own weather and light")
        read_all(found.raw)
        return {"kind": "custom", "type": part.tag}

    def _entity(self, part: Part) -> Fields:
        entity = part.text("entityRef")
        what = part.only({"AddEntityAction", "DeleteEntityAction"})
        if what.tag == "DeleteEntityAction":
            return {"kind": "delete_entity", "entity": entity}
        place = self._positions.position(what.child("Position"))
        return {"kind": "add_entity", "entity": entity, "position": place}

    def _signal_state(self, part: Part) -> Fields:
        return signal_state(part)

    def _signal_phase(self, part: Part) -> Fields:
        return signal_phase(part)

    def _variable(self, part: Part) -> Fields:
        new = "variableRef" in part.raw.attributes
        name = declared_name(part, "variableRef" if new else "parameterRef")
        what = part.only({"SetAction", "ModifyAction"})
        fields: Fields = {"kind": "set_variable", "variable": name}
        if what.tag == "SetAction":
            return {**fields, "value": plain_value(what.text("value"))}
        rule = what.child("Rule").only({"AddValue", "MultiplyByValue"})
        word = "add" if rule.tag == "AddValue" else "multiply"
        return {**fields, "rule": word, "value": float(rule.text("value"))}


def _dynamics(part: Part) -> Fields:
    part.choice("followingMode", MODES, "position")
    shape = part.choice("dynamicsShape", SHAPES)
    dimension = part.choice("dynamicsDimension", DIMENSIONS)
    # Some files give braking as a negative rate; its magnitude is used.
    signed = shape == "step" or dimension == "rate"
    value = part.number("value") if signed else part.magnitude("value")
    return {"shape": shape, "dimension": dimension, "value": value}


def _limits(part: Part) -> Fields:
    found = part.find("DynamicConstraints")
    if found is None:
        return {}
    for name in ("maxAccelerationRate", "maxDecelerationRate"):
        if name in found.raw.attributes:
            raise found.error(f"{name} of <DynamicConstraints> is not supported")
    return {
        "acceleration": found.number_or_none("maxAcceleration"),
        "deceleration": found.number_or_none("maxDeceleration"),
        "speed": found.number_or_none("maxSpeed"),
    }


def _inline(part: Part) -> Part:
    """A trajectory of version 1.0, defined directly in the action."""
    kept = [c for c in part.raw.children if c.tag in {"Trajectory", "CatalogReference"}]
    holder = type(part.raw)(part.tag, part.raw.line, {}, kept)
    return Part(holder, part.file, part.scope, part.notes)


_NESTED = frozenset(
    {
        "PrivateAction", "GlobalAction", "LongitudinalAction", "LateralAction", "RoutingAction",
        "InfrastructureAction", "TrafficSignalAction", "AppearanceAction",
    }
)  # fmt: skip
ONLY_LAMPS = "of the lights, images only show brake lamps and indicators"
CONTROLLERS = (
    "the planner drives the ego, and the actions of the file move all others; controllers of other "
    "programs do not run"
)
_WITHOUT_EFFECT = {
    "ControllerAction": CONTROLLERS,
    "ActivateControllerAction": CONTROLLERS,
    "AssignControllerAction": CONTROLLERS,
    "OverrideControllerValueAction": CONTROLLERS,
    "AnimationAction": "animations are not shown",
    "TrailerAction": "trailers are not simulated",
    "UserDefinedAction": "it is for another program",
}
"""Actions that do not change the drive, and why."""
_ACTIONS: dict[str, Any] = {
    "SpeedAction": Actions._speed,
    "SpeedProfileAction": Actions._speed_profile,
    "LongitudinalDistanceAction": Actions._longitudinal_distance,
    "LaneChangeAction": Actions._lane_change,
    "LaneOffsetAction": Actions._lane_offset,
    "LateralDistanceAction": Actions._lateral_distance,
    "SynchronizeAction": Actions._synchronize,
    "FollowTrajectoryAction": Actions._follow_trajectory,
    "AssignRouteAction": Actions._assign_route,
    "RandomRouteAction": Actions._random_route,
    "AcquirePositionAction": Actions._acquire_position,
    "TeleportAction": Actions._teleport,
    "VisibilityAction": Actions._visibility,
    "LightStateAction": Actions._light_state,
    "EntityAction": Actions._entity,
    "EnvironmentAction": Actions._environment,
    "TrafficSignalStateAction": Actions._signal_state,
    "TrafficSignalControllerAction": Actions._signal_phase,
    "VariableAction": Actions._variable,
    "ParameterAction": Actions._variable,
}
