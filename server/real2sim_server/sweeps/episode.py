"""One episode without a network: a world, and a planner with the observations of a worker."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from real2sim.images import Frame
from real2sim.observation import Observation, observation_from_wire
from real2sim.planners import Needs, load_planner, needs_of
from real2sim_proto.drive import Obs
from real2sim_proto.episode import ResetSpec
from real2sim_proto.jobs import PlannerName
from real2sim_proto.operations import Operation
from real2sim_proto.plans import PLAN, Control, PoseCommand, TrajectoryPlan

from .._numba import kernel
from ..edit import EditError, ScenarioState
from ..policies.planner_process import PlannerFailedError, PlannerProcesses
from ..policies.suite import Case
from ..render import RasterOptions, View, rasterize_batch
from ..render.images import to_uint8
from ..scene import Camera, Scene
from ..service.library.views import camera_infos
from ..world import World, WorldError
from ..world.recording import Recording, record
from ..world.replay import Entry, Replayer, action_payload, edit_payload, reset_payload
from ..world.scoring import metrics_version
from ..world.scoring.instant import STOPPED
from ..world.storyboard.run import object_ids_of

# --- Criticality: kernels -------------------------------------------------------------------------


@kernel
def signed_gaps_into(box, centres, yaws, sizes, found):
    """See :func:`.signed_gaps`; written to ``found`` [K]."""
    x, y, yaw, length, width = box
    c, s = math.cos(yaw), math.sin(yaw)
    for k in range(len(yaws)):
        dx, dy = centres[k, 0] - x, centres[k, 1] - y
        turned = yaws[k] - yaw
        cos, sin = math.cos(turned), math.sin(turned)
        # Each rectangle's centre in the frame of the other one.
        tx, ty = c * dx + s * dy, c * dy - s * dx
        ox, oy = -(cos * tx + sin * ty), -(cos * ty - sin * tx)
        la, wa, lb, wb = length / 2, width / 2, sizes[k, 0] / 2, sizes[k, 1] / 2
        ac, asin = abs(cos), abs(sin)
        ours = max(abs(tx) - la - lb * ac - wb * asin, abs(ty) - wa - lb * asin - wb * ac)
        theirs = max(abs(ox) - lb - la * ac - wa * asin, abs(oy) - wb - la * asin - wa * ac)
        separation = max(ours, theirs)
        if separation < 0.0:
            found[k] = separation
            continue
        nearest = math.inf
        for u, v in ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)):
            px, py = tx + cos * u * lb - sin * v * wb, ty + sin * u * lb + cos * v * wb
            nearest = min(nearest, _to_rectangle(px, py, la, wa))
            qx, qy = ox + cos * u * la + sin * v * wa, oy - sin * u * la + cos * v * wa
            nearest = min(nearest, _to_rectangle(qx, qy, lb, wb))
        found[k] = nearest


@kernel
def _to_rectangle(x, y, half_length, half_width):
    return math.hypot(max(abs(x) - half_length, 0.0), max(abs(y) - half_width, 0.0))


@kernel
def least_margin(bumper, velocity, others, per_metre):
    """Smallest criticality margin of objects ahead: ``min over t of t + per_metre * gap(t)``.

    All velocities are constant, for 3 s in steps of 0.2 s.

    Args:
        bumper: centre x, y [m], yaw [rad], length, width [m] of the front of the ego.
        velocity: velocity of the bumper, x and y [m/s].
        others: centres [K, 3] [m], yaws [K] [rad], sizes [K, 3] [m], velocities [K, 2] [m/s].
        per_metre: [s/m].
    """
    x, y, yaw, length, width = bumper
    centres, yaws, sizes, velocities = others
    least = math.inf
    place, heading, size = np.empty((1, 2)), np.empty(1), np.empty((1, 2))
    gap = np.empty(1)
    for k in range(len(yaws)):
        dx, dy = centres[k, 0] - x, centres[k, 1] - y
        wx, wy = velocities[k, 0] - velocity[0], velocities[k, 1] - velocity[1]
        reach = (width + math.hypot(sizes[k, 0], sizes[k, 1])) / 2
        heading[0], size[0, 0], size[0, 1] = yaws[k], sizes[k, 0], sizes[k, 1]
        for step in range(16):
            t = 0.2 * step
            if t >= least:
                break
            place[0, 0], place[0, 1] = x + dx + wx * t, y + dy + wy * t
            far = math.hypot(dx + wx * t, dy + wy * t) - reach
            if t + per_metre * far >= least:
                continue
            signed_gaps_into((x, y, yaw, length, width), place, heading, size, gap)
            least = min(least, t + per_metre * max(gap[0], 0.0))
    return least


# --- Criticality: gaps ----------------------------------------------------------------------------

Array = NDArray[np.float64]


def signed_gaps(
    box: tuple[float, float, float, float, float], centres: Array, yaws: Array, sizes: Array
) -> Array:
    """[K] float64 distances from a rectangle to others [m]; negative values are the overlap depth.

    Disjoint convex shapes are nearest at a corner of one of them. The depth is the minimum over the
    directions of their sides (separating axes, Gottschalk et al. 1996).

    Args:
        box: centre x, y [m], yaw [rad], length, width [m]; length 0 is a bumper.
        centres: [K, 2 or 3] [m].
        yaws: [K] [rad].
        sizes: [K, 2 or 3] length and width first [m].
    """
    found: Array = np.empty(len(yaws))
    signed_gaps_into(box, centres, yaws, sizes, found)
    return found


PER_METRE = 2.0
"""Time equivalent of a gap [s/m]: passing at half a metre is as critical as a collision in one
second.
"""
SHARPNESS = 16.0
"""Sharpness of the smooth minimum over time [1/s]."""
MAX_MARGIN = 100.0
"""Maximum margin [s], reached at half as many metres."""
AT_FAULT, PER_SPEED = 0.5, 0.05
"""Criticality of an at-fault collision, and additional criticality per m/s of its speed."""
NOT_AT_FAULT = -1.0
"""Maximum criticality of a collision caused by others. It equals a margin of one second, to prevent
searches from ending there."""


def adversaries_of(
    reset: Mapping[str, Any], operations: Sequence[Mapping[str, Any]] = ()
) -> frozenset[str]:
    """Adversaries of a case: objects with drivers, in a storyboard, or edited.

    Empty if the case names no adversaries; all objects then count.

    Args:
        reset: options of an episode.
        operations: edits at its start, as JSON.
    """
    names = set(reset.get("agents", {}).get("drivers", {}))
    names |= {str(o["object_id"]) for o in operations if o.get("object_id")}
    for entity in (reset.get("storyboard") or {}).get("entities", []):
        known = entity.get("object_id")
        names.update([known] if known else object_ids_of(entity["name"]))
    return frozenset(names)


@dataclass
class Danger:
    """Criticality of an episode, updated at each time step.

    The margin of a time step is the time until the front bumper touches another object at constant
    velocities, with the remaining lateral gap converted to time. Objects behind or alongside are
    ignored, because they do not reflect the driver's performance. The margin of the episode is a
    smooth minimum over time. :meth:`criticality` is its negative in seconds, and is positive only
    for at-fault collisions.

    Attributes:
        adversaries: objects to consider, see :func:`adversaries_of`; empty for all. Parked cars
            on the route would otherwise mask the distance to the adversaries of the case.
        gap: minimum distance from the ego's box to another's so far [m], negative if they overlap.
        margin: minimum margin so far [s].
    """

    adversaries: frozenset[str] = frozenset()
    gap: float = math.inf
    margin: float = MAX_MARGIN
    _margins: list[float] = field(default_factory=list)

    def add(self, world: World) -> None:
        """Add the current instant of a world."""
        instant, context = world.instant, world.context
        ego, others = instant.ego, instant.others
        if not others.ids:
            return
        cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
        x, y = ego.x + context.centre_ahead * cos, ego.y + context.centre_ahead * sin
        length, width, _ = context.ego_size
        where = others.centres, others.yaws, others.sizes
        self.gap = min(self.gap, float(signed_gaps((x, y, ego.yaw, length, width), *where).min()))
        if abs(ego.speed) <= STOPPED:
            return
        meant = [
            k
            for k, name in enumerate(others.ids)
            if name in self.adversaries or not self.adversaries
        ]
        if not meant:
            return
        bumper = (x + length / 2 * cos, y + length / 2 * sin, ego.yaw, 0.0, width)
        velocity = (
            ego.speed * cos - ego.lateral_speed * sin,
            ego.speed * sin + ego.lateral_speed * cos,
        )
        theirs = (*(values[meant] for values in where), others.velocities[meant])
        margin = min(float(least_margin(bumper, velocity, theirs, PER_METRE)), MAX_MARGIN)
        self.margin = min(self.margin, margin)
        self._margins.append(margin)

    def criticality(self, world: World) -> float:
        """Criticality of the episode so far.

        -100 far from all objects, rising towards 0 at closer range; positive for an at-fault
        collision, increasing with its speed.
        """
        if sum(world.accumulator.at_fault.values()):
            return AT_FAULT + PER_SPEED * (world.accumulator.first_impact or 0.0)
        margins = np.array(self._margins or [MAX_MARGIN])
        least = float(margins.min())
        smooth = least - math.log(np.exp(-SHARPNESS * (margins - least)).sum()) / SHARPNESS
        # A collision without fault is not a failure.
        found = min(-smooth, 0.0)
        return min(found, NOT_AT_FAULT) if world.accumulator.collisions else found


# --- Images --------------------------------------------------------------------------------------

RGB = RasterOptions(depth=False, instance=False)


@dataclass(frozen=True, eq=False)
class CameraFeed:
    """The colour images for a planner.

    Attributes:
        cameras: cameras at the size that the planner needs.
    """

    cameras: tuple[Camera, ...]

    @classmethod
    def of(cls, scene: Scene, needs: Needs) -> CameraFeed | None:
        """The feed that a planner needs; None for a planner without images.

        Raises:
            ValueError: images other than colour, or a camera missing in the scene.
        """
        if not needs.modalities:
            return None
        if set(needs.modalities) != {"rgb"}:
            raise ValueError(
                f"the planner needs {', '.join(needs.modalities)}; sweeps only render rgb: "
                "drive it with evaluate-policy"
            )
        sensors = needs.sensors(camera_infos(tuple(scene.rig)))
        cameras = (scene.rig[sensor["camera"]] for sensor in sensors)
        return cls(tuple(c if needs.width is None else c.resized(needs.width) for c in cameras))

    def added_to(self, obs: Observation, world: World) -> Observation:
        """The observation with its images."""
        frames = {camera.name: {"rgb": draw_frames([world], camera)[0]} for camera in self.cameras}
        return replace(obs, frames=frames)


def draw_frames(worlds: Sequence[World], camera: Camera) -> list[Frame]:
    """Images of a camera in several worlds of one scene, rendered in one call.

    Args:
        worlds: worlds at their current times; at least one.
        camera: camera of the ego.
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
        planner: name for ``load_planner``.
        reset: options including the seed, without the planner's needs.
        operations: edits at the start, as JSON.
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
        """Hex key of the result.

        A hash of scene, options, edits, planner with its files, and the versions of program and
        scores.
        """
        name, _, argument = self.planner.partition("=")
        module, of_module, _ = name.partition(":")
        content = {
            "scene": scene_hash,
            "planner": [
                name,
                _file_hash(argument) if argument else "",
                *([_source_hash(module)] if of_module else []),
            ],
            "reset": dict(self.reset),
            "operations": [dict(o) for o in self.operations],
            "versions": [version("real2sim"), metrics_version()],
        }
        text = json.dumps(content, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(eq=False)
class Driven:
    """A finished episode.

    Attributes:
        world: world at the end of the episode; None if it could not start.
        danger: criticality over the episode.
        error: why it could not start, or why the planner failed; None on success.
        entries: contents of a recording; empty unless requested.
        worlds: worlds of all steps; empty unless requested.
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
        """See :meth:`Danger.criticality`; NaN if it could not start."""
        return math.nan if self.world is None else self.danger.criticality(self.world)


IN_PROCESS = frozenset({*get_args(PlannerName), "learned"})
"""Planners that sweeps run in their own process, because they run no code of others."""


def load(name: str, processes: PlannerProcesses) -> Any:
    """A new planner, in a process of its own unless it is in :data:`IN_PROCESS`.

    Raises:
        ValueError, OSError: no such planner, or a file that it cannot read.
    """
    known = name.partition("=")[0] in IN_PROCESS
    return load_planner(name) if known else processes.load(name)


def begin(scene: Scene, drive: Drive, needs: Needs, *, privileged: bool) -> World:
    """The world of an episode at its start time, before its edits.

    Raises:
        WorldError, ValidationError: the episode cannot run with these options.
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
    """Let a planner drive an episode; it ends if the planner fails.

    Edits are applied at the start time, after the planner's first observation, as in sessions of a
    worker.

    Args:
        scene: scene of the case.
        drive: the episode.
        planner: loaded planner, see :func:`load`.
        keep_entries: keep the entries for a recording.
        keep_worlds: keep the world of each step, to continue from it.
        on_world: called with the world at every time step.
    """
    needs = needs_of(planner)
    try:
        # A planner without declared needs receives everything, as in `real2sim drive`.
        privileged = needs.privileged or not hasattr(planner, "needs")
        world = begin(scene, drive, needs, privileged=privileged)
    except (WorldError, ValidationError) as error:
        return Driven(None, Danger(), f"{type(error).__name__}: {error}")
    driven = Driven(world, Danger(adversaries_of(drive.reset, drive.operations)))
    feed = _feed_of(scene, needs, driven)
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
    while not world.over and driven.error is None:
        try:
            if world.steps == 0:
                planner.reset(obs)
            plan = _checked(planner.plan(obs))
            if keep_worlds:
                driven.worlds.append(world.fork())
            world.step(plan)
        except Exception as error:  # A planner may raise anything; only its episode ends.
            told = isinstance(error, PlannerFailedError)
            driven.error = str(error) if told else f"{type(error).__name__}: {error}"[:500]
            break
        if keep_entries:
            driven.entries.append(Entry("action", world.steps - 1, action_payload(plan)))
        driven.danger.add(world)
        for show in (on_world,) if on_world else ():
            show(world)
        obs = observation_of(world, feed)
    return driven


def _feed_of(scene: Scene, needs: Needs, driven: Driven) -> CameraFeed | None:
    try:
        return CameraFeed.of(scene, needs)
    except PlannerFailedError as error:
        driven.error = str(error)
        return None


def observation_of(world: World, feed: CameraFeed | None = None) -> Observation:
    """The observation as a session would send it."""
    obs = observation_from_wire(Obs(**world.observe().obs_fields(), frames=[]))
    return obs if feed is None else feed.added_to(obs, world)


def recording_of(scene: Scene, driven: Driven) -> Recording:
    """The recording of an episode with saved entries."""
    replayer = Replayer.on(scene, ScenarioState.of(scene))
    return record(replayer, driven.entries, scene_hash=scene.content_hash or "")


def _checked(plan: Any) -> TrajectoryPlan | Control | PoseCommand:
    return plan if isinstance(plan, PLANS) else PLAN.validate_python(plan)


@cache
def _file_hash(argument: str) -> str:
    path = Path(argument)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else argument


def _source_hash(module: str) -> str:
    """Hash of the source file of a planner's module, found without running it; empty if there is
    none."""
    here, folders, source = str(Path.cwd()), list(sys.path), None
    if here not in folders:
        folders.insert(0, here)
    for part in module.split("."):
        spec = PathFinder.find_spec(part, folders)
        source = spec.origin if spec is not None else None
        folders = list(spec.submodule_search_locations or ()) if spec is not None else []
    return _file_hash(source) if source else ""
