"""A storyboard fitted to the road of a recorded scene."""

from __future__ import annotations

import math
from typing import Any, Protocol

from real2sim_proto.storyboard import MapRoads, RouteLanes, Storyboard, resolved
from real2sim_proto.storyboard_actions import (
    LanePosition,
    RoadPosition,
    TeleportAction,
    WorldPosition,
)

from ..scene import Trajectory
from ..world.path import LoggedPath
from .errors import ScenarioError


class Recorded(Protocol):
    """What is needed of a scene: a Scene, or the summary of one."""

    @property
    def ego(self) -> Trajectory: ...  # noqa: D102


def fitted_to_scene(
    board: Storyboard, scene: Recorded, *, start_us: int | None = None
) -> Storyboard:
    """The storyboard with its roads laid along the scene's route, so that the ego begins where it
    was recorded: places on roads by lane and s, places of the world by a rigid motion. Where the
    storyboard does not place the ego nothing is moved.

    Args:
        board: the storyboard; of its road network one lane's width, 3.5 m, and a straight course
            are taken for granted where the scene has no map of its own.
        scene: to run it on.
        start_us: when the episode begins [us]; None: at the start of the recording.

    Raises:
        ScenarioError: the ego begins in a lane on the left of the road's reference line, whose
            traffic the scene's route cannot be.
    """
    place = _ego_place(resolved(board))
    fields: dict[str, Any] = board.model_dump()
    lanes = board.roads if isinstance(board.roads, RouteLanes) else RouteLanes()
    if isinstance(place, WorldPosition):
        fields["origin"] = _origin(place, scene, start_us)
    elif isinstance(place, LanePosition | RoadPosition):
        lane = int(place.lane) if isinstance(place, LanePosition) else lanes.ego_lane
        if lane >= 0:
            raise ScenarioError(
                f"the ego begins in lane {lane}, on the left of its road; scenes are driven on the "
                "right. Turn the scenario round, or run it without a scene"
            )
        path = LoggedPath(scene.ego)
        position, _ = scene.ego.pose(scene.ego.start_us if start_us is None else start_us)
        here = path.nearest(float(position[0]), float(position[1])).s
        lanes = lanes.model_copy(update={"ego_lane": lane, "s": float(place.s) - here})
    if isinstance(place, LanePosition | RoadPosition) or isinstance(board.roads, MapRoads):
        fields["roads"] = lanes.model_dump()
    return Storyboard.model_validate(fields)


def _ego_place(board: Storyboard) -> Any:
    ego = next((e.name for e in board.entities if e.kind == "ego"), None)
    places = [
        entry.action.position
        for entry in board.init
        if entry.entity == ego and isinstance(entry.action, TeleportAction)
    ]
    return places[-1] if places else None


def _origin(
    place: WorldPosition, scene: Recorded, start_us: int | None
) -> tuple[float, float, float]:
    """Where the file's frame is in the scene's, so that the ego's place is where it begins."""
    T = scene.ego.transform(scene.ego.start_us if start_us is None else start_us)
    yaw = math.atan2(T[1, 0], T[0, 0]) - float(place.h)
    x, y = float(place.x), float(place.y)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return float(T[0, 3]) - x * cos + y * sin, float(T[1, 3]) - x * sin - y * cos, yaw
