"""Which lanes of an OpenDRIVE file go on as which: lane links, road links, junctions."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from ..errors import MapError
from ..xml_files import integer
from .roads import OpenDriveRoad


class LaneEnd(NamedTuple):
    """One end of a lane of a section: ``end`` is "start" or "end" along the road."""

    road: str
    section: int
    number: int
    end: str


ENDS = {"predecessor": "start", "successor": "end"}


def joined_ends(
    roads: Mapping[str, OpenDriveRoad], junctions: list[ET.Element], file: str
) -> set[frozenset[LaneEnd]]:
    """Pairs of lane ends that meet, whichever way traffic crosses them.

    Raises:
        MapError: a junction names a road that is not there.
    """
    found: set[frozenset[LaneEnd]] = set()
    for road in roads.values():
        for pair in (*_within(road), *_to_roads(road, roads)):
            found.add(frozenset(pair))
    for junction in junctions:
        for pair in _through(junction, roads, file):
            found.add(frozenset(pair))
    there = {
        LaneEnd(r.road_id, i, n, end)
        for r in roads.values()
        for i, section in enumerate(r.sections)
        for n in section.lanes
        for end in ("start", "end")
    }
    return {pair for pair in found if len(pair) == 2 and pair <= there}


def _within(road: OpenDriveRoad) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    """From section to section of a road, as either side says."""
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
    """From the ends of a road to the roads that its links name."""
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
    junction: ET.Element, roads: Mapping[str, OpenDriveRoad], file: str
) -> Iterator[tuple[LaneEnd, LaneEnd]]:
    """From the roads that lead to a junction to those that cross it."""
    name = junction.get("id", "")
    where = f"{file}: junction {name!r}"
    for connection in junction.findall("connection"):
        incoming = connection.get("incomingRoad")
        crossing = connection.get("connectingRoad") or connection.get("linkedRoad")
        if incoming is None or crossing is None:
            continue
        for road_id in (incoming, crossing):
            if road_id not in roads:
                raise MapError(f"{where}: names road {road_id!r}, which the file does not have")
        contact = connection.get("contactPoint", "start")
        leaves = _facing_end(roads[incoming], roads[crossing], contact, name)
        for link in connection.findall("laneLink"):
            a, b = (integer(link, n, where) for n in ("from", "to"))
            yield _end_of(roads[incoming], leaves, a), _end_of(roads[crossing], contact, b)


def _facing_end(
    incoming: OpenDriveRoad, crossing: OpenDriveRoad, contact: str, junction: str
) -> str:
    """The end of the incoming road that meets the crossing one."""
    link = crossing.links.get("predecessor" if contact == "start" else "successor")
    if link is not None and link.kind == "road" and link.element == incoming.road_id:
        return link.contact
    after = incoming.links.get("successor")
    faces = after is not None and after.kind == "junction" and after.element == junction
    return "end" if faces else "start"


def _end_of(road: OpenDriveRoad, contact: str, lane: int) -> LaneEnd:
    section = 0 if contact == "start" else len(road.sections) - 1
    return LaneEnd(road.road_id, section, lane, contact)
