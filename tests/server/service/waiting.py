"""Waits for tests of workers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fastapi.testclient import TestClient

from real2sim_proto.jobs import JobInfo
from tests.waiting import wait_until


def is_ready(client: TestClient) -> bool:
    return client.get("/readyz").status_code == 200


def wait_ready(client: TestClient) -> None:
    """Wait until the worker is ready."""
    wait_until(lambda: is_ready(client), lambda: f"a worker: {client.get('/readyz').text}")


def finished(client: TestClient, job: Any) -> dict:
    """A job once it has ended.

    Args:
        client: client of any worker that knows the job.
        job: its path, or the response that started it.
    """
    if not isinstance(job, str):
        assert job.status_code == 202, job.text
        job = job.headers["Location"]
    return wait_until(lambda: _if_over(client.get(job).json()), lambda: client.get(job).text)


def succeeded(client: TestClient, job: Any) -> dict:
    """:func:`finished` for a job that must succeed."""
    ended = finished(client, job)
    assert ended["state"] == "succeeded", ended
    return ended


def accepted(send: Callable[[], Any]) -> Any:
    """The response to a request, repeated while the worker says that it can be retried.

    On a busy machine even a healthy database can exceed the short time limit of a test worker.
    """
    return wait_until(lambda: _unless_retryable(send()), lambda: f"a success: {send().text}")


def _if_over(job: dict) -> dict | None:
    # If the store has failed, the body is a problem document, not a job.
    return job if "job_id" in job and JobInfo.model_validate(job).over else None


def _unless_retryable(answer: Any) -> Any:
    if answer.status_code < 300:
        return answer
    assert answer.json()["retryable"], answer.text
    return None
