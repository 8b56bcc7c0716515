"""OpenDRIVE 1.4 to 1.8 as a lane graph. Source: ASAM OpenDRIVE 1.8.1."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...scene.lane import Lane
from ...scene.lane_graph import LaneGraph
from ...scene.road import Road, RoadLane
from ..errors import MapError, damage_named
from ..xml_files import head_of, number, read_xml
from .links import LaneEnd, joined_ends
from .roads import OpenDriveRoad, SectionLane, read_road
from .signals import read_crossings, read_signals

SAME_PLACE_M = 1e-4


class OpenDriveReader:
    """Reads ``.xodr``: every lane of every lane section becomes a lane of the graph, called
    ``<road>.<section>.<lane>``, in the direction that its traffic drives.

    Lanes with no width anywhere are left out. Road marks say where lanes may be changed; lateral
    shapes and heights of lanes above the road are not read.
    """

    name = "opendrive"
    expects = "a file .xodr of OpenDRIVE 1.4 to 1.8 (XML, root <OpenDRIVE>)"

    def recognises(self, path: Path) -> bool:
        """Whether it is a file that begins as one of OpenDRIVE."""
        return path.is_file() and (path.suffix == ".xodr" or b"<OpenDRIVE" in head_of(path))

    def read(self, path: Path) -> LaneGraph:
        """The map in the coordinates of the file, without its <offset>.

        Raises:
            MapError: see :class:`~..reader.MapReader`.
        """
        root = read_xml(path, "OpenDRIVE")
        with damage_named(str(path)):
            return _Build.of(root, str(path)).graph(path.name)


@dataclass
class _Build:
    """What is known of a file on the way to its graph."""

    file: str
    root: ET.Element
    roads: dict[str, OpenDriveRoad]
    lines: dict[str, Road]

    @classmethod
    def of(cls, root: ET.Element, file: str) -> _Build:
        _check_version(root, file)
        roads: dict[str, OpenDriveRoad] = {}
        for element in root.findall("road"):
            road = read_road(element, file)
            if road.road_id in roads:
                raise MapError(f"{file}: road {road.road_id!r} is there twice")
            roads[road.road_id] = road
        if not roads:
            raise MapError(f"{file}: has no <road>")
        return cls(file, root, roads, {k: _line(r) for k, r in roads.items()})

    def graph(self, name: str) -> LaneGraph:
        made = (
            self._lane(road, i, lane)
            for road in self.roads.values()
            for i, section in enumerate(road.sections)
            for lane in section.lanes.values()
            if is_kept(lane)
        )
        found = {lane.lane_id: lane for lane in made if lane is not None}
        if not found:
            raise MapError(f"{self.file}: none of its lanes has a width")
        found = self._joined(self._beside(found))
        lines = {k: self._with_lanes(k, found) for k, road in self.lines.items()}
        signals, stop_lines = read_signals(self.roads, lines, self.file)
        return LaneGraph.of(
            found.values(),
            areas=read_crossings(self.roads, lines, self.file),
            stop_lines=stop_lines,
            signals=signals,
            roads=lines.values(),
            source=f"opendrive {name}",
            geo_reference=_geo_reference(self.root, self.file),
        )

    def _lane(self, road: OpenDriveRoad, index: int, lane: SectionLane) -> Lane | None:
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
            return None
        kept[-1] = True
        if steps[-1] <= SAME_PLACE_M:  # the end counts, not what lies just before it
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
        """Lanes with their neighbours: of the same direction, and the first of the other."""
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
        pairs = joined_ends(self.roads, self.root.findall("junction"), self.file)
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

    # Numbers grow to the left of the reference line; of a lane that runs against it, to its right.
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
    """Whether the mark between two lanes may be crossed: it belongs to the outer one's inner rim,
    that is to the lane nearer to the reference line."""
    nearer = lanes.get(min(own, other, key=abs))
    if nearer is None or own * other < 0:
        return True
    return nearer.may_increase if other > own else nearer.may_decrease


def _check_version(root: ET.Element, file: str) -> None:
    header = root.find("header")
    if header is None:
        raise MapError(f"{file}: has no <header>")
    major, minor = header.get("revMajor", ""), header.get("revMinor", "")
    if major != "1" or not minor.isdecimal() or int(minor) < 1:
        raise MapError(
            f"{file}: is of OpenDRIVE {major or '?'}.{minor or '?'}; 1.4 to 1.8 can be read"
        )


def _geo_reference(root: ET.Element, file: str) -> str:
    """Projection of the file, and what is to be added to its coordinates for it.

    Coordinates stay those of the file: scenes ask for small ones.
    """
    text = " ".join((root.findtext("header/geoReference") or "").split())[:4000]
    offset = root.find("header/offset")
    if offset is None:
        return text
    x, y, z, heading = (number(offset, n, file, 0.0) for n in ("x", "y", "z", "hdg"))
    return f"{text} offset x={x} y={y} z={z} hdg={heading}".strip()
