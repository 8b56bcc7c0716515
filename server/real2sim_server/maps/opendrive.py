"""OpenDRIVE 1.4 to 1.8 as a lane graph. Source: ASAM OpenDRIVE 1.8.1."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from real2sim_proto.lanes import AreaKind, SignalKind

from ..geometry import Float
from ..scene.errors import LeftOut
from ..scene.lane import TRAVELLED, Area, Lane, Road, RoadLane, Signal, StopLine
from ..scene.lane_graph import LaneGraph
from .opendrive_roads import SPEED_UNITS, OpenDriveRoad, SectionLane, read_road
from .reader import (
    MapError,
    check_rest,
    damage_named,
    head_of,
    integer,
    notes_of,
    number,
    read_map_xml,
)

# --- Links ---------------------------------------------------------------------------------------

# Connections between lanes: lane links, road links, junctions.


class LaneEnd(NamedTuple):
    """One end of a lane of a section: ``end`` is "start" or "end" along the road."""

    road: str
    section: int
    number: int
    end: str


ENDS = {"predecessor": "start", "successor": "end"}


def joined_ends(
    roads: Mapping[str, OpenDriveRoad], junctions: list[ET.Element], left_out: LeftOut
) -> set[frozenset[LaneEnd]]:
    """Pairs of connected lane ends, independent of the direction of traffic.

    ``left_out`` receives the links to roads, junctions and lanes that are not there.
    """
    found: set[frozenset[LaneEnd]] = set()
    for road in roads.values():
        for pair in (*_within(road), *_to_roads(road, roads)):
            found.add(frozenset(pair))
    for junction in junctions:
        for pair in _through(junction, roads, left_out):
            found.add(frozenset(pair))
    named = {"road": set(roads), "junction": {j.get("id", "") for j in junctions}}
    for road in roads.values():
        beside = [("road", e.get("elementId", "")) for e in road.element.findall("link/neighbor")]
        inside = [("junction", road.junction)] if road.junction is not None else []
        given = [(link.kind, link.element) for link in road.links.values()]
        left_out["links of roads to a road or junction that is not there"] += [
            f"{road.road_id} to {name}"
            for kind, name in (*given, *beside, *inside)
            if name not in named.get(kind, {name})
        ]
    there = {
        LaneEnd(r.road_id, i, n, end)
        for r in roads.values()
        for i, section in enumerate(r.sections)
        for n in section.lanes
        for end in ("start", "end")
    }
    left_out["lane links to a lane that is not there"] += sorted(
        _key(end) for pair in found for end in pair - there
    )
    return {pair for pair in found if len(pair) == 2 and pair <= there}


def _within(road: OpenDriveRoad) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    """Connections between the sections of a road, as declared by either side."""
    for i, section in enumerate(road.sections):
        for lane in section.lanes.values():
            for link, step in (("successor", 1), ("predecessor", -1)):
                other = i + step
                if link in lane.links and 0 <= other < len(road.sections):
                    yield (
                        LaneEnd(road.road_id, i, lane.number, ENDS[link]),
                        LaneEnd(
                            road.road_id,
                            other,
                            lane.links[link],
                            "start" if step > 0 else "end",
                        ),
                    )


def _to_roads(
    road: OpenDriveRoad, roads: Mapping[str, OpenDriveRoad]
) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    """Connections from the ends of a road to its linked roads."""
    for link, road_link in road.links.items():
        other = roads.get(road_link.element)
        if road_link.kind != "road" or other is None:
            continue
        last = len(road.sections) - 1 if link == "successor" else 0
        for lane in road.sections[last].lanes.values():
            if link in lane.links:
                yield (
                    LaneEnd(road.road_id, last, lane.number, ENDS[link]),
                    _end_of(other, road_link.contact, lane.links[link]),
                )


def _through(
    junction: ET.Element, roads: Mapping[str, OpenDriveRoad], left_out: LeftOut
) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    """Connections from incoming roads of a junction to its connecting roads."""
    name = junction.get("id", "")
    for connection in junction.findall("connection"):
        incoming = connection.get("incomingRoad")
        crossing = connection.get("connectingRoad") or connection.get("linkedRoad")
        if incoming is None or crossing is None:
            if connection.find("laneLink") is not None:
                told = left_out["connections of junctions left out because they lack a road"]
                told.append(f"{connection.get('id', '')} of {name}")
            continue
        if gone := [f"{name} to {road}" for road in (incoming, crossing) if road not in roads]:
            left_out["connections of junctions to a road that is not there"] += gone
            continue
        contact = connection.get("contactPoint", "start")
        if contact not in ("start", "end"):
            told = left_out["connections of junctions left out because of their contact point"]
            told.append(f"{connection.get('id', '')} of {name}: {contact!r}")
            continue
        leaves = _facing_end(roads[incoming], roads[crossing], contact, name)
        for link in connection.findall("laneLink"):
            kind = "lane links of junctions left out because they cannot be read"
            with left_out.damaged(kind, f"{connection.get('id', '')} of {name}"):
                a, b = (integer(link, n) for n in ("from", "to"))
                yield _end_of(roads[incoming], leaves, a), _end_of(roads[crossing], contact, b)


def _facing_end(
    incoming: OpenDriveRoad, crossing: OpenDriveRoad, contact: str, junction: str
) -> str:
    """The end of the incoming road at the connecting one."""
    link = crossing.links.get("predecessor" if contact == "start" else "successor")
    if link is not None and link.kind == "road" and link.element == incoming.road_id:
        return link.contact
    after = incoming.links.get("successor")
    faces = after is not None and after.kind == "junction" and after.element == junction
    return "end" if faces else "start"


def _end_of(road: OpenDriveRoad, contact: str, lane: int) -> LaneEnd:
    section = 0 if contact == "start" else len(road.sections) - 1
    return LaneEnd(road.road_id, section, lane, contact)


# --- Signals, stop lines, crosswalks -------------------------------------------------------------

STOP_LINE_TYPES = {"294"}
STOP_TYPES, YIELD_TYPES, SPEED_TYPES = {"206"}, {"205"}, {"274"}
"""Sign numbers of the German catalogue, used by most map makers."""
LIGHT_TYPES = ("1.000.", "1000")
REACH_M = 25.0
"""Maximum distance of a stop line before its signal."""


def read_signals(
    roads: Mapping[str, OpenDriveRoad], lines: Mapping[str, Road], left_out: LeftOut
) -> tuple[list[Signal], list[StopLine]]:
    """All signals of a file with the lanes that they control, and its stop lines.

    A signal without <validity> controls every lane of the direction that it faces. ``left_out``
    receives references to signals that are not there, and signals that cannot be read.
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
    damaged = "signals left out because they cannot be read"
    for road_id, element, _ in placed:
        if element.get("type", "") in STOP_LINE_TYPES:
            name = f"{road_id}/{element.get('id', '')}"
            with left_out.damaged(damaged, name):
                line = _stop_line(name, element, roads[road_id], lines[road_id])
                if stop_lines.setdefault(name, line) is not line:
                    left_out["signals left out because their id is there twice"].append(name)
    for road_id, element, refers in placed:
        own = declared.get(element.get("id", "")) if refers else element
        if own is None:
            name = f"{element.get('id', '')} on road {road_id}"
            left_out["references to a signal that is not there"].append(name)
        if own is None or own.get("type", "") in STOP_LINE_TYPES:
            continue
        signal_id = own.get("id", "")
        name = f"{signal_id} on road {road_id}"
        with left_out.damaged(damaged, name):
            lanes = _ruled(element, roads[road_id], lines[road_id])
            spans = _spans(element)
            numbers = {0, *(n for section in roads[road_id].sections for n in section.lanes)}
            if spans and not any(min(a, b) <= n <= max(a, b) for a, b in spans for n in numbers):
                left_out["signals for lanes that are not there"].append(name)
            if refers and signal_id in signals:
                known = signals[signal_id]
                signals[signal_id] = _joined(known, lanes)
                continue
            key = signal_id if signal_id not in signals else f"{road_id}/{signal_id}"
            if key in signals:
                left_out["signals left out because their id is there twice"].append(name)
                continue
            signal = _signal(own, element, lines[road_id], lanes, left_out)
            signals[key] = replace(signal, signal_id=key)
    return [_with_stop_line(s, stop_lines) for s in signals.values()], list(stop_lines.values())


def read_controllers(
    root: ET.Element, signals: Collection[str], left_out: LeftOut
) -> dict[str, str]:
    """The controller of each controlled signal, the first one in the file.

    ``left_out`` receives the controlled signals that are not there.
    """
    found: dict[str, str] = {}
    for controller in root.findall("controller"):
        name = controller.get("id", "")
        for control in controller.findall("control"):
            signal = control.get("signalId", "")
            if signal in signals:
                found.setdefault(signal, name)
            else:
                left_out["controlled signals that are not there"].append(f"{signal} of {name}")
    return found


def _ruled(element: ET.Element, road: OpenDriveRoad, line: Road) -> tuple[str, ...]:
    s = min(max(number(element, "s"), 0.0), line.length)
    spans = _spans(element)
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
    # At the border of two sections, traffic stops at the end of the section that it leaves.
    waits: dict[int, RoadLane] = {}
    for part in found:
        known = waits.setdefault(part.number, part)
        if (part.s[0] < known.s[0]) == line.runs_along(part.number):
            waits[part.number] = part
    return tuple(part.lane_id for part in waits.values())


def _spans(element: ET.Element) -> list[tuple[int, int]]:
    """First and last lanes of each <validity>."""
    return [(integer(v, "fromLane"), integer(v, "toLane")) for v in element.findall("validity")]


def _is_travelled(road: OpenDriveRoad, s: float, lane: int) -> bool:
    return any(
        lane in section.lanes and section.lanes[lane].kind in TRAVELLED
        for section in road.sections
        if section.s[0] - 1e-6 <= s <= section.s[-1] + 1e-6
    )


def _signal(
    own: ET.Element, placed: ET.Element, line: Road, lanes: tuple[str, ...], left_out: LeftOut
) -> Signal:
    """A signal as declared, at its position."""
    s, t = number(placed, "s"), number(placed, "t")
    x, y, z, heading = line.at(s, t)
    against = math.pi if own.get("orientation", "+") != "-" else 0.0
    kind = _kind(own)
    value = None
    if kind == "speed_limit":
        with left_out.damaged("speed limit signs without their limit", own.get("id", "")):
            value = _limit(own, left_out)
    return Signal(
        own.get("id", ""),
        kind,
        (x, y, z + number(own, "zOffset", 0.0)),
        heading + against + number(own, "hOffset", 0.0),
        lanes,
        value=value,
    )


def _limit(sign: ET.Element, left_out: LeftOut) -> float:
    """Speed limit of a sign [m/s]. Raises MapError."""
    unit, value = sign.get("unit", ""), number(sign, "value")
    if unit.lower() not in SPEED_UNITS:
        raise MapError(
            f"its unit is {unit[:40]!r}; allowed: {', '.join(u for u in SPEED_UNITS if u)}"
        )
    if value <= 0:
        raise MapError(f"it is {value:g}, not above 0")
    if not unit:
        left_out["speed limit signs without a unit, read in m/s"].append(sign.get("id", ""))
    return value * SPEED_UNITS[unit.lower()]


def _kind(element: ET.Element) -> SignalKind:
    given, dynamic = element.get("type", ""), element.get("dynamic")
    # Marks on the road, such as those of crosswalks, have similar types but are not dynamic.
    if dynamic == "yes" or (dynamic != "no" and given.startswith(LIGHT_TYPES)):
        return "traffic_light"
    if given in STOP_TYPES:
        return "stop"
    if given in YIELD_TYPES:
        return "yield"
    return "speed_limit" if given in SPEED_TYPES else "other"


def _joined(known: Signal, lanes: tuple[str, ...]) -> Signal:
    return replace(known, lanes=(*known.lanes, *lanes))


def _stop_line(name: str, element: ET.Element, road: OpenDriveRoad, line: Road) -> StopLine:
    """A stop line across all controlled lanes, at the position of the signal."""
    s = min(max(number(element, "s"), 0.0), line.length)
    lanes = _ruled(element, road, line)
    parts = [p for p in line.lanes if p.lane_id in lanes]
    rims = [float(np.interp(s, p.s, side)) for p in parts for side in (p.inner, p.outer)] or [
        -1.5,
        1.5,
    ]
    ends = line.sample(np.array([s, s]), np.array([min(rims), max(rims)]))[:, :3]
    return StopLine(name, ends, lanes)


def _with_stop_line(signal: Signal, stop_lines: Mapping[str, StopLine]) -> Signal:
    """The signal with the nearest stop line of its lanes."""
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
    roads: Mapping[str, OpenDriveRoad], lines: Mapping[str, Road], left_out: LeftOut
) -> list[Area]:
    """Crosswalks and parking spaces among the objects with an outline; ``left_out`` receives the
    others.
    """
    found: dict[str, Area] = {}
    kinds: dict[str, AreaKind] = {"crosswalk": "crosswalk", "parkingSpace": "parking"}
    for road_id, road in roads.items():
        for element in road.element.findall("objects/object"):
            kind = kinds.get(element.get("type", ""))
            if kind is None:
                continue
            name = f"{road_id}/{element.get('id', '')}"
            with left_out.damaged("crosswalks and parking spaces left out", name):
                if name in found:
                    raise MapError("its id is there twice")
                outline = _outline(element, lines[road_id])
                if len(outline) < 3:
                    raise MapError("has no outline of three points")
                found[name] = Area(name, kind, outline)
    return list(found.values())


def _outline(element: ET.Element, line: Road) -> Float:
    road_corners = list(element.iter("cornerRoad"))
    if road_corners:
        st = np.array([[number(c, "s"), number(c, "t")] for c in road_corners])
        corners: Float = line.sample(st[:, 0], st[:, 1])[:, :3]
        return corners
    corners_uv = [[number(c, "u"), number(c, "v")] for c in element.iter("cornerLocal")]
    if not corners_uv and element.get("length") and element.get("width"):
        u, v = number(element, "length") / 2, number(element, "width") / 2
        corners_uv = [[u, v], [-u, v], [-u, -v], [u, -v]]
    if not corners_uv:
        return np.zeros((0, 3))
    x, y, z, heading = line.at(number(element, "s"), number(element, "t"))
    heading += number(element, "hdg", 0.0)
    local = np.array(corners_uv)
    cos, sin = math.cos(heading), math.sin(heading)
    places = local @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
    return np.column_stack([places, np.full(len(places), z)])


SAME_PLACE_M = 1e-4


class OpenDriveReader:
    """Reads ``.xodr``: every lane of every lane section becomes a lane of the graph, named
    ``<road>.<section>.<lane>``, in its driving direction.

    Lanes with zero width are skipped. Road marks determine the allowed lane changes. Lateral shapes
    and heights of lanes above the road are not read.
    """

    name = "opendrive"
    expects = "a file .xodr of OpenDRIVE 1.4 to 1.8 (XML, root <OpenDRIVE>)"

    def recognises(self, path: Path) -> bool:
        """Whether the path is a file that begins like an OpenDRIVE file."""
        return path.is_file() and (path.suffix.lower() == ".xodr" or b"<OpenDRIVE" in head_of(path))

    def read(self, path: Path) -> LaneGraph:
        """The map in the coordinates of the file, without its <offset>.

        Raises:
            MapError: see :class:`~..reader.MapReader`.
        """
        root = read_map_xml(path, "OpenDRIVE")
        with damage_named(str(path)):
            return _Build.of(root, str(path)).graph(path.name)


@dataclass
class _Build:
    """State of reading a file into a graph."""

    root: ET.Element
    roads: dict[str, OpenDriveRoad]
    lines: dict[str, Road]
    left_out: LeftOut

    @classmethod
    def of(cls, root: ET.Element, file: str) -> _Build:
        left_out = LeftOut()
        _check_version(root, file, left_out)
        roads: dict[str, OpenDriveRoad] = {}
        lines: dict[str, Road] = {}
        given = root.findall("road")
        for element in given:
            road_id = element.get("id", "")
            if road_id in roads:
                left_out["roads left out because their id is there twice"].append(road_id)
                continue
            with left_out.damaged("roads left out because they cannot be read", road_id):
                road = read_road(element, left_out)
                lines[road_id], roads[road_id] = _line(road), road
        if not given:
            raise MapError(f"{file}: has no <road>")
        check_rest(file, "roads", roads, given, left_out)
        return cls(root, roads, lines, left_out)

    def graph(self, name: str) -> LaneGraph:
        found: dict[str, Lane] = {}
        for road in self.roads.values():
            for i, section in enumerate(road.sections):
                for lane in section.lanes.values():
                    key = lane_id(road.road_id, i, lane.number)
                    if not is_kept(lane):
                        self.left_out["lanes left out because they have no width"].append(key)
                        continue
                    with self.left_out.damaged("lanes left out because they cannot be read", key):
                        found[key] = self._lane(road, i, lane)
        if not found:
            told = "; ".join(notes_of(self.left_out))
            raise MapError(f"{name}: none of its lanes can be read ({told})")
        found = self._joined(self._beside(found))
        lines = {k: self._with_lanes(k, found) for k, road in self.lines.items()}
        signals, stop_lines = read_signals(self.roads, lines, self.left_out)
        groups = read_controllers(self.root, {s.signal_id for s in signals}, self.left_out)
        return LaneGraph.of(
            found.values(),
            areas=read_crossings(self.roads, lines, self.left_out),
            stop_lines=stop_lines,
            signals=[replace(s, group=groups.get(s.signal_id)) for s in signals],
            roads=lines.values(),
            source=f"opendrive {name}",
            geo_reference=_geo_reference(self.root, self.left_out),
            notes=notes_of(self.left_out),
        )

    def _lane(self, road: OpenDriveRoad, index: int, lane: SectionLane) -> Lane:
        line, section = self.lines[road.road_id], road.sections[index]
        inner = line.sample(section.s, lane.inner)[:, :3]
        outer = line.sample(section.s, lane.outer)[:, :3]
        widths = np.abs(lane.outer - lane.inner)
        centre = (inner + outer) / 2
        if not runs_along(road, lane):
            centre, widths = centre[::-1], widths[::-1]
        steps = np.linalg.norm(np.diff(centre[:, :2], axis=0), axis=1)
        kept = np.concatenate([[True], steps > SAME_PLACE_M])
        if kept.sum() < 2:
            raise MapError("has no length")
        kept[-1] = True
        if steps[-1] <= SAME_PLACE_M:  # the end counts, not a point just before it
            kept[-2] = kept.sum() == 2
        return Lane(
            lane_id(road.road_id, index, lane.number),
            lane.kind,
            centre[kept],
            widths[kept],
            speed_limit=lane.speed_limit,
            junction=road.junction,
        )

    def _beside(self, lanes: dict[str, Lane]) -> dict[str, Lane]:
        """Lanes with their neighbours: those of the same direction, and the first opposite one."""
        found = dict(lanes)
        for road in self.roads.values():
            for i, section in enumerate(road.sections):
                for n, lane in section.lanes.items():
                    key = lane_id(road.road_id, i, n)
                    if key in found:
                        found[key] = _with_neighbours(found, key, road, i, lane)
        return found

    def _joined(self, lanes: dict[str, Lane]) -> dict[str, Lane]:
        onward: dict[str, list[str]] = {key: [] for key in lanes}
        junctions = self.root.findall("junction")
        pairs = joined_ends(self.roads, junctions, self.left_out)
        for pair in sorted(sorted(p) for p in pairs):
            for a, b in (pair, pair[::-1]):
                before, after = _key(a), _key(b)
                if before not in lanes or after not in lanes:
                    continue
                if self._leaves(a) and not self._leaves(b):
                    onward[before].append(after)
        return {k: replace(lane, successors=tuple(onward[k])) for k, lane in lanes.items()}

    def _leaves(self, end: LaneEnd) -> bool:
        """Whether traffic leaves its lane at this end."""
        road = self.roads[end.road]
        lane = road.sections[end.section].lanes[end.number]
        return runs_along(road, lane) == (end.end == "end")

    def _with_lanes(self, road_id: str, lanes: dict[str, Lane]) -> Road:
        road = self.roads[road_id]
        parts = [
            RoadLane(n, key, section.s, lane.inner, lane.outer)
            for i, section in enumerate(road.sections)
            for n, lane in section.lanes.items()
            if (key := lane_id(road_id, i, n)) in lanes
        ]
        return replace(self.lines[road_id], lanes=tuple(parts))


def lane_id(road: str, section: int, number: int) -> str:
    """Name of a lane in the graph."""
    return f"{road}.{section}.{number}"


def runs_along(road: OpenDriveRoad, lane: SectionLane) -> bool:
    """Whether traffic on the lane drives towards increasing s."""
    return ((lane.number < 0) == road.drives_right) != lane.reversed


def is_kept(lane: SectionLane) -> bool:
    """Whether a lane has a width anywhere."""
    return bool(np.abs(lane.outer - lane.inner).max() > 1e-3)


def _key(end: LaneEnd) -> str:
    return lane_id(end.road, end.section, end.number)


def _line(road: OpenDriveRoad) -> Road:
    plan = road.plan.at(road.s)
    points = np.column_stack([plan[:, :2], road.elevation.at(road.s)])
    return Road(
        road.road_id,
        road.s,
        points,
        plan[:, 2],
        road.roll.at(road.s),
        junction=road.junction,
        drives_right=road.drives_right,
    )


def _with_neighbours(
    lanes: dict[str, Lane], key: str, road: OpenDriveRoad, index: int, lane: SectionLane
) -> Lane:
    along = runs_along(road, lane)
    there = road.sections[index].lanes

    def beside(step: int) -> tuple[int, str | None, bool]:
        n = lane.number + step
        n = n + step if n == 0 else n
        name = lane_id(road.road_id, index, n)
        other = there.get(n)
        if other is None or name not in lanes:
            return n, None, False
        return n, name, runs_along(road, other) == along

    # Numbers increase to the left of the reference line, and to the right of a lane in the opposite
    # direction.
    (left_n, left, same_left), (right_n, right, same_right) = (
        beside(step) for step in ((1, -1) if along else (-1, 1))
    )
    return replace(
        lanes[key],
        left=left if same_left else None,
        right=right if same_right else None,
        opposite=left if left is not None and not same_left else None,
        may_change_left=_may_cross(there, lane.number, left_n),
        may_change_right=_may_cross(there, lane.number, right_n),
    )


def _may_cross(lanes: dict[int, SectionLane], own: int, other: int) -> bool:
    """Whether the marking between two lanes may be crossed. It is the outer marking of the lane
    nearer to the reference line."""
    nearer = lanes.get(min(own, other, key=abs))
    if nearer is None or own * other < 0:
        return True
    return nearer.may_increase if other > own else nearer.may_decrease


def _check_version(root: ET.Element, file: str, left_out: LeftOut) -> None:
    header = root.find("header")
    major, minor = (
        "" if header is None else header.get(name, "").strip() for name in ("revMajor", "revMinor")
    )
    known = major.isdecimal() and minor.isdecimal()
    if known and (int(major) != 1 or int(minor) < 1):
        raise MapError(f"{file}: is of OpenDRIVE {major}.{minor}; 1.4 to 1.8 can be read")
    if not known:
        given = f"{major or '?'}.{minor or '?'}"
        left_out["headers without a version, read as OpenDRIVE 1.8"].append(given)


def _geo_reference(root: ET.Element, left_out: LeftOut) -> str:
    """Projection of the file, and the offset between its coordinates and the projection.

    The offset is not applied, because scenes need small coordinates.
    """
    text = " ".join((root.findtext("header/geoReference") or "").split())[:4000]
    offset = root.find("header/offset")
    if offset is None:
        return text
    with left_out.damaged("offsets of the header that cannot be read", "<offset>"):
        x, y, z, heading = (number(offset, n, 0.0) for n in ("x", "y", "z", "hdg"))
        return f"{text} offset x={x} y={y} z={z} hdg={heading}".strip()
    return text
