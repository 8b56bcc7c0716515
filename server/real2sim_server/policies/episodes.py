"""Drives, records and scores episodes in parallel, with planners in separate processes."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import real2sim
from real2sim.planners import run_episode
from real2sim.planners.planner import forward_camera

from ..world.recording import Recording, load_recording
from .planner_process import PLAN_LIMIT_S, PlannerFailedError, PlannerProcesses, RemotePlanner
from .suite import Case, EpisodeGrid

if TYPE_CHECKING:
    from real2sim import DriveSession, Observation

STILLS, STILL_WIDTH = 6, 320


@dataclass(frozen=True)
class WorkerTarget:
    """The worker that episodes run on.

    Attributes:
        url, token: address and token of the worker.
        sessions: maximum number of sessions at a time.
        timeout: maximum seconds to wait for a reply.
    """

    url: str
    token: str | None = field(default=None, repr=False)
    sessions: int = 2
    timeout: float = 120.0

    def connect(self) -> real2sim.Client:
        """A client of the worker."""
        return real2sim.connect(self.url, token=self.token, timeout=self.timeout)


@dataclass(frozen=True)
class DrivenEpisode:
    """How a planner drove an episode.

    Attributes:
        reason: reason for the end; None if the planner failed.
        error: why the planner failed.
        times_ms: median times of the stages [ms].
        stills: (seconds since the start, JPEG) of the forward camera.
    """

    reason: str | None = None
    error: str | None = None
    times_ms: Mapping[str, float] = field(default_factory=dict)
    stills: Sequence[tuple[float, bytes]] = ()


def _drive(session: DriveSession, planner: RemotePlanner, case: Case, seed: int) -> DrivenEpisode:
    """Let a planner drive an episode to its end, or until the planner fails."""
    options: Any = case.reset_for(seed)
    capture = _StillCapture(session, options) if seed == 0 else None
    stills = capture.stills if capture else ()
    driver = _WithEdits(planner, session, case)
    try:
        summary = run_episode(session, driver, on_observation=capture, **options)
    except PlannerFailedError as error:
        return DrivenEpisode(error=str(error), stills=stills)
    except real2sim.InvalidActionError as error:
        return DrivenEpisode(error=f"plan refused: {error}", stills=stills)
    except (TypeError, ValueError) as error:  # Its needs cannot be met in this scene.
        return DrivenEpisode(error=f"{type(error).__name__}: {error}", stills=stills)
    times = {stage: times.p50 for stage, times in summary.stages.items()}
    return DrivenEpisode(reason=summary.reason, times_ms=times, stills=stills)


class _WithEdits:
    """Wraps a planner: applies the edits of the case at the start of the episode."""

    def __init__(self, planner: RemotePlanner, session: DriveSession, case: Case) -> None:
        self._planner, self._session, self._case = planner, session, case
        self.plan = planner.plan

    def __getattr__(self, name: str) -> Any:
        """``needs`` and ``begin``, if the planner has them."""
        return getattr(self._planner, name)

    def reset(self, obs: Observation) -> None:
        if self._case.operations:
            self._session.edit(self._case.operations)
        self._planner.reset(obs)


class _StillCapture:
    """Captures a few pictures during an episode."""

    def __init__(self, session: DriveSession, options: Mapping[str, Any]) -> None:
        welcome = session.welcome
        start = options.get("start_us") or welcome.start_us
        steps = options.get("horizon") or (welcome.end_us - start) // options.get("dt_us", 100_000)
        self._session, self._start = session, start
        self._every = max(int(steps) // (STILLS - 1), 1)
        self._camera = forward_camera(welcome.cameras) if welcome.cameras else None
        self.stills: list[tuple[float, bytes]] = []

    def __call__(self, obs: Observation) -> None:
        if self._camera is None or (obs.step % self._every and not obs.over):
            return
        if obs.reason == "horizon" and obs.step % self._every:
            return
        view = self._session.render(
            [{"camera": self._camera, "width": STILL_WIDTH, "codec": "jpeg", "quality": 80}]
        )
        frame = view.frames[self._camera]["rgb"]
        self.stills.append(((obs.t_us - self._start) * 1e-6, frame.data))


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """A finished episode.

    Attributes:
        policy, case, seed: planner, case and seed of the episode.
        file: file of its recording.
        recording: recording in the file.
        reason: reason for the end.
        error: why the planner failed; such an episode has no scores.
        figures: steps, seconds, times.
        stills: (seconds since the start, JPEG) of the forward camera.
    """

    policy: str
    case: str
    seed: int
    file: Path
    recording: Recording
    reason: str
    error: str | None
    figures: Mapping[str, Any]
    stills: Sequence[tuple[float, bytes]] = ()

    def scores(self) -> dict[str, dict[str, Any]]:
        """Scores by name, computed from the recording; empty for a failed episode."""
        if self.error is not None:
            return {}
        return {score.name: score.fields() for score in self.recording.rescore()}


def run_episodes(
    grid: EpisodeGrid,
    target: WorkerTarget,
    folder: Path,
    *,
    plan_limit_s: float = PLAN_LIMIT_S,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[EpisodeResult]:
    """Run every episode; results are in the order of ``grid.episodes()``.

    Args:
        grid: episodes to run.
        target: the worker.
        folder: folder of the recordings, ``case/policy/seed.r2e``.
        plan_limit_s: time limit for each answer of a planner [s].
        on_progress: called with (done, all).

    Raises:
        Real2SimError: the worker refuses a request or has ended.
        ValueError: an unknown planner.
    """
    episodes = grid.episodes()
    with contextlib.ExitStack() as stack:
        slots = max(min(target.sessions, len(episodes)), 1)
        planners = [stack.enter_context(PlannerProcesses(plan_limit_s)) for _ in range(slots)]
        for policy in grid.policies:
            planners[0].load(policy)
        free: SimpleQueue[PlannerProcesses] = SimpleQueue()
        for slot in planners:
            free.put(slot)
        pool = stack.enter_context(ThreadPoolExecutor(slots))
        futures = [pool.submit(_run_episode, episode, target, folder, free) for episode in episodes]
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                future.result()
                if on_progress is not None:
                    on_progress(done, len(futures))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [future.result() for future in futures]


def _run_episode(
    episode: tuple[str, Case, int],
    target: WorkerTarget,
    folder: Path,
    free: SimpleQueue[PlannerProcesses],
) -> EpisodeResult:
    """Drive and record an episode in a session of its own."""
    policy, case, seed = episode
    file = folder / case.name / _file_name(policy) / f"{seed}.r2e"
    planners = free.get()
    try:
        with target.connect() as client:
            info = client.sessions.create(
                scene=case.scene, scenario=case.scenario, **case.reset_for(seed)
            )
            name, token = info.session_id, info.token
            try:
                planner = planners.load(policy)
                with client.join(name, token=token) as session:
                    driven = _drive(session, planner, case, seed)
                with client.join(name, token=token, role="observer") as session:
                    session.save_recording(file)
            finally:
                client.sessions.delete(name)
    finally:
        free.put(planners)
    recording = load_recording(file)
    return EpisodeResult(
        policy=policy,
        case=case.name,
        seed=seed,
        file=file,
        recording=recording,
        reason="planner failed" if driven.error else driven.reason or "over",
        error=driven.error,
        figures=_figures(driven.times_ms, recording),
        stills=driven.stills,
    )


def _figures(times_ms: Mapping[str, float], recording: Recording) -> dict[str, Any]:
    instants, last = recording.instants, recording.accumulators()[-1]
    return {
        "steps": len(instants) - 1,
        "seconds": (instants[-1].t_us - instants[0].t_us) * 1e-6,
        "distance": last.distance,
        "collisions": last.collisions,
        "at_fault": sum(last.at_fault.values()),
        "off_road": last.off_road,
        "min_ttc": last.min_ttc if math.isfinite(last.min_ttc) else None,
        "plan_ms_p50": times_ms.get("plan"),
        "step_ms_p50": times_ms.get("step"),
    }


def _file_name(policy: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in policy)[-80:]
