"""nuScenes' map expansion (``maps/expansion/<location>.json``), in its location's frame."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import Float
from ..scene import Area, Lane, LaneGraph, Signal, StopLine
from .reader import MapError, damage_named, head_of, joined, read_json

STEP_M = 1.0
MAX_PIECE_M = 10_000.0
WIDTHS_M = (2.0, 8.0)


class NuScenesMapReader:
    """Reads lanes and lane connectors along their arcs, drivable areas, crossings, stop lines and
    traffic lights. Widths are the areas of the lanes' polygons divided by their lengths. The maps
    contain neither speed limits nor adjacent lanes.
    """

    name = "nuscenes"
    expects = "a file of nuScenes' map expansion, such as maps/expansion/boston-seaport.json"

    def recognises(self, path: Path) -> bool:
        """Whether the path is a JSON file that starts with tables of the expansion."""
        if not path.is_file() or path.suffix != ".json":
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
            tables = _Tables(content, str(path))
            lanes = tables.lanes()
            if not lanes:
                raise MapError(f"{path}: has no lanes with an arcline_path_3")
            stop_lines = tables.stop_lines(lanes)
            return joined(
                lanes,
                areas=tables.areas(),
                stop_lines=stop_lines,
                signals=tables.signals(stop_lines),
                source=f"nuscenes {path.name}",
            )


class _Tables:
    def __init__(self, content: dict[str, Any], file: str) -> None:
        self.content, self.file = content, file
        self.nodes = {n["token"]: (float(n["x"]), float(n["y"]), 0.0) for n in content["node"]}
        self.rings = {
            p["token"]: [self.nodes[n] for n in p["exterior_node_tokens"]]
            for p in content["polygon"]
        }

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Rows of a table; empty if the file lacks the table."""
        found: list[dict[str, Any]] = self.content.get(name, [])
        return found

    def lanes(self) -> list[Lane]:
        found = []
        paths, follows = self.content["arcline_path_3"], self.content.get("connectivity", {})
        for table in ("lane", "lane_connector"):
            for row in self.rows(table):
                token = row["token"]
                line = along(paths.get(token, ()), f"{self.file}: {table} {token}")
                if len(line) < 2:
                    continue
                length = float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())
                ring = np.array(self.rings.get(row.get("polygon_token"), ())).reshape(-1, 3)
                width = np.clip(_area_of(ring) / length, *WIDTHS_M) if len(ring) > 2 else 3.5
                found.append(
                    Lane(
                        token,
                        "driving",
                        line,
                        np.full(len(line), float(width)),
                        successors=tuple(follows.get(token, {}).get("outgoing", ())),
                        junction="intersection" if table == "lane_connector" else None,
                    )
                )
        return found

    def areas(self) -> list[Area]:
        found = [
            Area(f"{row['token']}_{i}", "drivable", np.array(self.rings[token]))
            for row in self.rows("drivable_area")
            for i, token in enumerate(row["polygon_tokens"])
            if len(self.rings[token]) > 2
        ]
        for table, kind in (("ped_crossing", "crosswalk"), ("carpark_area", "parking")):
            for row in self.rows(table):
                ring = self.rings[row["polygon_token"]]
                if len(ring) > 2:
                    found.append(Area(row["token"], kind, np.array(ring)))  # type: ignore[arg-type]
        return found

    def stop_lines(self, lanes: list[Lane]) -> list[StopLine]:
        """Stop lines along the long axes of their polygons, with their lanes."""
        graph = joined([lane for lane in lanes if lane.junction is None] or lanes)
        found = []
        for row in self.rows("stop_line"):
            ring = np.array(self.rings.get(row.get("polygon_token"), ())).reshape(-1, 3)
            if len(ring) < 3:
                continue
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
        waits = {
            light: row["token"]
            for row in self.rows("stop_line")
            for light in row.get("traffic_light_tokens", ())
            if row["token"] in lines
        }
        found = []
        for row in self.rows("traffic_light"):
            pose = row["pose"]
            stop = waits.get(row["token"])
            found.append(
                Signal(
                    row["token"],
                    "traffic_light",
                    (float(pose["tx"]), float(pose["ty"]), float(pose["tz"])),
                    float(pose["rz"]),
                    lines[stop].lanes if stop else (),
                    stop,
                )
            )
        return found


def along(path: Any, where: str) -> Float:
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
                raise MapError(f"{where}: segment {turn!r} of {length} m; allowed: L, S and R")
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
