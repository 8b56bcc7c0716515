"""Fixtures shared by all tests."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import real2sim_server  # noqa: F401 - sets the waiting policy of threads, before any library starts some
from scripts.compile_kernels import compile_drawing, compile_physics
from tests.pages import Page

# Machines under load are sometimes slow, and a failure must be reproduced by the next run.
settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("repeatable")

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", help="run slow and browser tests too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--run-slow"):
        return
    for item in items:
        for marker in ("slow", "browser"):
            if item.get_closest_marker(marker):
                item.add_marker(pytest.mark.skip(reason=f"{marker}; run with --run-slow"))


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Folder of real sample data. Tests that need it are skipped without it."""
    folder = Path(os.environ.get("REAL2SIM_TEST_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real test data at {folder} (set REAL2SIM_TEST_DATA)")
    return folder


@pytest.fixture(scope="session")
def compile_alone(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[], None]], None]:
    """Run a function that compiles kernels in only one process of this run.

    The other processes wait and load the result from disk. Time limits apply to tests, not to
    fixtures, so waiting does not fail a test.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # Shared by all processes.

    def locked(kernels: Callable[[], None]) -> None:
        with (folder / "compiling.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            done = folder / f"{kernels.__name__}.done"
            if not done.exists():
                kernels()
                done.touch()

    return locked


@pytest.fixture(scope="session")
def worker_kernels(compile_alone: Callable[[Callable[[], None]], None]) -> None:
    """Cache the kernels that a worker needs before it is ready."""
    compile_alone(compile_drawing)


@pytest.fixture(scope="session")
def solver_kernels(compile_alone: Callable[[Callable[[], None]], None]) -> None:
    """Cache the CPU physics kernels in both precisions."""
    compile_alone(compile_physics)


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Page]:
    """Open a page of README or docs, to run its blocks in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda name: Page(REPOSITORY / name, tmp_path)
