"""What all worlds of a batch share, as compiled code takes it: arrays alone, since parallel loops
take no tuples within tuples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.episode import IdmDriver, ResetSpec

from ...edit import ObjectState, ScenarioState
from ...scene import Ground
from ..path import Float, LoggedPath
from ..scoring import ScoringContext
from ..traffic.idm import desired_speed
from ..traffic.traffic import DRIVEN, MOVING

Longs = NDArray[np.int64]


class Tracks(NamedTuple):
    """Objects of the scenario, N of them.

    Attributes:
        ends, times, knots: their trajectories, see ``edit.track_kernels.poses_at``.
        sizes: [N, 3] float64 [m].
        driven: [N] bool, those that IDM drives.
        path_ends: [N + 1] int64, where the path of each begins in ``paths``.
        paths: [P, KNOT] float64, see :mod:`..path_kernels`.
        desired: [N] float64 [m/s].
        idm: [5] float64: headway [s], gap [m], acceleration, braking, lateral acceleration
            [m/s^2].
    """

    ends: Longs
    times: Longs
    knots: Float
    sizes: Float
    driven: NDArray[np.bool_]
    path_ends: Longs
    paths: Float
    desired: Float
    idm: Float


class Road(NamedTuple):
    """Ground and roads.

    Attributes:
        heights, frame: of the ground, see ``scene.ground_kernels``.
        route: knots of the recorded way, see :mod:`..path_kernels`.
        line_points, line_ends, lane_points, lane_ends: of the route and of other lanes, see
            ``scoring.road_kernels``.
        half_widths: [2] float64, of both [m].
        ego_size: [3] float64, (length, width, height) [m].
    """

    heights: NDArray[np.float32]
    frame: Float
    route: Float
    line_points: Float
    line_ends: Longs
    lane_points: Float
    lane_ends: Longs
    half_widths: Float
    ego_size: Float


def tracks_of(state: ScenarioState, spec: ResetSpec) -> tuple[tuple[ObjectState, ...], Tracks]:
    """The visible objects, and their tables."""
    packed = state.tracks
    objects = packed.objects
    ends, times, knots = packed.arrays
    driven = np.array([spec.agents.default == "idm" and _is_driven(o) for o in objects], np.bool_)
    paths = [
        LoggedPath(o.trajectory).knots for o, is_driven in zip(objects, driven, strict=True)
        if is_driven
    ]  # fmt: skip
    lengths = np.zeros(len(objects), np.int64)
    lengths[driven] = [len(path) for path in paths]
    idm = IdmDriver()
    desired = [
        desired_speed(o, idm) if is_driven else 0.0
        for o, is_driven in zip(objects, driven, strict=True)
    ]
    return objects, Tracks(
        ends=ends,
        times=times,
        knots=knots,
        sizes=np.ascontiguousarray(packed.sizes, np.float64),
        driven=driven,
        path_ends=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        paths=np.concatenate([np.zeros((0, 11)), *paths]),
        desired=np.array(desired, np.float64),
        idm=np.array([idm.headway, idm.gap, idm.acceleration, idm.braking, idm.lateral]),
    )


def road_of(ground: Ground, path: LoggedPath, context: ScoringContext) -> Road:
    """Ground and roads of an episode."""
    lines, lanes = context.road_lines
    return Road(
        *ground.grid,
        route=path.knots,
        line_points=lines[0],
        line_ends=lines[1],
        lane_points=lanes[0],
        lane_ends=lanes[1],
        half_widths=np.array([context.corridor, context.lane], np.float64),
        ego_size=np.array(context.ego_size, np.float64),
    )


def _is_driven(subject: ObjectState) -> bool:
    return subject.category in DRIVEN and subject.trajectory.extent >= MOVING
