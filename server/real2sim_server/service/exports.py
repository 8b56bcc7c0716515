"""Videos and labelled data sets of scenes, scenarios, simulations and episodes, as jobs."""

from __future__ import annotations

import asyncio
import json
import shutil
import tarfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import SensorSpec
from real2sim_proto.jobs import DatasetRequest, ExportRequest

from ..datasets.export import MANIFEST, PREVIEW, Estimate, estimate, export_dataset, work_folder
from ..datasets.labels.boxes import BoxNoise
from ..datasets.perturbed import Perturbation
from ..datasets.plan import ExportPlan, Variant, planned_cameras, planned_lidar, planned_shards
from ..datasets.writers import writer_of
from ..geometry import Float
from ..render import Backend, Instance, RenderOutput
from ..render.backend import RasterRequest
from ..render.cast import CastRequest, Echo, select_caster
from ..render.images import VideoError, VideoFile
from ..scene import Scene
from .engine import Engine, Priority, QueueFullError
from .frames import EncodedFrame
from .http.responses import ServiceError
from .jobs import JobContext, JobResult
from .library.scenes import Quota
from .renderer import Renderer, RenderRequest, check_sensors

VIDEO = "video.webm"
VIDEO_TYPE = "video/webm"
MAX_VIDEO_FRAMES = 20_000


@dataclass(frozen=True, eq=False)
class VideoSource:
    """Content of a video.

    Attributes:
        scene: provides cameras, sky and the ego trajectory.
        instances: returns the instances at a time [us]; called off the event loop.
        span: first and last available time [us].
        vehicle: trajectory of the cameras' vehicle; None: as recorded.
        outside: instances for cameras outside the ego; None if they are the same.
    """

    scene: Scene
    instances: Callable[[int], Sequence[Instance]]
    span: tuple[int, int]
    outside: Callable[[int], Sequence[Instance]] | None = None
    vehicle: Callable[[int], Float] | None = None

    def T_world_vehicle(self, t_us: int) -> Float:
        """[4, 4] pose of the cameras' vehicle at a time."""
        return self.scene.ego.transform(t_us) if self.vehicle is None else self.vehicle(t_us)


async def export_video(
    video_source: VideoSource, request: ExportRequest, *, renderer: Renderer, context: JobContext
) -> JobResult:
    """Render a video frame by frame, interleaved with other work of the engine.

    Raises:
        ServiceError: UNKNOWN_CAMERA, INVALID_REQUEST; TIME_OUT_OF_RANGE.
        JobCancelled: the job was cancelled.
    """
    times = frame_times(video_source, request)
    sensor = SensorSpec(camera=request.camera, width=request.width, codec="raw")
    await asyncio.to_thread(context.folder.mkdir, parents=True, exist_ok=True)
    loop = asyncio.get_running_loop()
    with ThreadPoolExecutor(1, thread_name_prefix="video") as encoder:
        video = VideoFile(context.folder / VIDEO, request.fps)
        try:
            for index, t_us in enumerate(times):
                context.progress(index / len(times), "drawing")
                render_request = await asyncio.to_thread(
                    _render_request, video_source, sensor, t_us
                )
                frame = await _render_frame(renderer, render_request, context)
                pixels = np.frombuffer(frame.data, np.uint8).reshape(frame.shape)
                await loop.run_in_executor(encoder, video.add, pixels)
            await loop.run_in_executor(encoder, video.close)
        except VideoError as error:
            raise ServiceError(ErrorCode.UNSUPPORTED, str(error)) from error
        finally:
            await loop.run_in_executor(encoder, video.discard)
    values = {"frames": len(times), "fps": request.fps, "start_us": times[0], "end_us": times[-1]}
    return JobResult(values, {VIDEO: VIDEO_TYPE})


async def _render_frame(
    renderer: Renderer, render_request: RenderRequest, context: JobContext
) -> EncodedFrame:
    """Render the frame; while the engine's queue is full, wait and retry."""
    while True:
        try:
            return (await renderer.render(render_request, stream="export")).frames[0]
        except QueueFullError:
            context.check()
            await asyncio.sleep(0.2)


def frame_times(video_source: VideoSource, request: ExportRequest) -> list[int]:
    """Times of the frames [us].

    Raises:
        ServiceError: TIME_OUT_OF_RANGE or INVALID_REQUEST.
    """
    first, last = video_source.span
    start = first if request.start_us is None else request.start_us
    end = last if request.end_us is None else request.end_us
    if not first <= start <= end <= last:
        raise ServiceError(
            ErrorCode.TIME_OUT_OF_RANGE,
            f"the video would show {start} to {end} us; there is {first} to {last} us",
            hint="leave start_us and end_us out for all of it",
        )
    count = int((end - start) * 1e-6 * request.fps) + 1
    if count > MAX_VIDEO_FRAMES:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{count} frames; {MAX_VIDEO_FRAMES} is the most in one video",
        )
    return [start + round(i * 1e6 / request.fps) for i in range(count)]


def check_camera(video_source: VideoSource, request: ExportRequest, *, max_pixels: int) -> None:
    """Refuse a camera or size before the job begins. Raises ServiceError."""
    sensor = SensorSpec(camera=request.camera, width=request.width, codec="raw")
    check_sensors(video_source.scene.rig, [sensor], max_pixels=max_pixels)


def _render_request(video_source: VideoSource, sensor: SensorSpec, t_us: int) -> RenderRequest:
    return RenderRequest(
        scene=video_source.scene,
        instances=video_source.instances(t_us),
        T_world_vehicle=video_source.T_world_vehicle(t_us),
        t_us=t_us,
        sensors=(sensor,),
    )


# --- Archives ------------------------------------------------------------------------------------


def pack(folder: Path, archive: Path, context: JobContext) -> None:
    """Pack all files below a folder reproducibly: without dates, users or permissions.

    Deletes each file once it is packed, to save disk space. Further names of a file (hard links)
    are links in the archive.

    Raises:
        JobCancelled: the job was cancelled.
    """
    packed: dict[int, str] = {}
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as tar:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            context.check()
            member, about = tarfile.TarInfo(str(path.relative_to(folder))), path.stat()
            member.mtime, member.mode = 0, 0o644
            if about.st_ino in packed:
                member.type, member.linkname = tarfile.LNKTYPE, packed[about.st_ino]
                tar.addfile(member)
            else:
                member.size = about.st_size
                with path.open("rb") as file:
                    tar.addfile(member, file)
                if about.st_nlink > 1:
                    packed[about.st_ino] = member.name
            path.unlink()


# Data sets.

MAX_DATASET_FRAMES = 20_000

T = TypeVar("T")
R = TypeVar("R")

ARCHIVE = "dataset.tar"
FOLDER = "dataset"

LABELLING = 0.9
"""Fraction of the work that is done when all frames are labelled."""

ROOM_CHECKS_S = 5.0
"""Interval of disk space checks while frames are labelled [s]."""

FEW_FRAMES = 12
"""Smaller exports start without an estimate; estimating takes as long as three frames."""


@dataclass(frozen=True, eq=False)
class DatasetSource:
    """Content of a data set.

    Attributes:
        variants: drives to label.
        made_of: other inputs, listed in the manifest.
    """

    variants: Sequence[Variant]
    made_of: dict[str, Any]


@dataclass(eq=False)
class EngineBackend:
    """Renders on the engine's thread, which owns the device, between other work.

    Attributes:
        engine: the engine.
        backend: its backend.
        context: context of the job, whose account is charged.
        loop: event loop of the engine's callers.
        name: name of the backend.
        caster: traces LiDAR rays on the engine, too.
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
        """Whether the engine's backend renders lenses."""
        return getattr(self.backend, "draws_lenses", False)

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Render with low priority; waits while the queue is full. Raises JobCancelled."""
        yielding = replace(request, between=self.engine.yield_to_urgent)
        return self.on_engine(self.backend.rasterize, yielding)

    def warm_up(self) -> None:
        """The engine's backend is already warm."""

    def on_engine(self, work: Callable[[T], R], argument: T) -> R:
        """The result of ``work`` on the engine's thread. Raises JobCancelled."""
        while True:
            self.context.check()
            awaited = self.engine.call(work, argument, label="dataset", priority=Priority.BULK)
            try:
                return asyncio.run_coroutine_threadsafe(awaited, self.loop).result()
            except QueueFullError:
                time.sleep(0.2)


@dataclass(frozen=True)
class EngineCaster:
    """Traces rays on the engine."""

    backend: EngineBackend
    name: str = "engine"

    def cast(self, request: CastRequest) -> Echo:
        """See :class:`CastBackend`. Raises JobCancelled."""
        return self.backend.on_engine(select_caster().cast, request)


def plan_of(request: DatasetRequest) -> ExportPlan:
    """The export plan of a request."""
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
    """Refuse invalid exports before the job begins.

    Raises:
        DatasetError: no such formats, cameras, times or splits.
        ServiceError: INVALID_REQUEST for more frames or pixels than the worker's limit.
    """
    for name in plan.formats:
        writer_of(name)
    cameras, clips = planned_cameras(variants[0].drive, plan), planned_shards(variants, plan)
    planned_lidar(plan)
    frames = sum(len(clip.times_us) for clip in clips)
    if frames > MAX_DATASET_FRAMES:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{frames} frames; {MAX_DATASET_FRAMES} is the most in one data set of a worker",
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
    """Label a drive, write it in all formats, and pack it into one file; or only estimate its
    size.

    Raises:
        JobCancelled: the job was cancelled.
        DatasetError: from :func:`export_dataset`.
        ServiceError: QUOTA_EXCEEDED, before or during the export.
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
    # Left by a worker that died while packing; its finished clips are stored next to it.
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
    """Reports the job's progress, and ends the job if it exceeds the available disk space."""

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
    """Result files of the job: the archive, the manifest and preview sheets."""
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
