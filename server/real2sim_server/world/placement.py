"""Where an edit of a running episode puts road users: beside the ego's route, from now on."""

from __future__ import annotations

import math
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.base import Pose
from real2sim_proto.operations import Operation, SetStoryboard, Spawn

from ..edit import EditError
from ..geometry.rotation import yaw_quaternion
from ..scene import Ground
from .path import LoggedPath


def placed(
    operation: Operation, route: LoggedPath, s: float, ground: Ground, *, t_us: int
) -> Operation:
    """The operation with what the episode alone knows: the time, and where the ego is.

    Args:
        operation: of an author.
        route: of the ego.
        s: where the ego is along it [m].
        ground: of the scene.
        t_us: now [us].

    Raises:
        EditError: INVALID_OPERATION for a storyboard, which an episode has from its start.
    """
    if isinstance(operation, SetStoryboard):
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            "an episode has its storyboard from its start; it cannot be set while it runs",
            hint="set it of the scenario, or send it with the next reset",
        )
    if not isinstance(operation, Spawn):
        return operation
    known: dict[str, Any] = {}
    if operation.start_us is None:
        known["start_us"] = t_us
    if (place := operation.place) is not None:
        x, y, _, yaw = route.at(s + place.ahead)
        x, y = x - place.offset * math.sin(yaw), y + place.offset * math.cos(yaw)
        w, qx, qy, qz = yaw_quaternion(yaw + math.pi if place.oncoming else yaw).tolist()
        pose = Pose(position=(x, y, ground.height(x, y)), quaternion=(w, qx, qy, qz))
        known |= {"pose": pose, "place": None}
    return operation.model_copy(update=known)
