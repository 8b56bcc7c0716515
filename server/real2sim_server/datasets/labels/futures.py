"""Where objects and ego will be: what prediction and planning are trained on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...edit import ObjectState, PlacedObjects
from ...geometry.transform import Float, invert_transform, matrix_to_quaternion, quaternion_yaw
from ...world.path import LoggedPath, command_ahead, route_ahead
from ..drive import Drive

STEP_US = 500_000
"""Between instants of a future [us]."""
AGENT_STEPS, EGO_STEPS = 16, 8
"""8 s of every agent, 4 s of the ego."""


def futures_at(drive: Drive, t_us: int, object_ids: Sequence[str]) -> dict[str, list[list[float]]]:
    """The next 8 s of each object at 2 Hz, by id: rows (seconds, x, y, z, heading) in the world,
    as far as the object is there and the drive goes."""
    futures: dict[str, list[list[float]]] = {object_id: [] for object_id in object_ids}
    for step in range(1, AGENT_STEPS + 1):
        then = t_us + step * STEP_US
        if then > drive.span[1]:
            break
        placed = drive.placed_at(then)
        for object_id, row in _rows(placed, step).items():
            if object_id in futures and len(futures[object_id]) == step - 1:
                futures[object_id].append(row)
    return futures


def _rows(placed: PlacedObjects[ObjectState], step: int) -> dict[str, list[float]]:
    seconds = step * STEP_US * 1e-6
    yaws = quaternion_yaw(placed.quaternions)
    return {
        subject.object_id: [seconds, *position.tolist(), float(yaw)]
        for subject, position, yaw in zip(placed.objects, placed.positions, yaws, strict=True)
    }


def ego_future(drive: Drive, t_us: int) -> list[list[float]]:
    """The ego's next 4 s at 2 Hz: rows (seconds, x, y, heading) in its own frame at ``t_us``, as
    far as the drive goes."""
    to_ego = invert_transform(drive.ego_at(t_us))
    rows = []
    for step in range(1, EGO_STEPS + 1):
        then = t_us + step * STEP_US
        if then > drive.span[1]:
            break
        pose: Float = to_ego @ drive.ego_at(then)
        yaw = float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
        rows.append([step * STEP_US * 1e-6, float(pose[0, 3]), float(pose[1, 3]), yaw])
    return rows


def ego_state(drive: Drive, path: LoggedPath, t_us: int) -> dict[str, Any]:
    """What a planner is told at ``t_us``, as in a session: ``speed`` [m/s], ``command``, and
    ``route``, 20 places 2 m apart in the ego's frame [m] along ``path``, the recorded drive."""
    pose = drive.ego_at(t_us)
    x, y = pose[:2, 3].tolist()
    yaw = float(quaternion_yaw(matrix_to_quaternion(pose[:3, :3])))
    s = path.nearest(x, y).s
    return {
        "speed": drive.ego_speed_at(t_us),
        "command": command_ahead(path, s),
        "route": route_ahead(path, s, x, y, yaw).tolist(),
    }
