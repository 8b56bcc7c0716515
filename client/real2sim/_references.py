"""What callers may give where a scene, a scenario or a job is meant: the object, or its id."""

from __future__ import annotations

from typing import Any, TypeAlias

from real2sim_proto.jobs import JobInfo
from real2sim_proto.scenarios import ScenarioInfo
from real2sim_proto.scenes import SceneInfo

from ._scenario_state import ScenarioState

SceneRef: TypeAlias = str | SceneInfo
"""A scene: its name, or what ``client.scenes`` gave."""

ScenarioRef: TypeAlias = str | ScenarioInfo | ScenarioState
"""A scenario: its id, its handle, or what ``client.scenarios.list()`` gave."""


def scene_name(scene: SceneRef) -> str:
    """Name of a scene. Raises TypeError for what is none."""
    if isinstance(scene, SceneInfo):
        return scene.scene
    return _checked_id(scene, "scene", "a name or a SceneInfo")


def scenario_id_of(scenario: ScenarioRef) -> str:
    """Id of a scenario. Raises TypeError for what is none."""
    if isinstance(scenario, ScenarioInfo | ScenarioState):
        return scenario.scenario_id
    return _checked_id(scenario, "scenario", "an id or a scenario's handle")


def job_id_of(job: Any) -> str:
    """Id of a job. Raises TypeError for what is none."""
    info = getattr(job, "info", job)
    if isinstance(info, JobInfo):
        return info.job_id
    return _checked_id(job, "simulation", "an id or a job's handle")


def session_and_token(session: Any) -> tuple[str | None, str | None]:
    """Id of a session and its token, as far as it is known. Raises TypeError for what is none."""
    if session is None or isinstance(session, str):
        return session, None
    name, token = getattr(session, "session_id", None), getattr(session, "token", None)
    return _checked_id(name, "session", "an id, a SessionInfo or an open drive session"), token


def optional_scene_name(scene: SceneRef | None) -> str | None:
    """As :func:`scene_name`; None stays None."""
    return None if scene is None else scene_name(scene)


def optional_scenario_id(scenario: ScenarioRef | None) -> str | None:
    """As :func:`scenario_id_of`; None stays None."""
    return None if scenario is None else scenario_id_of(scenario)


def _checked_id(value: Any, what: str, allowed: str) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{what} is a {type(value).__name__}; give {allowed}")
    return value
