"""Jobs, sweeps and searches: long work on the worker, followed from the client."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from real2sim_proto.jobs import (
    DatasetNoise,
    DatasetPerturbation,
    DatasetRequest,
    DatasetSweep,
    ExportRequest,
    JobInfo,
)
from real2sim_proto.operations import Operation
from real2sim_proto.sessions import SessionInfo
from real2sim_proto.storyboard import Storyboard
from real2sim_proto.sweeps import StopRule, SweepRequest

from .. import _requests
from .._calls import checked
from .._handles import (
    JobBase,
    OnProgress,
    ScenarioRef,
    SceneRef,
    job_id_of,
    optional_scenario_id,
    optional_scene_name,
    poll_delays,
    require_success,
    scene_name,
    session_and_token,
)
from .._session_state import SessionBase
from ..images import write_atomically
from .concurrency import run_blocking, sleep
from .transport import AsyncCollection, AsyncTransport


class AsyncJobs(AsyncCollection[JobInfo]):
    """``client.jobs``.

    Examples:
        >>> client = real2sim.connect_async()
        >>> job = await client.jobs.export_video(scene="street", camera="front", end_us=200_000)
    """

    async def get(self, job_id: str) -> AsyncJob:
        """A handle of an existing job.

        Raises:
            NotFoundError: no such job.

        Examples:
            >>> (await client.jobs.get(job.job_id)).info.kind
            'export'
        """
        return AsyncJob(self._transport, await self._transport.send(_requests.get_job(job_id)))

    async def list(self, *, subject: str | None = None) -> Sequence[JobInfo]:
        """Jobs of the worker, newest first; ``subject`` selects those of one scene or scenario.

        Examples:
            >>> newest = (await client.jobs.list(subject="street"))[0]
            >>> newest.job_id == job.job_id
            True
        """
        found = await self._transport.send(_requests.list_jobs(subject))
        return found.jobs

    async def export_video(
        self,
        *,
        camera: str,
        scenario: ScenarioRef | None = None,
        scene: SceneRef | None = None,
        simulation: str | AsyncJob | None = None,
        width: int | None = None,
        start_us: int | None = None,
        end_us: int | None = None,
        fps: float = 10.0,
    ) -> AsyncJob:
        """Start a video export.

        Args:
            camera: name of the recorded camera.
            scenario, scene, simulation: exactly one of them, or its id.
            width: pixels; default: as recorded.
            start_us, end_us: default: the full available span.
            fps: frames per second.

        Raises:
            ValueError: an invalid field.

        Examples:
            >>> job = await client.jobs.export_video(scene="street", camera="left", end_us=200_000)
            >>> job = await job.wait(timeout=60.0)
            >>> path = await job.download("video.webm", folder / "street.webm")
            >>> path.stat().st_size > 0
            True
        """
        fields = {
            "camera": camera,
            "scenario": optional_scenario_id(scenario),
            "scene": optional_scene_name(scene),
            "simulation": None if simulation is None else job_id_of(simulation),
            "width": width,
            "start_us": start_us,
            "end_us": end_us,
            "fps": fps,
        }
        call = _requests.create_export(checked(ExportRequest, **fields))
        return AsyncJob(self._transport, await self._transport.send(call))

    async def export_dataset(
        self,
        *,
        formats: Sequence[str],
        scenario: ScenarioRef | None = None,
        scene: SceneRef | None = None,
        session: str | SessionInfo | SessionBase | None = None,
        recording: bytes | None = None,
        cameras: Sequence[str] = (),
        width: int | None = None,
        period_us: int = 100_000,
        start_us: int | None = None,
        end_us: int | None = None,
        clip_s: float = 20.0,
        splits: Mapping[str, float] | None = None,
        seed: int = 0,
        flow: bool = True,
        lidar: str | None = None,
        rig: Mapping[str, Any] | None = None,
        sweep: DatasetSweep | Mapping[str, Any] | None = None,
        perturb: DatasetPerturbation | Mapping[str, Any] | None = None,
        noise: DatasetNoise | Mapping[str, Any] | None = None,
        dry_run: bool = False,
    ) -> AsyncJob:
        """Start a data set export: images with boxes, masks, depth, flow, points and tracks.

        Args:
            formats: ``labels``, ``kitti``, ``coco``, ``nuscenes``, ``argoverse2``,
                ``webdataset``, ``pictures``.
            scenario, scene, session: exactly one of them, or its id; a session exports its current
                episode.
            recording: an episode on ``scene`` instead of the recorded drive, see
                ``DriveSession.recording``.
            cameras: names; default: all.
            width: pixels; default: as recorded.
            period_us: time between frames.
            start_us, end_us: default: the full available span.
            clip_s: length of a clip in seconds; a clip is in one split.
            splits: share of the clips by name; default: all in ``train``.
            seed: seed of the assignment of clips to splits.
            flow: whether to export optical flow.
            lidar: a model such as ``hdl-64e``, whose returns become the labelled points; default:
                points sampled from the cameras.
            rig: custom cameras and LiDAR, instead of ``cameras``, ``width`` and ``lidar``.
            sweep: parameters, and edits in which ``"$name"`` is replaced by a parameter's value.
            perturb: the ego starts off its path and returns to it (recovery data).
            noise: detector errors; the noisy boxes are written next to the true ones.
            dry_run: only report frames, images, bytes and minutes in ``info.result``.

        Raises:
            ValueError: an invalid field.

        Examples:
            >>> job = await client.jobs.export_dataset(
            ...     scene="street", formats=["coco"], cameras=["front"], width=64, end_us=100_000
            ... )
            >>> job = await job.wait(timeout=60.0)
            >>> job.info.result["statistics"]["boxes"]
            {'car': 4, 'pole': 2}
            >>> path = await job.download("dataset.tar", folder / "street.tar")
            >>> path.stat().st_size > 0
            True
        """
        session_id, token = session_and_token(session)
        fields = {
            "kind": "dataset",
            "scenario": optional_scenario_id(scenario),
            "scene": optional_scene_name(scene),
            "session": session_id,
            "recording": None if recording is None else base64.b64encode(recording).decode(),
            "formats": list(formats),
            "cameras": list(cameras),
            "width": width,
            "period_us": period_us,
            "start_us": start_us,
            "end_us": end_us,
            "clip_s": clip_s,
            "splits": {"train": 1.0} if splits is None else dict(splits),
            "seed": seed,
            "flow": flow,
            "lidar": lidar,
            "rig": None if rig is None else dict(rig),
            "sweep": sweep,
            "perturb": perturb,
            "noise": noise,
            "dry_run": dry_run,
        }
        body = checked(DatasetRequest, **fields)
        call = _requests.create_dataset(body, self._transport.target.token or token)
        return AsyncJob(self._transport, await self._transport.send(call))


class AsyncJob(JobBase):
    """A job in its last fetched state.

    Examples:
        >>> client = real2sim.connect_async()
        >>> job = await client.jobs.export_video(scene="street", camera="front", end_us=200_000)
    """

    def __init__(self, transport: AsyncTransport, info: JobInfo) -> None:
        super().__init__(info)
        self._transport = transport

    async def refresh(self) -> AsyncJob:
        """Fetch the current state; returns itself.

        Examples:
            >>> job = await job.refresh()
            >>> 0.0 <= job.info.progress <= 1.0
            True
        """
        self.info = await self._transport.send(_requests.get_job(self.job_id))
        return self

    async def wait(
        self, *, timeout: float | None = None, on_progress: OnProgress | None = None
    ) -> AsyncJob:
        """Wait until the job has succeeded; returns itself.

        Args:
            timeout: seconds; default: no limit.
            on_progress: called on each observed change.

        Raises:
            ReplyTimeoutError: the job did not end in time.
            Real2SimError: the job failed, was cancelled or was interrupted; the subclass says
                which.

        Examples:
            >>> stages = []
            >>> job = await job.wait(timeout=60.0, on_progress=lambda i: stages.append(i.stage))
            >>> job.info.state.value, [file.name for file in job.info.files]
            ('succeeded', ['video.webm'])
        """
        for delay in poll_delays(self.job_id, timeout):
            seen = self.info.event
            await self.refresh()
            if on_progress is not None and self.info.event != seen:
                on_progress(self.info)
            if self.info.over:
                break
            await sleep(delay)
        require_success(self.info)
        return self

    async def cancel(self) -> AsyncJob:
        """Request cancellation; returns itself.

        Examples:
            >>> job = await job.cancel()
        """
        await self._transport.send(_requests.cancel_job(self.job_id))
        return await self.refresh()

    async def download(self, name: str, path: str | os.PathLike[str]) -> Path:
        """Download a result file of the job to ``path``.

        Examples:
            >>> job = await job.wait(timeout=60.0)
            >>> (await job.download("video.webm", folder / "street.webm")).name
            'street.webm'
        """
        content = await self._transport.send(_requests.job_file(self.job_id, name))
        await run_blocking(write_atomically, Path(path), content)
        return Path(path)


# Sweeps and searches: many variants of a case, driven on the worker.


class AsyncSweeps:
    """``client.sweeps``.

    Examples:
        >>> client = real2sim.connect_async()
        >>> case = {"scene": "street", "reset": {"horizon": 5}}
        >>> case["reset"]["agents"] = {"drivers": {"car_red": {"kind": "hard_brake"}}}
        >>> gap = {"path": "agents.drivers.car_red.delay", "low": 0.0, "high": 0.4}
    """

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._transport.target})"

    async def start(
        self,
        scene: SceneRef,
        *,
        parameters: Mapping[str, Any] | None = None,
        corner_case: str | None = None,
        openscenario: str | Path | None = None,
        storyboard: Storyboard | Mapping[str, Any] | None = None,
        ego: str | None = None,
        leave_out: Sequence[str] = (),
        reset: Mapping[str, Any] | None = None,
        operations: Sequence[Operation | Mapping[str, Any]] = (),
        method: str | Mapping[str, Any] = "sobol",
        seeds: Sequence[int] = (0,),
        planners: Sequence[str] = ("idm",),
        stop: StopRule | Mapping[str, Any] | None = None,
        metrics: Sequence[str] = (),
        worst: int = 3,
        rank_by: str = "criticality",
    ) -> AsyncJob:
        """Start a sweep over a parameter space; images are rendered only if a planner needs them.

        The job writes ``episodes.parquet``, with one row per episode. For each of the ``worst``
        episodes in its result it also writes ``EPISODE.r2e`` (a recording) and, for a scenario,
        ``EPISODE.xosc``.

        Args:
            scene: its name.
            parameters: parameters by name, as in ``real2sim sweep``, such as
                ``{"low": 2, "high": 20}``; with a ``path`` into ``reset``, or without one if the
                scenario has the parameter.
            corner_case, openscenario, storyboard: the traffic; set at most one of them. A case of
                the gallery, the text or path of an OpenSCENARIO file, or a storyboard in the
                scene's frame.
            ego: entity of the file that is the ego; default: ``Ego``.
            leave_out: elements of the file to ignore.
            reset: options of the episodes.
            operations: edits of the scene.
            method: ``sobol``, ``halton``, ``latin_hypercube``, ``random``, ``grid``, or one with
                its fields: ``{"kind": "grid", "levels": 5}``.
            seeds: every point is driven with each seed.
            planners: ``follow_route``, ``pid``, ``idm``, ``depth_sampling``.
            stop: stopping criterion, such as ``{"at_fault": 10}``.
            metrics: scores to add as columns.
            worst: number of episodes to save as recordings, with the highest ``rank_by``.
            rank_by: a column.

        Raises:
            ValueError: an invalid field.

        Examples:
            >>> method = {"kind": "grid", "levels": 2}
            >>> job = await client.sweeps.start(**case, parameters={"gap": gap}, method=method)
            >>> job = await job.wait(timeout=300.0)
            >>> job.result["episodes"]
            2
            >>> path = await job.download("episodes.parquet", folder / "episodes.parquet")
        """
        given = {
            "parameters": dict(parameters or {}),
            "method": method,
            "seeds": list(seeds),
            "planners": list(planners),
            "stop": stop,
            "metrics": list(metrics),
            "worst": worst,
            "rank_by": rank_by,
            "operations": list(operations),
            "reset": dict(reset or {}),
            **_scenario(corner_case, openscenario, storyboard, ego, leave_out),
        }
        return await self._started(scene, given)

    async def search(
        self,
        scene: SceneRef,
        *,
        planner: str,
        parameters: Mapping[str, Any] | None = None,
        corner_case: str | None = None,
        openscenario: str | Path | None = None,
        storyboard: Storyboard | Mapping[str, Any] | None = None,
        ego: str | None = None,
        leave_out: Sequence[str] = (),
        reset: Mapping[str, Any] | None = None,
        operations: Sequence[Operation | Mapping[str, Any]] = (),
        episodes: int = 300,
        seed: int = 0,
        shrink: int = 3,
        probability: int = 0,
        films: int = 0,
    ) -> AsyncJob:
        """Start a search for avoidable collisions that are the planner's fault.

        The job writes ``failures.json``, each failure as ``failure_01.xosc`` and ``.r2e``, and
        ``failures.tar`` with a page, cases and films.

        Args:
            scene, parameters, corner_case, openscenario: see :meth:`start`.
            storyboard, ego, leave_out, reset, operations: see :meth:`start`.
            planner: ``follow_route``, ``pid``, ``idm`` or ``depth_sampling``.
            episodes: maximum number of episodes, 20 or more.
            seed: makes the search repeatable.
            shrink: number of failures for which to find the boundary to success.
            probability: episodes for estimating the at-fault probability; 0 skips it.
            films: number of failures to film.

        Raises:
            ValueError: an invalid field.

        Examples:
            >>> asked = {"planner": "idm", "parameters": {"gap": gap}, "episodes": 20}
            >>> job = await client.sweeps.search(**case, **asked)
            >>> job.info.kind, (await job.cancel()).info.state.value
            ('sweep', 'cancelled')
        """
        method = {"kind": "search", "episodes": episodes, "seed": seed, "shrink": shrink}
        given = {
            "parameters": dict(parameters or {}),
            "method": method | {"probability": probability, "films": films},
            "planners": [planner],
            "operations": list(operations),
            "reset": dict(reset or {}),
            **_scenario(corner_case, openscenario, storyboard, ego, leave_out),
        }
        return await self._started(scene, given)

    async def _started(self, scene: SceneRef, given: Mapping[str, Any]) -> AsyncJob:
        fields = {name: value for name, value in given.items() if value is not None}
        call = _requests.create_sweep(checked(SweepRequest, scene=scene_name(scene), **fields))
        return AsyncJob(self._transport, await self._transport.send(call))


def _scenario(
    corner_case: str | None,
    openscenario: str | Path | None,
    storyboard: Storyboard | Mapping[str, Any] | None,
    ego: str | None,
    leave_out: Sequence[str],
) -> dict[str, Any]:
    text = openscenario.read_text("utf-8-sig") if isinstance(openscenario, Path) else openscenario
    given = {"corner_case": corner_case, "openscenario": text, "storyboard": storyboard}
    return {**given, "ego": ego, "leave_out": list(leave_out)}
