"""Workers for tests: in memory, by way of the ASGI interface."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import structlog
from fastapi.testclient import TestClient

from real2sim_server.service.app import create_app
from real2sim_server.settings import Settings


@pytest.fixture
def make_settings(tmp_path: Path, scenes_dir: Path) -> Callable[..., Settings]:
    """Settings of a worker in the test's own folders; keywords override."""

    def make(**overrides) -> Settings:
        defaults = {
            "data_dir": tmp_path / "data",
            "scenes_dir": scenes_dir,
            "import_root": tmp_path / "import",
            "port": 0,
            "backend": "cpu",
            "log_level": "error",
        }
        return Settings(**(defaults | overrides))

    return make


@pytest.fixture
def start_worker(make_settings) -> Iterator[Callable[..., TestClient]]:
    """Starts workers that stop with the test; keywords override settings."""
    with ExitStack() as stack:

        def start(**overrides) -> TestClient:
            return stack.enter_context(running_client(make_settings(**overrides)))

        yield start


@pytest.fixture
def client(start_worker) -> TestClient:
    return start_worker()


def running_client(settings: Settings) -> TestClient:
    """A client to be entered; the worker runs inside the ``with`` block."""
    return TestClient(create_app(settings), base_url="http://127.0.0.1")


@pytest.fixture(autouse=True, scope="session")
def quiet_log() -> None:
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
