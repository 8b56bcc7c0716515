"""Episodes driven, recorded and scored, several at a time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from ..world.recording.recording import Recording, load_recording
from .planner_process import PlannedEpisode, PlannerProcess, WorkerTarget
from .suite import Case, EpisodeGrid


@dataclass(frozen=True, eq=False)
class EpisodeResult:
    """One episode that was driven.

    Attributes:
        policy, case, seed: which one.
        file: its recording.
        recording: as read back from there.
        reason: why it ended.
        error: what its planner raised, was refused for, or ended its process with; such an episode
            has no scores.
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
    """Drive an episode in a free process; the session is made, recorded and ended from here."""
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
