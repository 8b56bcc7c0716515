"""Fixtures with a fake worker for the client's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from .fake_worker import FakeWorker


@pytest.fixture(scope="session")
def running_worker() -> Iterator[FakeWorker]:
    with FakeWorker().running() as running:
        yield running


@pytest.fixture
def worker(running_worker: FakeWorker) -> FakeWorker:
    running_worker.forget()
    return running_worker
