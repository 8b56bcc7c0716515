"""The road of a storyboard: fitted to a recorded scene, or a flat scene with painted lanes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from real2sim_proto.base import Model
from real2sim_proto.storyboard import MapRoads, RouteLanes, Storyboard, resolved
from real2sim_proto.storyboard_actions import (
    LanePosition,
    RoadPosition,
    TeleportAction,
    WorldPosition,
)

from ..edit import ObjectState, PackedTracks
from ..geometry import Float, yaw_quaternion
from ..maps import read_map
from ..scene import Camera, CameraRig, GaussianCloud, Ground, Scene, SceneObject, Sky, Trajectory
from ..scene.asset import person_asset
from ..scene.lane_graph import LaneGraph
from ..world.boxes import REAR_OVERHANG
from ..world.ego_motion import Motion
from ..world.path import LoggedPath
from ..world.storyboard.roads import GraphNetwork, Place, RoadNetwork, RouteNetwork, Way, straight
from ..world.storyboard.run import BOXES, StoryboardRun, own_centre
from ..world.traffic.driver import ObservedEgo, Surroundings
from . import ScenarioError

# --- Fitting to a recorded scene ------------------------------------------------------------------


class Recorded(Protocol):
    """The required parts of a scene: a Scene, or its summary."""

    @property
    def ego(self) -> Trajectory: ...  # noqa: D102

    @property
    def ego_size(self) -> tuple[float, float, float]: ...  # noqa: D102


def fitted_to_scene(
    board: Storyboard, scene: Recorded, *, start_us: int | None = None
) -> Storyboard:
    """Place a storyboard on the scene's route, so that the ego starts at its recorded pose.

    Positions on roads are mapped by lane and s, positions in the world by a rigid motion. If the
    storyboard does not place the ego, nothing is moved.

    Args:
        board: the storyboard. If the scene has no map, its road network is assumed to be straight
            with lanes 3.5 m wide.
        scene: scene for the run.
        start_us: start of the episode [us]; None: start of the recording.

    Raises:
        ScenarioError: the ego starts in a lane on the left of the road's reference line, which
            cannot be mapped to the scene's route.
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
    """The start of a storyboard without a scene; an ego without a position is placed at the origin.

    Args:
        board: the storyboard.
        network: its roads; None: straight lanes along the x axis, s at x.

    Raises:
        ScenarioError: the storyboard refers to objects of a scene.
        WorldError: invalid content.
    """
    of_scene = next((e for e in board.entities if e.kind == "object"), None)
    if of_scene is not None:
        raise ScenarioError(
            f"entity {of_scene.name!r} is the object {of_scene.object_id!r} of a scene; run the "
            "storyboard on that scene"
        )
    ego_size = _ego_size(board)
    return StoryboardRun.begin(
        board,
        {},
        nobody_around(board),
        ego_size=ego_size,
        network=network or _straight_lanes(board),
    )


def _ego_size(board: Storyboard) -> tuple[float, float, float]:
    boxes = [e.box for e in resolved(board).entities if e.kind == "ego" and e.box is not None]
    length, width, height = (float(v) for v in (boxes[0].size if boxes else Scene.ego_size))
    return length, width, height


def nobody_around(board: Storyboard) -> Surroundings:
    """The first instant of an ego that stands at the origin, without a scene."""
    route = straight(0.0, 0.0, 0.0)
    ego = ObservedEgo.of(Motion(0.0, 0.0, 0.0), route.nearest(0.0, 0.0), _ego_size(board))
    ground = Ground(np.zeros(2), 1.0, np.zeros((2, 2), np.float32), np.ones((2, 2), np.bool_))
    return Surroundings(0, 0, 1, ego, PackedTracks[ObjectState](()).at(0), route, ground)


def _straight_lanes(board: Storyboard) -> RouteNetwork:
    """Lanes along the x axis of the world, the route at y = 0 and s at x."""
    lanes = board.roads if isinstance(board.roads, RouteLanes) else RouteLanes()
    return RouteNetwork.of(lanes, straight(0.0, 0.0, 0.0))


def _ego_place(board: Storyboard) -> Any:
    """Position of the ego; None if the storyboard does not place it."""
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
    """Distance from the ego's reference point forward to its rear axle [m]."""
    ego = next((e for e in resolved(board).entities if e.kind == "ego"), None)
    centre = None if ego is None else own_centre(ego, scene.ego_size)
    return 0.0 if centre is None else centre[0] - (scene.ego_size[0] / 2 - REAR_OVERHANG)


def _origin(
    place: WorldPosition, ahead: float, scene: Recorded, start_us: int | None
) -> tuple[float, float, float]:
    """Pose of the file's frame in the scene that puts the ego at its start."""
    T = scene.ego.transform(scene.ego.start_us if start_us is None else start_us)
    yaw = math.atan2(T[1, 0], T[0, 0]) - float(place.h)
    x = float(place.x) + ahead * math.cos(float(place.h))
    y = float(place.y) + ahead * math.sin(float(place.h))
    cos, sin = math.cos(yaw), math.sin(yaw)
    return float(T[0, 3]) - x * cos + y * sin, float(T[1, 3]) - x * sin - y * cos, yaw


# --- Flat scene -----------------------------------------------------------------------------------

BEFORE, SECONDS = 60.0, 40.0
"""Length of the road behind the ego's start [m]; duration of the recorded drive [s]."""

MIN_EGO_SPEED, GAIN = 5.0, 1.0
"""Minimum speed that the recorded drive reaches [m/s], and its acceleration [m/s^2]."""

STEP_US = 100_000
AWAY = (-1000.0, 0.0, -50.0)
"""Out-of-sight position of objects that only define appearances [m]."""
ASPHALT, PAINT, GRASS = (0.33, 0.33, 0.35), (0.92, 0.92, 0.9), (0.42, 0.5, 0.36)
COLOURS = {
    "car": (0.75, 0.16, 0.14), "van": (0.85, 0.85, 0.82), "truck": (0.2, 0.35, 0.6),
    "bus": (0.8, 0.6, 0.15), "motorcycle": (0.12, 0.12, 0.14), "cyclist": (0.15, 0.45, 0.25),
    "pedestrian": (0.2, 0.3, 0.65), "animal": (0.45, 0.32, 0.2),
}  # fmt: skip
SH0 = 0.28209479177387814


def flat_scene(
    board: Storyboard, road_file: Path | None = None, *, seconds: float = SECONDS
) -> Scene:
    """A scene for a storyboard without a recording.

    Its recorded drive starts at the storyboard's ego position with the ego's speed and size, and
    follows the lane. Without an ego it runs straight ahead from the origin.

    Args:
        board: the storyboard.
        road_file: its road network in OpenDRIVE; without one, lanes follow the route.
        seconds: length of the drive.

    Raises:
        ScenarioError: the road network is required and missing, or the storyboard refers to objects
            of a scene.
        MapError: the road network cannot be read.
        WorldError: the ego has no valid position on it.
    """
    graph = _graph(board, road_file)
    run = begun_alone(board, None if graph is None else GraphNetwork(graph))
    start, speed, more = _start(run)
    way = _way(start, graph)
    times = np.arange(int(seconds * 1e6) // STEP_US + 1, dtype=np.int64) * STEP_US
    near = way.path.nearest(start.x, start.y)
    places = [way.path.at(near.s + _distance_driven(speed, t * 1e-6)) for t in times.tolist()]
    points = np.array([(x, y, 0.0) for x, y, _, _ in places])
    quaternions = np.array([yaw_quaternion(h) for *_, h in places])
    drive = Trajectory(times, points, quaternions)
    if graph is not None:
        more["lanes"] = graph
    background = _merged([*_surface(points, [h for *_, h in places]), *_lane_lines(graph)])
    return Scene(
        name="flat",
        background=background,
        objects=_looks(),
        sky=_sky(),
        rig=CameraRig(_cameras()),
        ego=drive,
        frame_times_us=times,
        stored_ground=_ground(points),
        provenance={"source": "flat", "storyboard": board.name},
        **more,
    )


def _graph(board: Storyboard, road_file: Path | None) -> LaneGraph | None:
    if not isinstance(board.roads, MapRoads):
        return None
    if road_file is None or not road_file.is_file():
        raise ScenarioError(
            f"the road network {str(road_file or board.roads.file)!r} of the scenario does not "
            "exist; put it there, or run the scenario on a scene"
        )
    return read_map(road_file)


def positions_off_roads(board: Storyboard, graph: LaneGraph) -> list[str]:
    """One note for each position beyond the ends of its road; it is moved to the nearest end."""
    found = dict[str, None]()

    def visit(part: Any) -> None:
        if isinstance(part, LanePosition | RoadPosition) and part.road in graph.roads:
            s, length = float(part.s), graph.road(part.road).length
            if not 0.0 <= s <= length:
                found[
                    f"s = {s:g} m is not on road {part.road!r}, which is {length:g} m long; the "
                    "position is moved to its end"
                ] = None
        elif isinstance(part, list):
            for each in part:
                visit(each)
        elif isinstance(part, Model):
            for each in part.__dict__.values():
                visit(each)

    visit(resolved(board))
    return list(found)


def _start(run: StoryboardRun) -> tuple[Place, float, dict[str, Any]]:
    """Start of the recorded drive, its speed, and further ego properties of the scene."""
    if run.ego is None:
        return Place(0.0, 0.0, 0.0), MIN_EGO_SPEED, {}
    ego = run.entities[run.ego]
    (x, y), speed = ego.axle, ego.speed if run.ego_put else MIN_EGO_SPEED
    if ego.trajectory is not None and ego.trajectory.timing is not None:
        speed = ego.trajectory.step(0.0, STEP_US * 1e-6)[0] / (STEP_US * 1e-6)
    return Place(x, y, ego.h), max(speed, 0.0), {"ego_size": ego.size}


def _distance_driven(speed: float, t: float) -> float:
    """Distance after ``t`` seconds [m], from at least ``MIN_EGO_SPEED``."""
    gaining = min(max(t - STEP_US * 1e-6, 0.0), max(MIN_EGO_SPEED - speed, 0.0) / GAIN)
    after = max(t - STEP_US * 1e-6 - gaining, 0.0)
    return speed * (t - after) + GAIN * gaining**2 / 2 + max(speed, MIN_EGO_SPEED) * after


def _way(start: Place, graph: LaneGraph | None) -> Way:
    if graph is not None:
        network = GraphNetwork(graph)
        here = network.locate(start.x, start.y, start.h)
        if here is not None:
            along = math.cos(start.h - here.h) >= 0.0
            return network.way(here.road, here.lane, here.s, along=along)
    path = straight(start.x, start.y, start.h)
    return Way("", 0, True, path)


# --- appearance -------------------------------------------------------------------------------


def _surface(points: Float, headings: Sequence[float]) -> list[GaussianCloud]:
    """Road and grass along the drive, with the lines of lanes of 3.5 m."""
    first, last = points[0, :2], points[-1, :2]
    h0 = headings[0]
    back = first - BEFORE * np.array([math.cos(h0), math.sin(h0)])
    way = np.vstack([back, points[:, :2], last + 60.0 * _unit(headings[-1])])
    yaws = np.array([h0, *headings, headings[-1]])
    path = LoggedPath.through(
        np.column_stack([way, np.zeros(len(way))]), np.unwrap(yaws),
        np.tile([0.0, 0.0, 1.0], (len(way), 1)),
    )  # fmt: skip
    length = min(path.length, 600.0)
    road = _strip(path, length, np.arange(-6.5, 8.6, 0.7), _Paint(0.8, ASPHALT, -0.02))
    side = np.concatenate([np.arange(-19.0, -7.0, 1.6), np.arange(9.5, 21.0, 1.6)])
    grass = _strip(path, length, side, _Paint(1.9, GRASS, -0.04))
    line, dashed = _Paint(0.35, PAINT, 0.0), _Paint(0.35, PAINT, 0.0, 9.0)
    lines = [_strip(path, length, np.array([t]), line) for t in (-5.25, 8.75)]
    dashes = [_strip(path, length, np.array([t]), dashed) for t in (-1.75, 1.75, 5.25)]
    return [road, grass, *lines, *dashes]


class _Paint(NamedTuple):
    """Appearance of a strip: spacing [m], colour, height [m], period of dashes or 0 [m]."""

    step: float
    colour: tuple[float, float, float]
    z: float
    dash: float = 0.0


def _strip(path: LoggedPath, length: float, offsets: Float, paint: _Paint) -> GaussianCloud:
    """Flat Gaussians along a path."""
    step, colour, z, dash = paint
    s = np.arange(0.0, length, step)
    s = s[(s % dash) < dash / 3] if dash else s
    places = np.array([path.at(float(v)) for v in s])
    left = np.stack([-np.sin(places[:, 3]), np.cos(places[:, 3])], axis=1)
    means = places[:, None, :2] + offsets[None, :, None] * left[:, None]
    flat = means.reshape(-1, 2)
    width = step * 0.5 if len(offsets) > 1 else 0.07
    scales = np.tile([step * 0.5, width, 0.01], (len(flat), 1))
    quats = np.repeat([yaw_quaternion(h) for h in places[:, 3]], len(offsets), axis=0)
    return _cloud(np.column_stack([flat, np.full(len(flat), z)]), scales, quats, colour)


def _lane_lines(graph: LaneGraph | None) -> list[GaussianCloud]:
    """Thinned centre lines of all lanes of a map."""
    found = []
    for lane in graph.lanes.values() if graph is not None else ():
        yaws = np.unwrap(lane.headings)
        path = LoggedPath.through(lane.centre, yaws, np.tile([0.0, 0.0, 1.0], (len(yaws), 1)))
        found.append(
            _strip(path, min(lane.length, 400.0), np.array([0.0]), _Paint(1.0, PAINT, 0.005, 6.0))
        )
    return found


def _looks() -> dict[str, SceneObject]:
    """A person, and a box for each other category, that define appearances.

    They are out of sight, before the start of the drive. Stationary tracks may be extended if an
    episode is longer than the log.
    """
    found = {}
    for name, (size, _) in BOXES.items():
        before = Trajectory(
            np.array([-2_000_000], np.int64), np.array([AWAY]), np.array([[1.0, 0.0, 0.0, 0.0]])
        )
        look = f"look_{name}"
        if name == "pedestrian":
            person = person_asset(look, "man", clothes={"top": COLOURS[name]})
            found[look] = SceneObject(
                look, name, person.size, person.cloud, before, figure=person.figure
            )
        else:
            found[look] = SceneObject(look, name, size, _box(size, COLOURS[name]), before)
    return found


def _box(size: tuple[float, float, float], colour: tuple[float, float, float]) -> GaussianCloud:
    """Gaussians on the faces of a box about the origin; its upper front half is glass."""
    clouds = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        step = max(min(size[u], size[v]) / 6, 0.08)
        a = np.arange(-size[u] / 2 + step / 2, size[u] / 2, step)
        b = np.arange(-size[v] / 2 + step / 2, size[v] / 2, step)
        grid = np.stack(np.meshgrid(a, b, indexing="ij"), -1).reshape(-1, 2)
        for side in (-1, 1):
            means = np.zeros((len(grid), 3))
            means[:, u], means[:, v] = grid[:, 0], grid[:, 1]
            means[:, axis] = side * size[axis] / 2
            scales = np.full((len(grid), 3), step * 0.55)
            scales[:, axis] = 0.01
            shade = {0: 0.8, 1: 0.65, 2: 1.0}[axis]
            tint = tuple(c * shade for c in colour)
            quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(grid), 1))
            clouds.append(_cloud(means, scales, quats, tint))  # type: ignore[arg-type]
    return _merged(clouds)


def _cloud(
    means: Float, scales: Float, quats: Float, colour: tuple[float, float, float]
) -> GaussianCloud:
    count = len(means)
    sh = (np.array(colour) - 0.5) / SH0
    return GaussianCloud(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor(quats, dtype=torch.float32),
        scales=torch.tensor(scales, dtype=torch.float32),
        opacities=torch.full((count,), 0.95),
        sh=torch.tensor(np.tile(sh, (count, 1, 1)), dtype=torch.float32),
    )


def _merged(clouds: list[GaussianCloud]) -> GaussianCloud:
    def joined(name: str) -> torch.Tensor:
        return torch.cat([getattr(cloud, name) for cloud in clouds])

    return GaussianCloud(
        means=joined("means"), quats=joined("quats"), scales=joined("scales"),
        opacities=joined("opacities"), sh=joined("sh"),
    )  # fmt: skip


def _sky() -> Sky:
    faces = torch.zeros(6, 4, 4, 3)
    faces[...] = torch.tensor([0.62, 0.74, 0.88])
    return Sky(faces)


def _cameras() -> tuple[Camera, ...]:
    """One camera behind and above the ego, and one looking ahead from its windscreen."""
    K = np.array([[460.0, 0.0, 320.0], [0.0, 460.0, 180.0], [0.0, 0.0, 1.0]])
    return (
        Camera("chase", 640, 360, K, _looking((-9.0, 0.0, 6.0), math.radians(16.0))),
        Camera("front", 640, 360, K, _looking((1.6, 0.0, 1.4), 0.0)),
    )


def _looking(position: tuple[float, float, float], down: float) -> Float:
    """``T_vehicle_camera`` of a camera that looks ahead, pitched down by an angle [rad]."""
    cos, sin = math.cos(down), math.sin(down)
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, -sin, cos], [-1.0, 0.0, 0.0], [0.0, -cos, -sin]])
    T[:3, 3] = position
    return T


def _ground(points: Float) -> Ground:
    low = points[:, :2].min(axis=0) - 100.0
    count = np.ceil((points[:, :2].max(axis=0) + 100.0 - low) / 20.0).astype(int) + 2
    heights = np.zeros(tuple(count.tolist()), np.float32)
    return Ground(low, 20.0, heights, np.ones(heights.shape, np.bool_))


def _unit(h: float) -> Float:
    return np.array([math.cos(h), math.sin(h)])
