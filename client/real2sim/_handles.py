"""Shared by all handles: hints for wrong calls, references, states of scenarios and jobs."""

from __future__ import annotations

import functools
import inspect
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeAlias, TypeVar

from real2sim_proto.base import Guided, advice
from real2sim_proto.jobs import JobInfo, JobState
from real2sim_proto.scenarios import OperationResult, ScenarioInfo
from real2sim_proto.scenes import SceneInfo
from real2sim_proto.storyboard import Storyboard

from .errors import ErrorDetails, Real2SimError, ReplyTimeoutError, error_for

F = TypeVar("F", bound=Callable[..., Any])

KEYWORDS = {
    "acceleration": "plan=real2sim.Control(acceleration=1.0, steering=0.0)",
    "angle_deg": "angle=math.radians(15)",
    "camera_name": "camera='front'",
    "cameras": "sensors=['front']",
    "degrees": "angle=math.radians(15)",
    "dt": "dt_us=100_000 (microseconds)",
    "dx": "x=1.0 (metres)",
    "dy": "y=1.0 (metres)",
    "dz": "z=1.0 (metres)",
    "end": "end_us=2_000_000 (microseconds)",
    "height": "width=640; the height follows",
    "host": "url='http://127.0.0.1:8600'",
    "ip": "url='http://127.0.0.1:8600'",
    "max_steps": "steps=100",
    "n_steps": "steps=100",
    "options": "seed=0, horizon=50 and so on, each option by its name",
    "pos": "position=(x, y, z)",
    "port": "url='http://127.0.0.1:8600'",
    "rotation": "quaternion=(w, x, y, z)",
    "scene_name": "scene='street'",
    "start": "start_us=500_000 (microseconds)",
    "steering": "plan=real2sim.Control(acceleration=1.0, steering=0.0)",
    "time": "t=2.0 (seconds)",
    "time_us": "t_us=2_000_000 (microseconds)",
    "timestamp": "t_us=2_000_000 (microseconds)",
    "yaw": "angle=0.26 (radians)",
}
"""Arguments that users often try, and the correct ones."""


class Handle(Guided):
    """Base of the SDK's objects: errors for wrong names and arguments suggest the right one."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name, value in list(vars(cls).items()):
            if inspect.isfunction(value) and (name == "__init__" or not name.startswith("_")):
                setattr(cls, name, guided(value))


def guided(function: F) -> F:
    """Decorate a function: the error for an unknown argument suggests the right one."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            # Errors raised inside the function have more frames in their traceback.
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise
            taken = [p for p in inspect.signature(function).parameters if p != "self"]
            said = {argument_advice(name, taken): None for name in kwargs if name not in taken}
            said = said or {f"it takes {', '.join(taken) or 'nothing'}": None}
            raise TypeError(f"{error}; {'; '.join(said)}") from None

    return call  # type: ignore[return-value]


def argument_advice(name: str, taken: Sequence[str]) -> str:
    """Suggestion for an unknown argument."""
    meant = {k: v for k, v in KEYWORDS.items() if v.partition("=")[0] in taken}
    return advice(name, taken, meant, otherwise="it takes")


# The state of a scenario's handle, for the sync and the async client.

H = TypeVar("H")


class ScenarioState(Handle):
    """The newest state of a scenario that this client has seen."""

    _instead: ClassVar = {
        "add": "scenario.insert(asset, position=(x, y, z))",
        "close": "nothing: a scenario stays on its worker until client.scenarios.delete(scenario)",
        "delete": "client.scenarios.delete(scenario)",
        "drive": "client.session(scenario=scenario)",
        "export_video": "client.jobs.export_video(scenario=scenario, camera='front')",
        "get_object": "scenario.objects['car_6']",
        "id": "scenario.scenario_id",
        "name": "scenario.info.name",
        "render": "scenario.preview(camera='front')",
        "save": "scenario.export(), for a file; every edit is stored by the worker already",
        "session": "client.session(scenario=scenario)",
        "video": "client.jobs.export_video(scenario=scenario, camera='front')",
    }

    def __init__(self, info: ScenarioInfo) -> None:
        self._info = info
        self._etag = info.etag
        self._revision = info.revision

    @property
    def info(self) -> ScenarioInfo:
        """Name, scene, objects, whether undo and redo are possible."""
        return self._info

    @property
    def scenario_id(self) -> str:
        """Id of the scenario on its worker."""
        return self._info.scenario_id

    @property
    def scene(self) -> str:
        """Name of the scene that is edited."""
        return self._info.scene

    @property
    def revision(self) -> int:
        """Revision that the next edit is based on."""
        return self._revision

    @property
    def storyboard(self) -> Storyboard | None:
        """Default storyboard of the scenario's sessions, or None."""
        return self._info.storyboard

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.scenario_id!r}, scene={self.scene!r}, "
            f"revision={self.revision})"
        )

    def _update(self, info: ScenarioInfo) -> None:
        self._info, self._etag, self._revision = info, info.etag, info.revision

    def _record(self, result: OperationResult) -> None:
        if not result.dry_run:
            self._etag, self._revision = result.etag, result.revision


class Objects(Mapping[str, H], Generic[H]):
    """Handles of a scenario's objects, by id."""

    def __init__(self, handles: Mapping[str, H]) -> None:
        self._handles = handles

    def __getitem__(self, object_id: str) -> H:
        try:
            return self._handles[object_id]
        except KeyError:
            if not isinstance(object_id, str):
                raise KeyError(
                    f"{object_id!r} is not an id; write "
                    f"list(scenario.objects.values())[{object_id!r}]"
                ) from None
            raise KeyError(
                f"the scenario has no object {object_id!r} among {len(self)}; "
                f"{advice(object_id, self._handles)} refresh() shows what other clients have added"
            ) from None

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_"):
                raise AttributeError(f"'Objects' object has no attribute {name!r}")
            raise AttributeError(f"Objects has no {name!r}; write scenario.objects[{name!r}]")

    def __delitem__(self, object_id: str) -> None:
        raise TypeError(f"write scenario.objects[{object_id!r}].delete()")

    def __iter__(self) -> Iterator[str]:
        return iter(self._handles)

    def __len__(self) -> int:
        return len(self._handles)

    def __repr__(self) -> str:
        return f"Objects({', '.join(self._handles)})"


# References: callers may pass a scene, a scenario or a job as an object or by its id.

SceneRef: TypeAlias = str | SceneInfo
"""A scene: its name, or its info from ``client.scenes``."""

ScenarioRef: TypeAlias = str | ScenarioInfo | ScenarioState
"""A scenario: its id, its handle, or its info from ``client.scenarios.list()``."""


def scene_name(scene: SceneRef) -> str:
    """Name of a scene. Raises TypeError for other objects."""
    if isinstance(scene, SceneInfo):
        return scene.scene
    return _checked_id(scene, "scene", "a name or a SceneInfo")


def scenario_id_of(scenario: ScenarioRef) -> str:
    """Id of a scenario. Raises TypeError for other objects."""
    if isinstance(scenario, ScenarioInfo | ScenarioState):
        return scenario.scenario_id
    return _checked_id(scenario, "scenario", "an id or a scenario's handle")


def job_id_of(job: Any) -> str:
    """Id of a job. Raises TypeError for other objects."""
    info = getattr(job, "info", job)
    if isinstance(info, JobInfo):
        return info.job_id
    return _checked_id(job, "simulation", "an id or a job's handle")


def session_and_token(session: Any) -> tuple[str | None, str | None]:
    """Id of a session, and its token if known. Raises TypeError for other objects."""
    if session is None or isinstance(session, str):
        return session, None
    name, token = getattr(session, "session_id", None), getattr(session, "token", None)
    return _checked_id(name, "session", "an id, a SessionInfo or an open drive session"), token


def optional_scene_name(scene: SceneRef | None) -> str | None:
    """Like :func:`scene_name`; returns None for None."""
    return None if scene is None else scene_name(scene)


def optional_scenario_id(scenario: ScenarioRef | None) -> str | None:
    """Like :func:`scenario_id_of`; returns None for None."""
    return None if scenario is None else scenario_id_of(scenario)


def _checked_id(value: Any, what: str, allowed: str) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{what} is a {type(value).__name__}; give {allowed}")
    return value


# Waiting for a job, for the sync and the async client.

OnProgress = Callable[[JobInfo], object]

FIRST_POLL = 0.05
MAX_POLL_S = 1.0


class JobBase(Handle):
    """Last fetched state of a job; base of the sync and the async handle."""

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
        """The job's result; empty until it has succeeded."""
        return self.info.result or {}

    def __repr__(self) -> str:
        state, progress = self.info.state.value, self.info.progress
        return f"{type(self).__name__}({self.job_id!r}, {state}, {progress:.0%})"


def poll_delays(job_id: str, timeout: float | None) -> Iterator[float]:
    """Increasing pauses between two polls.

    Raises:
        ReplyTimeoutError: the timeout has passed.
    """
    started, delay = time.monotonic(), FIRST_POLL
    while timeout is None or time.monotonic() - started < timeout:
        yield delay
        delay = min(delay * 1.5, MAX_POLL_S)
    raise ReplyTimeoutError(
        f"end of job {job_id!r}", timeout or 0.0, hint="the job continues; wait again or cancel it"
    )


def require_success(info: JobInfo) -> None:
    """Raise the Real2SimError of the job's problem, unless the job has succeeded."""
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
