"""Lanes of a log, from its map or, without a map, from the drive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from ..geometry import Float, apply_transform
from ..logs import DrivingLog
from ..scene import Lane, LaneGraph
from .align import VEHICLES
from .read import read_map
from .reader import MapError, joined

STEP_M = 1.0
SAME_LANE_M, SAME_HEADING = 1.7, 0.5
"""Maximum distance of paths in the same lane, with about the same direction."""
SHARED = 0.6
MIN_LENGTH_M = 8.0
BRIDGED_M = 40.0
SMOOTH_M = 4.0
WIDTH_M, WIDTHS_M = 3.4, (2.5, 4.5)
LANE_OFFSETS_M = (2.2, 5.0)
MAX_SWEEPS = 40
REACH_M, FLAT_M = 4.0, 0.25
BIN_M, WINDOW_M = 0.05, 20.0
BRIGHT_SHARE, BRIGHT_MADS, POINTS_MIN = 0.12, 5.0, 200
MARK_M = (1.0, 2.5)
UNMARKED_M, MARKED_LEAST_M = 0.4, 0.1
"""Typical lateral variation of driving within a lane, and lower limit of the accuracy from
markings.
"""


@dataclass(frozen=True)
class _Way:
    """A lane under construction: its line, and the error of this line [m]."""

    line: Float
    width: float
    error: float


def lanes_from_log(log: DrivingLog) -> LaneGraph:
    """Lanes estimated from a recorded drive.

    The paths of the recording vehicle and of moving tracked vehicles are merged into lanes. Where
    LiDAR intensities show markings on both sides, the centre line and the width follow the
    markings. ``accuracy`` of the graph is the expected median error: 0.4 m if only paths are known,
    otherwise the spread of the markings between sections of 20 m.

    Raises:
        MapError: no vehicle drove 8 m in the log.
    """
    ways = [_line(log.ego.positions)]
    tracks = (t for t in log.tracks if t.category in VEHICLES)
    ways += [_line(t.trajectory.positions - [0, 0, t.size[2] / 2]) for t in tracks]
    driven = [way for way in ways if len(way) * STEP_M >= MIN_LENGTH_M]
    if not driven:
        raise MapError(f"log {log.name!r}: no vehicle drives {MIN_LENGTH_M:.0f} m in it")
    points, intensity = _ground_returns(log)
    made = [_marked(line, points, intensity) for line in _gathered(driven)]
    lanes = [
        Lane(f"log.{i}", "driving", way.line, np.full(len(way.line), way.width))
        for i, way in enumerate(made)
    ]
    errors = np.repeat([way.error for way in made], [len(way.line) for way in made])
    return LaneGraph.of(_neighbours(lanes), source="log", accuracy=float(np.median(errors)))


def _line(positions: Float) -> Float:
    """Points [N, 3] every metre along a path, without standstill and noise; [0, 3] for none."""
    kept = [0]
    for i in range(1, len(positions)):
        if np.linalg.norm(positions[i, :2] - positions[kept[-1], :2]) >= STEP_M / 2:
            kept.append(i)
    if len(kept) < 4:
        return np.zeros((0, 3))
    way = positions[kept]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1))])
    places = np.linspace(0.0, s[-1], max(int(s[-1] / STEP_M) + 1, 2))
    even = np.column_stack([np.interp(places, s, way[:, i]) for i in range(3)])
    return _smoothed(even)


def _smoothed(line: Float) -> Float:
    """Smooth wiggles shorter than a few metres; the ends keep their direction."""
    reach = int(4 * SMOOTH_M / STEP_M)
    if len(line) < 4:
        return line
    steps = np.arange(1, reach + 1)[:, None]
    near = min(4, len(line) - 1)
    before = line[0] - steps[::-1] * (line[near] - line[0]) / near
    after = line[-1] + steps * (line[-1] - line[-1 - near]) / near
    whole = gaussian_filter1d(np.concatenate([before, line, after]), SMOOTH_M / STEP_M, axis=0)
    found: Float = whole[reach:-reach]
    return found


def _headings(line: Float) -> Float:
    d = np.gradient(line[:, :2], axis=0)
    found: Float = np.arctan2(d[:, 1], d[:, 0])
    return found


def _beside(line: Float, other: Float) -> tuple[Float, Float, Float]:
    """For each point of ``other`` [M]: index of the nearest point of ``line``, distance to the left
    of it, and cosine of the angle between the directions.
    """
    apart = np.linalg.norm(other[:, None, :2] - line[None, :, :2], axis=2)
    k = apart.argmin(axis=1)
    heading = _headings(line)
    d = other[:, :2] - line[k, :2]
    left = d[:, 1] * np.cos(heading[k]) - d[:, 0] * np.sin(heading[k])
    along = np.abs(d[:, 0] * np.cos(heading[k]) + d[:, 1] * np.sin(heading[k]))
    left = np.where(along > 2 * STEP_M, np.inf, left)
    return k, left, np.cos(_headings(other) - heading[k])


def _gathered(ways: list[Float]) -> list[Float]:
    """One line per lane: the first path on it, extended by the others at its ends."""
    lanes: list[Float] = []
    for way in ways:
        for i, line in enumerate(lanes):
            _, left, agree = _beside(line, way)
            same = (np.abs(left) < SAME_LANE_M) & (agree > np.cos(SAME_HEADING))
            if same.mean() >= SHARED or same.sum() * STEP_M >= 3 * MIN_LENGTH_M:
                lanes[i] = _extended(line, way, same)
                break
        else:
            lanes.append(way)
    return _bridged(lanes)


def _bridged(lanes: list[Float]) -> list[Float]:
    """Join lanes that continue each other across an undriven section."""
    found = list(lanes)
    for a in range(len(found)):
        for b in range(len(found)):
            while a != b and len(found[a]) and len(found[b]) and _leads_to(found[a], found[b]):
                start, end = found[a][-1], found[b][0]
                count = max(int(np.linalg.norm(end - start)), 2)
                u = np.linspace(0, 1, count + 1)[1:-1, None]
                out, into = ((x[-1] - x[-4]) / 3 for x in (found[a], found[b][3::-1]))
                reach = np.linalg.norm(end - start)
                between = (
                    (1 + 2 * u) * (1 - u) ** 2 * start
                    + u * (1 - u) ** 2 * reach * out
                    + u**2 * (3 - 2 * u) * end
                    - u**2 * (u - 1) * reach * into
                )
                found[a] = _even(np.concatenate([found[a], between, found[b]]))
                found[b] = found[b][:0]
    return [line for line in found if len(line)]


def _leads_to(line: Float, other: Float) -> bool:
    """Whether a line, extended along its curvature, meets another within reach."""
    d = other[0, :2] - line[-1, :2]
    reach = float(np.linalg.norm(d))
    if not 0.5 < reach < BRIDGED_M:
        return False
    out, into, between = _headings(line)[-1], _headings(other)[0], np.arctan2(d[1], d[0])
    turns = np.angle(np.exp(1j * np.array([between - out, into - between])))
    # On an arc both angles are equal to half of the road's total bend.
    return bool(np.abs(turns).max() < 0.35 and abs(turns[0] - turns[1]) * reach < 2 * SAME_LANE_M)


def _extended(line: Float, way: Float, same: Float) -> Float:
    """A lane's line extended by the part of a path before its start or after its end, blended
    laterally over some metres.
    """
    shared = np.flatnonzero(same)
    before, after = way[: shared[0]], way[shared[-1] + 1 :]
    parts = [line]
    if len(before) and _is_beyond(line[0], line[1], before[-1]):
        parts.insert(0, before + (line[0] - way[shared[0]]) * _fading(len(before))[::-1])
    if len(after) and _is_beyond(line[-1], line[-2], after[0]):
        parts.append(after + (line[-1] - way[shared[-1]]) * _fading(len(after)))
    return _smoothed(_even(np.concatenate(parts)))


def _is_beyond(end: Float, inner: Float, place: Float) -> bool:
    """Whether a position is beyond the end of a line with the previous point ``inner``."""
    return bool((place - end)[:2] @ (end - inner)[:2] > 0)


def _fading(count: int) -> Float:
    found: Float = np.maximum(1.0 - np.arange(count)[:, None] * STEP_M / 15.0, 0.0)
    return found


def _even(line: Float) -> Float:
    steps = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    kept = np.concatenate([[True], steps > 0.05])
    line = line[kept]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    places = np.linspace(0.0, s[-1], max(int(s[-1] / STEP_M) + 1, 2))
    found: Float = np.column_stack([np.interp(places, s, line[:, i]) for i in range(3)])
    return found


def _ground_returns(log: DrivingLog) -> tuple[Float, Float]:
    """LiDAR points [N, 3] near the height of the road, in the world, and their intensities."""
    frames = np.unique(np.linspace(0, log.frame_count - 1, MAX_SWEEPS).astype(int))
    places, levels = [], []
    for frame in frames.tolist():
        sweep = log.lidar(frame)
        if not len(sweep.points):
            continue
        near = np.linalg.norm(sweep.points[:, :2], axis=1) < 30
        near &= np.abs(sweep.points[:, 2]) < 3 * FLAT_M
        T_world_vehicle = log.ego.transform(int(log.frame_times_us[frame]))
        places.append(apply_transform(T_world_vehicle, sweep.points[near].astype(np.float64)))
        levels.append(sweep.intensity[near].astype(np.float64))
    if not places:
        return np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(places), np.concatenate(levels)


def _marked(line: Float, points: Float, intensity: Float) -> _Way:
    """A lane's line, centred between its markings where visible."""
    shifts, widths = [], []
    reach = int(WINDOW_M / STEP_M)
    places = np.arange(0, len(line), reach // 2)
    for first in places.tolist():
        part = line[max(first - reach // 4, 0) : first + reach]
        found = _marks(part, points, intensity) if len(part) > reach // 2 else None
        shifts.append(np.nan if found is None else (found[0] + found[1]) / 2)
        widths.append(np.nan if found is None else found[0] - found[1])
    known = np.flatnonzero(np.isfinite(shifts))
    if len(known) < 2 or len(known) < 0.25 * len(places):
        return _Way(line, WIDTH_M, UNMARKED_M)
    centre = np.array(shifts)[known]
    typical = float(np.median(centre))
    # A section that differs from most others has found the wrong markings.
    centre = np.clip(centre, typical - 0.3, typical + 0.3)
    shift = np.interp(np.arange(len(line)), places[known] + reach / 4, centre)
    shift = gaussian_filter1d(shift, reach / 4, mode="nearest")
    heading = _headings(line)
    moved = line.copy()
    moved[:, 0] -= shift * np.sin(heading)
    moved[:, 1] += shift * np.cos(heading)
    spread = float(np.median(np.abs(centre - typical)))
    error = max(MARKED_LEAST_M, spread) if len(known) > 2 else UNMARKED_M / 2
    return _Way(_even(moved), float(np.median(np.array(widths)[known])), error)


def _marks(line: Float, points: Float, intensity: Float) -> tuple[float, float] | None:
    """Left and right marking next to a section of a lane's line [m], or None."""
    low, high = line[:, :2].min(axis=0) - REACH_M, line[:, :2].max(axis=0) + REACH_M
    near = ((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)
    chosen, levels = points[near], intensity[near]
    if len(chosen) < POINTS_MIN:
        return None
    every = max(len(chosen) // 60_000, 1)
    chosen, levels = chosen[::every], levels[::every]
    left, height = _across(line, chosen)
    flat = (np.abs(left) < REACH_M) & (np.abs(height) < FLAT_M)
    left, levels = left[flat], levels[flat]
    lane = levels[np.abs(left) < MARK_M[1]]
    if len(lane) < POINTS_MIN:
        return None
    middle = float(np.median(lane))
    spread = max(float(np.median(np.abs(lane - middle))), 0.005)
    bins = np.arange(-REACH_M, REACH_M + BIN_M, BIN_M)
    counts = np.histogram(left, bins)[0].astype(np.float64)
    bright = np.histogram(left[levels > middle + BRIGHT_MADS * spread], bins)[0]
    share = gaussian_filter1d(bright.astype(float), 1.5) / np.maximum(
        gaussian_filter1d(counts, 1.5), 5.0
    )
    centres = (bins[1:] + bins[:-1]) / 2
    sides = [_peak(centres * side, share) for side in (1, -1)]
    if sides[0] is None or sides[1] is None:
        return None
    a, b = sides[0], -sides[1]
    return (a, b) if WIDTHS_M[0] <= a - b <= WIDTHS_M[1] else None


def _peak(distance: Float, share: Float) -> float | None:
    """Position of the first marking beyond ``MARK_M[0]``; None without one."""
    side = np.flatnonzero((distance > MARK_M[0]) & (distance < MARK_M[1]))
    best = side[share[side].argmax()]
    if share[best] < BRIGHT_SHARE:
        return None
    about = np.abs(distance - distance[best]) < 0.15
    return float((distance[about] * share[about]).sum() / share[about].sum())


def _across(line: Float, points: Float) -> tuple[Float, Float]:
    """Distance to the left of a line and height above it of points [N]; inf beyond its ends."""
    left, height = np.full(len(points), np.inf), np.full(len(points), np.inf)
    for a, b in pairwise(line):
        d = b[:2] - a[:2]
        length = np.linalg.norm(d)
        e = (points[:, :2] - a[:2]) @ d / length**2
        within = (e >= 0) & (e < 1)
        side = (d[0] * (points[:, 1] - a[1]) - d[1] * (points[:, 0] - a[0])) / length
        within &= np.abs(side) < np.abs(left)
        left[within] = side[within]
        height[within] = (points[:, 2] - a[2] - e * (b[2] - a[2]))[within]
    return left, height


def _neighbours(lanes: list[Lane]) -> list[Lane]:
    """Mark lanes as adjacent if they run side by side over most of the shorter one."""
    found = []
    for lane in lanes:
        beside: dict[str, str | None] = {"left": None, "right": None, "opposite": None}
        nearest = dict.fromkeys(beside, np.inf)
        for other in lanes:
            if other is lane:
                continue
            _, left, agree = _beside(lane.centre, other.centre)
            near = np.isfinite(left) & (np.abs(agree) > np.cos(SAME_HEADING))
            if near.sum() < 5 or near.mean() < 0.3:
                continue
            offset, same = float(np.median(left[near])), float(np.median(agree[near])) > 0
            side = ("left" if offset > 0 else "right") if same else "opposite"
            fits = LANE_OFFSETS_M[0] < abs(offset) < LANE_OFFSETS_M[1] and (same or offset > 0)
            if fits and abs(offset) < nearest[side]:
                beside[side], nearest[side] = other.lane_id, abs(offset)
        found.append(replace(lane, **beside))  # type: ignore[arg-type]
    return found


# --- Lanes of a log ------------------------------------------------------------------------------

LaneSource = Literal["map", "log", "none"]
LANE_SOURCES: tuple[str, ...] = get_args(LaneSource)
MAP_REACH_M = 250.0
"""Part of a town map around the driven path that is used."""


def lanes_of_log(log: DrivingLog, *, source: LaneSource = "map") -> LaneGraph | None:
    """Lanes in the world frame of a log, with the heights of the map.

    Args:
        log: the drive; ``log.lanes`` take precedence over the file of ``log.logged_map``.
        source: ``map``: lanes of the log's map; ``log``: the same, or without a map, lanes
            estimated from the drive (:func:`.lanes_from_log`), if possible; ``none``: none.

    Returns:
        None without lanes.

    Raises:
        MapError: the map is damaged, or far from the drive; the message names the file.
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
    """The part of a graph within MAP_REACH_M of driven positions [N, 2]."""
    tree = cKDTree(driven)

    def is_near(points: Float) -> bool:
        return bool((tree.query(points[:, :2])[0] < MAP_REACH_M).any())

    lanes = [lane for lane in graph.lanes.values() if is_near(lane.centre)]
    if not lanes:
        raise MapError(
            f"{where}: no lane of this map is within {MAP_REACH_M:.0f} m of the drive, so it is of "
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
