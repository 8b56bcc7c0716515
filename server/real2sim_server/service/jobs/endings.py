"""How jobs end, and why some do not succeed."""

from __future__ import annotations

from real2sim_proto import ErrorCode, Problem
from real2sim_proto.jobs import JobInfo, JobState

from ..clock import now_us
from ..http.problems import ServiceError, problem_of
from ..scenarios.replies import iso_time


def ended(info: JobInfo, state: JobState, *, error: Problem | None = None) -> JobInfo:
    """The job once it is over."""
    return info.model_copy(
        update={"state": state, "finished_at": iso_time(now_us()), "error": error}
    )


def interruption() -> Problem:
    """Of a job whose worker stopped."""
    failure = ServiceError(
        ErrorCode.DRAINING, "the worker stopped before this job was done", hint="start it again"
    )
    return problem_of(failure, path="", request_id=None)


def given_up(deaths: int) -> Problem:
    """Of a job at which so many workers died."""
    failure = ServiceError(
        ErrorCode.JOB_FAILED,
        f"{deaths} workers died at this job; it is not begun once more",
        hint="look at the logs of the workers, and ask for less at once",
    )
    return problem_of(failure, path="", request_id=None)
