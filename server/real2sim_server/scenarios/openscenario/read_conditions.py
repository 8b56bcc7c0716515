"""Triggers and conditions of OpenSCENARIO files."""

from __future__ import annotations

from typing import Any

from .elements import Part
from .names import EDGES, ELEMENTS, FRAMES, MEASURES, RULES, STATES
from .read_positions import Fields, Positions


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
        return {
            "kind": "signal_state", "signal": part.text("name"), "state": part.text("state"),
        }  # fmt: skip

    def _controller(self, part: Part) -> Fields:
        return {
            "kind": "signal_phase", "controller": part.text("trafficSignalControllerRef"),
            "phase": part.text("phase"),
        }  # fmt: skip

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
