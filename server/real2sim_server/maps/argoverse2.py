"""Vector maps of Argoverse 2 (``log_map_archive_*.json``), in their city's frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from real2sim_proto.lanes import LaneKind

from ..geometry import Float
from ..scene import Area, Lane, LaneGraph
from ..scene.errors import LeftOut
from .reader import (
    MapError,
    between,
    check_rest,
    damage_named,
    joined,
    read_json,
)

PATTERN = "log_map_archive_*.json"
KINDS: dict[str, LaneKind] = {"VEHICLE": "driving", "BUS": "bus", "BIKE": "bicycle"}


class Argoverse2MapReader:
    """Reads lane segments, drivable areas and pedestrian crossings. The maps contain neither
    signals nor speed limits.
    """

    name = "argoverse2"
    expects = f"{PATTERN} of Argoverse 2, its folder map/, or the folder of the log"

    def recognises(self, path: Path) -> bool:
        """Whether the path is a map file, or a folder with one."""
        return _archive(path) is not None

    def read(self, path: Path) -> LaneGraph:
        """The map in the frame of its city. Raises MapError: see :class:`~.reader.MapReader`."""
        file = _archive(path)
        if file is None:
            raise MapError(f"{path}: has no {PATTERN}")
        content = read_json(file)
        with damage_named(str(file)):
            return _graph(content, file)


def _graph(content: dict[str, Any], file: Path) -> LaneGraph:
    left_out = LeftOut()
    segments = content["lane_segments"]
    lanes: list[Lane] = []
    for key, entry in segments.items():
        with left_out.damaged("lane segments left out because they cannot be read", str(key)):
            lanes.append(_lane(entry, segments, left_out))
    if not segments:
        raise MapError(f"{file}: has no lane segments")
    check_rest(str(file), "lane segments", lanes, segments, left_out)
    areas: list[Area] = []
    for key, entry in _table(content, "drivable_areas", left_out).items():
        with left_out.damaged("drivable areas left out because they cannot be read", str(key)):
            areas.append(Area(str(entry["id"]), "drivable", _points(entry["area_boundary"])))
    for key, entry in _table(content, "pedestrian_crossings", left_out).items():
        with left_out.damaged("crossings left out because they cannot be read", str(key)):
            one, other = (_points(entry[edge]) for edge in ("edge1", "edge2"))
            outline = np.concatenate([one, other[::-1]])
            areas.append(Area(f"crossing_{entry['id']}", "crosswalk", outline))
    return joined(lanes, left_out, areas=areas, source=f"argoverse2 {file.name}")


def _table(content: dict[str, Any], name: str, left_out: LeftOut) -> dict[str, Any]:
    """Entries by their key; empty if the file lacks the table."""
    found: Any = content.get(name, {})
    if isinstance(found, dict):
        return found
    left_out["tables left out because they are not objects"].append(name)
    return {}


def _archive(path: Path) -> Path | None:
    if path.is_file():
        return path if path.match(PATTERN) else None
    found = [*sorted(path.glob(PATTERN)), *sorted(path.glob(f"map/{PATTERN}"))]
    return found[0] if found else None


def _lane(entry: dict[str, Any], segments: dict[str, Any], left_out: LeftOut) -> Lane:
    left, right = _points(entry["left_lane_boundary"]), _points(entry["right_lane_boundary"])
    beside: dict[str, str | None] = {"left": None, "right": None, "opposite": None}
    for side in ("left", "right"):
        if (name := entry.get(f"{side}_neighbor_id")) is None:
            continue
        if (other := segments.get(str(name))) is None:
            beside[side] = str(name)
            continue
        with left_out.damaged("neighbours left out because they cannot be read", str(name)):
            same = _direction(entry) @ _direction(other) > 0
            if same or side == "left":
                beside[side if same else "opposite"] = str(other["id"])
    shape = between(left, right)
    if shape is None:
        raise MapError("has no length")
    return Lane(
        str(entry["id"]),
        KINDS.get(entry["lane_type"], "other"),
        *shape,
        successors=tuple(str(n) for n in entry["successors"]),
        may_change_left=_may_cross(entry["left_lane_mark_type"]),
        may_change_right=_may_cross(entry["right_lane_mark_type"]),
        junction="intersection" if entry["is_intersection"] else None,
        left=beside["left"],
        right=beside["right"],
        opposite=beside["opposite"],
    )


def _may_cross(mark: str) -> bool:
    return "SOLID" not in mark or mark.startswith("DASHED_SOLID")


def _direction(entry: dict[str, Any]) -> Float:
    line = _points(entry["left_lane_boundary"])
    found: Float = line[-1, :2] - line[0, :2]
    return found


def _points(entries: list[dict[str, float]]) -> Float:
    return np.array([[p["x"], p["y"], p.get("z", 0.0)] for p in entries], dtype=np.float64)
