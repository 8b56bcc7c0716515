"""nuScenes' map expansion (``maps/expansion/<location>.json``), in its location's frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from real2sim_proto.lanes import AreaKind

from ..geometry import Float
from ..scene import Area, Lane, LaneGraph, Signal, StopLine
from ..scene.errors import LeftOut
from .reader import (
    MapError,
    check_rest,
    damage_named,
    head_of,
    joined,
    read_json,
)

STEP_M = 1.0
MAX_PIECE_M = 10_000.0
WIDTHS_M, USUAL_WIDTH_M = (2.0, 8.0), 3.5
AREAS: dict[str, AreaKind] = {"ped_crossing": "crosswalk", "carpark_area": "parking"}


class NuScenesMapReader:
    """Reads lanes and lane connectors along their arcs, drivable areas, crossings, stop lines and
    traffic lights. Widths are the areas of the lanes' polygons divided by their lengths. The maps
    contain neither speed limits nor adjacent lanes.
    """

    name = "nuscenes"
    expects = "a file of nuScenes' map expansion, such as maps/expansion/boston-seaport.json"

    def recognises(self, path: Path) -> bool:
        """Whether the path is a JSON file that starts with tables of the expansion."""
        if not path.is_file() or path.suffix.lower() != ".json":
            return False
        head = head_of(path)
        return b'"polygon"' in head or b'"arcline_path_3"' in head

    def read(self, path: Path) -> LaneGraph:
        """The map in the frame of its location.

        Raises:
            MapError: see :class:`~.reader.MapReader`.
        """
        content = read_json(path)
        with damage_named(str(path)):
            tables = _Tables(content)
            lanes = tables.lanes()
            given = [*tables.rows("lane"), *tables.rows("lane_connector")]
            if not given:
                raise MapError(f"{path}: has no lanes")
            check_rest(str(path), "lanes", lanes, given, tables.left_out)
            stop_lines = tables.stop_lines(lanes)
            return joined(
                lanes,
                tables.left_out,
                areas=tables.areas(),
                stop_lines=stop_lines,
                signals=tables.signals(stop_lines),
                source=f"nuscenes {path.name}",
            )


class _Tables:
    def __init__(self, content: dict[str, Any]) -> None:
        self.content = content
        self.left_out = LeftOut()
        self.nodes: dict[str, tuple[float, float, float]] = {}
        self.rings: dict[str, Float] = {}
        for name, n in self._read("node"):
            with self.left_out.damaged("nodes left out because they cannot be read", name):
                self.nodes[n["token"]] = (float(n["x"]), float(n["y"]), 0.0)
        for name, p in self._read("polygon"):
            with self.left_out.damaged("polygons left out because they cannot be read", name):
                ring = [self.nodes[node] for node in p["exterior_node_tokens"]]
                self.rings[p["token"]] = np.array(ring).reshape(-1, 3)

    def _read(self, table: str) -> Iterator[tuple[str, dict[str, Any]]]:
        """Names and rows of a table."""
        for i, row in enumerate(self.rows(table)):
            known = isinstance(row, dict) and "token" in row
            yield str(row["token"]) if known else f"row {i}", row

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Rows of a table; empty if the file lacks the table."""
        found: Any = self.content.get(name, [])
        if isinstance(found, list):
            return found
        self.left_out["tables left out because they are not lists"].append(name)
        return []

    def lanes(self) -> list[Lane]:
        found = []
        for table in ("lane", "lane_connector"):
            for name, row in self._read(table):
                with self.left_out.damaged("lanes left out because they cannot be read", name):
                    found.append(self._lane(table, row))
        return found

    def _lane(self, table: str, row: dict[str, Any]) -> Lane:
        token = row["token"]
        line = along(self.content["arcline_path_3"].get(token, ()))
        if len(line) < 2:
            raise MapError("has no arcline_path_3 with a length")
        follows = self.content.get("connectivity", {}).get(token, {})
        return Lane(
            token,
            "driving",
            line,
            np.full(len(line), self._width(token, row, line)),
            successors=tuple(follows.get("outgoing", ())),
            junction="intersection" if table == "lane_connector" else None,
        )

    def _width(self, token: str, row: dict[str, Any], line: Float) -> float:
        length = float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())
        ring = self.rings.get(row.get("polygon_token", ""), np.zeros((0, 3)))
        if len(ring) < 3:
            self.left_out["lanes of 3.5 m, because they have no polygon"].append(token)
            return USUAL_WIDTH_M
        width = _area_of(ring) / length
        if not WIDTHS_M[0] <= width <= WIDTHS_M[1]:
            kind = "lanes whose polygon gives a width outside of 2 to 8 m, which is limited to that"
            self.left_out[kind].append(token)
        return float(np.clip(width, *WIDTHS_M))

    def _ring(self, token: str) -> Float:
        """Corners of a polygon. Raises MapError."""
        ring = self.rings.get(token, np.zeros((0, 3)))
        if len(ring) < 3:
            raise MapError(f"has no polygon {token!r} with three corners")
        return ring

    def areas(self) -> list[Area]:
        found = []
        for name, row in self._read("drivable_area"):
            for i, token in enumerate(row.get("polygon_tokens", ())):
                with self.left_out.damaged(
                    "areas left out because they cannot be read", f"{name}_{i}"
                ):
                    found.append(Area(f"{row['token']}_{i}", "drivable", self._ring(token)))
        for table, kind in AREAS.items():
            for name, row in self._read(table):
                with self.left_out.damaged("areas left out because they cannot be read", name):
                    found.append(Area(row["token"], kind, self._ring(row["polygon_token"])))
        return found

    def stop_lines(self, lanes: list[Lane]) -> list[StopLine]:
        """Stop lines along the long axes of their polygons, with their lanes."""
        graph = joined([lane for lane in lanes if lane.junction is None] or lanes)
        found = []
        for name, row in self._read("stop_line"):
            with self.left_out.damaged("stop lines left out because they cannot be read", name):
                ring = self._ring(row["polygon_token"])
                middle = ring.mean(axis=0)
                _, _, axes = np.linalg.svd((ring - middle)[:, :2], full_matrices=False)
                reach = (ring - middle)[:, :2] @ axes[0]
                ends = np.array([middle[:2] + r * axes[0] for r in (reach.min(), reach.max())])
                across = np.linspace(ends[0], ends[1], 9)
                index, values = graph.nearest_many(np.column_stack([across, np.full(9, np.nan)]))
                near = {
                    graph.lane_ids[k]
                    for k, (_, offset) in zip(index.tolist(), values.tolist(), strict=True)
                    if k >= 0 and abs(offset) < 1.0
                }
                points = np.column_stack([ends, np.zeros(2)])
                found.append(StopLine(row["token"], points, tuple(sorted(near))))
        return found

    def signals(self, stop_lines: list[StopLine]) -> list[Signal]:
        lines = {line.stop_line_id: line for line in stop_lines}
        waits: dict[str, str] = {}
        for name, row in self._read("stop_line"):
            with self.left_out.damaged("stop lines left out because they cannot be read", name):
                if row["token"] in lines:
                    waits |= dict.fromkeys(row.get("traffic_light_tokens", ()), row["token"])
        found = []
        for name, row in self._read("traffic_light"):
            with self.left_out.damaged("signals left out because they cannot be read", name):
                pose, stop = row["pose"], waits.get(row["token"])
                x, y, z = (float(pose[axis]) for axis in ("tx", "ty", "tz"))
                ruled = lines[stop].lanes if stop else ()
                heading = float(pose["rz"])
                found.append(Signal(row["token"], "traffic_light", (x, y, z), heading, ruled, stop))
        return found


def along(path: Any) -> Float:
    """Points [N, 3] about every metre of an arcline path: pieces of three segments, each a left
    turn, a straight line or a right turn (L, S, R).

    Raises:
        MapError: an invalid piece, or one longer than 10 km.
    """
    points: list[tuple[float, float, float]] = []
    for piece in path:
        x, y, heading = (float(v) for v in piece["start_pose"])
        radius, shape = float(piece["radius"]), str(piece["shape"])
        if not points:
            points.append((x, y, 0.0))
        for turn, length in zip(shape, piece["segment_length"], strict=True):
            if turn not in "LSR" or not 0 <= float(length) < MAX_PIECE_M:
                raise MapError(f"segment {turn!r} of {length} m; allowed: L, S and R")
            bend = {"L": 1.0, "S": 0.0, "R": -1.0}[turn] / radius if radius > 0 else 0.0
            count = max(math.ceil(float(length) / STEP_M), 1)
            step = float(length) / count
            for _ in range(count):
                half = bend * step / 2
                chord = step * math.sin(half) / half if half else step
                x += chord * math.cos(heading + half)
                y += chord * math.sin(heading + half)
                heading += bend * step
                points.append((x, y, 0.0))
    kept = points[:1] + [b for a, b in pairwise(points) if math.dist(a, b) > 1e-3]
    return np.array(kept).reshape(-1, 3)


def _area_of(ring: Float) -> float:
    x, y = ring[:, 0], ring[:, 1]
    return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)
