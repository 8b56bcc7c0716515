"""The lanes of a log: of the map that it comes with, or gathered from the drive itself."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.rotation import Float
from ..logs import DrivingLog
from ..scene import LaneGraph
from .bounds import joined
from .errors import MapError
from .from_log import lanes_from_log
from .read import read_map

LaneSource = Literal["map", "log", "none"]
LANE_SOURCES: tuple[str, ...] = get_args(LaneSource)
REACH_M = 250.0
"""Of a map of a whole town so much about the driven way is kept."""


def lanes_of_log(log: DrivingLog, *, source: LaneSource = "map") -> LaneGraph | None:
    """Lanes in the world frame of a log, heights as the map has them.

    Args:
        log: the drive; ``log.lanes`` come first, then the file that ``log.logged_map`` names.
        source: ``map``: those of the map that the log comes with; ``log``: these, and where there
            is no map, what the drive tells of lanes (:func:`.lanes_from_log`), if it tells
            anything; ``none``: none.

    Returns:
        None where there are none.

    Raises:
        MapError: the map is damaged, or none of it lies near the drive; the message names the file.
    """
    if source == "none":
        return None
    if log.lanes is not None:
        return log.lanes
    if log.logged_map is not None:
        graph = read_map(log.logged_map.path)
        T = log.logged_map.T_world_map
        moved = graph.moved(float(np.arctan2(T[1, 0], T[0, 0])), T[:3, 3])
        return _near(moved, log.ego.positions[:, :2], str(log.logged_map.path))
    if source == "map":
        return None
    try:
        return lanes_from_log(log)
    except MapError:
        return None


def _near(graph: LaneGraph, driven: Float, where: str) -> LaneGraph:
    """The part of a graph within REACH_M of driven places [N, 2]."""
    tree = cKDTree(driven)

    def is_near(points: Float) -> bool:
        return bool((tree.query(points[:, :2])[0] < REACH_M).any())

    lanes = [lane for lane in graph.lanes.values() if is_near(lane.centre)]
    if not lanes:
        raise MapError(
            f"{where}: no lane of this map is within {REACH_M:.0f} m of the drive, so it is of "
            "another place; with lanes 'none' it is not read"
        )
    there = {lane.lane_id for lane in lanes}
    lines = {key: line for key, line in graph.stop_lines.items() if there.issuperset(line.lanes)}
    return joined(
        lanes,
        areas=[area for area in graph.areas.values() if is_near(area.outline)],
        stop_lines=lines.values(),
        signals=[
            s
            for s in graph.signals.values()
            if there.issuperset(s.lanes) and (s.stop_line is None or s.stop_line in lines)
        ],
        roads=[r for r in graph.roads.values() if there.issuperset(p.lane_id for p in r.lanes)],
        source=graph.source,
        accuracy=graph.accuracy,
        geo_reference=graph.geo_reference,
        notes=graph.notes,
    )
