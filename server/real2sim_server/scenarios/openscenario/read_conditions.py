"""Positions, routes, trajectories, triggers and conditions of OpenSCENARIO files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .elements import EDGES, ELEMENTS, FRAMES, MEASURES, RULES, STATES, Part, scoped

# --- Positions -----------------------------------------------------------------------------------

Fields = dict[str, Any]
"""Of a model of the storyboard."""

Resolve = Callable[[Part, str], Part]
"""The entry of a catalog that an element refers to, of a type."""


class Positions:
    """Reads positions; ``entry`` finds entries of catalogs."""

    def __init__(self, entry: Resolve) -> None:
        self._entry = entry

    def position(self, part: Part) -> Fields:
        """The position that an element holds."""
        found = part.only(_POSITIONS)
        fields: Fields = _POSITIONS[found.tag](self, found)
        return fields

    def route(self, part: Part) -> Fields:
        """Of ``RouteRef`` or ``AssignRouteAction``: a route here, or of a catalog."""
        found = part.only({"Route", "CatalogReference"})
        is_named = found.tag == "CatalogReference"
        found = self._entry(found, "Route") if is_named else scoped(found)
        points = found.children("Waypoint")
        for point in points:
            point.optional("routeStrategy")
        return {
            "name": found.text("name", "route"),
            "closed": found.flag("closed", False),
            "waypoints": [self.position(p.child("Position")) for p in points],
        }

    def trajectory(self, part: Part) -> Fields:
        """Of ``TrajectoryRef``: name, closed and curve."""
        found = part.only({"Trajectory", "CatalogReference"})
        is_named = found.tag == "CatalogReference"
        found = self._entry(found, "Trajectory") if is_named else scoped(found)
        shape = found.child("Shape").only(_SHAPES)
        return {
            "name": found.text("name", "trajectory"),
            "closed": found.flag("closed", False),
            "curve": _SHAPES[shape.tag](self, shape),
        }

    def _orientation(self, part: Part) -> Fields | None:
        found = part.find("Orientation")
        if found is None:
            return None
        _level(found)
        relative = found.choice("type", {"relative": True, "absolute": False}, "absolute")
        return {"h": found.number("h", 0.0), "relative": relative}

    def _world(self, part: Part) -> Fields:
        _level(part)
        z = part.number_or_none("z")
        h = part.number("h", 0.0)
        return {
            "kind": "world", "x": part.number("x"), "y": part.number("y"), "h": h,
            **({"z": z} if z not in {None, 0.0} else {}),
        }  # fmt: skip

    def _relative(self, part: Part) -> Fields:
        _flat(part, "dz")
        kind = "relative_world" if part.tag == "RelativeWorldPosition" else "relative_object"
        return _with(
            {
                "kind": kind, "entity": part.text("entityRef"),
                "dx": part.number("dx"), "dy": part.number("dy"),
            },
            self._orientation(part),
        )  # fmt: skip

    def _road(self, part: Part) -> Fields:
        fields = {
            "kind": "road", "road": part.text("roadId"),
            "s": part.number("s"), "t": part.number("t"),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _relative_road(self, part: Part) -> Fields:
        fields = {
            "kind": "relative_road", "entity": part.text("entityRef"),
            "ds": part.number("ds"), "dt": part.number("dt"),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _lane(self, part: Part) -> Fields:
        fields = {
            "kind": "lane", "road": part.text("roadId"), "lane": part.integer("laneId"),
            "s": part.number("s"), "offset": part.number("offset", 0.0),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _relative_lane(self, part: Part) -> Fields:
        along = "lane" if "dsLane" in part.raw.attributes else "road"
        fields = {
            "kind": "relative_lane", "entity": part.text("entityRef"),
            "lanes": part.integer("dLane"), "along": along,
            "ds": part.number("dsLane" if along == "lane" else "ds"),
            "offset": part.number("offset", 0.0),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    def _route_position(self, part: Part) -> Fields:
        where = part.child("InRoutePosition").only({"FromLaneCoordinates", "FromRoadCoordinates"})
        fields = {
            "kind": "route", "route": self.route(part.child("RouteRef")),
            "s": where.number("pathS"),
        }  # fmt: skip
        if where.tag == "FromRoadCoordinates":
            fields["t"] = where.number("t", 0.0)
        else:
            fields |= {"lane": where.integer("laneId"), "t": where.number("laneOffset", 0.0)}
        return _with(fields, self._orientation(part))

    def _trajectory_position(self, part: Part) -> Fields:
        fields = {
            "kind": "trajectory", "curve": self.trajectory(part.child("TrajectoryRef"))["curve"],
            "s": part.number("s"), "t": part.number("t", 0.0),
        }  # fmt: skip
        return _with(fields, self._orientation(part))

    # --- shapes ---------------------------------------------------------------------------------

    def _polyline(self, part: Part) -> Fields:
        vertices = [
            {"time": v.number("time", 0.0), "position": self.position(v.child("Position"))}
            for v in part.children("Vertex")
        ]
        return {"shape": "polyline", "vertices": vertices}

    def _clothoid(self, part: Part) -> Fields:
        rate = "curvaturePrime" if "curvaturePrime" in part.raw.attributes else "curvatureDot"
        return {
            "shape": "clothoid",
            "position": self.position(part.child("Position")),
            "curvature": part.number("curvature"),
            "curvature_rate": part.number(rate, 0.0),
            "length": part.magnitude("length"),
            "start_time": part.number_or_none("startTime"),
            "stop_time": part.number_or_none("stopTime"),
        }

    def _spline(self, part: Part) -> Fields:
        part.number_or_none("timeEnd")
        segments = part.children("ClothoidSplineSegment")
        starts = [s.find("PositionStart") for s in segments]
        if not starts or starts[0] is None or any(s is not None for s in starts[1:]):
            raise part.error(
                "<ClothoidSpline> is supported with <PositionStart> in its first segment alone"
            )
        pieces = [
            {
                "start": s.number("curvatureStart"), "end": s.number("curvatureEnd"),
                "length": s.number("length"), "end_time": s.number_or_none("timeEnd"),
            }
            for s in segments
        ]  # fmt: skip
        position = self.position(starts[0])
        return {"shape": "clothoid_spline", "position": position, "pieces": pieces}

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
    """Objects stand level: other angles are refused."""
    for name in ("p", "r"):
        _flat(part, name)


def _flat(part: Part, name: str) -> None:
    if name in part.raw.attributes and part.number(name) != 0.0:
        raise part.error(f"{name} of <{part.tag}> is not supported but as 0: objects stand level")


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


def signal_state(part: Part) -> Fields:
    """The state of one traffic signal, as an action sets it and a condition expects it."""
    return {"kind": "signal_state", "signal": part.text("name"), "state": part.text("state")}


def signal_phase(part: Part) -> Fields:
    """The phase of a signal controller, as an action sets it and a condition expects it."""
    controller = part.text("trafficSignalControllerRef")
    return {"kind": "signal_phase", "controller": controller, "phase": part.text("phase")}


def plain_value(text: str) -> bool | float | str:
    """A text as the value that it looks like."""
    if text in {"true", "false"}:
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text


class Conditions:
    """Reads triggers; ``positions`` reads what is in them."""

    def __init__(self, positions: Positions) -> None:
        self._positions = positions

    def trigger(self, part: Part | None) -> Fields | None:
        """A trigger; None where there is none."""
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
            found = kind.child("EntityCondition").only(_BY_ENTITY)
            test = {
                **_BY_ENTITY[found.tag](self, found),
                "entities": [e.text("entityRef") for e in who.children("EntityRef")],
                "of": who.choice("triggeringEntitiesRule", {"any": "any", "all": "all"}),
            }
        return {"name": part.text("name", ""), "edge": edge, "delay": delay, "test": test}

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
        name = "variableRef" if part.tag == "VariableCondition" else "parameterRef"
        value = plain_value(part.text("value"))
        rule = part.choice("rule", RULES)
        return {"kind": "variable", "variable": part.text(name), "rule": rule, "value": value}

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
        measured = {"measure": "longitudinal"} | _measured(part)
        if "relativeDistanceType" not in part.raw.attributes:
            measured["measure"] = "longitudinal"
        return {
            "kind": "time_headway", "entity": part.text("entityRef"), **_ruled(part), **measured,
        }  # fmt: skip

    def _relative_distance(self, part: Part) -> Fields:
        of = {"entity": part.text("entityRef")}
        return {"kind": "relative_distance", **of, **_ruled(part), **_measured(part)}

    def _distance(self, part: Part) -> Fields:
        place = self._positions.position(part.child("Position"))
        return {"kind": "distance", "position": place, **_ruled(part), **_measured(part)}

    def _reach(self, part: Part) -> Fields:
        place = self._positions.position(part.child("Position"))
        return {
            "kind": "reach_position", "position": place, "tolerance": part.magnitude("tolerance"),
        }  # fmt: skip

    def _speed(self, part: Part) -> Fields:
        fields: Fields = {"kind": "speed", **_ruled(part), **_directed(part)}
        if part.tag == "RelativeSpeedCondition":
            fields["relative_to"] = part.text("entityRef")
        return fields

    def _acceleration(self, part: Part) -> Fields:
        return {"kind": "acceleration", **_ruled(part), **_directed(part)}

    def _collision(self, part: Part) -> Fields:
        target = part.only({"EntityRef", "ByType"})
        if target.tag == "EntityRef":
            return {"kind": "collision", "entity": target.text("entityRef")}
        kind = target.choice("type", {"vehicle": "car", "pedestrian": "pedestrian"})
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
        part.choice("angleType", {"heading": "heading"})
        systems = {"entity": "entity", "road": "road", "lane": "road", "world": "world"}
        frame = part.choice("coordinateSystem", systems, "world")
        fields: Fields = {"entity": part.text("entityRef")} if "Rel" in part.tag else {}
        if frame == "road" and not fields:
            raise part.error("coordinateSystem of <AngleCondition> is supported as 'world'")
        return {
            **fields, "kind": "angle", "angle": part.number("angle"),
            "tolerance": part.number("angleTolerance"),
        }  # fmt: skip


def _ruled(part: Part) -> Fields:
    return {"rule": part.choice("rule", RULES), "value": part.number("value")}


def _measured(part: Part) -> Fields:
    """How a distance is measured; ``alongRoute`` is the word of version 1.0."""
    along = part.flag("alongRoute", False)
    measure = part.choice("relativeDistanceType", MEASURES, "euclidianDistance")
    frame = part.choice("coordinateSystem", FRAMES, "entity")
    part.optional("routingAlgorithm")
    if along:
        measure, frame = "longitudinal", "lane"
    return {"measure": measure, "frame": frame, "freespace": part.flag("freespace", False)}


def _directed(part: Part) -> Fields:
    words = {"longitudinal": "longitudinal", "lateral": "lateral"}
    if "direction" not in part.raw.attributes:
        return {}
    return {"direction": part.choice("direction", words)}


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
