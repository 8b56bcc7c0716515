"""The files of a sweep: what its command reads, and what the job leaves of what it wrote."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from real2sim_proto import ErrorCode
from real2sim_proto.sweeps import SearchMethod, SweepRequest

from ...scenarios.errors import ScenarioError
from ...scenarios.gallery import corner_case
from ...scenarios.openscenario import ReadOptions, read_openscenario_text
from ..http.problems import ServiceError
from ..jobs.archive import pack
from ..jobs.jobs import JobContext, JobResult
from ..sessions.recording import RECORDING

SPEC, OUT, FIGURES = "sweep.json", "out", "figures.json"
TABLE, FAILURES, PAGE, ARCHIVE = (
    "episodes.parquet",
    "failures.json",
    "failures.html",
    "failures.tar",
)
PARQUET, XML, JSON, TAR = (
    "application/vnd.apache.parquet",
    "application/xml",
    "application/json",
    "application/x-tar",
)
SUMMED_UP = ("name", "cell", "score", "values", "impact", "avoidable_until")
"""Of a failure, in the result of the job; the rest is in its files."""


def check_scenario(request: SweepRequest) -> None:
    """Refuse a scenario that cannot be read, before the job begins.

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
    """Write what the command reads.

    Args:
        request: of the sweep.
        folder: of the job.
        scene: bundle.
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
    """How the command reads the scenario, which is written beside what names it."""
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
    """What a sweep leaves: its table, and recordings and scenario files of the worst."""
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
    """What a search leaves: its failures as data, as scenario files and recordings, and all of it
    packed."""
    folder, out = context.folder, context.folder / OUT
    found = json.loads((folder / FIGURES).read_bytes())
    bundle = json.loads((folder / SPEC).read_bytes())["case"]["scene"]
    for name in (FAILURES, PAGE):
        # Where the worker keeps its scenes is nobody else's concern.
        text = (out / name).read_text(encoding="utf-8").replace(bundle, scene)
        (out / name).write_text(text, encoding="utf-8")
    files: dict[str, str] = {}
    for path in [
        out / FAILURES,
        *sorted(out.glob("scenarios/*")),
        *sorted(out.glob("recordings/*")),
    ]:
        files |= _copied(path, folder)
    pack(out, folder / ARCHIVE, context)
    files[ARCHIVE] = TAR
    _tidy(folder)
    keys = ("episodes", "first_failure", "at_fault", "avoidable", "cells", "spaces")
    failures = [{name: f.get(name) for name in SUMMED_UP} for f in found["failures"]]
    return JobResult({k: found[k] for k in keys} | {"failures": failures}, files)


def _moved(path: Path, folder: Path) -> dict[str, str]:
    files = _copied(path, folder)
    path.unlink(missing_ok=True)
    return files


def _copied(path: Path, folder: Path) -> dict[str, str]:
    """A file among those that the job leaves, and its media type; nothing where there is none."""
    types = {".r2e": RECORDING, ".xosc": XML, ".json": JSON}
    if not path.is_file() or path.suffix not in types:
        return {}
    shutil.copyfile(path, folder / path.name)
    return {path.name: types[path.suffix]}


def _tidy(folder: Path) -> None:
    shutil.rmtree(folder / OUT, ignore_errors=True)
    for name in (SPEC, FIGURES, "scenario.json", "scenario.xosc"):
        (folder / name).unlink(missing_ok=True)
