"""Sweeps and searches as jobs: `real2sim sweep` and `real2sim search` in child processes."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from pathlib import Path
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import JobInfo
from real2sim_proto.sweeps import SearchMethod, SweepRequest

from ..scenarios import ScenarioError
from ..scenarios.gallery import corner_case
from ..scenarios.openscenario import ReadOptions, read_openscenario_text
from .drives import CommandProcess
from .exports import pack
from .http.requests import IdempotentRequest
from .http.responses import ServiceError
from .jobs import JobContext, JobResult, Jobs, NewJob, Work
from .library.scenes import SceneCache
from .sessions.recording import RECORDING

# --- Files ---------------------------------------------------------------------------------------

SPEC, OUT, FIGURES = "sweep.json", "out", "figures.json"
TABLE, FAILURES, PAGE, JOURNAL, ARCHIVE = (
    "episodes.parquet",
    "failures.json",
    "failures.html",
    "search.journal",
    "failures.tar",
)
PARQUET, XML, JSON, TAR = (
    "application/vnd.apache.parquet",
    "application/xml",
    "application/json",
    "application/x-tar",
)
SUMMED_UP = ("name", "cell", "score", "values", "impact", "avoidable_until")
"""Members of a failure in the job's result; the rest is in its files."""


def check_scenario(request: SweepRequest) -> None:
    """Refuse an unreadable scenario before the job begins.

    Raises:
        ServiceError: INVALID_REQUEST.
    """
    try:
        if request.corner_case is not None:
            corner_case(request.corner_case)
        if request.openscenario is not None:
            options = ReadOptions(leave_out=frozenset(request.leave_out), ego=request.ego)
            read_openscenario_text(request.openscenario.encode(), "openscenario", options)
    except ScenarioError as error:
        hint = "leave_out takes an element out by its name"
        raise ServiceError(ErrorCode.INVALID_REQUEST, str(error), hint=hint) from error
    except ValueError as error:
        raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error


def write_spec(request: SweepRequest, folder: Path, scene: Path) -> None:
    """Write the input of the command.

    Args:
        request: the sweep.
        folder: folder of the job.
        scene: bundle of the scene.
    """
    folder.mkdir(parents=True, exist_ok=True)
    given = request.model_dump(mode="json", exclude_unset=True)
    kept = ("parameters", "seeds", "planners", "stop", "metrics", "worst", "rank_by")
    spec: dict[str, Any] = {name: given[name] for name in kept if given.get(name) is not None}
    case = {"reset": request.reset, "operations": given.get("operations", [])}
    name = request.corner_case or "case"
    spec["case"] = {"name": name, "scene": str(scene.resolve()), **case}
    if "method" in given and not isinstance(request.method, SearchMethod):
        spec["method"] = given["method"]
    if (storyboard := _storyboard(request, folder)) is not None:
        spec["storyboard"] = storyboard
    (folder / SPEC).write_text(json.dumps(spec), encoding="utf-8")


def _storyboard(request: SweepRequest, folder: Path) -> dict[str, Any] | None:
    """The command's scenario input; the scenario's file is written next to it."""
    common: dict[str, Any] = {"leave_out": request.leave_out, "ego": request.ego}
    if request.corner_case is not None:
        return common | {"file": f"gallery:{request.corner_case}"}
    if request.storyboard is not None:
        text = request.storyboard.model_dump_json()
        (folder / "scenario.json").write_text(text, encoding="utf-8")
        return common | {"file": "scenario.json", "as_it_is": True}
    if request.openscenario is not None:
        (folder / "scenario.xosc").write_text(request.openscenario, encoding="utf-8")
        return common | {"file": "scenario.xosc", "alone": True}
    return None


def left_by_sweep(context: JobContext) -> JobResult:
    """Files of a sweep: its table, and recordings and scenario files of the worst episodes."""
    folder, out = context.folder, context.folder / OUT
    figures = json.loads((folder / FIGURES).read_bytes())
    figures.pop("table")
    files = {TABLE: PARQUET}
    shutil.move(out / TABLE, folder / TABLE)
    for key in figures["worst"]:
        files |= _moved(out / "recordings" / f"{key}.r2e", folder)
        for suffix in (".xosc", ".json"):
            files |= _moved(out / "scenarios" / f"{key}{suffix}", folder)
    _tidy(folder)
    return JobResult({name.replace(" ", "_"): v for name, v in figures.items()}, files)


def left_by_search(context: JobContext, scene: str) -> JobResult:
    """Files of a search: its failures as data, scenario files and recordings, and an archive of
    them."""
    folder, out = context.folder, context.folder / OUT
    found = json.loads((folder / FIGURES).read_bytes())
    bundle = json.loads((folder / SPEC).read_bytes())["case"]["scene"]
    for name in (FAILURES, PAGE):
        # The paths of the worker's scenes are not disclosed.
        text = (out / name).read_text(encoding="utf-8").replace(bundle, scene)
        (out / name).write_text(text, encoding="utf-8")
    files: dict[str, str] = {}
    for path in [
        out / FAILURES,
        *sorted(out.glob("scenarios/*")),
        *sorted(out.glob("recordings/*")),
    ]:
        files |= _copied(path, folder)
    (out / JOURNAL).unlink()
    pack(out, folder / ARCHIVE, context)
    files[ARCHIVE] = TAR
    _tidy(folder)
    keys = ["episodes", "driven_now", "planner_failed", "first_error", "first_failure"]
    keys += ["at_fault", "avoidable", "cells", "spaces"]
    failures = [{name: f.get(name) for name in SUMMED_UP} for f in found["failures"]]
    return JobResult({k: found[k] for k in keys} | {"failures": failures}, files)


def _moved(path: Path, folder: Path) -> dict[str, str]:
    files = _copied(path, folder)
    path.unlink(missing_ok=True)
    return files


def _copied(path: Path, folder: Path) -> dict[str, str]:
    """Copy a file to the job's results; returns its name and media type, or nothing if missing."""
    types = {".r2e": RECORDING, ".xosc": XML, ".json": JSON}
    if not path.is_file() or path.suffix not in types:
        return {}
    shutil.copyfile(path, folder / path.name)
    return {path.name: types[path.suffix]}


def _tidy(folder: Path) -> None:
    shutil.rmtree(folder / OUT, ignore_errors=True)
    for name in (SPEC, FIGURES, "scenario.json", "scenario.xosc"):
        (folder / name).unlink(missing_ok=True)


CHECK_S = 0.2
ROOM_CHECKS_S = 5.0
"""Interval of disk space checks [s]."""

MAX_RECORDED = 64_000
"""Maximum length of a stored request, in characters; jobs with longer ones cannot be restarted."""

SHARES = {
    "episodes": (0.0, 0.95),
    "recordings": (0.95, 0.99),
    "search": (0.0, 0.7),
    "failures": (0.7, 0.9),
    "probability": (0.9, 0.99),
}
"""Range of the whole work, by stage: from, to."""


class Sweeps:
    """Starts sweeps and searches, for use on the event loop.

    Each is a separate process that simulates worlds directly, at a lower priority than the engine.
    Episodes are stored as they finish, and a restarted worker resumes the job.
    """

    def __init__(self, jobs: Jobs, scene_cache: SceneCache) -> None:
        self._jobs = jobs
        self._scene_cache = scene_cache

    async def start(
        self, request: SweepRequest, *, who: str, idempotent: IdempotentRequest
    ) -> JobInfo:
        """Start a sweep or search.

        Raises:
            ServiceError: UNKNOWN_SCENE, INVALID_REQUEST for an unreadable scenario; or as for
                jobs.
        """
        await self._scene_cache.listing(request.scene)
        await asyncio.to_thread(check_scenario, request)
        fields = request.model_dump(mode="json", exclude_unset=True)
        portable = len(request.model_dump_json(exclude_unset=True)) <= MAX_RECORDED
        if not portable:
            fields = {k: v for k, v in fields.items() if k not in {"openscenario", "storyboard"}}
        new = NewJob("sweep", request.scene, fields, who, portable=portable)
        return await self._jobs.start(new, self._work(request), idempotent=idempotent)

    async def rebuild(self, info: JobInfo) -> Work:
        """The work of a stored job."""
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
        """Wait until the command ends.

        Raises:
            ServiceError: JOB_FAILED, with the command's error output.
            JobCancelled: the job was cancelled.
        """
        context.progress(0.0, "starting")
        process = await CommandProcess.run(_command(request, context.folder), follow=True)
        process.yield_to_urgent()
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
    """Reports the progress of a job from the command's output, with the remaining time."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._begun: tuple[str, int, float] = ("", 0, 0.0)

    def __call__(self, told: Any) -> None:
        """Report a line of the command; None before the first line. Raises JobCancelled."""
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
