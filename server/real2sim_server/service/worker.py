"""A worker: assembles all its parts."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from typing import Annotated, Any

import structlog
from fastapi import Depends, Response
from starlette.requests import HTTPConnection

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import WITHOUT_SCENES, DeviceInfo, Readiness

from ..render import Backend, describe_backends, select_backend
from ..render.backend import device_of
from ..scene.io import DEMO_SCENE, SHIPPED_STREET, StagingLimits
from ..settings import Settings
from .accounts import Accounts, worker_key
from .audit import Audit, AuditLog
from .drives import Drives
from .engine import Engine
from .exports import VideoSource
from .http.connections import ConnectionLimits, Connections, connection_limit
from .http.requests import Idempotency
from .http.responses import ServiceError
from .http.telemetry import Metrics
from .jobs import Jobs
from .library.assets import AssetLibrary
from .library.imports import ImportQueue, import_scene
from .library.scenes import MemoryBudget, Quota, SceneCache, SceneCatalog
from .library.views import SplatFiles
from .maintenance import Maintenance
from .membership import Agent, Membership, Prewarming, Sharing, Willingness, takes_work
from .renderer import Renderer
from .rollouts import Calibrations, Simulations
from .scenarios import Scenarios
from .sessions import SessionLimits, Sessions
from .sessions.pipeline import StepPipeline
from .sessions.shared_memory import Segments
from .shared_objects import BundleFolders, BundleLog, open_objects
from .storage.connection import owned_folder
from .storage.fleet import Leases, Notices
from .storage.job_log import JobLog
from .storage.store import Store
from .sweeps import Sweeps
from .warm_up import KernelWarmUp

LAG_PERIOD_S = 0.1
WARMING_UP = "warming up kernels"

log = structlog.get_logger(__name__)


@dataclass(eq=False)
class Worker:
    """One worker: its parts, and whether it accepts work.

    Attributes:
        device: the rendering device, and the reason for its choice.
        waiting_for: pending steps before the worker is ready.
        draining: whether the worker is shutting down.
        handed_over: whether other workers have its sessions and jobs.
        start_error: reason why it did not start.
        on_ready: called on the event loop when startup is complete.
    """

    settings: Settings
    engine: Engine
    metrics: Metrics
    accounts: Accounts
    connections: Connections
    store: Store
    scene_cache: SceneCache
    scenarios: Scenarios
    assets: AssetLibrary
    jobs: Jobs
    simulations: Simulations
    calibrations: Calibrations
    drives: Drives
    sweeps: Sweeps
    idempotency: Idempotency
    leases: Leases
    kernels: KernelWarmUp
    renderer: Renderer
    sessions: Sessions
    backend: Backend
    device: DeviceInfo
    audit: Audit
    sharing: Sharing | None = None
    membership: Membership | None = None
    imports: ImportQueue = field(default_factory=ImportQueue)
    splat_files: SplatFiles = field(default_factory=SplatFiles)
    waiting_for: set[str] = field(default_factory=lambda: {"start"})
    draining: bool = False
    handed_over: bool = False
    start_error: Exception | None = None
    on_ready: Callable[[], object] = lambda: None
    _last_load: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def build(cls, settings: Settings) -> Worker:
        """Assemble a worker; nothing runs yet.

        Raises:
            RenderError: the backend of the settings is not available here.
            TokenFileError: the token file is unusable.
            ValueError: invalid URL of the object store.
        """
        metrics = Metrics()
        secret = settings.token.get_secret_value() if settings.token is not None else None
        accounts = Accounts(token=secret, file=settings.tokens_file)
        backend = select_backend(settings.backend)
        engine = Engine(
            queue_length=settings.queue_length,
            threads=settings.threads,
            on_job=metrics.observe_job,
        )
        budget = MemoryBudget(settings.scene_memory_bytes)
        scene_cache = SceneCache(
            SceneCatalog(settings.scenes_path),
            engine,
            budget=budget,
            device=str(device_of(backend)),
            on_load=metrics.scene_loads.observe,
        )
        store = Store(
            settings.database_url,
            worker_id=settings.worker_id,
            timeout_s=settings.store_timeout_seconds,
            durability=settings.durability,
            migration=settings.store_migration,
            on_call=metrics.observe_store,
        )
        assets = AssetLibrary(settings.assets_path, budget)
        scenarios = Scenarios(store, scene_cache, metrics, assets=assets.find)
        leases = Leases(store, settings.worker_id, seconds=settings.lease_seconds)
        job_log = JobLog(store, settings.worker_id)
        jobs = Jobs(job_log, _jobs_quota(settings), on_end=metrics.observe_ended_job)
        kernels = KernelWarmUp()
        renderer = Renderer(
            engine,
            backend,
            metrics,
            max_pixels=settings.max_pixels_per_step,
            budget=budget,
        )
        sessions = Sessions(
            SessionLimits(settings.worker_id, settings.max_sessions, settings.session_idle_seconds),
            pipeline=StepPipeline(
                engine,
                renderer,
                metrics,
                deformation=kernels.deformation,
                max_pixels=settings.max_pixels_per_step,
                max_rays=settings.max_rays_per_step,
                caster="cuda" if backend.name == "nvrtc" else "auto",
            ),
            kernels=kernels,
            store=store,
            scene_cache=scene_cache,
            scenarios=scenarios,
            metrics=metrics,
            segments=Segments(budget, settings.shared_memory_bytes),
            leases=leases,
            accounts=accounts,
        )
        worker = cls(
            settings=settings,
            engine=engine,
            metrics=metrics,
            accounts=accounts,
            connections=Connections(_connection_limits(settings), metrics),
            store=store,
            scene_cache=scene_cache,
            scenarios=scenarios,
            assets=assets,
            jobs=jobs,
            simulations=Simulations(jobs, scenarios, scene_cache),
            calibrations=Calibrations(jobs, scenarios, scene_cache),
            idempotency=Idempotency(store),
            leases=leases,
            kernels=kernels,
            renderer=renderer,
            sessions=sessions,
            drives=Drives(jobs, sessions, scene_cache, assets.find),
            sweeps=Sweeps(jobs, scene_cache),
            backend=backend,
            device=_device_info(backend, settings),
            audit=Audit(AuditLog(store)),
        )
        worker._share(job_log)
        worker._connect_gauges()
        return worker

    @asynccontextmanager
    async def running(self) -> AsyncIterator[Worker]:
        """Run the worker during the block: from the start of its engine to the end of its last job.

        Raises:
            StateFolderError: another worker uses the state folder, or it is not writable.
            StoreError: the store cannot be opened.
        """
        async with AsyncExitStack() as at_exit:
            at_exit.enter_context(owned_folder(self.settings.data_dir))
            self.sessions.resume_key = worker_key(self.settings.data_dir)
            self.engine.start()
            at_exit.push_async_callback(asyncio.to_thread, self.engine.stop)
            at_exit.callback(self.renderer.close)
            at_exit.callback(self.scene_cache.close)
            at_exit.callback(self.imports.close)
            at_exit.push_async_callback(self.store.close)
            await self.store.open()
            at_exit.push_async_callback(_cancel, asyncio.create_task(self.store.watch()))
            at_exit.push_async_callback(self.scenarios.flush)
            maintenance = Maintenance(self.settings, self.store, self.jobs, self.sessions)
            # No uploads can be in progress yet: existing temporary files are abandoned.
            await asyncio.to_thread(partial(maintenance.sweep, at_start=True))
            if self.settings.demo:
                await asyncio.to_thread(self._add_demo)
            if not await self.scene_cache.refresh():
                log.warning("no scenes", folder=str(self.settings.scenes_path), hint=WITHOUT_SCENES)
            self.waiting_for = {WARMING_UP}
            at_exit.push_async_callback(_cancel, asyncio.create_task(self._warm_up()))
            at_exit.push_async_callback(self.kernels.deformation.close)
            at_exit.push_async_callback(_cancel, asyncio.create_task(self._watch_loop()))
            at_exit.push_async_callback(_cancel, asyncio.create_task(self.connections.watch()))
            at_exit.push_async_callback(_cancel, asyncio.create_task(self.accounts.watch()))
            await at_exit.enter_async_context(self.audit.running())
            await at_exit.enter_async_context(self.sessions.running())
            self.membership = self._membership()
            await at_exit.enter_async_context(self.membership.running())
            await at_exit.enter_async_context(self._hear())
            await at_exit.enter_async_context(self.jobs.running())
            if self.sharing is not None:
                await at_exit.enter_async_context(self.sharing.running())
            at_exit.push_async_callback(_cancel, asyncio.create_task(maintenance.run()))
            prewarming = Prewarming(
                self.leases,
                self.scene_cache,
                worker_id=self.settings.worker_id,
                hot=self.settings.hot_scene_sessions,
            )
            at_exit.push_async_callback(_cancel, asyncio.create_task(prewarming.run()))
            if self.settings.agent_port is not None:
                agent = Agent(self._willingness, weight=self.settings.agent_weight)
                listening = agent.running(self.settings.host, self.settings.agent_port)
                await at_exit.enter_async_context(listening)
            at_exit.callback(self.drain)
            yield self

    def readiness(self) -> Readiness:
        """Whether the worker can work, and the reason if it cannot.

        A busy worker is ready: it refuses excess work per request, and metrics report it.
        """
        reasons = sorted(self.waiting_for)
        if WARMING_UP in reasons and (compiling := self.kernels.compiling()) is not None:
            reasons.append(compiling)
        if self.draining:
            reasons.append("draining: the worker is stopping")
        if not self.engine.alive:
            reasons.append(f"engine stopped: {self.engine.failure or 'its thread has ended'}")
        if self.store.trouble is not None:
            reasons.append(str(self.store.trouble))
        return Readiness(ready=not reasons, reasons=reasons)

    @property
    def scene_limits(self) -> StagingLimits:
        """Limits of the process that reads an imported scene."""
        largest = min(self.settings.max_scene_bytes, self.settings.scene_memory_bytes)
        return self._limits(largest)

    @property
    def asset_limits(self) -> StagingLimits:
        """Limits of the process that reads an uploaded asset."""
        return self._limits(min(self.settings.max_asset_bytes, self.settings.scene_memory_bytes))

    def _limits(self, max_bytes: int) -> StagingLimits:
        settings = self.settings
        return StagingLimits(max_bytes, settings.import_memory_bytes, settings.import_seconds)

    @property
    def scenes_quota(self) -> Quota:
        """Quota of the scene folder."""
        return Quota(
            self.settings.scenes_path,
            "scenes",
            self.settings.scenes_quota,
            self.settings.scenes_quota_bytes,
            "SCENES_QUOTA",
            "delete bundles on the worker's disk",
        )

    @property
    def assets_quota(self) -> Quota:
        """Quota of the asset library."""
        return Quota(
            self.settings.assets_path,
            "assets",
            self.settings.assets_quota,
            self.settings.assets_quota_bytes,
            "ASSETS_QUOTA",
            "delete assets: DELETE /v1/assets/{id}",
        )

    def replayed(self, answer: Response) -> Response:
        """Count a repeated reply."""
        self.metrics.replays.inc()
        return answer

    async def video_source(self, job_id: str) -> VideoSource:
        """Video source of a finished simulation or drive.

        Raises:
            ServiceError: UNKNOWN_JOB, JOB_NOT_DONE, JOB_FAILED, or INVALID_REQUEST for other jobs.
        """
        shown = self.drives if (await self.jobs.get(job_id)).kind == "drive" else self.simulations
        return await shown.video_source(job_id)

    def drain(self) -> None:
        """Start the shutdown: no new sessions; open ones continue."""
        self.draining = self.sessions.draining = True

    @asynccontextmanager
    async def _hear(self) -> AsyncIterator[None]:
        """Deliver notifications of other workers during the block."""
        settings = self.settings
        notices = Notices(settings.database_url, timeout_s=settings.store_timeout_seconds)
        if notices.can_hear:
            self.jobs.listen = partial(notices.listener, "jobs")
            if self.sharing is not None:
                self.sharing.listen = partial(notices.listener, "bundles")
        async with notices.running():
            yield

    def _share(self, job_log: JobLog) -> None:
        """Connect to the object store, if one is configured."""
        settings = self.settings
        if settings.objects_url is None:
            return
        folders = {
            "scene": settings.scenes_path,
            "asset": settings.assets_path,
            "job": settings.jobs_path,
        }
        self.sharing = Sharing(
            BundleFolders(
                open_objects(settings.objects_url),
                folders,
                max_bytes=settings.objects_cache_bytes,
            ),
            BundleLog(self.store),
            job_log,
            catalog=self.scene_cache.catalog,
            assets=self.assets,
        )
        self.scene_cache.fetch = partial(self.sharing.take_out, "scene")
        self.jobs.fetch = partial(self.sharing.take_out, "job")
        self.jobs.on_forget = partial(self.sharing.forget, "job")

    async def hand_over(self) -> bool:
        """Hand over sessions and jobs to other workers.

        Returns False if no other worker accepts them; they then continue when this worker is back.

        Raises:
            StoreError: from the database; nothing was handed over.
        """
        rows = await self.leases.workers()
        others = [w for w in rows if w.alive and w.worker_id != self.settings.worker_id]
        if not any(takes_work(w.document) for w in others):
            return False
        self.drain()
        self.handed_over = True
        await self.jobs.leave()
        self.sessions.hand_over()
        if self.membership is not None:
            await self.membership.leave()
        log.info("handed over", to=len(others))
        return True

    def _add_demo(self) -> None:
        """Import the demo street, unless a scene with its name exists."""
        try:
            import_scene(
                SHIPPED_STREET,
                scenes=self.settings.scenes_path,
                name=DEMO_SCENE,
                limits=self.scene_limits,
                quota=self.scenes_quota,
            )
        except (ServiceError, OSError) as error:
            if not isinstance(error, ServiceError) or error.code != ErrorCode.ALREADY_EXISTS:
                log.warning("the demo street cannot be added", reason=str(error))

    def _willingness(self) -> Willingness:
        return Willingness(
            ready=self.readiness().ready,
            full=len(self.sessions) >= self.settings.max_sessions,
            handed_over=self.handed_over,
        )

    def _membership(self) -> Membership:
        return Membership(
            self.leases,
            self.sessions,
            seconds=self.settings.lease_seconds,
            document=self._about,
            accounts=self.accounts,
        )

    def _about(self) -> dict[str, Any]:
        """Status of this worker for the fleet."""
        return {
            "version": version("real2sim"),
            "backend": self.backend.name,
            "ready": self.readiness().ready,
            "draining": self.draining,
            "sessions": len(self.sessions),
            "max_sessions": self.settings.max_sessions,
            "load": self._load(),
            "queue": self.engine.queue_depth,
            "scenes": self.scene_cache.resident_names,
            "scene_sessions": dict(Counter(session.row.scene for session in self.sessions)),
            "held": self._held(),
        }

    def _held(self) -> dict[str, list[int]]:
        """Numbers of sessions and unfinished jobs by owner name."""
        sessions, jobs = self.sessions.owned(), self.jobs.unfinished()
        return {
            name: [sessions[name], jobs[name]] for name in sorted(sessions.keys() | jobs.keys())
        }

    def _load(self) -> float:
        """Utilization of the engine since the last call, 0 to 1."""
        now, worked = time.monotonic(), self.metrics.engine_seconds
        since, before = self._last_load
        self._last_load = (now, worked)
        return round(min(1.0, (worked - before) / max(now - since, 1e-3)), 3)

    async def _warm_up(self) -> None:
        started = time.perf_counter()
        try:
            await self.kernels.run(self.renderer.warm_up)
        except Exception as error:
            log.exception("warm-up failed")
            self.waiting_for = {f"warm-up failed: {error}"}
            return
        self.on_ready()
        self.waiting_for = set()
        seconds = round(time.perf_counter() - started, 2)
        if self.membership is not None:
            await self.membership.tell()
        log.info("ready", backend=self.backend.name, warm_up_s=seconds)
        for needed_by_few in (self.kernels.run_planning, self.renderer.small_images.ready):
            try:
                await needed_by_few()
            except Exception:
                log.exception("warm-up of kernels that few sessions need failed")

    async def _watch_loop(self) -> None:
        while True:
            due = time.perf_counter() + LAG_PERIOD_S
            await asyncio.sleep(LAG_PERIOD_S)
            self.metrics.loop_lag.observe(max(0.0, time.perf_counter() - due))

    def _connect_gauges(self) -> None:
        self.metrics.build.info(
            {"version": version("real2sim"), "backend": self.backend.name},
        )
        self.metrics.watch_accounts(self.accounts, self.sessions.owned)
        self.metrics.session_limit.set(self.settings.max_sessions)
        self.metrics.watch(self.metrics.queue_depth, lambda: self.engine.queue_depth)
        levels = self.renderer.levels
        self.metrics.watch(
            self.metrics.scene_bytes,
            lambda: self.scene_cache.resident_bytes + levels.held_bytes,
        )
        self.metrics.watch(
            self.metrics.shared_memory_bytes, lambda: self.sessions.segments.held_bytes
        )
        for state, count in self.scene_cache.counters().items():
            self.metrics.watch(self.metrics.scenes.labels(state), count)


def _jobs_quota(settings: Settings) -> Quota:
    return Quota(
        settings.jobs_path,
        "jobs",
        settings.jobs_quota,
        settings.jobs_quota_bytes,
        "JOBS_QUOTA",
        "delete jobs that are over: DELETE /v1/jobs/{id}",
    )


def _connection_limits(settings: Settings) -> ConnectionLimits:
    return ConnectionLimits(
        most=connection_limit(settings.max_connections),
        head_s=settings.head_seconds,
        body_s=settings.body_seconds,
        write_s=settings.write_seconds,
    )


async def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


def _device_info(backend: Backend, settings: Settings) -> DeviceInfo:
    import numba

    reasons = {status.name: status.reason for status in describe_backends()}
    reason = reasons.get(backend.name, "")
    if backend.name == "cpu" and settings.backend == "auto":
        reason = f"{reason}; not cuda: {reasons.get('cuda', 'unknown')}"
    if settings.backend != "auto":
        reason = f"asked for by REAL2SIM_BACKEND; {reason}"
    return DeviceInfo(
        backend=backend.name,
        reason=reason,
        device=device_of(backend).type,
        threads=settings.threads or numba.get_num_threads(),
    )


# Async, because FastAPI runs plain functions on threads, and a thread switch takes longer.
async def _worker_of(connection: HTTPConnection) -> Worker:
    worker: Worker = connection.app.state.worker
    return worker


WorkerOf = Annotated[Worker, Depends(_worker_of)]
"""Parameter of routes and sockets that receives the worker."""
