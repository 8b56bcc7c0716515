"""The planner interface, the sensors that planners need, loading by name, running episodes."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, Unpack, runtime_checkable

import numpy as np

if TYPE_CHECKING:
    from real2sim_proto.base import Modality
    from real2sim_proto.drive import Event
    from real2sim_proto.plans import Plan
    from real2sim_proto.scenes import CameraInfo

    from .._requests import ResetOptions, Sensor
    from .._sync.sessions import DriveSession
    from ..observation import Observation


BUILT_IN = {
    "follow_route": "real2sim.planners.follow_route:FollowRoute",
    "pid": "real2sim.planners.pid:PidFollowRoute",
    "idm": "real2sim.planners.idm:Idm",
    "depth_sampling": "real2sim.planners.depth_sampling:DepthSampling",
    "learned": "real2sim.planners.learned:LearnedPolicy",
    "neuroncap": "real2sim.planners.neuroncap:NeuroNcap",
    "alpasim": "real2sim.planners.alpasim:AlpasimDriver",
    "carla": "real2sim.planners.carla_agent:CarlaAgent",
}


@runtime_checkable
class Planner(Protocol):
    """Converts observations into plans.

    A planner that needs more than the ego and its route has an attribute ``needs``: :class:`Needs`.
    A planner that needs the session's cameras or its whole route has a method ``begin(welcome)``,
    which is called before ``reset``.
    """

    def reset(self, obs: Observation) -> None:
        """Forget the last episode; ``obs`` is the first of the new one."""

    def plan(self, obs: Observation) -> Plan | Mapping[str, Any]:
        """The answer to an observation: a trajectory, a control or a pose."""


@dataclass(frozen=True)
class Needs:
    """Inputs that a planner needs, and the kind of its plans.

    Attributes:
        modalities: modalities of its cameras; empty if it uses no images.
        cameras: camera names; empty: the most forward-looking camera.
        all_cameras: whether it uses every camera of the scene instead.
        width: image width [px]; None: as recorded.
        privileged: whether observations list all objects.
        action: kind of its plans.
    """

    modalities: tuple[Modality, ...] = ()
    cameras: tuple[str, ...] = ()
    width: int | None = None
    privileged: bool = False
    action: Literal["trajectory", "control", "pose"] = "trajectory"
    all_cameras: bool = False

    def sensors(self, cameras: Sequence[CameraInfo]) -> list[dict[str, Any]]:
        """Sensors to pass to reset, from a session's cameras.

        Raises:
            ValueError: a camera that the scene lacks.

        Examples:
            >>> with real2sim.connect() as client:
            ...     cameras = client.scenes.get("street").cameras
            >>> Needs(modalities=("rgb",), width=64).sensors(cameras)
            [{'camera': 'front', 'modalities': ['rgb'], 'width': 64}]
        """
        if not self.modalities:
            return []
        there = [camera.name for camera in cameras]
        missing = [name for name in self.cameras if name not in there]
        if missing or not there:
            raise ValueError(
                f"the planner needs camera {(missing or ['any'])[0]!r}; the scene has "
                f"{', '.join(there) or 'none'}"
            )
        return [
            {"camera": name, "modalities": list(self.modalities), "width": self.width}
            for name in (there if self.all_cameras else self.cameras or [forward_camera(cameras)])
        ]


def needs_of(planner: Planner) -> Needs:
    """Needs of a planner; by default it needs nothing.

    Examples:
        >>> needs_of(load_planner("depth_sampling")).modalities
        ('depth',)
    """
    found = getattr(planner, "needs", None)
    return found if isinstance(found, Needs) else Needs()


def forward_camera(cameras: Sequence[CameraInfo]) -> str:
    """Name of the camera whose axis is closest to the vehicle's x axis; the first in a tie."""
    # The optical axis is z of the camera frame; its component along vehicle x is element [0, 2].
    return max(cameras, key=lambda camera: camera.T_vehicle_camera[0][2]).name


class UnknownPlannerError(ValueError):
    """No planner has this name."""


def load_planner(name: str) -> Planner:
    """Load a planner by name: a built-in one, or ``module:Class``.

    It is constructed without arguments, or with the text after ``=`` as its only argument, as in
    ``learned=policy.safetensors`` or ``neuroncap=http://127.0.0.1:9000``. Modules are also found in
    the working directory.

    Raises:
        UnknownPlannerError: no such module or class, or it is not a planner.

    Examples:
        >>> load_planner("idm").speed
        8.0
        >>> load_planner("cruise_control")
        Traceback (most recent call last):
        real2sim.planners.planner.UnknownPlannerError: planner 'cruise_control' is unknown; give ...
    """
    given, equals, argument = name.partition("=")
    module_name, colon, attribute = BUILT_IN.get(given, given).partition(":")
    if not colon:
        known = ", ".join(sorted(BUILT_IN))
        raise UnknownPlannerError(f"planner {name!r} is unknown; give {known} or 'module:Class'")
    if (folder := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, folder)
    try:
        make = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise UnknownPlannerError(f"planner {name!r} cannot be loaded: {error}") from error
    try:
        planner = make(argument) if equals else make()
    except TypeError as error:
        # Errors raised inside the constructor have more frames in their traceback.
        if error.__traceback__ is None or error.__traceback__.tb_next is not None:
            raise
        raise UnknownPlannerError(f"planner {name!r} cannot be made: {error}") from error
    if not isinstance(planner, Planner):
        raise UnknownPlannerError(f"planner {name!r} needs the methods reset(obs) and plan(obs)")
    return planner


# An episode: observe, plan, step, until it is over.


@dataclass(frozen=True)
class StageTimes:
    """Statistics of the duration of one stage over an episode [ms]."""

    count: int
    mean: float
    p50: float
    p95: float
    p99: float

    @classmethod
    def of(cls, milliseconds: Sequence[float]) -> StageTimes:
        """Statistics of at least one measurement.

        Examples:
            >>> StageTimes.of([1.0, 2.0, 3.0]).p50
            2.0
        """
        p50, p95, p99 = np.percentile(milliseconds, (50, 95, 99))
        mean = float(np.mean(milliseconds))
        return cls(len(milliseconds), mean, float(p50), float(p95), float(p99))


@dataclass(frozen=True)
class EpisodeSummary:
    """Results and timing of an episode.

    Attributes:
        steps: number of driven steps.
        start_us, end_us: first and last time.
        distance: metres that the rear axle moved.
        terminated, truncated, reason: how it ended; all unset if the steps ran out first.
        metrics: the worker's scores at the end.
        events: all events, oldest first.
        wall_seconds: duration of the loop, without reset.
        stages: milliseconds by stage. ``plan``, ``step`` (round trip) and ``loop`` (both) are
            measured here; ``worker.*`` are the worker's figures.
    """

    steps: int
    start_us: int
    end_us: int
    distance: float
    terminated: bool
    truncated: bool
    reason: str | None
    metrics: dict[str, float]
    events: tuple[Event, ...]
    wall_seconds: float
    stages: dict[str, StageTimes] = field(default_factory=dict)

    @property
    def steps_per_second(self) -> float:
        """Steps per second of the whole loop."""
        return self.steps / self.wall_seconds if self.wall_seconds > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """The summary as JSON values."""
        fields = {k: v for k, v in vars(self).items() if k not in {"events", "stages"}}
        return fields | {
            "steps_per_second": self.steps_per_second,
            "events": [event.model_dump() for event in self.events],
            "stages_ms": {name: asdict(times) for name, times in self.stages.items()},
        }


def run_episode(
    session: DriveSession,
    planner: Planner | str,
    steps: int | None = None,
    *,
    sensors: Sequence[Sensor] | None = None,
    on_observation: Callable[[Observation], None] | None = None,
    **options: Unpack[ResetOptions],
) -> EpisodeSummary:
    """Reset the session and let the planner drive.

    Args:
        session: an open session.
        planner: the planner, or its name as in :func:`load_planner`.
        steps: maximum number of steps; default: to the end of the episode.
        sensors: sensors of every observation; default: those the planner needs.
        on_observation: called with every observation, including the first; its time is not counted.
        options: options of reset; ``action`` and ``privileged`` come from the planner's ``needs``,
            and a planner without ``needs`` is privileged.

    Raises:
        TypeError: a class, or an object that is not a planner.

    Examples:
        >>> planner = real2sim.planners.FollowRoute(speed=5.0)
        >>> with real2sim.connect() as client, client.session(scene="street") as session:
        ...     summary = run_episode(session, planner, steps=5)
        >>> summary.steps, round(summary.distance, 1)
        (5, 2.5)
        >>> sorted(summary.stages)[:3]
        ['loop', 'plan', 'step']
    """
    if isinstance(planner, str):
        planner = load_planner(planner)
    if isinstance(planner, type) or not isinstance(planner, Planner):
        made = f"{planner.__name__}()" if isinstance(planner, type) else "an object"
        raise TypeError(f"planner is {planner!r}; give {made} with reset(obs) and plan(obs)")
    begin = getattr(planner, "begin", None)
    if begin is not None:
        begin(session.welcome)
    needs = needs_of(planner)
    options.setdefault("action", needs.action)
    options.setdefault("privileged", needs.privileged or not hasattr(planner, "needs"))
    if sensors is None:
        sensors = needs.sensors(session.welcome.cameras) if needs.modalities else ()
    obs = session.reset(sensors=sensors, **options)
    planner.reset(obs)
    log = _EpisodeLog(obs)
    if on_observation is not None:
        on_observation(obs)
    while not obs.over and (steps is None or log.steps < steps):
        started = time.perf_counter()
        plan = planner.plan(obs)
        planned = time.perf_counter()
        obs = session.step(plan)
        log.add(obs, plan_s=planned - started, step_s=time.perf_counter() - planned)
        if on_observation is not None:
            on_observation(obs)
    return log.summary()


class _EpisodeLog:
    def __init__(self, first: Observation) -> None:
        self._first = self._last = first
        self._events: list[Event] = list(first.events)
        self._stages: dict[str, list[float]] = {}
        self._distance = 0.0
        self.steps = 0

    def add(self, obs: Observation, *, plan_s: float, step_s: float) -> None:
        moved = np.subtract(obs.ego.position, self._last.ego.position)
        self._distance += float(np.linalg.norm(moved))
        self._events.extend(obs.events)
        self._last = obs
        self.steps += 1
        own = {"plan": plan_s * 1e3, "step": step_s * 1e3, "loop": (plan_s + step_s) * 1e3}
        theirs: Mapping[str, float] = {f"worker.{k}": v for k, v in obs.timing.items()}
        for stage, milliseconds in (own | dict(theirs)).items():
            self._stages.setdefault(stage, []).append(milliseconds)

    def summary(self) -> EpisodeSummary:
        last = self._last
        return EpisodeSummary(
            steps=self.steps,
            start_us=self._first.t_us,
            end_us=last.t_us,
            distance=self._distance,
            terminated=last.terminated,
            truncated=last.truncated,
            reason=last.reason,
            metrics=dict(last.metrics),
            events=tuple(self._events),
            wall_seconds=sum(self._stages.get("loop", ())) * 1e-3,
            stages={name: StageTimes.of(times) for name, times in self._stages.items()},
        )
