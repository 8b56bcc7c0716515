"""Videos of scenes, scenarios and simulations."""

from __future__ import annotations

import asyncio
import tarfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import SensorSpec
from real2sim_proto.jobs import ExportRequest

from ...geometry.transform import Float
from ...render import Instance
from ...render.video import VideoError, VideoFile
from ...scene import Scene
from ..engine import QueueFullError
from ..http.problems import ServiceError
from ..rendering.frames import EncodedFrame
from ..rendering.renderer import Renderer, RenderRequest, check_sensors
from .jobs import JobContext, JobResult

VIDEO = "video.webm"
VIDEO_TYPE = "video/webm"
MAX_FRAMES = 20_000


@dataclass(frozen=True, eq=False)
class VideoSource:
    """What a video shows.

    Attributes:
        scene: gives cameras, sky and the ego trajectory.
        instances: what is drawn at an instant [us]; called off the event loop.
        span: first and last instant that can be shown [us].
        vehicle: where the cameras' vehicle is; None: as it was recorded.
        outside: the same for who looks on from outside the ego; None where that is the same.
    """

    scene: Scene
    instances: Callable[[int], Sequence[Instance]]
    span: tuple[int, int]
    outside: Callable[[int], Sequence[Instance]] | None = None
    vehicle: Callable[[int], Float] | None = None

    def T_world_vehicle(self, t_us: int) -> Float:
        """[4, 4] of the vehicle that carries the cameras, at an instant."""
        return self.scene.ego.transform(t_us) if self.vehicle is None else self.vehicle(t_us)


async def export_video(
    video_source: VideoSource, request: ExportRequest, *, renderer: Renderer, context: JobContext
) -> JobResult:
    """Draw a video frame by frame, other users of the engine in between.

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
    """The frame, rendered when interactive requests leave room in the queue."""
    while True:
        try:
            return (await renderer.render(render_request, stream="export")).frames[0]
        except QueueFullError:
            context.check()
            await asyncio.sleep(0.2)


def frame_times(video_source: VideoSource, request: ExportRequest) -> list[int]:
    """Instants of the frames [us].

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
    if count > MAX_FRAMES:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST, f"{count} frames; {MAX_FRAMES} is the most in one video"
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
    """Pack all files below a folder; the same bytes for the same files: without the day, the user
    or the rights. A file that is packed goes, so that the disk holds each once.

    Raises:
        JobCancelled: the job was cancelled.
    """
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as tar:
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            context.check()
            member = tarfile.TarInfo(str(path.relative_to(folder)))
            member.size, member.mtime, member.mode = path.stat().st_size, 0, 0o644
            with path.open("rb") as file:
                tar.addfile(member, file)
            path.unlink()
