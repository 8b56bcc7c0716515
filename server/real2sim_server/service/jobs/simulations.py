"""Physics rollouts and calibrations of scenarios, as jobs."""

from __future__ import annotations

import asyncio
import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import CalibrateRequest, JobInfo, SimulateRequest

from ...edit import ScenarioState
from ...render import Instance
from ...scene import Scene
from ...simulation.calibration import (
    CalibrationCancelled,
    ObjectCalibration,
    Observation,
    calibrate_object,
    observations_of,
)
from ...simulation.result import SimulationResult
from ..http.idempotency import IdempotentRequest
from ..http.problems import ServiceError
from ..library.scenes import SceneCache
from ..scenarios.scenarios import Scenarios
from .exports import VideoSource
from .jobs import JobCancelled, JobContext, JobResult, Jobs, NewJob, Work, require_success
from .rollouts import PLAYBACK, RolloutPlan, RolloutPlayback, plan_rollout, run_rollout

MAX_CACHED_PLAYBACKS = 4
"""Finished rollouts kept open; others are read from their files again."""


class Simulations:
    """Starts rollouts and shows finished ones. Belongs to the event loop."""

    def __init__(self, jobs: Jobs, scenarios: Scenarios, scene_cache: SceneCache) -> None:
        self._jobs = jobs
        self._scenarios = scenarios
        self._scene_cache = scene_cache
        self._playbacks: OrderedDict[str, tuple[Scene, RolloutPlayback]] = OrderedDict()
        self._drawing = threading.Lock()

    async def start(
        self, scenario_id: str, request: SimulateRequest, *, who: str, idempotent: IdempotentRequest
    ) -> JobInfo:
        """Begin a rollout of the scenario as it is now.

        Raises:
            ServiceError: as scenarios, scene cache and jobs do; INVALID_REQUEST, UNKNOWN_OBJECT or
                TIME_OUT_OF_RANGE for what cannot be simulated.
        """
        revision = (await self._scenarios.view(scenario_id)).revision
        work = await self._work(scenario_id, revision, request)
        fields = request.model_dump(mode="json", exclude_none=True)
        fields |= {"scenario": scenario_id, "revision": revision}
        new = NewJob("simulate", scenario_id, fields, who, portable=True)
        return await self._jobs.start(new, work, idempotent=idempotent)

    async def work_again(self, info: JobInfo) -> Work:
        """The rollout of a job on record, of the scenario as it was then."""
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
        """What a finished rollout shows.

        Raises:
            ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, JOB_FAILED; INVALID_REQUEST for another kind
                of job; UNKNOWN_SCENARIO where that was deleted.
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
            # It keeps the last deformed clouds, which is not for two threads at once.
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
    """Starts calibrations. Belongs to the event loop."""

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
        """Begin a calibration on the scenario as it is now.

        Raises:
            ServiceError: as a simulation's; UNKNOWN_OBJECT for an object that takes no part.
            PhysicsError: for observations that cannot be of the simulation.
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
            f"{request.object_id!r} takes no part in the simulation",
            hint=f"taking part: {', '.join(plan.options.objects)}",
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
    # Slopes at the start, once more on the way, and at the end; steps; and coarser cells.
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
