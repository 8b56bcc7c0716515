"""Planners that run elsewhere, behind an interface of another simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import Real2SimError

if TYPE_CHECKING:
    from real2sim_proto.drive import EgoState

    from ..images import Frame
    from ..observation import Observation

Matrix = NDArray[np.float64]


class PeerError(Real2SimError):
    """The planner elsewhere cannot be reached, or answers with what is no plan."""


def T_world_ego(ego: EgoState) -> Matrix:
    """[4, 4] pose of the vehicle: rear axle on the ground, x forward, y left, z up."""
    w, x, y, z = ego.quaternion
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = ego.position
    return pose


def T_ego_camera(obs: Observation, frame: Frame) -> Matrix:
    """[4, 4] pose of a camera (x right, y down, z forward) on the vehicle."""
    pose: Matrix = np.linalg.inv(T_world_ego(obs.ego)) @ frame.T_world_sensor
    return pose


def rgb_frames(obs: Observation) -> dict[str, Frame]:
    """The colour image of each camera, by its name.

    Raises:
        PeerError: the observation shows none.
    """
    frames = {name: found["rgb"] for name, found in obs.frames.items() if "rgb" in found}
    if not frames:
        raise PeerError("the observation shows no rgb image; reset with sensors for the planner")
    return frames


def headings(points: NDArray[np.floating[Any]], *, moved: float = 0.1) -> list[float]:
    """Directions of travel [N] at points [N, 2] of a way that begins at the origin along x [rad].

    From the point before to the point after; kept where they are within ``moved`` metres.
    """
    way = np.vstack([np.zeros(2), points])
    found, last = [], 0.0
    for k in range(1, len(way)):
        step = way[min(k + 1, len(way) - 1)] - way[k - 1]
        if math.hypot(step[0], step[1]) >= moved:
            last = math.atan2(step[1], step[0])
        found.append(last)
    return found


def checked_points(answer: Any, *, columns: int, what: str) -> NDArray[np.float64]:
    """Finite points [N, columns], N at least 1, out of an answer. Raises PeerError."""
    try:
        points = np.asarray(answer, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PeerError(f"{what} is no list of points: {error}") from error
    if points.ndim != 2 or points.shape[1] != columns or not len(points):
        raise PeerError(f"{what} has shape {list(points.shape)}, not [N, {columns}]")
    if not np.isfinite(points).all():
        raise PeerError(f"{what} holds values that are not finite")
    return points


def named_as(
    frames: Mapping[str, Frame], obs: Observation, names: Mapping[str, float]
) -> dict[str, str]:
    """Names that another simulator gives to the cameras.

    Cameras that have one of these names keep it; others get the free name whose direction is
    nearest to theirs, and none where all are taken.

    Args:
        frames: one of each camera, by its name here.
        obs: whose frames they are.
        names: direction by name there [rad], positive to the left.
    """
    found = {name: name for name in frames if name in names}
    turns = {n: _turn(T_ego_camera(obs, f)) for n, f in frames.items() if n not in found}
    pairs = sorted(
        (abs(math.remainder(turn - there, math.tau)), name, theirs)
        for name, turn in turns.items()
        for theirs, there in names.items()
    )
    for _, name, theirs in pairs:
        if name not in found and theirs not in found.values():
            found[name] = theirs
    return found


def _turn(T_ego_camera: Matrix) -> float:
    return math.atan2(T_ego_camera[1, 2], T_ego_camera[0, 2])
