"""Signals, stop lines and crosswalks of OpenDRIVE roads."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from real2sim_proto.lanes import SignalKind

from ...geometry.rotation import Float
from ...scene.lane import TRAVELLED, Area, Signal, StopLine
from ...scene.road import Road, RoadLane
from ..xml_files import integer, number
from .roads import SPEED_UNITS, OpenDriveRoad

STOP_LINE_TYPES = {"294"}
STOP_TYPES, YIELD_TYPES, SPEED_TYPES = {"206"}, {"205"}, {"274"}
"""Of the German catalogue, which most makers of maps use."""
LIGHT_TYPES = ("1.000.", "1000")
REACH_M = 25.0
"""A stop line so near before a signal is the signal's."""


def read_signals(
    roads: Mapping[str, OpenDriveRoad], lines: Mapping[str, Road], file: str
) -> tuple[list[Signal], list[StopLine]]:
    """All signals of a file with the lanes that they rule, and its stop lines.

    A signal without <validity> rules every lane of the direction that it faces.

    Raises:
        MapError: an attribute is absent or no number.
    """
    stop_lines: dict[str, StopLine] = {}
    signals: dict[str, Signal] = {}
    declared: dict[str, ET.Element] = {}
    placed: list[tuple[str, ET.Element, bool]] = []
    for road_id, road in roads.items():
        for element in road.element.findall("signals/signal"):
            declared[element.get("id", "")] = element
            placed.append((road_id, element, False))
        placed += [(road_id, e, True) for e in road.element.findall("signals/signalReference")]
    for road_id, element, _ in placed:
        if element.get("type", "") in STOP_LINE_TYPES:
            name = f"{road_id}/{element.get('id', '')}"
            stop_lines[name] = _stop_line(name, element, roads[road_id], lines[road_id], file)
    for road_id, element, refers in placed:
        own = declared.get(element.get("id", "")) if refers else element
        if own is None or own.get("type", "") in STOP_LINE_TYPES:
            continue
        signal_id = own.get("id", "")
        lanes = _ruled(element, roads[road_id], lines[road_id], file)
        if refers and signal_id in signals:
            known = signals[signal_id]
            signals[signal_id] = _joined(known, lanes)
            continue
        key = signal_id if signal_id not in signals else f"{road_id}/{signal_id}"
        signal = _signal(own, element, lines[road_id], lanes, file)
        signals[key] = replace(signal, signal_id=key)
    return [_with_stop_line(s, stop_lines) for s in signals.values()], list(stop_lines.values())


def _ruled(element: ET.Element, road: OpenDriveRoad, line: Road, file: str) -> tuple[str, ...]:
    where = f"{file}: signal {element.get('id', '')!r}"
    s = min(max(number(element, "s", where), 0.0), line.length)
    spans = [
        (integer(v, "fromLane", where), integer(v, "toLane", where))
        for v in element.findall("validity")
    ]
    facing = element.get("orientation", "none")
    found = []
    for part in line.lanes:
        if not part.s[0] - 1e-6 <= s <= part.s[-1] + 1e-6:
            continue
        along = line.runs_along(part.number)
        if spans:
            rules = any(min(a, b) <= part.number <= max(a, b) for a, b in spans)
        else:
            rules = facing == "none" or along == (facing == "+")
        if rules and _is_travelled(road, s, part.number):
            found.append(part)
    # Where two sections meet, the one that traffic comes from waits.
    waits: dict[int, RoadLane] = {}
    for part in found:
        known = waits.setdefault(part.number, part)
        if (part.s[0] < known.s[0]) == line.runs_along(part.number):
            waits[part.number] = part
    return tuple(part.lane_id for part in waits.values())


def _is_travelled(road: OpenDriveRoad, s: float, lane: int) -> bool:
    return any(
        lane in section.lanes and section.lanes[lane].kind in TRAVELLED
        for section in road.sections
        if section.s[0] - 1e-6 <= s <= section.s[-1] + 1e-6
    )


def _signal(
    own: ET.Element, placed: ET.Element, line: Road, lanes: tuple[str, ...], file: str
) -> Signal:
    """A signal as it is declared, where it is placed."""
    where = f"{file}: signal {own.get('id', '')!r}"
    s, t = number(placed, "s", where), number(placed, "t", where)
    x, y, z, heading = line.at(s, t)
    against = math.pi if own.get("orientation", "+") != "-" else 0.0
    kind = _kind(own)
    unit = SPEED_UNITS.get(own.get("unit", ""), 1.0)
    value = number(own, "value", where, -1.0) * unit if kind == "speed_limit" else None
    return Signal(
        own.get("id", ""),
        kind,
        (x, y, z + number(own, "zOffset", where, 0.0)),
        heading + against + number(own, "hOffset", where, 0.0),
        lanes,
        value=value if value is not None and value > 0 else None,
    )


def _kind(element: ET.Element) -> SignalKind:
    given = element.get("type", "")
    if element.get("dynamic", "no") == "yes" or given.startswith(LIGHT_TYPES):
        return "traffic_light"
    if given in STOP_TYPES:
        return "stop"
    if given in YIELD_TYPES:
        return "yield"
    return "speed_limit" if given in SPEED_TYPES else "other"


def _joined(known: Signal, lanes: tuple[str, ...]) -> Signal:
    return replace(known, lanes=(*known.lanes, *lanes))


def _stop_line(
    name: str, element: ET.Element, road: OpenDriveRoad, line: Road, file: str
) -> StopLine:
    """Across all lanes that it rules, at its place."""
    s = min(max(number(element, "s", f"{file}: signal {name!r}"), 0.0), line.length)
    lanes = _ruled(element, road, line, file)
    parts = [p for p in line.lanes if p.lane_id in lanes]
    rims = [float(np.interp(s, p.s, side)) for p in parts for side in (p.inner, p.outer)] or [
        -1.5,
        1.5,
    ]
    ends = line.sample(np.array([s, s]), np.array([min(rims), max(rims)]))[:, :3]
    return StopLine(name, ends, lanes)


def _with_stop_line(signal: Signal, stop_lines: Mapping[str, StopLine]) -> Signal:
    """The signal with the nearest line at which lanes that it rules wait."""
    if signal.kind not in ("traffic_light", "stop", "yield"):
        return signal
    place = np.array(signal.position[:2])
    best, nearest = None, REACH_M
    for line in stop_lines.values():
        distance = float(np.linalg.norm(line.points[:, :2].mean(axis=0) - place))
        if set(line.lanes) & set(signal.lanes) and distance < nearest:
            best, nearest = line.stop_line_id, distance
    return replace(signal, stop_line=best)


def read_crossings(
    roads: Mapping[str, OpenDriveRoad], lines: Mapping[str, Road], file: str
) -> list[Area]:
    """Crosswalks and parking spaces among the objects that have an outline.

    Raises:
        MapError: an attribute is absent or no number.
    """
    found: list[Area] = []
    for road_id, road in roads.items():
        for element in road.element.findall("objects/object"):
            kind = {"crosswalk": "crosswalk", "parkingSpace": "parking"}.get(
                element.get("type", "")
            )
            outline = _outline(element, lines[road_id], f"{file}: object of road {road_id!r}")
            if kind is not None and len(outline) >= 3:
                name = f"{road_id}/{element.get('id', '')}"
                if all(name != area.area_id for area in found[-50:]):
                    found.append(Area(name, kind, outline))  # type: ignore[arg-type]
    return found


def _outline(element: ET.Element, line: Road, where: str) -> Float:
    road_corners = list(element.iter("cornerRoad"))
    if road_corners:
        st = np.array([[number(c, "s", where), number(c, "t", where)] for c in road_corners])
        corners: Float = line.sample(st[:, 0], st[:, 1])[:, :3]
        return corners
    corners_uv = [
        [number(c, "u", where), number(c, "v", where)] for c in element.iter("cornerLocal")
    ]
    if not corners_uv and element.get("length") and element.get("width"):
        u, v = number(element, "length", where) / 2, number(element, "width", where) / 2
        corners_uv = [[u, v], [-u, v], [-u, -v], [u, -v]]
    if not corners_uv:
        return np.zeros((0, 3))
    x, y, z, heading = line.at(number(element, "s", where), number(element, "t", where))
    heading += number(element, "hdg", where, 0.0)
    local = np.array(corners_uv)
    cos, sin = math.cos(heading), math.sin(heading)
    places = local @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
    return np.column_stack([places, np.full(len(places), z)])
