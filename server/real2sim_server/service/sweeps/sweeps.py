"""Sweeps and searches: planners in many variants of a case, as jobs."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import JobInfo
from real2sim_proto.sweeps import SearchMethod, SweepRequest

from ..http.idempotency import IdempotentRequest
from ..http.problems import ServiceError
from ..jobs.command_process import CommandProcess
from ..jobs.jobs import JobContext, JobResult, Jobs, NewJob, Work
from ..library.scene_cache import SceneCache
from .files import FIGURES, OUT, SPEC, check_scenario, left_by_search, left_by_sweep, write_spec

CHECK_S = 0.2
ROOM_CHECKS_S = 5.0
"""Between two looks at the disk."""

MAX_RECORDED = 64_000
"""Characters of a request that are put on record; jobs of longer ones are not begun anew."""

SHARES = {
    "episodes": (0.0, 0.95),
    "recordings": (0.95, 0.99),
    "search": (0.0, 0.7),
    "failures": (0.7, 0.9),
    "probability": (0.9, 0.99),
}
"""Of the whole work, by stage: from, to."""


class Sweeps:
    """Starts sweeps and searches. Belongs to the event loop.

    Each is a process that drives on the world itself, beside the engine and behind it: it has what
    processor time others leave. Its episodes are kept as they come, so that a worker that was
    stopped goes on where it was.
    """

    def __init__(self, jobs: Jobs, scene_cache: SceneCache) -> None:
        self._jobs = jobs
        self._scene_cache = scene_cache

    async def start(
        self, request: SweepRequest, *, who: str, idempotent: IdempotentRequest
    ) -> JobInfo:
        """Begin one.

        Raises:
            ServiceError: UNKNOWN_SCENE, INVALID_REQUEST for a scenario that cannot be read; as jobs
                do.
        """
        await self._scene_cache.listing(request.scene)
        await asyncio.to_thread(check_scenario, request)
        fields = request.model_dump(mode="json", exclude_unset=True)
        portable = len(request.model_dump_json(exclude_unset=True)) <= MAX_RECORDED
        if not portable:
            fields = {k: v for k, v in fields.items() if k not in {"openscenario", "storyboard"}}
        new = NewJob("sweep", request.scene, fields, who, portable=portable)
        return await self._jobs.start(new, self._work(request), idempotent=idempotent)

    async def work_again(self, info: JobInfo) -> Work:
        """The work of a job on record."""
        return self._work(SweepRequest.model_validate(info.request))

    def _work(self, request: SweepRequest) -> Work:
        async def work(context: JobContext) -> JobResult:
            listing = await self._scene_cache.listing(request.scene)
            await asyncio.to_thread(write_spec, request, context.folder, listing.path)
            await self._driven(request, context, scene=listing.path)
            context.progress(0.99, "packing")
            if isinstance(request.method, SearchMethod):
                return await asyncio.to_thread(left_by_search, context, request.scene)
            return await asyncio.to_thread(left_by_sweep, context)

        return work

    async def _driven(self, request: SweepRequest, context: JobContext, *, scene: Path) -> None:
        """Wait until all is driven.

        Raises:
            ServiceError: JOB_FAILED, with what the command said.
            JobCancelled: the job was cancelled.
        """
        context.progress(0.0, "starting")
        process = await CommandProcess.run(_command(request, context.folder), follow=True)
        process.give_way()
        try:
            telling, looked = _Telling(context), time.monotonic()
            while process.running:
                context.check()
                telling(process.told)
                if time.monotonic() - looked > ROOM_CHECKS_S:
                    await asyncio.to_thread(self._jobs.quota.check, entries=0)
                    looked = time.monotonic()
                await asyncio.sleep(CHECK_S)
            error = await process.error()
        finally:
            await process.close()
        if error is not None:
            said = error.removeprefix("error: ").replace(str(context.folder / SPEC), "the sweep")
            raise ServiceError(
                ErrorCode.JOB_FAILED, said.replace(str(scene.resolve()), request.scene)
            )


def _command(request: SweepRequest, folder: Path) -> list[str]:
    method = request.method
    given: dict[str, Any] = {"--out": folder / OUT, "--json": folder / FIGURES}
    name = "sweep"
    if isinstance(method, SearchMethod):
        name = "search"
        given |= {"--planner": request.planners[0], "--episodes": method.episodes}
        given |= {"--seed": method.seed, "--shrink": method.shrink}
        given |= {"--probability": method.probability, "--films": method.films}
    options = [str(text) for option in given.items() for text in option]
    return [name, str(folder / SPEC), "--follow", *options]


class _Telling:
    """Says how far a job is by what its command told, and how long the stage will still take."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._begun: tuple[str, int, float] = ("", 0, 0.0)

    def __call__(self, told: Any) -> None:
        """Args: told, a line of the command, None before there is one. Raises JobCancelled."""
        if told is None:
            return
        stage, done, total = str(told["stage"]), int(told["done"]), max(int(told["total"]), 1)
        now = time.monotonic()
        if self._begun[0] != stage:
            self._begun = (stage, done, now)
        first, last = SHARES.get(stage, (0.0, 0.99))
        text = f"{stage} {done} of {total}"
        if done > (before := self._begun[1]):
            left = (now - self._begun[2]) / (done - before) * (total - done)
            text += f", {_rounded(left)} left"
        self._context.progress(first + (last - first) * min(done / total, 1.0), text)


def _rounded(seconds: float) -> str:
    if seconds >= 90.0:
        return f"{round(seconds / 60)} min"
    return f"{round(seconds / 5) * 5} s"
