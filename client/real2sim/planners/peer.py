"""Planners that run elsewhere, behind an interface of another simulator."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .._session_state import Matrix, pose_matrix
from ..errors import Real2SimError

if TYPE_CHECKING:
    from real2sim_proto.drive import EgoState
    from real2sim_proto.scenes import CameraInfo

    from ..images import Frame
    from ..observation import Observation


class PeerError(Real2SimError):
    """The external planner is unreachable, or returns an invalid plan."""


def T_world_ego(ego: EgoState) -> Matrix:
    """[4, 4] pose of the vehicle: rear axle on the ground, x forward, y left, z up."""
    return pose_matrix(ego.position, ego.quaternion)


def T_ego_camera(obs: Observation, frame: Frame) -> Matrix:
    """[4, 4] pose of a camera (x right, y down, z forward) on the vehicle."""
    pose: Matrix = np.linalg.inv(T_world_ego(obs.ego)) @ frame.T_world_sensor
    return pose


def rgb_frames(obs: Observation) -> dict[str, Frame]:
    """The colour image of each camera, by its name.

    Raises:
        PeerError: the observation has no colour image.
    """
    frames = {name: found["rgb"] for name, found in obs.frames.items() if "rgb" in found}
    if not frames:
        raise PeerError("the observation shows no rgb image; reset with sensors for the planner")
    return frames


def headings(points: NDArray[np.floating[Any]], *, moved: float = 0.1) -> list[float]:
    """Directions of travel [N] at points [N, 2] of a path that starts at the origin along x [rad].

    Each is the direction from the previous to the next point; within ``moved`` metres it is held.
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
    """Parse finite points [N, columns], N at least 1, from an answer. Raises PeerError."""
    try:
        points = np.asarray(answer, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PeerError(f"{what} is not a list of points: {error}") from error
    if points.ndim != 2 or points.shape[1] != columns or not len(points):
        raise PeerError(f"{what} has shape {list(points.shape)}, not [N, {columns}]")
    if not np.isfinite(points).all():
        raise PeerError(f"{what} holds values that are not finite")
    return points


def named_as(
    frames: Mapping[str, Frame], obs: Observation, names: Mapping[str, float]
) -> dict[str, str]:
    """Names that another simulator uses for the cameras.

    Cameras that have one of these names keep it. Others receive the free name with the nearest
    direction, or no name if all are taken.

    Args:
        frames: one frame per camera, by its name in the scene.
        obs: observation of the frames.
        names: direction by external name [rad], positive to the left.
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


@dataclass(frozen=True)
class Look:
    """Direction and field of view of a camera [rad]; ``turn`` is positive to the left."""

    turn: float
    field: float

    @classmethod
    def of(cls, K: Any, width: int, T_ego_camera: Any) -> Look:
        """The look of a pinhole camera on the vehicle."""
        K, pose = np.asarray(K, dtype=np.float64), np.asarray(T_ego_camera, dtype=np.float64)
        left, right = K[0, 2] / K[0, 0], (width - K[0, 2]) / K[0, 0]
        return cls(_turn(pose), math.atan(left) + math.atan(right))


def looks_of(cameras: Iterable[CameraInfo]) -> dict[str, Look]:
    """The look of each camera of a scene, by name."""
    return {c.name: Look.of(c.K, c.width, c.T_vehicle_camera) for c in cameras}


def looks_in(obs: Observation) -> dict[str, Look]:
    """Looks of the cameras with images in an observation, by name."""
    return {
        name: Look.of(frame.K, frame.shape[1], T_ego_camera(obs, frame))
        for name, frame in rgb_frames(obs).items()
    }


def cameras_for(
    names: Iterable[str],
    there: Mapping[str, Look],
    *,
    known: Mapping[str, Look],
    given: Mapping[str, str],
) -> dict[str, str]:
    """The scene camera for each external name.

    This is the camera of the same name, or the one in ``given``. For names in ``known``, it is the
    camera with the most similar direction, then the most similar field of view. One camera may
    serve several names.

    Raises:
        PeerError: no camera fits a name.
    """
    return {name: _camera_for(name, there, known, given) for name in names}


MAX_ANGLE = math.radians(60)
"""Maximum angle between the axes of two matching cameras [rad]."""


def _camera_for(
    name: str, there: Mapping[str, Look], known: Mapping[str, Look], given: Mapping[str, str]
) -> str:
    wanted = given.get(name, name)
    if wanted in there:
        return wanted
    cameras = ", ".join(there) or "none"
    if name in given:
        raise PeerError(
            f"camera {wanted!r}, given for {name!r}, does not exist; available: {cameras}"
        )
    if name not in known:
        raise PeerError(
            f"the planner needs camera {name!r}, which matches none of {cameras} by name",
            hint=f"map it: cameras={name}:{next(iter(there), 'CAMERA')}",
        )
    look = known[name]

    def apart(camera: str) -> float:
        return abs(math.remainder(there[camera].turn - look.turn, math.tau))

    near = [camera for camera in there if apart(camera) <= MAX_ANGLE]
    if not near:
        raise PeerError(
            f"the planner needs camera {name!r}, but none of {cameras} faces that direction",
            hint=f"use another one: cameras={name}:{next(iter(there), 'CAMERA')}",
        )
    return min(near, key=lambda c: (apart(c) + 0.5 * abs(there[c].field - look.field), c))


def quoted_cameras(text: str) -> list[str]:
    """Camera names listed in an error message such as ``cameras ['a', 'b'] are missing``."""
    lists: list[str] = re.findall(r"[Cc]ameras?\s*[\[({]([^\])}]*)", text)
    return list(dict.fromkeys(re.findall(r"['\"]([^'\"]+)['\"]", " ".join(lists))))


def _turn(T_ego_camera: Matrix) -> float:
    return math.atan2(T_ego_camera[1, 2], T_ego_camera[0, 2])
