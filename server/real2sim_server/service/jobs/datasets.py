"""Labelled data sets of scenes, scenarios and episodes, as jobs."""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import DatasetRequest

from ...datasets.export import MANIFEST, PREVIEW, Estimate, estimate, export_dataset, work_folder
from ...datasets.labels.boxes import BoxNoise
from ...datasets.perturbed import Perturbation
from ...datasets.plan import ExportPlan, Variant, planned_cameras, planned_lidar, planned_shards
from ...datasets.writers import writer_of
from ...render import Backend, RenderOutput
from ...render.backend import RasterRequest
from ...render.cast import CastRequest, Echo, select_caster
from ..engine import Engine, Lane, QueueFullError
from ..http.problems import ServiceError
from ..library.budgets import Quota
from .exports import pack
from .jobs import JobContext, JobResult

T = TypeVar("T")
R = TypeVar("R")

ARCHIVE = "dataset.tar"
FOLDER = "dataset"
MAX_FRAMES = 20_000
LABELLING = 0.9
"""Share of the work that is over when all frames are labelled."""

ROOM_CHECKS_S = 5.0
"""Between two looks at the disk while frames are labelled."""

FEW_FRAMES = 12
"""Fewer are begun without an estimate, which takes as long as three."""


@dataclass(frozen=True, eq=False)
class DatasetSource:
    """What a data set shows.

    Attributes:
        variants: what is labelled.
        made_of: what else decided on it, for the manifest.
    """

    variants: Sequence[Variant]
    made_of: dict[str, Any]


@dataclass(eq=False)
class EngineBackend:
    """Draws on the engine, whose thread owns the device, between the work of others.

    Attributes:
        engine: that draws.
        backend: of the engine.
        context: of the job, whose account is charged.
        loop: that the engine's callers await on.
        name: of the backend that draws.
        caster: follows the beams of LiDARs there, too.
    """

    engine: Engine
    backend: Backend
    context: JobContext
    loop: asyncio.AbstractEventLoop
    name: str = field(init=False)
    caster: EngineCaster = field(init=False)

    def __post_init__(self) -> None:
        self.name = self.backend.name
        self.caster = EngineCaster(self)

    @property
    def draws_lenses(self) -> bool:
        """As of the backend that draws."""
        return getattr(self.backend, "draws_lenses", False)

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw when interactive requests leave room in the queue. Raises JobCancelled."""
        yielding = replace(request, between=self.engine.give_way)
        return self.on_engine(self.backend.rasterize, yielding)

    def warm_up(self) -> None:
        """The engine's is warm."""

    def on_engine(self, work: Callable[[T], R], argument: T) -> R:
        """The result of ``work`` on the engine's thread. Raises JobCancelled."""
        while True:
            self.context.check()
            awaited = self.engine.call(work, argument, label="dataset", lane=Lane.BULK)
            try:
                return asyncio.run_coroutine_threadsafe(awaited, self.loop).result()
            except QueueFullError:
                time.sleep(0.2)


@dataclass(frozen=True)
class EngineCaster:
    """Follows beams on the engine."""

    backend: EngineBackend
    name: str = "engine"

    def cast(self, request: CastRequest) -> Echo:
        """See :class:`CastBackend`. Raises JobCancelled."""
        return self.backend.on_engine(select_caster().cast, request)


def plan_of(request: DatasetRequest) -> ExportPlan:
    """What a request asks for."""
    return ExportPlan(
        formats=tuple(dict.fromkeys(request.formats)),
        cameras=tuple(request.cameras),
        width=request.width,
        period_us=request.period_us,
        start_us=request.start_us,
        end_us=request.end_us,
        clip_s=request.clip_s,
        splits=request.splits,
        seed=request.seed,
        flow=request.flow,
        lidar=request.lidar,
        rig=request.rig,
        perturb=None if request.perturb is None else Perturbation(**dict(request.perturb)),
        noise=None if request.noise is None else BoxNoise(**dict(request.noise)),
    )


def check_dataset(variants: Sequence[Variant], plan: ExportPlan, *, max_pixels: int) -> None:
    """Refuse what cannot be exported before the job begins.

    Raises:
        DatasetError: formats, cameras, instants or splits that there are none of.
        ServiceError: INVALID_REQUEST for more frames or pixels than a worker makes.
    """
    for name in plan.formats:
        writer_of(name)
    cameras, clips = planned_cameras(variants[0].drive, plan), planned_shards(variants, plan)
    planned_lidar(plan)
    frames = sum(len(clip.times_us) for clip in clips)
    if frames > MAX_FRAMES:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{frames} frames; {MAX_FRAMES} is the most in one data set of a worker",
            hint="ask for a longer period_us or a shorter span",
        )
    pixels = sum(camera.width * camera.height for camera in cameras)
    if pixels > max_pixels:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{pixels} pixels a frame; this worker draws at most {max_pixels}",
            hint="ask for fewer cameras or a smaller width",
        )


async def make_dataset(
    source: DatasetSource,
    plan: ExportPlan,
    *,
    dry_run: bool,
    backend: EngineBackend,
    quota: Quota,
) -> JobResult:
    """Label a drive, write it in all formats, and pack it into one file; or only tell how much
    there would be.

    Raises:
        JobCancelled: the job was cancelled.
        DatasetError: as :func:`export_dataset`.
        ServiceError: QUOTA_EXCEEDED, before or while it is made.
    """
    if dry_run:
        guess = await asyncio.to_thread(_estimate, source.variants, plan, backend)
        values = {"frames": guess.frames, "images": guess.images}
        return JobResult(values | {"bytes": guess.nbytes, "minutes": guess.minutes})
    return await asyncio.to_thread(_export, source, plan, backend, quota)


def _estimate(variants: Sequence[Variant], plan: ExportPlan, backend: EngineBackend) -> Estimate:
    backend.context.progress(0.0, "estimating")
    return estimate(variants, plan, backend=backend)


def _export(
    source: DatasetSource, plan: ExportPlan, backend: EngineBackend, quota: Quota
) -> JobResult:
    context = backend.context
    context.folder.mkdir(parents=True, exist_ok=True)
    folder = context.folder / FOLDER
    # Left half packed by a worker that died; the clips that it had finished are kept beside it.
    shutil.rmtree(folder, ignore_errors=True)
    frames = sum(len(clip.times_us) for clip in planned_shards(source.variants, plan))
    if frames > FEW_FRAMES:
        quota.check(added_bytes=_estimate(source.variants, plan, backend).nbytes, entries=0)
    try:
        export_dataset(
            source.variants,
            plan,
            folder,
            made_of=source.made_of,
            backend=backend,
            on_progress=_Progress(context, quota),
        )
        return _packed(folder, context)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(work_folder(folder), ignore_errors=True)


class _Progress:
    """Tells how far the job is, and ends it when it takes more disk than there is for it."""

    def __init__(self, context: JobContext, quota: Quota) -> None:
        self._context = context
        self._quota = quota
        self._looked = time.monotonic()

    def __call__(self, stage: str, done: int, total: int) -> None:
        share = done / max(total, 1)
        if stage == "frames":
            self._context.progress(LABELLING * share, "labelling")
        else:
            self._context.progress(LABELLING + (0.97 - LABELLING) * share, "writing")
        if time.monotonic() - self._looked > ROOM_CHECKS_S:
            self._quota.check(entries=0)
            self._looked = time.monotonic()


def _packed(folder: Path, context: JobContext) -> JobResult:
    """The files that the job leaves: the archive, the manifest and sheets to look at."""
    manifest = json.loads((folder / MANIFEST).read_bytes())
    files = {ARCHIVE: "application/x-tar", MANIFEST: "application/json"}
    shutil.copyfile(folder / MANIFEST, context.folder / MANIFEST)
    for sheet in sorted((folder / PREVIEW).iterdir()):
        name = f"{PREVIEW}_{sheet.name}"
        shutil.copyfile(sheet, context.folder / name)
        files[name] = "image/jpeg"
    context.progress(0.97, "packing")
    pack(folder, context.folder / ARCHIVE, context)
    values = {
        "frames": manifest["statistics"]["frames"],
        "formats": list(manifest["plan"]["formats"]),
        "clips": len(manifest["clips"]),
        "licence": manifest["licence"],
        "statistics": manifest["statistics"],
    }
    return JobResult(values, files)
