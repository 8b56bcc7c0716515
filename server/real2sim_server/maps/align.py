"""Alignment of a map with a scene: rotation, translation, and heights of the ground."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Float, wrapped
from ..scene import Ground, LaneGraph, Scene, Trajectory
from .reader import MapError

STEP_M = 2.0
"""Spacing of the poses of a path that are compared with lanes."""
VEHICLES = frozenset({"car", "van", "truck", "bus", "vehicle"})
ROUNDS, HUBER_M = 40, 1.0
NEAR_M = 6.0
"""A map with lanes this close to most of the path counts as almost aligned with the scene."""
MEDIAN_M, WITHIN = 1.0, 0.75
"""Acceptance limits of a fit: median distance from centre lines, share of poses inside a lane."""
CANDIDATES, KEPT = 4000, 12
SAME_M, SAME_YAW, AS_GOOD_M = 4.0, 0.1, 0.1


@dataclass(frozen=True)
class Alignment:
    """A rigid motion from a map to a scene, seen from above.

    Attributes:
        yaw: rotation about z [rad].
        x, y: translation after the rotation [m].
        residual: median distance of driven poses from the centre lines of their lanes [m].
        within: share of those poses inside a lane of their direction.
    """

    yaw: float
    x: float
    y: float
    residual: float
    within: float

    def apply(self, graph: LaneGraph, ground: Ground | None = None) -> LaneGraph:
        """The graph in the scene's frame; placed on ``ground`` if given."""
        moved = graph.moved(self.yaw, [self.x, self.y, 0.0])
        return moved if ground is None else laid_on(moved, ground)


def driven_poses(scene: Scene) -> Float:
    """Poses [N, 3] (x, y [m], heading [rad]) along the paths of the recording vehicle and of moving
    vehicles, every ``STEP_M``.
    """
    ways = [scene.ego, *(o.trajectory for o in scene.objects.values() if o.category in VEHICLES)]
    found = [way_poses(way) for way in ways]
    return np.concatenate(found) if found else np.zeros((0, 3))


def way_poses(way: Trajectory, *, step: float = STEP_M) -> Float:
    """Poses [N, 3] (x, y, heading of motion) along a moving trajectory; empty without motion."""
    places = way.positions[:, :2]
    kept = [0]
    for i in range(1, len(places)):
        if np.linalg.norm(places[i] - places[kept[-1]]) >= step:
            kept.append(i)
    if len(kept) < 4:
        return np.zeros((0, 3))
    line = places[kept]
    steps = np.diff(line, axis=0)
    return np.column_stack([(line[1:] + line[:-1]) / 2, np.arctan2(steps[:, 1], steps[:, 0])])


def align(
    graph: LaneGraph, poses: ArrayLike, *, start: tuple[float, float, float] | None = None
) -> Alignment:
    """The rigid motion that aligns a map's lanes with the driven poses.

    Args:
        graph: graph in the frame of the map.
        poses: [N, 3] x, y, heading in the scene; see :func:`driven_poses`.
        start: (yaw, x, y) to start from; None: the map's own frame if it almost fits, otherwise
            all possible positions of the first pose on the map.

    Raises:
        MapError: no driven path, no fit, or several equally good fits.
    """
    driven = np.asarray(poses, dtype=np.float64).reshape(-1, 3)
    if len(driven) < 5:
        raise MapError(
            "a map is aligned to recorded paths, and no vehicle drove 10 m in this scene"
        )
    if start is not None:
        return _checked(_refined(graph, driven, np.array(start)))
    here = np.zeros(3)
    if np.median(np.abs(_offsets(graph, driven, here))) < NEAR_M:
        return _checked(_refined(graph, driven, here))
    return _checked(_anywhere(graph, driven))


def laid_on(graph: LaneGraph, ground: Ground) -> LaneGraph:
    """The graph with the heights of a scene's ground, for lanes, areas, stop lines and roads."""

    def on(points: Float) -> Float:
        return np.column_stack([points[:, :2], ground.height_at(points[:, :2])])

    def lifted(position: tuple[float, float, float], z: float) -> tuple[float, float, float]:
        x, y, own = position
        return x, y, own - z + ground.height(x, y)

    base = {name: _height_near(graph, s.position) for name, s in graph.signals.items()}
    return replace(
        graph,
        lanes={k: replace(v, centre=on(v.centre)) for k, v in graph.lanes.items()},
        areas={k: replace(v, outline=on(v.outline)) for k, v in graph.areas.items()},
        stop_lines={k: replace(v, points=on(v.points)) for k, v in graph.stop_lines.items()},
        signals={
            k: replace(v, position=lifted(v.position, base[k])) for k, v in graph.signals.items()
        },
        roads={k: replace(v, points=on(v.points)) for k, v in graph.roads.items()},
    )


def _height_near(graph: LaneGraph, position: tuple[float, float, float]) -> float:
    found = graph.nearest(position[0], position[1])
    return 0.0 if found is None else graph.lane(found.lane_id).at(found.s)[2]


def _to_map(poses: Float, motion: Float) -> Float:
    """Poses of the scene in the frame of the map."""
    yaw, x, y = motion
    cos, sin = np.cos(yaw), np.sin(yaw)
    dx, dy = poses[:, 0] - x, poses[:, 1] - y
    return np.column_stack([cos * dx + sin * dy, -sin * dx + cos * dy, poses[:, 2] - yaw])


def _offsets(graph: LaneGraph, poses: Float, motion: Float) -> Float:
    index, values = graph.nearest_many(_to_map(poses, motion))
    return np.where(index >= 0, values[:, 1], 1e6)


def _refined(graph: LaneGraph, poses: Float, start: Float) -> Alignment:
    """Iterated closest lines: Gauss-Newton on offsets from centre lines, with Huber's weights.

    Components that the offsets do not determine (along a straight road) do not change.
    """
    motion = start.copy()
    for _ in range(ROUNDS):
        local = _to_map(poses, motion)
        index, values = graph.nearest_many(local)
        known = np.flatnonzero(index >= 0)
        if not len(known):
            break
        headings = _headings(graph, index[known], values[known, 0])
        offset = values[known, 1]
        weight = np.minimum(1.0, HUBER_M / np.maximum(np.abs(offset), 1e-9))
        left = np.column_stack([-np.sin(headings), np.cos(headings)])
        x, y = local[known, 0], local[known, 1]
        # A rotation of the map moves a position of the scene within it by (y, -x).
        jacobian = np.column_stack([left[:, 0] * y - left[:, 1] * x, -left])
        scaled = jacobian * weight[:, None]
        normal = jacobian.T @ scaled + np.diag([1e-3, 1e-3, 1e-3])
        step = -np.linalg.solve(normal, scaled.T @ offset)
        yaw = motion[0]
        cos, sin = np.cos(yaw), np.sin(yaw)
        motion[0] += step[0]
        motion[1] += cos * step[1] - sin * step[2]
        motion[2] += sin * step[1] + cos * step[2]
        if np.abs(step).max() < 1e-6:
            break
    return _measured(graph, poses, motion)


def _headings(graph: LaneGraph, index: NDArray[np.int64], s: Float) -> Float:
    lanes = graph.lane_ids
    pairs = zip(index.tolist(), s.tolist(), strict=True)
    return np.array([graph.lanes[lanes[int(i)]].at(at)[3] for i, at in pairs])


def _measured(graph: LaneGraph, poses: Float, motion: Float) -> Alignment:
    local = _to_map(poses, motion)
    index, values = graph.nearest_many(local)
    lanes = graph.lane_ids
    inside = []
    for k, (s, offset), heading in zip(index.tolist(), values.tolist(), local[:, 2], strict=True):
        if k < 0:
            inside.append(False)
            continue
        lane = graph.lanes[lanes[k]]
        along = np.cos(heading - lane.at(s)[3]) > 0.7
        inside.append(bool(along and abs(offset) <= lane.width(s) / 2))
    residual = float(np.median(np.abs(np.where(index >= 0, values[:, 1], 1e6))))
    yaw = wrapped(motion[0])
    return Alignment(
        float(yaw), float(motion[1]), float(motion[2]), residual, float(np.mean(inside))
    )


def _anywhere(graph: LaneGraph, poses: Float) -> Alignment:
    """The best fit over all positions of the first pose on a lane."""
    starts = [
        (*lane.at(s)[:2], lane.at(s)[3])
        for lane in graph.lanes.values()
        if lane.kind == "driving"
        for s in np.arange(0.0, lane.length, 3.0)
    ]
    starts = starts[:: max(len(starts) // CANDIDATES, 1)]
    few = poses[:: max(len(poses) // 40, 1)]
    motions = []
    for x, y, heading in starts:
        yaw = poses[0, 2] - heading
        cos, sin = np.cos(yaw), np.sin(yaw)
        motions.append(
            np.array([yaw, poses[0, 0] - cos * x + sin * y, poses[0, 1] - sin * x - cos * y])
        )
    costs = [float(np.median(np.abs(_offsets(graph, few, m)))) for m in motions]
    order = np.argsort(costs, kind="stable")[:KEPT]
    fits = sorted((_refined(graph, poses, motions[k]) for k in order), key=_cost)
    if not fits:
        raise MapError("the map has no driving lanes to align")
    best = fits[0]
    for other in fits[1:]:
        apart = np.hypot(other.x - best.x, other.y - best.y) > SAME_M
        apart |= abs(other.yaw - best.yaw) > SAME_YAW
        if apart and _cost(other) < _cost(best) + AS_GOOD_M:
            places = " and ".join(f"{f.yaw:.3f},{f.x:.1f},{f.y:.1f}" for f in (best, other))
            raise MapError(
                f"the map fits the recorded path equally well in several places, such as "
                f"(yaw,x,y) {places}; choose one with --at"
            )
    return best


def _cost(fit: Alignment) -> float:
    return fit.residual + 2.0 * (1.0 - fit.within)


def _checked(fit: Alignment) -> Alignment:
    if fit.residual > MEDIAN_M or fit.within < WITHIN:
        raise MapError(
            f"the map does not fit: driven poses are {fit.residual:.2f} m from centre lines in the "
            f"median (allowed: {MEDIAN_M} m), {fit.within:.0%} of them inside a lane of their "
            f"direction (minimum: {WITHIN:.0%}); use another map, or give its pose with --at"
        )
    return fit
