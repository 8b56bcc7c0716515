"""Positions, routes and trajectories of OpenSCENARIO files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .elements import Part
from .parameters import scoped

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
