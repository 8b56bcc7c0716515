"""A storyboard fitted to the road of a recorded scene."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from real2sim_proto.storyboard import MapRoads, RouteLanes, Storyboard, resolved
from real2sim_proto.storyboard_actions import (
    LanePosition,
    RoadPosition,
    TeleportAction,
    WorldPosition,
)

from ..edit import ObjectState, PackedTracks
from ..scene import Ground, Scene, Trajectory
from ..world.boxes import REAR_OVERHANG
from ..world.ego.motion import Motion
from ..world.path import LoggedPath
from ..world.storyboard.roads import RoadNetwork, RouteNetwork, straight
from ..world.storyboard.run import StoryboardRun, own_centre
from ..world.traffic.driver import ObservedEgo, Surroundings
from . import ScenarioError


class Recorded(Protocol):
    """What is needed of a scene: a Scene, or the summary of one."""

    @property
    def ego(self) -> Trajectory: ...  # noqa: D102

    @property
    def ego_size(self) -> tuple[float, float, float]: ...  # noqa: D102


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
    ahead = _axle_ahead(board, scene)
    if isinstance(place, WorldPosition):
        fields["origin"] = _origin(place, ahead, scene, start_us)
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
        lanes = lanes.model_copy(update={"ego_lane": lane, "s": float(place.s) + ahead - here})
    if isinstance(place, LanePosition | RoadPosition) or isinstance(board.roads, MapRoads):
        fields["roads"] = lanes.model_dump()
    return Storyboard.model_validate(fields)


def begun_alone(board: Storyboard, network: RoadNetwork | None = None) -> StoryboardRun:
    """The start of a storyboard without a scene: an ego that it does not put anywhere stands at
    the origin.

    Args:
        board: the storyboard.
        network: its roads; None: straight lanes along the x axis, s at x.

    Raises:
        ScenarioError: the storyboard is about objects of a scene.
        WorldError: what it asks for cannot be.
    """
    of_scene = next((e for e in board.entities if e.kind == "object"), None)
    if of_scene is not None:
        raise ScenarioError(
            f"entity {of_scene.name!r} is the object {of_scene.object_id!r} of a scene; run the "
            "storyboard on that scene"
        )
    boxes = [e.box for e in resolved(board).entities if e.kind == "ego" and e.box is not None]
    length, width, height = (float(v) for v in (boxes[0].size if boxes else Scene.ego_size))
    route = straight(0.0, 0.0, 0.0)
    ego = ObservedEgo.of(Motion(0.0, 0.0, 0.0), route.nearest(0.0, 0.0), (length, width, height))
    ground = Ground(np.zeros(2), 1.0, np.zeros((2, 2), np.float32), np.ones((2, 2), np.bool_))
    nobody = PackedTracks[ObjectState](()).at(0)
    return StoryboardRun.begin(
        board, {}, Surroundings(0, 0, 1, ego, nobody, route, ground),
        ego_size=(length, width, height), network=network or _straight_lanes(board),
    )  # fmt: skip


def _straight_lanes(board: Storyboard) -> RouteNetwork:
    """Lanes along the x axis of the world, the route at y = 0 and s at x."""
    lanes = board.roads if isinstance(board.roads, RouteLanes) else RouteLanes()
    return RouteNetwork.of(lanes, straight(0.0, 0.0, 0.0))


def _ego_place(board: Storyboard) -> Any:
    """Its position; None: the storyboard does not place it."""
    ego = next((e.name for e in board.entities if e.kind == "ego"), None)
    places = [
        entry.action.position
        for entry in board.init
        if entry.entity == ego and isinstance(entry.action, TeleportAction)
    ]
    place = places[-1] if places else None
    others = any(e.kind == "object" for e in board.entities)
    if place is None or others or isinstance(place, LanePosition | RoadPosition | WorldPosition):
        return place
    run = begun_alone(board)
    there = run.entities[str(ego)]
    here = _straight_lanes(board).locate(there.x, there.y, there.h)
    if here is None:
        return WorldPosition(x=there.x, y=there.y, h=there.h)
    return LanePosition(road=here.road, lane=here.lane, s=here.s)


def _axle_ahead(board: Storyboard, scene: Recorded) -> float:
    """How far the ego's rear axle is ahead of its reference point [m]."""
    ego = next((e for e in resolved(board).entities if e.kind == "ego"), None)
    centre = None if ego is None or board.version < 2 else own_centre(ego, scene.ego_size)
    return 0.0 if centre is None else centre[0] - (scene.ego_size[0] / 2 - REAR_OVERHANG)


def _origin(
    place: WorldPosition, ahead: float, scene: Recorded, start_us: int | None
) -> tuple[float, float, float]:
    """Where the file's frame is in the scene's, so that the ego's place is where it begins."""
    T = scene.ego.transform(scene.ego.start_us if start_us is None else start_us)
    yaw = math.atan2(T[1, 0], T[0, 0]) - float(place.h)
    x = float(place.x) + ahead * math.cos(float(place.h))
    y = float(place.y) + ahead * math.sin(float(place.h))
    cos, sin = math.cos(yaw), math.sin(yaw)
    return float(T[0, 3]) - x * cos + y * sin, float(T[1, 3]) - x * sin - y * cos, yaw
