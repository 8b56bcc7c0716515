"""One episode without a network: a world, and a planner that sees what a worker would send."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from real2sim.images import Frame
from real2sim.observation import Observation, observation_from_wire
from real2sim.planners import Needs, needs_of
from real2sim_proto.drive import Obs
from real2sim_proto.episode import ResetSpec
from real2sim_proto.operations import Operation
from real2sim_proto.plans import PLAN, Control, PoseCommand, TrajectoryPlan

from ..edit import EditError, ScenarioState
from ..policies.suite import Case
from ..render import RasterOptions, View, rasterize_batch
from ..render.images import to_uint8
from ..scene import Camera, Scene
from ..service.library.views import camera_infos
from ..world import World, WorldError
from ..world.recording.recording import Recording, record
from ..world.recording.replay import Entry, Replayer, action_payload, edit_payload, reset_payload
from ..world.scoring import metrics_version
from .criticality import Danger, adversaries_of

# --- Images --------------------------------------------------------------------------------------

RGB = RasterOptions(depth=False, instance=False)


@dataclass(frozen=True, eq=False)
class CameraFeed:
    """The colour images that a planner asks for.

    Attributes:
        cameras: resized to what it wants.
    """

    cameras: tuple[Camera, ...]

    @classmethod
    def of(cls, scene: Scene, needs: Needs) -> CameraFeed | None:
        """What a planner needs; None for one that is blind.

        Raises:
            ValueError: images other than colour, or a camera that the scene lacks.
        """
        if not needs.modalities:
            return None
        if set(needs.modalities) != {"rgb"}:
            raise ValueError(
                f"the planner wants {', '.join(needs.modalities)}; sweeps draw rgb alone: drive it "
                "with evaluate-policy"
            )
        sensors = needs.sensors(camera_infos(tuple(scene.rig)))
        cameras = (scene.rig[sensor["camera"]] for sensor in sensors)
        return cls(tuple(c if needs.width is None else c.resized(needs.width) for c in cameras))

    def added_to(self, obs: Observation, world: World) -> Observation:
        """The observation with the images of its instant."""
        frames = {camera.name: {"rgb": draw_frames([world], camera)[0]} for camera in self.cameras}
        return replace(obs, frames=frames)


def draw_frames(worlds: Sequence[World], camera: Camera) -> list[Frame]:
    """What a camera sees in each of several worlds of one scene, drawn in one call.

    Args:
        worlds: at their instants; one at least.
        camera: of the ego.
    """
    views = [View(w.instances(), camera.viewmat(w.T_world_body), camera.K) for w in worlds]
    drawn = rasterize_batch(
        views, camera.width, camera.height, sky=worlds[0].scene.sky, options=RGB
    )
    images = zip(worlds, to_uint8(drawn.rgb), strict=True)
    return [_frame(world, camera, image) for world, image in images]


def _frame(world: World, camera: Camera, image: NDArray[np.uint8]) -> Frame:
    return Frame(
        modality="rgb",
        codec="raw",
        dtype="uint8",
        shape=image.shape,
        data=image.tobytes(),
        sensor=camera.name,
        t_us=world.t_us,
        T_world_sensor=world.T_world_body @ camera.T_vehicle_camera,
        K=camera.K,
    )


OPERATIONS: TypeAdapter[list[Operation]] = TypeAdapter(list[Operation])
PLANS = (TrajectoryPlan, Control, PoseCommand)


@dataclass(frozen=True)
class Drive:
    """One episode to drive.

    Attributes:
        planner: by name, as ``load_planner`` takes it.
        reset: options, the seed among them; without what the planner needs.
        operations: edits when it begins, as JSON.
    """

    planner: str
    reset: Mapping[str, Any]
    operations: tuple[Mapping[str, Any], ...] = ()

    @classmethod
    def of(cls, case: Case, planner: str, seed: int) -> Drive:
        """The episode of a case."""
        edits = tuple(o.model_dump(mode="json") for o in case.operations)
        return cls(planner, case.reset_for(seed), edits)

    def key(self, scene_hash: str) -> str:
        """Hex, the same for episodes that come out the same: scene, options, edits, planner with
        the file that it is made of, and the versions of program and scores."""
        name, _, argument = self.planner.partition("=")
        content = {
            "scene": scene_hash,
            "planner": [name, _file_hash(argument) if argument else ""],
            "reset": dict(self.reset),
            "operations": [dict(o) for o in self.operations],
            "versions": [version("real2sim"), metrics_version()],
        }
        text = json.dumps(content, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(eq=False)
class Driven:
    """An episode that was driven.

    Attributes:
        world: at its end; None where it could not begin.
        danger: seen on the way.
        error: why it could not begin, or what its planner raised; None for one that went well.
        entries: what a recording holds; empty unless asked for.
        worlds: at every step; empty unless asked for.
    """

    world: World | None
    danger: Danger
    error: str | None = None
    entries: list[Entry] = field(default_factory=list)
    worlds: list[World] = field(default_factory=list)

    @property
    def at_fault(self) -> bool:
        """Whether a collision was the planner's fault."""
        return self.world is not None and sum(self.world.accumulator.at_fault.values()) > 0

    @property
    def criticality(self) -> float:
        """See :meth:`.criticality.Danger.criticality`; NaN for one that could not begin."""
        return math.nan if self.world is None else self.danger.criticality(self.world)


def begin(scene: Scene, drive: Drive, needs: Needs, *, privileged: bool) -> World:
    """The world of an episode at its first instant, before its edits.

    Raises:
        WorldError, ValidationError: the episode cannot run as asked.
    """
    options = {**drive.reset, "action": needs.action, "privileged": privileged}
    return World(scene, ScenarioState.of(scene), ResetSpec.model_validate(options))


def drive_episode(
    scene: Scene,
    drive: Drive,
    planner: Any,
    *,
    keep_entries: bool = False,
    keep_worlds: bool = False,
    on_world: Callable[[World], None] | None = None,
) -> Driven:
    """Let a planner drive an episode; what it raises ends it.

    As over the network, edits are made at the first instant, which the planner has seen without
    them.

    Args:
        scene: of the case.
        drive: the episode.
        planner: as loaded.
        keep_entries: so that it can be recorded.
        keep_worlds: so that others can go on from each of its steps.
        on_world: shown the world at every instant.
    """
    needs = needs_of(planner)
    try:
        # A planner that does not say what it needs gets everything, as in `real2sim drive`.
        privileged = needs.privileged or not hasattr(planner, "needs")
        world = begin(scene, drive, needs, privileged=privileged)
    except (WorldError, ValidationError) as error:
        return Driven(None, Danger(), f"{type(error).__name__}: {error}")
    driven = Driven(world, Danger(adversaries_of(drive.reset, drive.operations)))
    feed = CameraFeed.of(scene, needs)
    if keep_entries:
        driven.entries.append(Entry("reset", 0, reset_payload(world.spec)))
    obs = observation_of(world, feed)
    try:
        if drive.operations:
            operations = OPERATIONS.validate_python([dict(o) for o in drive.operations])
            world.apply(operations)
            if keep_entries:
                driven.entries.append(Entry("edit", 0, edit_payload(operations)))
    except (EditError, ValidationError) as error:
        return Driven(None, Danger(), f"{type(error).__name__}: {error}")
    driven.danger.add(world)
    for show in (on_world,) if on_world else ():
        show(world)
    while not world.over:
        try:
            if world.steps == 0:
                planner.reset(obs)
            plan = _checked(planner.plan(obs))
            if keep_worlds:
                driven.worlds.append(world.fork())
            world.step(plan)
        except Exception as error:  # A planner may raise anything; it ends its own episode only.
            driven.error = f"{type(error).__name__}: {error}"[:500]
            break
        if keep_entries:
            driven.entries.append(Entry("action", world.steps - 1, action_payload(plan)))
        driven.danger.add(world)
        for show in (on_world,) if on_world else ():
            show(world)
        obs = observation_of(world, feed)
    return driven


def observation_of(world: World, feed: CameraFeed | None = None) -> Observation:
    """What a session would show."""
    obs = observation_from_wire(Obs(**world.observe().obs_fields(), frames=[]))
    return obs if feed is None else feed.added_to(obs, world)


def recording_of(scene: Scene, driven: Driven) -> Recording:
    """The recording of an episode whose entries were kept."""
    replayer = Replayer.on(scene, ScenarioState.of(scene))
    return record(replayer, driven.entries, scene_hash=scene.content_hash or "")


def _checked(plan: Any) -> TrajectoryPlan | Control | PoseCommand:
    return plan if isinstance(plan, PLANS) else PLAN.validate_python(plan)


@cache
def _file_hash(argument: str) -> str:
    path = Path(argument)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else argument
