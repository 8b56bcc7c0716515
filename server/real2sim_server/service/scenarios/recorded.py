"""Scenes as they were recorded, as scenarios that nobody made: looked at, never changed."""

from __future__ import annotations

from real2sim_proto import ErrorCode

from ...scene.io import SceneSummary
from ..http.problems import ServiceError
from ..storage.store import ScenarioRow

PREFIX = "recorded."
"""Before the content hash of a scene: the id of its recording. No other id begins like that."""


def recorded_hash(scenario_id: str) -> str | None:
    """Content hash of the scene whose recording has this id; None of scenarios that were made."""
    return scenario_id.removeprefix(PREFIX) if scenario_id.startswith(PREFIX) else None


def recorded_row(scene: str, summary: SceneSummary) -> ScenarioRow:
    """What the store would have of it, were it stored."""
    return ScenarioRow(
        scenario_id=f"{PREFIX}{summary.content_hash}",
        name="",
        scene=scene,
        scene_hash=summary.content_hash,
        created_us=0,
    )


def check_made(scenario_id: str) -> None:
    """Raises ServiceError: INVALID_OPERATION for a recording, which nobody can change."""
    if recorded_hash(scenario_id) is not None:
        raise ServiceError(
            ErrorCode.INVALID_OPERATION,
            f"{scenario_id!r} is a scene as it was recorded and cannot be changed",
            hint="make a scenario of it: POST /v1/scenarios, or fork it",
        )
