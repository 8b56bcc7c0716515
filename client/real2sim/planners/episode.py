"""One episode: observe, plan, step, until it is over."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from .planner import Planner, load_planner, needs_of

if TYPE_CHECKING:
    from real2sim_proto.drive import Event

    from .._sensors import ResetOptions, Sensor
    from .._sync.drive_session import DriveSession
    from ..observation import Observation


@dataclass(frozen=True)
class StageTimes:
    """Milliseconds that one stage took over an episode."""

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
    """What happened in an episode, and what it cost.

    Attributes:
        steps: clock steps driven.
        start_us, end_us: first and last instant.
        distance: metres that the rear axle moved.
        terminated, truncated, reason: how it ended; none of them when the steps ran out first.
        metrics: the worker's scores at the end.
        events: what happened, oldest first.
        wall_seconds: duration of the loop, without reset.
        stages: milliseconds by stage. ``plan``, ``step`` (round trip) and ``loop`` (both) are
            measured here; ``worker.*`` are the worker's own figures.
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
        """Rate of the whole loop."""
        return self.steps / self.wall_seconds if self.wall_seconds > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
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
        session: open.
        planner: who drives, or its name as of :func:`load_planner`.
        steps: stop after so many; default: when the episode is over.
        sensors: what every observation shows; default: what the planner needs.
        on_observation: called with every observation, the first included; its time is not counted.
        options: of reset; ``action`` and ``privileged`` are those of the planner's ``needs``, and a
            planner that has none is shown everything.

    Raises:
        TypeError: a class, or something else that does not plan.

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
