"""One export of the tiny scene in all formats, shared read-only by tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.plan import ExportPlan
from real2sim_server.datasets.writers import writer_names
from real2sim_server.edit import ScenarioState

PLAN = ExportPlan(
    formats=tuple(writer_names()),
    period_us=250_000,
    end_us=1_000_000,
    clip_s=0.75,
    splits={"train": 0.5, "val": 0.5},
)
"""Five frames in two clips."""


@pytest.fixture(scope="session")
def tiny_drive(tiny_scene) -> ScenarioDrive:
    """The tiny scene as it was recorded."""
    return ScenarioDrive(tiny_scene, ScenarioState.of(tiny_scene))


@pytest.fixture(scope="session")
def exported(tiny_drive, tmp_path_factory) -> Path:
    """PLAN in all formats."""
    return export_dataset(tiny_drive, PLAN, tmp_path_factory.mktemp("dataset") / "all")


@pytest.fixture(scope="session")
def plan() -> ExportPlan:
    """See :data:`PLAN`."""
    return PLAN
