"""What waiting for a job means, whoever waits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

from real2sim_proto.jobs import JobInfo, JobState

from ._guidance import Handle
from .errors import ErrorDetails, Real2SimError, ReplyTimeoutError, error_for

OnProgress = Callable[[JobInfo], object]

FIRST_POLL = 0.05
SLOWEST_POLL = 1.0


class JobBase(Handle):
    """State of a job that this client has seen last, shared by the sync and the async variant."""

    _instead: ClassVar = {
        "done": "job.info.over",
        "id": "job.job_id",
        "progress": "job.info.progress",
        "save": "job.download(name, path)",
        "state": "job.info.state",
        "status": "job.info.state",
    }

    def __init__(self, info: JobInfo) -> None:
        self.info = info

    @property
    def job_id(self) -> str:
        """Id of the job on its worker."""
        return self.info.job_id

    @property
    def result(self) -> dict[str, Any]:
        """What it found, once it has succeeded; before that, nothing."""
        return self.info.result or {}

    def __repr__(self) -> str:
        state, progress = self.info.state.value, self.info.progress
        return f"{type(self).__name__}({self.job_id!r}, {state}, {progress:.0%})"


def poll_delays(job_id: str, timeout: float | None) -> Iterator[float]:
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


def require_success(info: JobInfo) -> None:
    """Raises Real2SimError, of the kind of its problem, unless the job has succeeded."""
    if info.state is JobState.SUCCEEDED:
        return
    if info.error is None:
        raise Real2SimError(f"job {info.job_id!r} is {info.state.value}", hint="start it again")
    problem = info.error
    raise error_for(
        ErrorDetails(
            status=problem.status,
            code=str(problem.code),
            detail=f"job {info.job_id!r} is {info.state.value}: {problem.detail}",
            hint=problem.hint,
        )
    )
