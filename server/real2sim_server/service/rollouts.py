"""Physics rollouts and calibrations of scenarios as jobs, their pictures and figures."""

from __future__ import annotations

import asyncio
import functools
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, assert_never

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import CalibrateRequest, JobInfo, SimulateRequest
from real2sim_proto.operations import (
    AddCollider,
    BoxShape,
    CapsuleShape,
    CylinderShape,
    GroundShape,
    MeshShape,
    PhysicsValues,
    PlaneShape,
)

from ..edit import ObjectState, ScenarioState
from ..edit.compose import cast_shadows, composed_background
from ..geometry import Float, quaternion_to_matrix, transform_from
from ..physics.colliders import (
    Box,
    Capsule,
    Collider,
    Cylinder,
    HeightField,
    Plane,
    Solid,
    TriangleMesh,
    TriangleSurface,
)
from ..render import Instance
from ..scene import Scene, SceneObject
from ..simulation.background import ground_collider
from ..simulation.calibration import (
    CalibrationCancelled,
    ObjectCalibration,
    Observation,
    calibrate_object,
    observations_of,
)
from ..simulation.experiments.setups import set_up
from ..simulation.result import ENERGIES, PlacedObjects, Playback, SimulationResult
from ..simulation.rollout import SimulateOptions, simulate
from ..simulation.spawn import EGO, with_ego
from ..simulation.structure import ObjectPhysics, with_values
from .exports import VideoSource
from .http.requests import IdempotentRequest
from .http.responses import ServiceError
from .jobs import JobCancelled, JobContext, JobResult, Jobs, NewJob, Work, require_success
from .library.scenes import SceneCache
from .scenarios import Scenarios

NEARBY_DISTANCE = 25.0
"""Objects this close to a moving one are simulated too [m], up to ``MAX_NEARBY_OBJECTS``."""

MAX_NEARBY_OBJECTS = 12
PLAYBACK = "playback.json"


@dataclass(frozen=True, eq=False)
class RolloutPlan:
    """A rollout, ready to start.

    Attributes:
        scene: scene without erased regions and with inserted assets.
        state: state of the scenario; ``resolved_objects`` are its objects as in ``scene``.
        options: options of the physics.
    """

    scene: Scene
    state: ScenarioState
    resolved_objects: PlacedObjects
    options: SimulateOptions


@dataclass(frozen=True, eq=False)
class ResolvedObjects:
    """Objects of a scenario, each with the id of its scene object."""

    visible: tuple[ObjectState, ...]


def plan_rollout(scene: Scene, state: ScenarioState, request: SimulateRequest) -> RolloutPlan:
    """The rollout plan of a request.

    Raises:
        ServiceError: INVALID_REQUEST, UNKNOWN_OBJECT or TIME_OUT_OF_RANGE.
        PhysicsError: a value that the physics does not support.
    """
    start, end = _span(state, request)
    present = {o.object_id: o for o in state.visible if o.trajectory.covers(start)}
    complete, resolved_objects = with_assets(scene, state)
    has_ego = EGO in (request.objects or ()) and EGO not in present
    background = request.background is not False and request.experiment is None
    if background:
        poses = {o.object_id: o.trajectory.transform(start) for o in present.values()}
        complete = replace(complete, background=composed_background(scene, state, poses))
    if has_ego:
        complete, resolved_objects = with_ego(complete, resolved_objects)
    if request.experiment is None or request.objects is not None:
        named = _chosen(present, request, start, also=[EGO] if has_ego else [])
    else:
        named = []
    if request.experiment is None:
        options = SimulateOptions(
            preset=request.preset or "vehicle",
            objects={
                object_id: _physics(present[object_id], start)
                if object_id in present
                else ObjectPhysics()
                for object_id in named
            },
            colliders=colliders_of(state),
            start_us=start,
            duration=(end - start) * 1e-6,
        )
    else:
        asked = request.model_copy(update={"start_us": start})
        options = _experiment(complete, resolved_objects, present, asked, named)
    options = replace(
        options,
        objects=_with_values(options.objects, request.physics),
        frame_rate=1e6 / request.frame_us,
        backend=request.backend,
        background=background,
        gravity=request.gravity or options.gravity,
        max_particles=request.max_particles or options.max_particles,
    )
    return RolloutPlan(complete, state, resolved_objects, options)


def _experiment(
    scene: Scene,
    resolved_objects: PlacedObjects,
    present: dict[str, ObjectState],
    request: SimulateRequest,
    named: Sequence[str],
) -> SimulateOptions:
    """An experiment; objects keep their values from ``set_physics``."""
    setup = set_up(
        str(request.experiment),
        scene,
        resolved_objects,
        preset=request.preset,
        speed=request.speed,
        objects=tuple(named),
        start_us=request.start_us,
        grids=[v.grid for v in request.physics.values() if v.grid is not None],
    )
    known = {
        name: given
        for name in setup.options.objects
        if name in present and (given := present[name].physics) is not None
    }
    objects = _with_values(setup.options.objects, known)
    if request.end_us is None:
        return replace(setup.options, objects=objects)
    span = request.end_us - setup.options.start_us
    return replace(setup.options, objects=objects, duration=span * 1e-6)


def _with_values(
    objects: Mapping[str, ObjectPhysics], values: Mapping[str, PhysicsValues]
) -> dict[str, ObjectPhysics]:
    """Physics values of the objects, with some replaced.

    Raises:
        ServiceError: UNKNOWN_OBJECT for values of an object that is not simulated.
    """
    unknown = [name for name in values if name != "*" and name not in objects]
    if unknown:
        raise ServiceError(
            ErrorCode.UNKNOWN_OBJECT,
            f"physics is given for {unknown[0]!r}, which is not simulated",
            hint=f"simulated objects: {', '.join(objects)}; '*' means all",
        )
    return {
        name: with_values(own, values.get("*"), values.get(name)) for name, own in objects.items()
    }


def run_rollout(
    plan: RolloutPlan,
    folder: Path,
    *,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
) -> tuple[dict[str, Any], dict[str, str]]:
    """Simulate and store the result in ``folder``; returns figures, and files by media type."""
    result = simulate(
        plan.scene,
        plan.resolved_objects,
        plan.options,
        on_progress=lambda done, frames: progress(done / frames),
        cancelled=cancelled,
    )
    result.save(folder)
    playback = json.dumps(describe(result), separators=(",", ":"))
    (folder / PLAYBACK).write_text(playback, encoding="utf-8")
    files = {
        PLAYBACK: "application/json",
        "simulation.json": "application/json",
        "frames.safetensors": "application/octet-stream",
    }
    return summary_of(result), files


def summary_of(result: SimulationResult) -> dict[str, Any]:
    """Summary of a rollout for its job."""
    return {
        "frames": result.frames,
        "start_us": result.start_us,
        "end_us": result.start_us + round(float(result.times_s[-1]) * 1e6),
        "objects": list(result.objects),
        "contacts": [vars(contact) for contact in result.contacts],
        "breakages": [breakage.record() for breakage in result.breakages or ()],
        "figures": dict(result.figures),
        "stopped": result.stopped,
    }


def describe(result: SimulationResult) -> dict[str, Any]:
    """Everything except deformed shapes, for plots and maps: times, poses, contacts, energies."""
    return summary_of(result) | {
        "times_us": [result.start_us + round(t * 1e6) for t in result.times_s.tolist()],
        "energy_names": list(ENERGIES),
        "energies": _rounded(result.energies),
        "impulses": _rounded(result.impulses),
        "tracks": {
            object_id: {
                "mass": own.mass,
                "positions": _rounded(own.positions),
                "quaternions": _rounded(own.quaternions),
                "velocities": _rounded(own.velocities),
                "angular_velocities": _rounded(own.angular_velocities),
                "modes": own.modes.tolist(),
            }
            for object_id, own in result.objects.items()
        },
    }


class RolloutPlayback:
    """Renders a finished rollout; not thread-safe."""

    def __init__(self, scene: Scene, state: ScenarioState, result: SimulationResult) -> None:
        self._scene = scene
        self._state = state
        self._result = result
        complete, resolved_objects = with_assets(scene, state)
        if EGO in result.objects:
            complete, resolved_objects = with_ego(complete, resolved_objects)
        self._playback = Playback(complete, resolved_objects, result)
        self.span = (result.start_us, self._playback.time_us(result.frames - 1))

    def instances(self, t_us: int, *, aboard: bool = True) -> Sequence[Instance]:
        """Instances at the stored frame nearest to ``t_us`` [us], with shadows of edited objects.

        Args:
            t_us: time [us].
            aboard: whether the cameras are on the ego, which hides its body.
        """
        since = (t_us - self._result.start_us) * 1e-6
        frame = int(np.abs(self._result.times_s - since).argmin())
        standing = [
            (subject, self._pose(subject, frame, t_us))
            for subject in self._state.visible
            if subject.object_id in self._result.objects or subject.trajectory.covers(t_us)
        ]
        poses = {subject.object_id: pose for subject, pose in standing}
        background = Instance(composed_background(self._scene, self._state, poses))
        unseen = [EGO] if aboard and EGO not in poses else []
        _, *objects = self._playback.instances(frame, without=unseen)
        placed = [
            (subject, pose)
            for subject, pose in standing
            if subject.edited or subject.object_id in self._result.objects
        ]
        return [background, *objects, *cast_shadows(self._scene, placed, t_us)]

    def _pose(self, subject: ObjectState, frame: int, t_us: int) -> Float:
        simulated = self._result.objects.get(subject.object_id)
        if simulated is not None:
            return simulated.transform(frame)
        return subject.trajectory.transform(t_us)


def with_assets(scene: Scene, state: ScenarioState) -> tuple[Scene, PlacedObjects]:
    """The scene with the scenario's assets as objects."""
    objects = dict(scene.objects)
    visible = []
    for subject in state.visible:
        if subject.asset is None:
            visible.append(subject)
            continue
        resolved_id = f"asset.{subject.asset.asset_id}"
        cloud = subject.asset.cloud_in(scene)
        objects[resolved_id] = SceneObject(
            resolved_id,
            subject.category,
            subject.size,
            cloud,
            subject.trajectory,
            figure=subject.asset.figure,
        )
        visible.append(replace(subject, source_id=resolved_id))
    return replace(scene, objects=objects), ResolvedObjects(tuple(visible))


def _span(state: ScenarioState, request: SimulateRequest) -> tuple[int, int]:
    first, last = state.clock
    start = first if request.start_us is None else request.start_us
    end = last if request.end_us is None else request.end_us
    if not first <= start < end <= last:
        raise ServiceError(
            ErrorCode.TIME_OUT_OF_RANGE,
            f"the rollout would go from {start} to {end} us; the scenario plays from {first} to "
            f"{last} us",
            hint="choose start_us before end_us, both within the scenario's span",
        )
    return start, end


def _chosen(
    present: dict[str, ObjectState], request: SimulateRequest, start: int, *, also: Sequence[str]
) -> list[str]:
    if request.objects is not None:
        missing = [name for name in request.objects if name not in {*present, *also}]
        if missing or not request.objects:
            raise ServiceError(
                ErrorCode.UNKNOWN_OBJECT if missing else ErrorCode.INVALID_REQUEST,
                f"no object {missing[0]!r} at {start} us" if missing else "objects is empty",
                hint=f"there are: {', '.join(present) or 'none'}",
            )
        return list(dict.fromkeys(request.objects))
    moved = [o for o in present.values() if o.velocity is not None or o.physics is not None]
    if not moved:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            "no object has a velocity or physics, so there is nothing to simulate",
            hint="name objects, or edit one with set_velocity or set_physics first",
        )
    centres = np.array([o.trajectory.pose(start)[0] for o in moved])
    rest = [o for o in present.values() if o not in moved]
    apart = [
        float(np.linalg.norm(centres - o.trajectory.pose(start)[0], axis=1).min()) for o in rest
    ]
    near = [rest[i] for i in np.argsort(apart, kind="stable") if apart[i] <= NEARBY_DISTANCE]
    return [o.object_id for o in (moved + near)[: max(MAX_NEARBY_OBJECTS, len(moved))]]


def _physics(subject: ObjectState, start: int) -> ObjectPhysics:
    velocity = subject.velocity
    turn: Float = np.eye(3)
    if velocity is not None and velocity.frame == "object":
        turn = quaternion_to_matrix(subject.trajectory.pose(start)[1])
    linear = velocity.linear if velocity is not None else None
    angular = velocity.angular if velocity is not None else None
    own = ObjectPhysics(
        velocity=None if linear is None else turn @ np.array(linear),
        angular_velocity=None if angular is None else turn @ np.array(angular),
    )
    return own if subject.physics is None else with_values(own, subject.physics)


def colliders_of(state: ScenarioState) -> list[Collider]:
    """The scenario's rigid colliders, and the scene's ground if the scenario has no ground."""
    colliders: list[Collider] = []
    grounds = [c for c in state.standing_colliders if isinstance(c.shape, GroundShape)]
    if not grounds:
        colliders.append(_ground(state, offset=0.0, friction=None))
    return colliders + [_collider(state, c) for c in state.standing_colliders]


def _collider(state: ScenarioState, given: AddCollider) -> Collider:
    name = given.collider_id or "collider"
    shape, friction = given.shape, given.friction
    if isinstance(shape, GroundShape):
        return _ground(state, offset=shape.offset, friction=friction)
    if isinstance(shape, PlaneShape):
        return Plane(name=name, point=shape.point, normal=shape.normal, friction=friction)
    kind, own = _solid(shape)
    own[kind.POSE] = transform_from(shape.position, shape.quaternion)
    return kind(name=name, friction=friction, **own)


def _solid(
    shape: BoxShape | CylinderShape | CapsuleShape | MeshShape,
) -> tuple[type[Solid], dict[str, Any]]:
    """The solid of a shape, with the shape's parameters."""
    match shape:
        case BoxShape():
            return Box, {"size": shape.size}
        case CylinderShape():
            return Cylinder, {"radius": shape.radius, "height": shape.height}
        case CapsuleShape():
            return Capsule, {"radius": shape.radius, "length": shape.length}
        case MeshShape():
            surface = TriangleSurface(shape.vertices, shape.triangles, shape.thickness)
            return TriangleMesh, {"surface": surface}
        case _:
            assert_never(shape)


def _ground(state: ScenarioState, *, offset: float, friction: float | None) -> HeightField:
    positions = [o.trajectory.positions[:, :2] for o in state.visible]
    places = np.concatenate([state.extent, *positions])
    return ground_collider(state.ground, places, offset=offset, friction=friction)


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), 6).tolist()


# Jobs.

MAX_CACHED_PLAYBACKS = 4
"""Cached finished rollouts; others are read from their files."""


class Simulations:
    """Starts rollouts and shows finished ones, for use on the event loop."""

    def __init__(self, jobs: Jobs, scenarios: Scenarios, scene_cache: SceneCache) -> None:
        self._jobs = jobs
        self._scenarios = scenarios
        self._scene_cache = scene_cache
        self._playbacks: OrderedDict[str, tuple[Scene, RolloutPlayback]] = OrderedDict()
        self._drawing = threading.Lock()

    async def start(
        self, scenario_id: str, request: SimulateRequest, *, who: str, idempotent: IdempotentRequest
    ) -> JobInfo:
        """Start a rollout of the scenario's current revision.

        Raises:
            ServiceError: as for scenarios, scene cache and jobs; INVALID_REQUEST, UNKNOWN_OBJECT or
                TIME_OUT_OF_RANGE if the request cannot be simulated.
        """
        revision = (await self._scenarios.view(scenario_id)).revision
        work = await self._work(scenario_id, revision, request)
        fields = request.model_dump(mode="json", exclude_none=True)
        fields |= {"scenario": scenario_id, "revision": revision}
        new = NewJob("simulate", scenario_id, fields, who, portable=True)
        return await self._jobs.start(new, work, idempotent=idempotent)

    async def rebuild(self, info: JobInfo) -> Work:
        """The rollout of a stored job, with the scenario at its revision."""
        fields = dict(info.request)
        scenario_id, revision = fields.pop("scenario"), fields.pop("revision")
        return await self._work(scenario_id, revision, SimulateRequest.model_validate(fields))

    async def _work(self, scenario_id: str, revision: int, request: SimulateRequest) -> Work:
        view = await self._scenarios.view(scenario_id)
        state = await self._scenarios.state_at(scenario_id, revision)
        scene = await self._scene_cache.get(view.row.scene)
        plan = await asyncio.to_thread(plan_rollout, scene, state, request)

        async def work(context: JobContext) -> JobResult:
            values, files = await asyncio.to_thread(
                run_rollout,
                plan,
                context.folder,
                progress=lambda share: context.progress(share, "simulating"),
                cancelled=context.cancelled,
            )
            context.check()
            if values["stopped"] == "cancelled":
                raise JobCancelled
            return JobResult(values, files)

        return work

    async def video_source(self, job_id: str) -> VideoSource:
        """Video source of a finished rollout.

        Raises:
            ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, JOB_FAILED; INVALID_REQUEST for another kind
                of job; UNKNOWN_SCENARIO if the scenario was deleted.
        """
        cached = self._playbacks.get(job_id)
        if cached is None:
            cached = await self._open(job_id)
            self._playbacks[job_id] = cached
            while len(self._playbacks) > MAX_CACHED_PLAYBACKS:
                self._playbacks.popitem(last=False)
        self._playbacks.move_to_end(job_id)
        scene, playback = cached

        def instances(t_us: int, *, aboard: bool = True) -> Sequence[Instance]:
            # The replay caches the last deformed clouds and is not thread-safe.
            with self._drawing:
                return playback.instances(t_us, aboard=aboard)

        outside = functools.partial(instances, aboard=False)
        return VideoSource(scene, instances, playback.span, outside)

    async def _open(self, job_id: str) -> tuple[Scene, RolloutPlayback]:
        info = await self._jobs.get(job_id)
        if info.kind != "simulate":
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"job {job_id!r} is of kind {info.kind!r}, not a simulation",
                hint="POST /v1/scenarios/{id}/simulate starts one",
            )
        require_success(info)
        fields: dict[str, Any] = info.request
        view = await self._scenarios.view(fields["scenario"])
        state = await self._scenarios.state_at(fields["scenario"], fields["revision"])
        scene = await self._scene_cache.get(view.row.scene)
        path, _ = await self._jobs.file(job_id, PLAYBACK)
        return scene, await asyncio.to_thread(
            lambda: RolloutPlayback(scene, state, SimulationResult.load(path.parent))
        )


# --- Calibrations --------------------------------------------------------------------------------


class Calibrations:
    """Starts calibrations, for use on the event loop."""

    def __init__(self, jobs: Jobs, scenarios: Scenarios, scene_cache: SceneCache) -> None:
        self._jobs = jobs
        self._scenarios = scenarios
        self._scene_cache = scene_cache

    async def start(
        self,
        scenario_id: str,
        request: CalibrateRequest,
        *,
        who: str,
        idempotent: IdempotentRequest,
    ) -> JobInfo:
        """Start a calibration on the scenario's current revision.

        Raises:
            ServiceError: as for a simulation; UNKNOWN_OBJECT for an object that is not simulated.
            PhysicsError: observations that do not fit the simulation.
        """
        view = await self._scenarios.view(scenario_id)
        scene = await self._scene_cache.get(view.row.scene)
        plan, seen = await asyncio.to_thread(_plan, scene, view.state, request)

        async def work(context: JobContext) -> JobResult:
            found = await asyncio.to_thread(
                _run,
                plan,
                seen,
                request,
                progress=lambda share: context.progress(share, "simulating"),
                cancelled=context.cancelled,
            )
            context.check()
            return JobResult(found.figures())

        fields = request.model_dump(mode="json", exclude_none=True, exclude={"observations"})
        fields |= {"scenario": scenario_id, "revision": view.revision}
        new = NewJob("calibrate", scenario_id, fields, who)
        return await self._jobs.start(new, work, idempotent=idempotent)


def _plan(
    scene: Scene, state: ScenarioState, request: CalibrateRequest
) -> tuple[RolloutPlan, list[Observation]]:
    asked = request.simulate
    if asked.objects is None:
        asked = asked.model_copy(update={"objects": [request.object_id]})
    plan = plan_rollout(scene, state, asked)
    if request.object_id not in plan.options.objects:
        raise ServiceError(
            ErrorCode.UNKNOWN_OBJECT,
            f"{request.object_id!r} is not part of the simulation",
            hint=f"simulated objects: {', '.join(plan.options.objects)}",
        )
    [subject] = [o for o in plan.resolved_objects.visible if o.object_id == request.object_id]
    start = plan.options.start_us
    end = start + round(plan.options.duration * 1e6)
    return plan, observations_of(request.observations, plan.scene, subject, start, end)


def _run(
    plan: RolloutPlan,
    seen: list[Observation],
    request: CalibrateRequest,
    *,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
) -> ObjectCalibration:
    # Gradients at the start, in the middle and at the end; search steps; coarser cells.
    expected = 6 * len(request.parameters) + 2 * request.steps + 5
    try:
        return calibrate_object(
            plan.scene,
            plan.resolved_objects,
            plan.options,
            request.object_id,
            seen,
            parameters=request.parameters,
            steps=request.steps,
            on_run=lambda runs: progress(min(runs / expected, 0.99)),
            cancelled=cancelled,
        )
    except CalibrationCancelled as stopped:
        raise JobCancelled from stopped
