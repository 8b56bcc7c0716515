"""Lanelet2 maps as OSM-XML. Source: Poggenhans et al. 2018 and the tagging rules of Lanelet2."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from real2sim_proto.lanes import AreaKind, LaneKind, SignalKind

from ..geometry import Float
from ..scene import Area, Lane, LaneGraph, Signal, StopLine
from ..scene.errors import LeftOut
from .reader import (
    MapError,
    between,
    check_rest,
    damage_named,
    head_of,
    joined,
    number,
    read_map_xml,
)

EARTH_M = 6_378_137.0
KINDS: dict[str, LaneKind] = {
    "road": "driving",
    "highway": "driving",
    "play_street": "driving",
    "emergency_lane": "shoulder",
    "road_shoulder": "shoulder",
    "bus_lane": "bus",
    "bicycle_lane": "bicycle",
    "walkway": "sidewalk",
    "shared_walkway": "sidewalk",
}
AREAS: dict[str, AreaKind] = {
    "crosswalk": "crosswalk",
    "parking": "parking",
    "freespace": "drivable",
    "walkway": "sidewalk",
    "intersection_area": "junction",
}
GERMAN_LIMIT = re.compile(r"^de274(?:[._]1)?(?:-([0-9]+))?$")
"""Sign number in the German catalogue of 2017; its last part is the limit [km/h], 30 without it."""
TOWN_SIGN, TOWN_KMH = "de310", 50.0
GERMAN_KMH = {
    ("road", "urban"): 50.0,
    ("road", "nonurban"): 100.0,
    ("bus_lane", "urban"): 50.0,
    ("bus_lane", "nonurban"): 100.0,
    ("exit", "urban"): 50.0,
    ("highway", ""): 130.0,
    ("play_street", ""): 7.0,
}
"""Limits by subtype and location in Lanelet2's traffic rules for Germany; "" is any location."""
SIGN_LIMIT = re.compile(
    r"^(?:(?P<mph>us|gb)|de|at|fr|nl|pl)[: ]?"
    r"(?:274(?:\.1)?|R2-1|670|52\.?a?10a|B14|A0?1|B-?33)(?:[-:_]V?|[\[(]V?)(?P<limit>[0-9]{1,3})[\])]?$",
    re.IGNORECASE,
)
"""Signs of other countries and notations, such as ``usR2-1-35`` and ``DE:274[60]``."""
SPEED = re.compile(r"^\s*([0-9]+(?:\.[0-9]*)?)\s*(km/h|kmh|kph|mph|m/s|mps)?\s*$", re.IGNORECASE)
UNITS = {
    "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704, "m/s": 1.0, "mps": 1.0,
    "": 1 / 3.6,
}  # fmt: skip


class Lanelet2Reader:
    """Reads lanelets as lanes.

    Order, neighbours and junctions follow from shared points and borders; lights, stop lines and
    right of way from regulatory elements; speed limits from them, from tags or, with a note, from
    the kind of road in Germany. Positions are ``local_x``, ``local_y`` and
    ``ele`` of the nodes if present, otherwise latitude and longitude on a plane about the centre of
    the file (accurate to some centimetres over a few kilometres). Elements that an editor has
    marked as deleted are ignored.
    """

    name = "lanelet2"
    expects = "a file .osm of Lanelet2 (XML, root <osm>, relations of type lanelet)"

    def recognises(self, path: Path) -> bool:
        """Whether it is an OSM file."""
        return path.is_file() and (path.suffix.lower() == ".osm" or b"<osm" in head_of(path))

    def read(self, path: Path) -> LaneGraph:
        """The map in the frame of the file. Raises MapError: see :class:`~.reader.MapReader`."""
        root = read_map_xml(path, "osm")
        with damage_named(str(path)):
            osm = _Osm.of(root, str(path))
            return _graph(osm, path.name)


@dataclass
class _Relation:
    tags: dict[str, str]
    members: dict[str, list[tuple[str, str]]]


@dataclass
class _Osm:
    """A file's nodes as positions, ways as node ids, and relations."""

    file: str
    places: dict[str, Float]
    ways: dict[str, list[str]]
    way_tags: dict[str, dict[str, str]]
    relations: dict[str, _Relation]
    origin: str = ""
    way_of: dict[tuple[str, ...], str] = field(default_factory=dict)
    left_out: LeftOut = field(default_factory=LeftOut)

    @classmethod
    def of(cls, root: ET.Element, file: str) -> _Osm:
        left_out = LeftOut()
        nodes, drawn, related = (
            _kept(root, kind, left_out) for kind in ("node", "way", "relation")
        )
        ways = {w.get("id", ""): [n.get("ref", "") for n in w.findall("nd")] for w in drawn}
        places, origin = _places(nodes, left_out)
        for way_id, refs in ways.items():
            if not all(node in places for node in refs):
                ways[way_id] = [node for node in refs if node in places]
                left_out["ways read without nodes that are not there"].append(way_id)
        relations = {}
        for element in related:
            members: dict[str, list[tuple[str, str]]] = defaultdict(list)
            for m in element.findall("member"):
                members[m.get("role", "")].append((m.get("type", ""), m.get("ref", "")))
            relations[element.get("id", "")] = _Relation(_tags(element), members)
        known: dict[str, set[str]]
        known = {"node": set(places), "way": set(ways), "relation": set(relations)}
        for key, relation in relations.items():
            if relation.tags.get("type") in ("lanelet", "regulatory_element", "multipolygon"):
                left_out["relations read without members that are not there"] += [
                    f"{key} without {kind} {ref}"
                    for named in relation.members.values()
                    for kind, ref in named
                    if ref not in known.get(kind, {ref})
                ]
        tags = {w.get("id", ""): _tags(w) for w in drawn}
        way_of = {tuple(refs): way for way, refs in ways.items()}
        return cls(file, places, ways, tags, relations, origin, way_of, left_out)

    def line(self, way_id: str) -> Float:
        """Points [N, 3] of a way."""
        return np.array([self.places[n] for n in self.ways[way_id]]).reshape(-1, 3)

    def member_ways(self, relation: _Relation, role: str) -> list[str]:
        """Existing ways with a role."""
        named = relation.members.get(role, ())
        return [ref for kind, ref in named if kind == "way" and ref in self.ways]


def _kept(root: ET.Element, kind: str, left_out: LeftOut) -> list[ET.Element]:
    """Elements of a kind, the first of each id, without those that JOSM or an OSM server has marked
    as deleted.
    """
    found: dict[str, ET.Element] = {}
    for element in root.findall(kind):
        if element.get("action") == "delete" or element.get("visible") == "false":
            continue
        key = element.get("id", "")
        if found.setdefault(key, element) is not element:
            left_out[f"{kind}s left out because their id is there twice"].append(key)
    return list(found.values())


def _tags(element: ET.Element) -> dict[str, str]:
    return {t.get("k", ""): t.get("v", "") for t in element.findall("tag")}


def _places(nodes: Iterable[ET.Element], left_out: LeftOut) -> tuple[dict[str, Float], str]:
    """Positions of nodes: local ones if most have them, else on a plane about their centre."""
    local: dict[str, Float] = {}
    degrees: dict[str, tuple[float, float, float]] = {}
    for node in nodes:
        key, tags = node.get("id", ""), _tags(node)
        with left_out.damaged("nodes left out because they cannot be read", key):
            height = _value(tags, "ele", "0")
            if "local_x" in tags and "local_y" in tags:
                local[key] = np.array([_value(tags, "local_x"), _value(tags, "local_y"), height])
                continue
            lat, lon = number(node, "lat"), number(node, "lon")
            if abs(lat) > 89 or abs(lon) > 361:
                raise MapError(f"latitude {lat}, longitude {lon}")
            degrees[key] = (lat, lon, height)
    if local and len(local) >= len(degrees):
        left_out["nodes left out because they lack local_x and local_y"] += degrees
        return local, ""
    left_out["nodes left out because few others have local_x and local_y"] += local
    if not degrees:
        return {}, ""
    found: dict[str, Float] = {}
    lat0, lon0 = np.array([(a, b) for a, b, _ in degrees.values()]).mean(axis=0).tolist()
    scale = math.radians(1) * EARTH_M
    for name, (lat, lon, height) in degrees.items():
        x = (lon - lon0) * scale * math.cos(math.radians(lat0))
        found[name] = np.array([x, (lat - lat0) * scale, height])
    return found, f"+proj=eqc +lat_ts={lat0!r} +lat_0={lat0!r} +lon_0={lon0!r} +R={EARTH_M}"


def _value(tags: dict[str, str], name: str, default: str = "") -> float:
    text = tags.get(name, default)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) < 1e9:
        raise MapError(f"{name} is {text[:60]!r}, not a number")
    return value


def _graph(osm: _Osm, name: str) -> LaneGraph:
    lanelets = {k: r for k, r in osm.relations.items() if r.tags.get("type") == "lanelet"}
    rims = {}
    for key, relation in lanelets.items():
        if (pair := _rims(osm, relation)) is not None:
            rims[key] = pair
        else:
            osm.left_out["lanelets left out because they lack a rim"].append(key)
    lanes: dict[str, Lane] = {}
    areas: dict[str, Area] = {}
    index = _Index(rims)
    for key, pair in rims.items():
        with osm.left_out.damaged("lanelets left out because they cannot be read", key):
            if lanelets[key].tags.get("subtype") == "crosswalk":
                left, right = _oriented(osm, *pair)
                areas[key] = Area(key, "crosswalk", np.concatenate([left, right[::-1]]))
            else:
                lanes[key] = _lane(osm, key, lanelets[key], index)
    if not lanelets:
        raise MapError(f"{osm.file}: has no lanelets, relations of type lanelet with two rims")
    check_rest(osm.file, "lanelets", {**lanes, **areas}, lanelets, osm.left_out)
    if not lanes:
        raise MapError(f"{osm.file}: has no lanelets except crosswalks")
    for key, relation in osm.relations.items():
        with osm.left_out.damaged("areas left out because they cannot be read", key):
            if (area := _area(osm, key, relation)) is not None:
                areas[area.area_id] = area
    stop_lines, signals = _rules(osm, lanelets, set(lanes))
    return joined(
        lanes.values(), osm.left_out, areas=areas.values(), stop_lines=stop_lines, signals=signals,
        source=f"lanelet2 {name}", geo_reference=osm.origin,
    )  # fmt: skip


def _lane(osm: _Osm, key: str, relation: _Relation, index: _Index) -> Lane:
    left, right = index.rims[key]
    shape, beside = between(*_oriented(osm, left, right)), index.beside(key)
    if shape is None:
        raise MapError("has no length")
    return Lane(
        key,
        KINDS.get(relation.tags.get("subtype", "road"), "other"),
        *shape,
        speed_limit=_speed_limit(osm, key, relation),
        may_change_left=_may_cross(osm, left, "left"),
        may_change_right=_may_cross(osm, right, "right"),
        junction="intersection" if "turn_direction" in relation.tags else None,
        left=beside["left"],
        right=beside["right"],
        opposite=beside["opposite"],
        successors=index.successors(key),
    )


def _rims(osm: _Osm, relation: _Relation) -> tuple[list[str], list[str]] | None:
    """Node ids of both borders, each of one or several consecutive ways."""
    sides = [_chained(osm, osm.member_ways(relation, side)) for side in ("left", "right")]
    if any(len(side) < 2 for side in sides):
        return None
    left, right = sides
    # If the borders run in opposite directions, the right one is reversed. The left border on the
    # left side then determines the direction of traffic.
    a, b, c, d = (osm.places[n] for n in (left[0], left[-1], right[0], right[-1]))
    as_they_are = np.linalg.norm(a - c) + np.linalg.norm(b - d)
    if as_they_are > np.linalg.norm(a - d) + np.linalg.norm(b - c):
        right = right[::-1]
    middle = (osm.places[left[0]] + osm.places[right[0]]) / 2
    ahead = (osm.places[left[-1]] + osm.places[right[-1]]) / 2 - middle
    across = osm.places[left[0]] - osm.places[right[0]]
    if np.linalg.norm(across[:2]) < 1e-6:
        across = osm.places[left[-1]] - osm.places[right[-1]]
    if ahead[0] * across[1] - ahead[1] * across[0] < 0:
        left, right = left[::-1], right[::-1]
    return left, right


def _chained(osm: _Osm, ways: list[str]) -> list[str]:
    """Nodes of connected ways, from one end to the other; the others are left out with a note."""
    if not ways:
        return []
    nodes = list(osm.ways[ways[0]])
    rest = ways[1:]
    while rest:
        for way in rest:
            other = osm.ways[way]
            if not other or not nodes:
                continue
            if other[0] == nodes[-1]:
                nodes += other[1:]
            elif other[-1] == nodes[-1]:
                nodes += other[-2::-1]
            elif other[-1] == nodes[0]:
                nodes = other[:-1] + nodes
            elif other[0] == nodes[0]:
                nodes = other[:0:-1] + nodes
            else:
                continue
            rest.remove(way)
            break
        else:
            osm.left_out["ways left out because they do not continue a border"] += rest
            return nodes
    return nodes


def _oriented(osm: _Osm, left: list[str], right: list[str]) -> tuple[Float, Float]:
    one, other = (np.array([osm.places[n] for n in rim]) for rim in (left, right))
    return one, other


class _Index:
    """Lanelets by their first nodes, and by their borders in driving direction."""

    def __init__(self, rims: dict[str, tuple[list[str], list[str]]]) -> None:
        self.rims = rims
        self.starts: dict[tuple[str, str], list[str]] = defaultdict(list)
        self.left: dict[tuple[str, ...], list[str]] = defaultdict(list)
        self.right: dict[tuple[str, ...], list[str]] = defaultdict(list)
        for key, (left, right) in rims.items():
            self.starts[left[0], right[0]].append(key)
            self.left[tuple(left)].append(key)
            self.right[tuple(right)].append(key)

    def successors(self, key: str) -> tuple[str, ...]:
        """Lanelets that begin at the end of another one."""
        left, right = self.rims[key]
        return tuple(n for n in self.starts.get((left[-1], right[-1]), ()) if n != key)

    def beside(self, key: str) -> dict[str, str | None]:
        """Neighbours that share a border."""
        left, right = (tuple(rim) for rim in self.rims[key])
        found = {
            "left": self.right.get(left, ()),
            "right": self.left.get(right, ()),
            "opposite": self.left.get(left[::-1], ()),
        }
        return {side: next((n for n in names if n != key), None) for side, names in found.items()}


def _may_cross(osm: _Osm, rim: list[str], side: str) -> bool:
    """Whether the marking of a border allows a lane change."""
    way = osm.way_of.get(tuple(rim))
    turned = way is None
    way = way or osm.way_of.get(tuple(reversed(rim)))
    tags = osm.way_tags.get(way, {}) if way else {}
    towards = "right" if (side == "right") != turned else "left"  # seen along the way
    for name in ("lane_change", f"lane_change:{towards}"):
        if name in tags:
            return tags[name] in ("yes", "true")
    kind, subtype = tags.get("type", ""), tags.get("subtype", "")
    if kind in ("curbstone", "guard_rail", "wall", "fence", "road_border"):
        return False
    if subtype == "dashed_solid":  # dashed on the left of the way
        return (side == "right") != turned
    if subtype == "solid_dashed":
        return (side == "left") != turned
    return not subtype.startswith("solid")


def _speed_limit(osm: _Osm, key: str, relation: _Relation) -> float | None:
    """The limit of the first regulatory element or of the tags of the lanelet, else the German one
    of its kind of road.
    """
    texts = []
    for _, ref in relation.members.get("regulatory_element", ()):
        rule = osm.relations.get(ref)
        if rule is not None and rule.tags.get("subtype") == "speed_limit":
            signs = osm.member_ways(rule, "refers")
            texts += [osm.way_tags[way].get("subtype", "") for way in signs]
            texts += [rule.tags.get(name, "") for name in ("sign_type", "limit")]
    cars = ("speed_limit:vehicle:car", "speed_limit:vehicle", "speed_limit")
    texts += [relation.tags.get(name, "") for name in cars]
    for text in texts:
        if (limit := _speed(text)) is not None:
            return limit
    if unknown := next((text for text in texts if text), None):
        osm.left_out[f"lanes without a speed limit because {unknown[:40]!r} is not known"].append(
            key
        )
        return None
    tags = relation.tags
    kinds = ((tags.get("subtype", "road"), where) for where in (tags.get("location"), ""))
    limit = next((GERMAN_KMH[kind] for kind in kinds if kind in GERMAN_KMH), None)
    if limit is None or not tags.get("region", "de").lower().startswith("de"):
        return None
    osm.left_out["lanes with the speed limit of their kind of road in Germany"].append(key)
    return limit / 3.6


def _speed(text: str) -> float | None:
    """A speed limit [m/s], from a speed with its unit (km/h by default) or from a sign."""
    if text.strip() == TOWN_SIGN:
        return TOWN_KMH / 3.6
    if sign := GERMAN_LIMIT.match(text.strip()):
        limit = int(sign[1] or 30)
        known = limit in (5, 15) or (0 < limit <= 130 and limit % 10 == 0)
        return limit / 3.6 if known else None
    if sign := SIGN_LIMIT.match(text.strip()):
        return (int(sign["limit"]) * UNITS["mph" if sign["mph"] else "km/h"]) or None
    found = SPEED.match(text)
    return float(found[1]) * UNITS[(found[2] or "").lower()] or None if found else None


def _area(osm: _Osm, key: str, relation: _Relation) -> Area | None:
    if relation.tags.get("type") != "multipolygon":
        return None
    nodes = _chained(osm, osm.member_ways(relation, "outer"))
    nodes = nodes[:-1] if len(nodes) > 1 and nodes[0] == nodes[-1] else nodes
    if len(nodes) < 3:
        osm.left_out["areas left out because they have fewer than three points"].append(key)
        return None
    kind = AREAS.get(relation.tags.get("subtype", ""), "other")
    return Area(f"area_{key}", kind, np.array([osm.places[n] for n in nodes]))


def _rules(
    osm: _Osm, lanelets: dict[str, _Relation], lanes: set[str]
) -> tuple[list[StopLine], list[Signal]]:
    """Stop lines and signals of regulatory elements, with the lanes that refer to them."""
    ruled: dict[str, list[str]] = defaultdict(list)
    for key, lanelet in lanelets.items():
        for _, ref in lanelet.members.get("regulatory_element", ()):
            if key in lanes:
                ruled[ref].append(key)
    lines: dict[str, StopLine] = {}
    signals: dict[str, Signal] = {}
    for key, rule in osm.relations.items():
        kind = _signal_kind(rule)
        if rule.tags.get("type") != "regulatory_element" or kind is None:
            continue
        waiting = ruled.get(key, [])
        if kind == "yield":  # right of way: yielding lanes wait
            waiting = [r for _, r in rule.members.get("yield", ()) if r in lanes]
        stop = next(iter(osm.member_ways(rule, "ref_line")), None)
        if stop is not None and len(osm.ways[stop]) >= 2:
            known = lines.get(stop)
            both = (*(known.lanes if known else ()), *waiting)
            with osm.left_out.damaged("stop lines left out because they cannot be read", stop):
                lines[stop] = StopLine(stop, osm.line(stop), both)
        refers = osm.member_ways(rule, "refers") or ([stop] if stop is not None else [])
        if not refers or not len(osm.ways[refers[0]]):
            osm.left_out["signals left out because they have no place"].append(key)
            continue
        line = osm.line(refers[0])
        x, y, z = line.mean(axis=0).tolist()
        along = line[-1] - line[0]
        with osm.left_out.damaged("signals left out because they cannot be read", key):
            signals[key] = Signal(
                key, kind, (x, y, z), math.atan2(along[1], along[0]) - math.pi / 2, tuple(waiting),
                stop if stop in lines else None,
            )  # fmt: skip
    return list(lines.values()), list(signals.values())


def _signal_kind(rule: _Relation) -> SignalKind | None:
    subtype = rule.tags.get("subtype", "")
    if subtype == "traffic_sign":
        sign = rule.tags.get("sign_type", "")
        return "stop" if sign in ("de206", "usR1-1") else "yield" if sign == "de205" else "other"
    kinds: dict[str, SignalKind] = {
        "traffic_light": "traffic_light",
        "right_of_way": "yield",
        "all_way_stop": "stop",
    }
    return kinds.get(subtype)
