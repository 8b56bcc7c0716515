"""Drives, records and scores episodes in parallel, with planners in separate processes."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import real2sim
from real2sim._protocol import valid_plan
from real2sim.planners import load_planner, needs_of, run_episode
from real2sim.planners.planner import forward_camera

from ..world.recording import Recording, load_recording
from .suite import Case, EpisodeGrid

if TYPE_CHECKING:
    from real2sim import DriveSession, Observation


# --- Planner processes ---------------------------------------------------------------------------

# A planner that exits its process fails only its own episode.

STILLS, STILL_WIDTH = 6, 320
END_S = 10.0
"""Time limit for an idle process to exit [s]."""


@dataclass(frozen=True)
class WorkerTarget:
    """The worker that episodes run on.

    Attributes:
        url, token: address and token of the worker.
        sessions: maximum number of sessions at a time.
        timeout: maximum seconds to wait for a reply.
    """

    url: str
    token: str | None = None
    sessions: int = 2
    timeout: float = 120.0

    def connect(self) -> real2sim.Client:
        """A client of the worker."""
        return real2sim.connect(self.url, token=self.token, timeout=self.timeout)


@dataclass(frozen=True)
class PlannedEpisode:
    """An episode to drive in an existing session.

    Attributes:
        policy: name of the planner.
        case, seed: case and seed of the episode.
        target: the worker.
        session_id, token: id and token of the session.
    """

    policy: str
    case: Case
    seed: int
    target: WorkerTarget
    session_id: str
    token: str


@dataclass(frozen=True)
class DrivenEpisode:
    """Report of a planner's process about an episode.

    Attributes:
        reason: reason for the end; None if the planner failed.
        error: exception of the planner, rejection of a plan, or exit of the process.
        times_ms: median times of the stages [ms].
        stills: (seconds since the start, JPEG) of the forward camera.
    """

    reason: str | None = None
    error: str | None = None
    times_ms: Mapping[str, float] = field(default_factory=dict)
    stills: Sequence[tuple[float, bytes]] = ()


class PlannerProcess:
    """A process that runs planners, one episode after another.

    If a planner exits the process, the next episode starts a new one.
    """

    def __init__(self) -> None:
        self._process: Any = None
        self._pipe: Connection | None = None

    def check(self, policy: str) -> None:
        """Load a planner.

        Raises:
            ValueError: it cannot be loaded.
        """
        failed = self._asked(policy)
        if isinstance(failed, int):
            raise ValueError(f"planner {policy!r} ends its process with exit code {failed}")
        if failed is not None:
            raise failed

    def drive(self, episode: PlannedEpisode) -> DrivenEpisode:
        """Drive an episode.

        Raises:
            Real2SimError: the worker refuses a request or has ended.
            ValueError: the planner cannot drive in this scene.
        """
        told = self._asked(episode)
        if isinstance(told, int):
            return DrivenEpisode(error=f"the planner ended its process with exit code {told}")
        if isinstance(told, Exception):
            raise told
        driven: DrivenEpisode = told
        return driven

    def _asked(self, what: str | PlannedEpisode) -> Any:
        """The process's answer, or its exit code if it has ended."""
        if self._pipe is None:
            context = multiprocessing.get_context("spawn")
            self._pipe, other = context.Pipe()
            self._process = context.Process(target=_serve, args=(other,))
            self._process.start()
            other.close()
        try:
            self._pipe.send(what)
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            self._process.join()
            code = int(self._process.exitcode)
            self._pipe.close()
            self._pipe = None
            return code

    def close(self) -> None:
        """End the process."""
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None
            self._process.join(END_S)
            self._process.kill()


def _serve(pipe: Connection) -> None:
    """Answer until the other end closes."""
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            asked = pipe.recv()
            answer: Any = None
            try:
                if isinstance(asked, str):
                    load_planner(asked)
                else:
                    answer = _driven(asked)
            # Some exception classes cannot be sent through a pipe.
            except ValueError as error:
                answer = ValueError(str(error))
            except real2sim.Real2SimError as error:
                answer = real2sim.Real2SimError(str(error))
            pipe.send(answer)


def _driven(episode: PlannedEpisode) -> DrivenEpisode:
    planner = load_planner(episode.policy)
    with (
        episode.target.connect() as client,
        client.join(episode.session_id, token=episode.token) as session,
    ):
        options: Any = episode.case.reset_for(episode.seed)
        driver = _IsolatedPlanner(planner, session, episode.case)
        capture = _StillCapture(session, options) if episode.seed == 0 else None
        summary = None
        try:
            summary = run_episode(
                session,
                driver,
                on_observation=capture,
                **options,
            )
        except real2sim.InvalidActionError as error:
            driver.error = f"plan refused: {error}"
    return DrivenEpisode(
        reason=summary.reason if summary and not driver.error else None,
        error=driver.error,
        times_ms={k: v.p50 for k, v in summary.stages.items()} if summary else {},
        stills=capture.stills if capture else (),
    )


class _IsolatedPlanner:
    """Wraps a planner: its exceptions fail only its own episode. Applies the edits of the case."""

    def __init__(self, planner: Any, session: DriveSession, case: Case) -> None:
        self._planner, self._session, self._case = planner, session, case
        if hasattr(planner, "needs"):
            self.needs = planner.needs
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
        plan: Any = None
        if self.error is None:
            with self._catching_errors():
                plan = self._planner.plan(obs)
        if self.error is None:
            try:
                return valid_plan(plan)
            except ValueError as error:
                self.error = f"plan refused: {error}"
        # After a failure, the vehicle stands still to the end of the episode.
        return _standstill_plan(obs, needs_of(self._planner).action)

    @contextlib.contextmanager
    def _catching_errors(self) -> Iterator[None]:
        try:
            yield
        except (Exception, SystemExit) as error:
            self.error = f"{type(error).__name__}: {error}"


def _standstill_plan(obs: Observation, action: str) -> dict[str, Any]:
    if action == "control":
        return {"kind": "control", "acceleration": -4.0, "steering": 0.0}
    if action == "pose":
        x, y, _ = obs.ego.position
        return {"kind": "pose", "x": x, "y": y, "yaw": obs.ego.yaw}
    return {"kind": "trajectory", "times_us": [obs.t_us + 1_000_000], "poses": [(0.0, 0.0, 0.0)]}


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
        error: exception of the planner, rejection of a plan, or exit of its process; such an
            episode has no scores.
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
    on_progress: Callable[[int, int], None] | None = None,
) -> list[EpisodeResult]:
    """Run every episode; results are in the order of ``grid.episodes()``.

    Args:
        grid: episodes to run.
        target: the worker.
        folder: folder of the recordings, ``case/policy/seed.r2e``.
        on_progress: called with (done, all).

    Raises:
        Real2SimError: the worker refuses a request or has ended.
        ValueError: an unknown planner, or one that cannot drive in a scene.
    """
    episodes = grid.episodes()
    with contextlib.ExitStack() as stack:
        slots = max(min(target.sessions, len(episodes)), 1)
        processes = [stack.enter_context(closing(PlannerProcess())) for _ in range(slots)]
        for policy in grid.policies:
            processes[0].check(policy)
        free: SimpleQueue[PlannerProcess] = SimpleQueue()
        for process in processes:
            free.put(process)
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
    free: SimpleQueue[PlannerProcess],
) -> EpisodeResult:
    """Drive an episode in a free process; this function creates, records and ends the session."""
    policy, case, seed = episode
    file = folder / case.name / _file_name(policy) / f"{seed}.r2e"
    process = free.get()
    try:
        with target.connect() as client:
            info = client.sessions.create(
                scene=case.scene, scenario=case.scenario, **case.reset_for(seed)
            )
            name, token = info.session_id, info.token
            try:
                driven = process.drive(PlannedEpisode(policy, case, seed, target, name, token))
                with client.join(name, token=token, role="observer") as session:
                    session.save_recording(file)
            finally:
                client.sessions.delete(name)
    finally:
        free.put(process)
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
