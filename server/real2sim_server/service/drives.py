"""Drives: jobs in which a planner drives a session and stores a recording."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections import OrderedDict, defaultdict
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from real2sim_proto import ErrorCode, decode
from real2sim_proto.jobs import DriveRequest, JobInfo
from real2sim_proto.plans import PLAN

from ..datasets.drive import EpisodeDrive
from ..edit import AssetLookup
from ..geometry import matrix_to_quaternion
from ..world import World, plan_in_world
from ..world.plan import PlannedTrajectory
from ..world.recording import Recording, load_recording, to_bytes
from .exports import VideoSource
from .http.requests import IdempotentRequest
from .http.responses import ServiceError
from .jobs import JobContext, JobResult, Jobs, NewJob, require_success
from .library.scenes import SceneCache
from .sessions import Sessions
from .sessions.recording import RECORDING, episode_of
from .sessions.session import Session

# --- Commands in a child process ------------------------------------------------------------------

CLOSE_S = 3.0
NICENESS = 10
"""Niceness of a process that yields to urgent work."""

MAX_ERROR_BYTES = 16_384
MAX_LINE_BYTES = 65_536


class CommandProcess:
    """A ``real2sim`` command in a child process, started by :meth:`run`.

    Attributes:
        told: newest JSON line of its standard output, if followed; None before the first line.
    """

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        assert process.stderr is not None
        self.told: Mapping[str, Any] | None = None
        self._process = process
        self._errors = asyncio.create_task(_last_of(process.stderr))
        self._listening = asyncio.create_task(self._listen())

    @classmethod
    async def run(
        cls,
        arguments: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        follow: bool = False,
    ) -> Self:
        """Start the process.

        Args:
            arguments: arguments after ``real2sim``.
            environment: additional environment variables.
            follow: whether to read its standard output, and to close its standard input when this
                process ends, as ``--follow`` requires.
        """
        pipe, nothing = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "real2sim", *arguments),
            env=os.environ | dict(environment or {}),
            stdin=pipe if follow else nothing,
            stdout=pipe if follow else nothing,
            stderr=pipe,
            limit=MAX_LINE_BYTES,
        )
        return cls(process)

    @property
    def running(self) -> bool:
        """Whether the process is running."""
        return self._process.returncode is None

    def yield_to_urgent(self) -> None:
        """Lower its scheduling priority."""
        # The process has ended, or the system does not support it.
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)

    async def error(self) -> str | None:
        """The last error output of a failed process, once it has ended."""
        if await self._process.wait() == 0:
            return None
        said = (await self._errors).decode("utf-8", "replace").split("\n")
        lines = [line.strip() for line in said if line.strip()]
        return lines[-1] if lines else f"the process ended with {self._process.returncode}"

    async def close(self) -> None:
        """Kill the process."""
        for end in (self._process.terminate, self._process.kill):
            if not self.running:
                break
            with contextlib.suppress(ProcessLookupError):
                end()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_S):
                    await self._process.wait()
        await self._errors
        await self._listening

    async def _listen(self) -> None:
        if self._process.stdout is None:
            return
        # A line that is too long or not JSON is not a progress line.
        while True:
            try:
                line = await self._process.stdout.readline()
                if not line:
                    return
                told = json.loads(line)
            except ValueError:
                continue
            if isinstance(told, dict):
                self.told = told


async def _last_of(stream: asyncio.StreamReader) -> bytes:
    """The last part of a stream, at its end."""
    kept = b""
    while data := await stream.read(65_536):
        kept = (kept + data)[-MAX_ERROR_BYTES:]
    return kept


# --- The planner's process -----------------------------------------------------------------------

EPISODE_STEPS = 100_000
"""Exceeds the steps of any recording; the drive ends with its episode."""

OF_THE_PLANNER = {
    *("sensors", "lidars", "radars", "action", "privileged"),
    *("seed", "dt_us", "warmup_us"),
}
"""Options of reset that the planner sets, or that have their own command-line option."""


async def start_planner(
    request: DriveRequest, session: Session, *, url: str, token: str
) -> CommandProcess:
    """Start `real2sim drive --session`.

    Args:
        request: the planner, and the number of steps.
        session: the session to drive, with its own reset options.
        url: address of the worker.
        token: token of the session; passed in the environment, which other users cannot read.
    """
    environment = {"REAL2SIM_SESSION_TOKEN": token}
    return await CommandProcess.run(_command(request, session, url), environment=environment)


def _command(request: DriveRequest, session: Session, url: str) -> list[str]:
    spec = session.spec
    reset = spec.model_dump(mode="json", exclude_unset=True, exclude=OF_THE_PLANNER)
    options = {
        "--session": session.session_id,
        "--planner": str(request.planner),
        "--steps": str(request.steps or EPISODE_STEPS),
        "--seed": str(spec.seed),
        "--dt-us": str(spec.dt_us),
        "--warmup-us": str(spec.warmup_us),
        "--reset": json.dumps(reset),
        "--url": url,
    }
    given = [text for option in options.items() for text in option]
    return ["drive", *given]


# --- Playback ------------------------------------------------------------------------------------


def playback_of(recording: Recording, drive: EpisodeDrive, *, reason: str | None) -> dict[str, Any]:
    """Times, poses, scores, plans and events of a drive, by step.

    ``tracks``, ``ego`` and ``times_us`` are as in a physics rollout (`rollouts.describe`).
    ``metrics`` has a list per score; ``plans`` has the planned poses (x [m], y [m], yaw [rad],
    world) of each step; ``speeds`` has the ego's speeds [m/s]; ``reason`` is the reason for the
    episode's end.
    """
    worlds = drive.worlds
    seen = [world.observe() for world in worlds]
    names = list(dict.fromkeys(name for one in seen for name in one.metrics))
    return {
        "kind": "drive",
        "scene": recording.scene,
        "scenario_id": recording.scenario_id,
        "scenario_revision": recording.scenario_revision,
        "start_us": worlds[0].t_us,
        "end_us": worlds[-1].t_us,
        "times_us": [world.t_us for world in worlds],
        "steps": [world.steps for world in worlds],
        "reason": reason,
        "ego": _ego(worlds),
        "speeds": [round(float(np.hypot(*world.motion.velocity)), 4) for world in worlds],
        "tracks": _tracks(worlds),
        "metrics": {name: [_number(one.metrics.get(name)) for one in seen] for name in names},
        "scores": list(recording.scores),
        "events": [event.fields() for one in seen for event in one.events],
        "plans": _plans(recording, worlds),
    }


def _ego(worlds: tuple[World, ...]) -> dict[str, Any]:
    poses = np.stack([np.asarray(world.T_world_body) for world in worlds])
    return {
        "times_us": [world.t_us for world in worlds],
        "positions": _rounded(poses[:, :3, 3]),
        "quaternions": _rounded(matrix_to_quaternion(poses[:, :3, :3])),
        "size": list(worlds[0].scene.ego_size),
    }


def _tracks(worlds: tuple[World, ...]) -> dict[str, Any]:
    tracks: dict[str, Any] = {}
    rows = defaultdict[str, list[tuple[int, Any, Any]]](list)
    for world in worlds:
        agents = world.agents
        for k, subject in enumerate(agents.objects):
            kept = {"category": subject.category, "size": list(subject.size)}
            tracks.setdefault(subject.object_id, kept)
            rows[subject.object_id].append((world.t_us, agents.positions[k], agents.quaternions[k]))
    for object_id, found in rows.items():
        times, positions, quaternions = zip(*found, strict=True)
        tracks[object_id] |= {
            "times_us": list(times),
            "positions": _rounded(positions),
            "quaternions": _rounded(quaternions),
        }
    return tracks


def _plans(recording: Recording, worlds: tuple[World, ...]) -> list[Any]:
    """Planned poses of each step; empty if the plan is held or is not a trajectory."""
    by_step = {world.steps: world for world in worlds}
    plans = dict[int, Any]()
    for entry in recording.entries:
        fields = decode(entry.payload) if entry.kind == "action" else {}
        world = by_step.get(entry.step)
        if fields.get("plan") is None or world is None:
            continue
        plan = plan_in_world(PLAN.validate_python(fields["plan"]), world.motion)
        if isinstance(plan, PlannedTrajectory):
            plans[entry.step] = _rounded(plan.poses)
    return [plans.get(world.steps, []) for world in worlds]


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else round(float(value), 5)


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), 4).tolist()


PLAYBACK, RECORDED = "playback.json", "recording.r2e"
CHECK_S = 0.1
MAX_CACHED_DRIVES = 4
"""Cached finished drives; others are replayed from their files."""


@dataclass(frozen=True, eq=False)
class Seat:
    """Session and address for a planner.

    Attributes:
        session: session to drive.
        url: address of this worker, from this machine.
        token: token of the session.
    """

    session: Session
    url: str
    token: str = field(repr=False)


class Drives:
    """Starts drives and shows finished ones, for use on the event loop."""

    def __init__(
        self, jobs: Jobs, sessions: Sessions, scene_cache: SceneCache, assets: AssetLookup
    ) -> None:
        self._jobs = jobs
        self._sessions = sessions
        self._scene_cache = scene_cache
        self._assets = assets
        self._opened: OrderedDict[str, EpisodeDrive] = OrderedDict()

    async def start(
        self, seat: Seat, request: DriveRequest, *, who: str, idempotent: IdempotentRequest
    ) -> JobInfo:
        """Let a planner drive, and save the recording when the episode ends.

        Raises:
            ServiceError: the errors of ``Jobs.start``.
        """
        row = seat.session.row

        async def work(context: JobContext) -> JobResult:
            error = await _driven(self._sessions, seat, request, context)
            context.progress(1.0, "recording")
            return await self._recorded(seat.session, context, error)

        fields = request.model_dump(mode="json", exclude_none=True)
        fields |= {"planner": request.planner, "session_id": row.session_id, "scene": row.scene}
        if row.scenario_id is not None:
            fields |= {"scenario": row.scenario_id, "revision": row.scenario_revision}
        new = NewJob("drive", row.scenario_id or row.scene, fields, who)
        return await self._jobs.start(new, work, idempotent=idempotent)

    async def _recorded(
        self, session: Session, context: JobContext, error: str | None
    ) -> JobResult:
        recording = await episode_of(self._sessions, session)
        scene, folder = session.start.scene, context.folder
        reason = session.running_world().reason

        def write() -> None:
            drive = EpisodeDrive.of(recording, scene, assets=self._assets)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / RECORDED).write_bytes(to_bytes(recording))
            shown = json.dumps(playback_of(recording, drive, reason=reason), separators=(",", ":"))
            (folder / PLAYBACK).write_text(shown, encoding="utf-8")

        await self._sessions.pipeline.on_world_thread(write)
        return JobResult(
            _figures(recording, session) | ({"error": error} if error else {}),
            {PLAYBACK: "application/json", RECORDED: RECORDING},
        )

    async def video_source(self, job_id: str) -> VideoSource:
        """Video source of a finished drive, seen from its own vehicle.

        Raises:
            ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, JOB_FAILED; also the errors of the scene cache.
        """
        drive = self._opened.get(job_id)
        if drive is None:
            drive = self._opened[job_id] = await self._open(job_id)
            while len(self._opened) > MAX_CACHED_DRIVES:
                self._opened.popitem(last=False)
        self._opened.move_to_end(job_id)
        return VideoSource(
            drive.scene, lambda t_us: drive.at(t_us).instances, drive.span, vehicle=drive.ego_at
        )

    async def _open(self, job_id: str) -> EpisodeDrive:
        info = await self._jobs.get(job_id)
        require_success(info)
        path, _ = await self._jobs.file(job_id, RECORDED)
        scene = await self._scene_cache.get(info.request["scene"])
        return await self._sessions.pipeline.on_world_thread(
            lambda: EpisodeDrive.of(load_recording(path), scene, assets=self._assets)
        )


def _figures(recording: Recording, session: Session) -> dict[str, object]:
    first, last = recording.instants[0], recording.instants[-1]
    world = session.running_world()
    return {
        "steps": len(recording.instants) - 1,
        "start_us": first.t_us,
        "end_us": last.t_us,
        "reason": world.reason,
        "scores": list(recording.scores),
        "metrics": recording.metrics,
    }


# --- driving ------------------------------------------------------------------------------------


async def _driven(
    sessions: Sessions, seat: Seat, request: DriveRequest, context: JobContext
) -> str | None:
    """Wait until the drive ends; returns the planner's error, if any.

    Raises:
        ServiceError: JOB_FAILED, the planner did not drive a single step.
        JobCancelled: the job was cancelled; the episode is ended.
    """
    session = seat.session
    before = session.world
    async with _planner(seat, request) as process:
        try:
            await _until_over(session, process, request, context)
        except BaseException:
            with contextlib.suppress(ServiceError):
                await sessions.end_episode(session)
            raise
        error = await process.error() if process is not None else None
    if session.world is None or session.world is before:
        raise ServiceError(
            ErrorCode.JOB_FAILED,
            f"the planner did not drive: {error or 'it ended before its first observation'}",
            hint="start it again, or read the planner's log",
        )
    return error


@asynccontextmanager
async def _planner(seat: Seat, request: DriveRequest) -> AsyncIterator[CommandProcess | None]:
    """The planner's process during the drive; None if an external planner drives."""
    if request.planner is None:
        yield None
        return
    process = await start_planner(request, seat.session, url=seat.url, token=seat.token)
    try:
        yield process
    finally:
        await process.close()


async def _until_over(
    session: Session, process: CommandProcess | None, request: DriveRequest, context: JobContext
) -> None:
    before, was_driven = session.world, False
    while session.closed is None:
        context.check()
        world = session.world
        begun = world is not None and world is not before
        if process is not None and not process.running:
            return
        if process is None:
            has_left = was_driven and session.controller is None
            was_driven = was_driven or session.controller is not None
            if has_left or (begun and _is_done(session, request)):
                return
        if world is None or not begun:
            context.progress(0.0, f"waiting for {request.planner or 'a planner'}")
        else:
            last = request.steps or max(world.horizon, 1)
            context.progress(min(world.steps / last, 1.0), f"step {world.steps}")
        await asyncio.sleep(CHECK_S)


def _is_done(session: Session, request: DriveRequest) -> bool:
    world = session.running_world()
    return world.over or (request.steps is not None and world.steps >= request.steps)
