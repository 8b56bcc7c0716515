"""Values of an object from what was seen of it, as jobs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import CalibrateRequest, JobInfo

from ...edit import ScenarioState
from ...scene import Scene
from ...simulation.calibration import (
    CalibrationCancelled,
    ObjectCalibration,
    Observation,
    calibrate_object,
    observations_of,
)
from ..http.idempotency import IdempotentRequest
from ..http.problems import ServiceError
from ..library.scene_cache import SceneCache
from ..scenarios.scenarios import Scenarios
from .jobs import JobCancelled, JobContext, JobResult, Jobs, NewJob
from .rollouts import RolloutPlan, plan_rollout


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
