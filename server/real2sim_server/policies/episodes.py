"""Episodes driven, recorded and scored, several at a time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import real2sim
from real2sim.planners import load_planner, needs_of, run_episode
from real2sim.planners.planner import forward_camera

from ..world.recording.recording import Recording, load_recording
from .suite import Case, EpisodeGrid

if TYPE_CHECKING:
    from real2sim import DriveSession, Observation
    from real2sim.planners import EpisodeSummary

STILLS, STILL_WIDTH = 6, 320


@dataclass(frozen=True)
class WorkerTarget:
    """The worker that episodes run on.

    Attributes:
        url, token: of the worker.
        sessions: how many at a time.
        timeout: seconds that a reply may take.
    """

    url: str
    token: str | None = None
    sessions: int = 2
    timeout: float = 120.0


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """One episode that was driven.

    Attributes:
        policy, case, seed: which one.
        file: its recording.
        recording: as read back from there.
        reason: why it ended.
        error: what its planner raised; such an episode has no scores.
        figures: steps, seconds, times.
        stills: (seconds since the start, JPEG) of the camera that looks ahead.
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
        """Scores by name, computed from the recording; none for an episode that failed."""
        if self.error is not None:
            return {}
        return {score.name: score.fields() for score in self.recording.rescore()}


def run_episodes(
    grid: EpisodeGrid,
    target: WorkerTarget,
    folder: Path,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[EpisodeResult]:
    """Run every episode; in the order of ``grid.episodes()``.

    Args:
        grid: what to run.
        target: where.
        folder: recordings go there, as ``case/policy/seed.r2e``.
        on_progress: called with (done, all).

    Raises:
        Real2SimError: the worker refuses, or has ended.
        ValueError: a planner that does not exist, or cannot drive in a scene.
    """
    for policy in grid.policies:
        load_planner(policy)
    episodes = grid.episodes()
    with ThreadPoolExecutor(max(target.sessions, 1)) as pool:
        futures = [pool.submit(_run_episode, *episode, target, folder) for episode in episodes]
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
    policy: str, case: Case, seed: int, target: WorkerTarget, folder: Path
) -> EpisodeResult:
    file = folder / case.name / _file_name(policy) / f"{seed}.r2e"
    planner = load_planner(policy)
    needs = needs_of(planner)
    with (
        real2sim.connect(target.url, token=target.token, timeout=target.timeout) as client,
        client.session(scene=case.scene, scenario=case.scenario) as session,
    ):
        options: Any = case.reset_for(seed) | {
            "action": needs.action,
            # A planner that does not say what it needs gets everything, as in `real2sim drive`.
            "privileged": needs.privileged or not hasattr(planner, "needs"),
        }
        driver = _IsolatedPlanner(planner, session, case)
        capture = _StillCapture(session, options) if seed == 0 else None
        summary = None
        try:
            summary = run_episode(
                session,
                driver,
                sensors=needs.sensors(session.welcome.cameras),
                on_observation=capture,
                **options,
            )
        except real2sim.InvalidActionError as error:
            driver.error = f"plan refused: {error}"
        session.save_recording(file)
    recording = load_recording(file)
    return EpisodeResult(
        policy=policy,
        case=case.name,
        seed=seed,
        file=file,
        recording=recording,
        reason=summary.reason or "over" if summary and not driver.error else "planner failed",
        error=driver.error,
        figures=_figures(summary, recording),
        stills=capture.stills if capture else (),
    )


class _IsolatedPlanner:
    """A planner whose exceptions end its own episode only; it applies the edits of the case."""

    def __init__(self, planner: Any, session: DriveSession, case: Case) -> None:
        self._planner, self._session, self._case = planner, session, case
        self.error: str | None = None

    def begin(self, welcome: Any) -> None:
        begin = getattr(self._planner, "begin", None)
        if begin is not None:
            with self._catching_errors():
                begin(welcome)

    def reset(self, obs: Observation) -> None:
        if self._case.operations:
            self._session.edit(self._case.operations)
        with self._catching_errors():
            self._planner.reset(obs)

    def plan(self, obs: Observation) -> Any:
        plan = None
        if self.error is None:
            with self._catching_errors():
                plan = self._planner.plan(obs)
        # The rest of a failed episode is driven standing still, so that it ends as any other.
        return plan if plan is not None else _standstill_plan(obs, needs_of(self._planner).action)

    @contextlib.contextmanager
    def _catching_errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.error = f"{type(error).__name__}: {error}"


def _standstill_plan(obs: Observation, action: str) -> dict[str, Any]:
    if action == "control":
        return {"kind": "control", "acceleration": -4.0, "steering": 0.0}
    if action == "pose":
        x, y, _ = obs.ego.position
        return {"kind": "pose", "x": x, "y": y, "yaw": obs.ego.yaw}
    return {"kind": "trajectory", "times_us": [obs.t_us + 1_000_000], "poses": [(0.0, 0.0, 0.0)]}


class _StillCapture:
    """Takes a few pictures of an episode on the way."""

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


def _figures(summary: EpisodeSummary | None, recording: Recording) -> dict[str, Any]:
    instants, last = recording.instants, recording.accumulators()[-1]
    stages = summary.stages if summary else {}
    return {
        "steps": len(instants) - 1,
        "seconds": (instants[-1].t_us - instants[0].t_us) * 1e-6,
        "distance": last.distance,
        "collisions": last.collisions,
        "at_fault": sum(last.at_fault.values()),
        "off_road": last.off_road,
        "min_ttc": last.min_ttc if math.isfinite(last.min_ttc) else None,
        "plan_ms_p50": stages["plan"].p50 if "plan" in stages else None,
        "step_ms_p50": stages["step"].p50 if "step" in stages else None,
    }


def _file_name(policy: str) -> str:
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in policy)[-80:]
