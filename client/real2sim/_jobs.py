"""Jobs: long work on the worker, followed from here."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from real2sim_proto.jobs import ExportRequest, JobInfo, JobState

from . import _requests
from ._call import checked
from ._transport import AsyncTransport, Transport
from .errors import Real2SimError, Refusal, ReplyTimeoutError, error_for

OnProgress = Callable[[JobInfo], object]

FIRST_POLL = 0.05
SLOWEST_POLL = 1.0


class Jobs:
    """``client.jobs``."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def get(self, job_id: str) -> Job:
        """A handle of an existing job."""
        return Job(self._transport, self._transport.send(_requests.get_job(job_id)))

    def list(self, *, subject: str | None = None) -> Sequence[JobInfo]:
        """Jobs of the worker, newest first; those of one scene or scenario on request."""
        return self._transport.send(_requests.list_jobs(subject)).jobs

    def export_video(
        self,
        *,
        camera: str,
        scenario: str | None = None,
        scene: str | None = None,
        simulation: str | None = None,
        width: int | None = None,
        start_us: int | None = None,
        end_us: int | None = None,
        fps: float = 10.0,
    ) -> Job:
        """Start making a video; ``job.wait().download("video.webm", path)`` fetches it.

        Args:
            camera: recorded camera that it is seen from.
            scenario, scene, simulation: id of exactly one of them.
            width: pixels; default: as recorded.
            start_us, end_us: default: as long as there is something.
            fps: frames a second.
        """
        fields = {
            "camera": camera,
            "scenario": scenario,
            "scene": scene,
            "simulation": simulation,
            "width": width,
            "start_us": start_us,
            "end_us": end_us,
            "fps": fps,
        }
        call = _requests.create_export(checked(ExportRequest, **fields))
        return Job(self._transport, self._transport.send(call))


class Job:
    """One job as this client last saw it."""

    def __init__(self, transport: Transport, info: JobInfo) -> None:
        self._transport = transport
        self.info = info

    @property
    def job_id(self) -> str:
        return self.info.job_id

    @property
    def result(self) -> dict[str, Any]:
        """What it found, once it has succeeded; before that, nothing."""
        return self.info.result or {}

    def refresh(self) -> Job:
        """See how far it is; returns itself."""
        self.info = self._transport.send(_requests.get_job(self.job_id))
        return self

    def wait(self, *, timeout: float | None = None, on_progress: OnProgress | None = None) -> Job:
        """Wait until it has succeeded; returns itself.

        Args:
            timeout: seconds; default: without limit.
            on_progress: called with every change that is seen.

        Raises:
            ReplyTimeoutError: it goes on for longer.
            Real2SimError: it failed, was cancelled or interrupted; of the kind of its problem.
        """
        for delay in _delays(self.job_id, timeout):
            seen = self.info.event
            self.refresh()
            if on_progress is not None and self.info.event != seen:
                on_progress(self.info)
            if self.info.over:
                break
            time.sleep(delay)
        _require_success(self.info)
        return self

    def cancel(self) -> Job:
        """Ask it to end; returns itself."""
        self._transport.send(_requests.cancel_job(self.job_id))
        return self.refresh()

    def download(self, name: str, path: str | os.PathLike[str]) -> Path:
        """Fetch a file that it left, and write it to ``path``."""
        content = self._transport.send(_requests.job_file(self.job_id, name))
        return _written(content, path)

    def __repr__(self) -> str:
        return f"Job({self.job_id!r}, {self.info.state.value}, {self.info.progress:.0%})"


class AsyncJobs:
    """``client.jobs`` of the async client; see :class:`Jobs`."""

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    async def get(self, job_id: str) -> AsyncJob:
        """A handle of an existing job."""
        return AsyncJob(self._transport, await self._transport.send(_requests.get_job(job_id)))

    async def list(self, *, subject: str | None = None) -> Sequence[JobInfo]:
        """Jobs of the worker, newest first."""
        return (await self._transport.send(_requests.list_jobs(subject))).jobs

    async def export_video(self, *, camera: str, **options: Any) -> AsyncJob:
        """Start making a video; options as of :meth:`Jobs.export_video`."""
        asked = checked(ExportRequest, camera=camera, **options)
        info = await self._transport.send(_requests.create_export(asked))
        return AsyncJob(self._transport, info)


class AsyncJob:
    """One job as this client last saw it; see :class:`Job`."""

    def __init__(self, transport: AsyncTransport, info: JobInfo) -> None:
        self._transport = transport
        self.info = info

    @property
    def job_id(self) -> str:
        return self.info.job_id

    @property
    def result(self) -> dict[str, Any]:
        """What it found, once it has succeeded; before that, nothing."""
        return self.info.result or {}

    async def refresh(self) -> AsyncJob:
        """See how far it is; returns itself."""
        self.info = await self._transport.send(_requests.get_job(self.job_id))
        return self

    async def wait(
        self, *, timeout: float | None = None, on_progress: OnProgress | None = None
    ) -> AsyncJob:
        """Wait until it has succeeded; see :meth:`Job.wait`."""
        for delay in _delays(self.job_id, timeout):
            seen = self.info.event
            await self.refresh()
            if on_progress is not None and self.info.event != seen:
                on_progress(self.info)
            if self.info.over:
                break
            await asyncio.sleep(delay)
        _require_success(self.info)
        return self

    async def cancel(self) -> AsyncJob:
        """Ask it to end; returns itself."""
        await self._transport.send(_requests.cancel_job(self.job_id))
        return await self.refresh()

    async def download(self, name: str, path: str | os.PathLike[str]) -> Path:
        """Fetch a file that it left, and write it to ``path``."""
        content = await self._transport.send(_requests.job_file(self.job_id, name))
        return await asyncio.to_thread(_written, content, path)

    def __repr__(self) -> str:
        return f"AsyncJob({self.job_id!r}, {self.info.state.value}, {self.info.progress:.0%})"


def _delays(job_id: str, timeout: float | None) -> Iterator[float]:
    """Pauses between two looks, ever longer.

    Raises:
        ReplyTimeoutError: when the time is up.
    """
    started, delay = time.monotonic(), FIRST_POLL
    while timeout is None or time.monotonic() - started < timeout:
        yield delay
        delay = min(delay * 1.5, SLOWEST_POLL)
    raise ReplyTimeoutError(
        f"end of job {job_id!r}", timeout or 0.0, hint="it goes on; wait again, or cancel it"
    )


def _require_success(info: JobInfo) -> None:
    if info.state is JobState.SUCCEEDED:
        return
    if info.error is None:
        raise Real2SimError(f"job {info.job_id!r} is {info.state.value}", hint="start it again")
    problem = info.error
    raise error_for(
        Refusal(
            status=problem.status,
            code=problem.code.value,
            detail=f"job {info.job_id!r} is {info.state.value}: {problem.detail}",
            hint=problem.hint,
        )
    )


def _written(content: bytes, path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.part")
    partial.write_bytes(content)
    partial.replace(target)
    return target
