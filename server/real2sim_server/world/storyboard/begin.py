"""The storyboard of an episode at its start."""

from __future__ import annotations

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec
from real2sim_proto.storyboard import MapRoads, Storyboard, resolved

from ...edit import ScenarioState
from ...scene import Scene
from ...scene.lane_graph import LaneGraph
from ..draws import Draws
from ..errors import WorldError
from ..traffic.driver import Surroundings
from .entities import subjects_of
from .graph_roads import GraphNetwork
from .roads import RoadNetwork
from .run import StoryboardRun


def begin_storyboard(
    spec: ResetSpec, state: ScenarioState, surroundings: Surroundings, scene: Scene, draws: Draws
) -> StoryboardRun:
    """The run of the storyboard that a reset has.

    Args:
        spec: with a storyboard.
        state: objects of the scenario.
        surroundings: the start, the ego as it was recorded.
        scene: that it runs on.
        draws: of the episode.

    Raises:
        WorldError: INVALID_REQUEST where it does not go together with other options or cannot be;
            UNKNOWN_OBJECT, UNKNOWN_ASSET.
    """
    board = spec.storyboard
    assert board is not None
    if spec.beyond_log == "loop":
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a storyboard goes on in one direction, and beyond_log 'loop' puts the ego back",
            hint="let beyond_log be 'extend' or 'end'",
        )
    if spec.warmup_us:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            "a storyboard says where the ego begins, and a warm-up lets it follow the log",
            hint="leave out warmup_us, or the storyboard",
        )
    driven = {e.object_id for e in board.entities if e.kind == "object"} & set(spec.agents.drivers)
    if driven:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"object {min(map(str, driven))!r} has a driver and is moved by the storyboard",
            hint="leave it out of agents.drivers",
        )
    return StoryboardRun.begin(
        board,
        subjects_of(resolved(board).entities, state, scene),
        surroundings,
        ego_size=scene.ego_size,
        network=_network(board, scene),
        draws=draws,
    )


def _network(board: Storyboard, scene: Scene) -> RoadNetwork | None:
    """Roads of the scene's map where the storyboard is for a map; None: lanes along the route."""
    if not isinstance(board.roads, MapRoads):
        return None
    graph: LaneGraph | None = getattr(scene, "lanes", None)
    if graph is None or not graph.roads:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"the storyboard is for a road network ({board.roads.file or 'unnamed'}), and scene "
            f"{scene.name!r} has no map with roads",
            hint="run it on a scene made from that network, or with storyboard.roads of kind "
            "'route', lanes along the ego's route",
        )
    return GraphNetwork(graph)
