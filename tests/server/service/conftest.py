"""Workers for tests, in memory through the ASGI interface."""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import structlog
from fastapi.testclient import TestClient

from real2sim_server.service import exports
from real2sim_server.service.app import create_app
from real2sim_server.settings import Settings

from .manual_clock import manual_clock
from .postgres import Postgres, running_postgres

__all__ = ["manual_clock"]

PROCESSORS = [
    structlog.contextvars.merge_contextvars,
    structlog.processors.add_log_level,
    structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback),
]


@pytest.fixture
def make_settings(tmp_path: Path, scenes_dir: Path) -> Callable[..., Settings]:
    """Settings of a worker in the test's own folders. Keyword arguments override them."""

    def make(**overrides) -> Settings:
        defaults = {
            "data_dir": tmp_path / "data",
            "scenes_dir": scenes_dir,
            "import_root": tmp_path / "import",
            "port": 0,
            "backend": "cpu",
            "log_level": "error",
            "drain_seconds": 0,
        }
        return Settings(**(defaults | overrides))

    return make


@pytest.fixture
def run_worker(make_settings) -> Callable[..., TestClient]:
    """Create workers that run inside a ``with`` block. Keyword arguments override settings."""
    return lambda **overrides: TestClient(
        create_app(make_settings(**overrides)), base_url="http://127.0.0.1"
    )


@pytest.fixture
def start_worker(run_worker) -> Iterator[Callable[..., TestClient]]:
    """Start workers that stop at the end of the test. Keyword arguments override settings."""
    with ExitStack() as stack:

        def start(**overrides) -> TestClient:
            return stack.enter_context(run_worker(**overrides))

        yield start


@pytest.fixture
def client(start_worker) -> TestClient:
    return start_worker()


@dataclass(frozen=True)
class HeldVideos:
    """Holds back the video jobs of workers in this process.

    Attributes:
        begun: set once a video job waits for its first frame.
        released: set it to let the videos be drawn. They can be cancelled before.
    """

    begun: threading.Event = field(default_factory=threading.Event)
    released: threading.Event = field(default_factory=threading.Event)


@pytest.fixture
def held_videos(monkeypatch) -> Iterator[HeldVideos]:
    held, render_frame = HeldVideos(), exports._render_frame

    async def render_when_released(renderer, render_request, context):
        held.begun.set()
        while not held.released.is_set():
            context.check()
            await asyncio.sleep(0.01)
        return await render_frame(renderer, render_request, context)

    monkeypatch.setattr(exports, "_render_frame", render_when_released)
    yield held
    held.released.set()


@pytest.fixture
def small_disk() -> Iterator[Path]:
    """A 4 MiB file system."""
    if os.getuid() != 0 or shutil.which("mount") is None:
        pytest.skip("needs root, to mount a small file system")
    with tempfile.TemporaryDirectory(prefix="real2sim-disk-") as folder:
        mounted = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", folder]
        done = subprocess.run(mounted, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A PostgreSQL server for the whole run. Skips if PostgreSQL is not installed."""
    # Outside pytest's own folder, which other users cannot enter.
    with (
        tempfile.TemporaryDirectory(prefix="real2sim-pg-") as folder,
        running_postgres(Path(folder)) as server,
    ):
        yield server


@pytest.fixture(autouse=True, scope="session")
def kernels(worker_kernels) -> None:
    """Make workers under test ready at once."""


@pytest.fixture(autouse=True, scope="session")
def quiet_log() -> None:
    _log_from(logging.ERROR)


@pytest.fixture
def logged() -> Iterator[list[dict[str, Any]]]:
    """All log entries of the test, oldest first."""
    _log_from(logging.DEBUG)
    with structlog.testing.capture_logs() as entries:
        yield entries
    _log_from(logging.ERROR)


def _log_from(level: int) -> None:
    # Format tracebacks as a worker does. Pretty ones print all variables, which takes seconds.
    structlog.configure(
        processors=PROCESSORS, wrapper_class=structlog.make_filtering_bound_logger(level)
    )
