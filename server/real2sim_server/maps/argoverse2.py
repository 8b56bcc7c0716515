"""Vector maps of Argoverse 2 (``log_map_archive_*.json``), in their city's frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from real2sim_proto.lanes import LaneKind

from ..geometry import Float
from ..scene import Area, Lane, LaneGraph
from .reader import MapError, between, damage_named, joined, read_json

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
            segments = content["lane_segments"]
            lanes = [_lane(entry, segments) for entry in segments.values()]
            areas = [
                Area(str(a["id"]), "drivable", _points(a["area_boundary"]))
                for a in content.get("drivable_areas", {}).values()
            ]
            for crossing in content.get("pedestrian_crossings", {}).values():
                one, other = (_points(crossing[edge]) for edge in ("edge1", "edge2"))
                outline = np.concatenate([one, other[::-1]])
                areas.append(Area(f"crossing_{crossing['id']}", "crosswalk", outline))
            kept = [lane for lane in lanes if lane is not None]
            if not kept:
                raise MapError(f"{file}: has no lane segments")
            short = [str(key) for key, lane in zip(segments, lanes, strict=True) if lane is None]
            told = f"lane segments left out because they have no length: {', '.join(short)}"
            notes = (told,) if short else ()
            return joined(kept, areas=areas, source=f"argoverse2 {file.name}", notes=notes)


def _archive(path: Path) -> Path | None:
    if path.is_file():
        return path if path.match(PATTERN) else None
    found = [*sorted(path.glob(PATTERN)), *sorted(path.glob(f"map/{PATTERN}"))]
    return found[0] if found else None


def _lane(entry: dict[str, Any], segments: dict[str, Any]) -> Lane | None:
    left, right = _points(entry["left_lane_boundary"]), _points(entry["right_lane_boundary"])
    beside: dict[str, str | None] = {"left": None, "right": None, "opposite": None}
    for side in ("left", "right"):
        other = segments.get(str(entry.get(f"{side}_neighbor_id")))
        if other is not None:
            same = _direction(entry) @ _direction(other) > 0
            if same or side == "left":
                beside[side if same else "opposite"] = str(other["id"])
    shape = between(left, right)
    if shape is None:
        return None
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
