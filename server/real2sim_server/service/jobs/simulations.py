"""Physics rollouts of scenarios, as jobs."""

from __future__ import annotations

import asyncio
import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import JobInfo, SimulateRequest

from ...render import Instance
from ...scene import Scene
from ...simulation.result import SimulationResult
from ..http.idempotency import IdempotentRequest
from ..http.problems import ServiceError
from ..library.scene_cache import SceneCache
from ..scenarios.scenarios import Scenarios
from .exports import Film
from .jobs import JobCancelled, JobContext, JobResult, Jobs, NewJob, require_success
from .rollouts import PLAYBACK, Show, plan_rollout, run_rollout

KEPT_SHOWS = 4
"""Finished rollouts kept ready to be looked at; others are read from their files again."""


class Simulations:
    """Starts rollouts and shows finished ones. Belongs to the event loop."""

    def __init__(self, jobs: Jobs, scenarios: Scenarios, residency: SceneCache) -> None:
        self._jobs = jobs
        self._scenarios = scenarios
        self._residency = residency
        self._shows: OrderedDict[str, tuple[Scene, Show]] = OrderedDict()
        self._drawing = threading.Lock()

    async def start(
        self, scenario_id: str, asked: SimulateRequest, *, who: str, once: IdempotentRequest
    ) -> JobInfo:
        """Begin a rollout of the scenario as it is now.

        Raises:
            ServiceError: as scenarios, residency and jobs do; INVALID_REQUEST, UNKNOWN_OBJECT or
                TIME_OUT_OF_RANGE for what cannot be simulated.
        """
        view = await self._scenarios.view(scenario_id)
        scene = await self._residency.get(view.row.scene)
        plan = await asyncio.to_thread(plan_rollout, scene, view.state, asked)

        async def work(ticket: JobContext) -> JobResult:
            values, files = await asyncio.to_thread(
                run_rollout,
                plan,
                ticket.folder,
                progress=lambda share: ticket.progress(share, "simulating"),
                cancelled=ticket.cancelled,
            )
            ticket.check()
            if values["stopped"] == "cancelled":
                raise JobCancelled
            return JobResult(values, files)

        request = asked.model_dump(mode="json", exclude_none=True)
        request |= {"scenario": scenario_id, "revision": view.revision}
        new = NewJob("simulate", scenario_id, request, who)
        return await self._jobs.start(new, work, once=once)

    async def film(self, job_id: str) -> Film:
        """What a finished rollout shows.

        Raises:
            ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, JOB_FAILED; INVALID_REQUEST for another kind
                of job; UNKNOWN_SCENARIO where that was deleted.
        """
        kept = self._shows.get(job_id)
        if kept is None:
            kept = await self._open(job_id)
            self._shows[job_id] = kept
            while len(self._shows) > KEPT_SHOWS:
                self._shows.popitem(last=False)
        self._shows.move_to_end(job_id)
        scene, show = kept

        def instances(t_us: int) -> Sequence[Instance]:
            # It keeps the last deformed clouds, which is not for two threads at once.
            with self._drawing:
                return show.instances(t_us)

        return Film(scene, instances, show.span)

    async def _open(self, job_id: str) -> tuple[Scene, Show]:
        info = await self._jobs.get(job_id)
        if info.kind != "simulate":
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"job {job_id!r} is of kind {info.kind!r}, not a simulation",
                hint="POST /v1/scenarios/{id}/simulate starts one",
            )
        require_success(info)
        request: dict[str, Any] = info.request
        view = await self._scenarios.view(request["scenario"])
        state = await self._scenarios.state_at(request["scenario"], request["revision"])
        scene = await self._residency.get(view.row.scene)
        path, _ = await self._jobs.file(job_id, PLAYBACK)
        return scene, await asyncio.to_thread(
            lambda: Show(scene, state, SimulationResult.load(path.parent))
        )
