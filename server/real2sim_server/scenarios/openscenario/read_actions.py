"""Actions of OpenSCENARIO files."""

from __future__ import annotations

from typing import Any

from .elements import DIMENSIONS, FRAMES, PLACES, SHAPES, SIDES, Part
from .read_conditions import Fields, Positions, plain_value, signal_phase, signal_state

MODES = {"position": "position", "follow": "follow"}
"""Trajectories and dynamics are followed exactly in both: 'follow' only allows to deviate."""


class Actions:
    """Reads actions; ``positions`` reads what is in them."""

    def __init__(self, positions: Positions) -> None:
        self._positions = positions

    def action(self, part: Part) -> list[Fields]:
        """What ``Action`` of an event, ``PrivateAction`` or ``GlobalAction`` does."""
        found = part.only(None)
        while found.tag in _NESTED:
            found = found.only(None)
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
            "offset": part.number("targetLaneOffset", 0.0),
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
            "offset": target.number("value"),
            "continuous": part.flag("continuous"),
            "shape": how.choice("dynamicsShape", SHAPES),
            "acceleration": how.number_or_none("maxLateralAcc"),
        }
        if target.tag == "RelativeTargetLaneOffset":
            fields["relative_to"] = target.text("entityRef")
        if fields["shape"] == "linear" and fields["acceleration"] is not None:
            raise how.error(
                "a linear <LaneOffsetAction> has no highest acceleration that is finite; take "
                "sinusoidal or cubic"
            )
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

    # --- both -----------------------------------------------------------------------------------

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

    def _acquire_position(self, part: Part) -> Fields:
        place = self._positions.position(part.child("Position"))
        return {"kind": "acquire_position", "position": place}

    def _teleport(self, part: Part) -> Fields:
        return {"kind": "teleport", "position": self._positions.position(part.child("Position"))}

    def _visibility(self, part: Part) -> Fields:
        shown = {part.flag("graphics"), part.flag("sensors"), part.flag("traffic")}
        if len(shown) > 1:
            raise part.error(
                "<VisibilityAction> is supported with graphics, sensors and traffic alike"
            )
        return {"kind": "visibility", "visible": shown.pop()}

    def _activate(self, part: Part) -> Fields:
        if part.flag("lateral", False):
            raise part.error("<ActivateControllerAction> is supported for the longitudinal domain")
        part.optional("controllerRef")
        return {"kind": "controller", "active": part.flag("longitudinal", False)}

    # --- of nobody ------------------------------------------------------------------------------

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
        name = part.optional("variableRef") or part.text("parameterRef")
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
    # Some write braking as a negative rate, whose magnitude counts.
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
    """A trajectory of version 1.0, which stands in the action itself."""
    kept = [c for c in part.raw.children if c.tag in {"Trajectory", "CatalogReference"}]
    holder = type(part.raw)(part.tag, part.raw.line, {}, kept)
    return Part(holder, part.file, part.scope)


_NESTED = frozenset(
    {
        "PrivateAction", "GlobalAction", "LongitudinalAction", "LateralAction", "RoutingAction",
        "ControllerAction", "InfrastructureAction", "TrafficSignalAction",
    }
)  # fmt: skip
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
    "AcquirePositionAction": Actions._acquire_position,
    "TeleportAction": Actions._teleport,
    "VisibilityAction": Actions._visibility,
    "ActivateControllerAction": Actions._activate,
    "EntityAction": Actions._entity,
    "TrafficSignalStateAction": Actions._signal_state,
    "TrafficSignalControllerAction": Actions._signal_phase,
    "VariableAction": Actions._variable,
    "ParameterAction": Actions._variable,
}
