"""``real2sim bench serve``: what a drive step costs, and what it leaves to others.

The worker runs in a process of its own, as it does for a planner; everything is measured from
outside, over loopback.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import real2sim

from ..demo.worker import own_worker
from ..scene.io import save_scene
from .drive_probe import DriveProbe, straight_on
from .loop_lag import loop_lag
from .report import print_report
from .street import street

SCENE = "street"
CAMERA = "front"
SHORT_STEP_US = 1_000
CAMERA_STEP_US = 50_000
WARM_UP_STEPS = 20
SESSIONS = 10

Figures = dict[str, Any]


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        gaussians: of the scene.
        width, height: of its camera [px].
        steps, camera_steps: measured, without sensors and with one raw camera.
        heavy_seconds: how long large pictures are drawn while the event loop is watched.
    """

    gaussians: int = 200_000
    width: int = 640
    height: int = 427
    steps: int = 2000
    camera_steps: int = 200
    heavy_seconds: float = 15.0


def run(effort: Effort | None = None) -> Figures:
    """Measure a worker on a procedural street; print a table and return its figures.

    Latencies are in milliseconds, memory in MB (1e6 bytes).
    """
    effort = effort or Effort()
    console = Console()
    with tempfile.TemporaryDirectory(prefix="real2sim-bench-") as folder:
        root = Path(folder)
        with console.status(f"making a street of {effort.gaussians} Gaussians"):
            sizes = {"width": effort.width, "height": effort.height}
            scene = street(SCENE, gaussians=effort.gaussians, **sizes)
            save_scene(scene, root / "scenes" / f"{SCENE}.r2s")
        log_file = root / "worker.log"
        with own_worker(scenes=root / "scenes", data=root, log_file=log_file) as worker:
            figures = _measure(console, effort, url=worker.url, pid=worker.process.pid)
    print_report(console, figures)
    return figures


def _measure(console: Console, effort: Effort, *, url: str, pid: int) -> Figures:
    raw = [{"camera": CAMERA, "codec": "raw"}]
    with real2sim.connect(url) as client:
        with console.status("starting the worker"):
            info = client.wait_ready()
        setup = {"device": info.device.model_dump(), "cores": os.cpu_count(), **vars(effort)}
        figures: Figures = {"setup": setup}
        # First, as long as the worker has no freed memory to fill again.
        with console.status(f"memory of {SESSIONS} sessions"):
            figures["memory"] = _memory(client, raw, pid)
        with console.status("drive steps without sensors"):
            figures["no_sensors"] = _drive(client, [], effort.steps, SHORT_STEP_US)
        with console.status("drive steps without sensors, by the SDK"):
            figures["no_sensors_sdk"] = _drive_by_sdk(client, effort.steps)
        with console.status(f"drive steps with one raw camera {effort.width}x{effort.height}"):
            figures["one_raw_camera"] = _drive(client, raw, effort.camera_steps, CAMERA_STEP_US)
        with console.status("the event loop while large pictures are drawn"):
            figures["event_loop"] = _event_loop(client, url, effort.heavy_seconds)
    return figures


def _drive(
    client: real2sim.Client, sensors: Sequence[Mapping[str, Any]], steps: int, dt_us: int
) -> Figures:
    """Latency from the action's bytes to the observation's, and its parts."""
    info = client.sessions.create(scene=SCENE)
    latencies, stages = [], []
    try:
        with DriveProbe(info) as probe:
            obs, _ = probe.reset(sensors, dt_us=dt_us)
            for k in range(WARM_UP_STEPS + steps):
                if obs["terminated"] or obs["truncated"]:
                    obs, _ = probe.reset(sensors, dt_us=dt_us)
                obs, seconds = probe.act(obs)
                if k >= WARM_UP_STEPS:
                    latencies.append(seconds * 1e3)
                    stages.append(obs["timing"])
    finally:
        client.sessions.delete(info.session_id)
    return percentiles(latencies) | _parts(latencies, stages)


def _parts(latencies: Sequence[float], stages: Sequence[Mapping[str, float]]) -> Figures:
    """Medians by stage, of what is in no stage, and of the share of a step that is not render."""
    by_stage = {name: [stage[name] for stage in stages] for name in stages[-1]}
    by_stage["socket, log and rest"] = [
        total - sum(stage.values()) for total, stage in zip(latencies, stages, strict=True)
    ]
    shares = 1 - np.array(by_stage["render"]) / np.array(latencies)
    return {
        "p50_by_stage_ms": {name: float(np.median(ms)) for name, ms in by_stage.items()},
        "share_not_render": float(np.median(shares)),
    }


def _drive_by_sdk(client: real2sim.Client, steps: int) -> Figures:
    latencies = []
    with client.session(scene=SCENE) as session:
        obs = session.reset(dt_us=SHORT_STEP_US)
        for k in range(WARM_UP_STEPS + steps):
            plan = straight_on(obs.t_us)
            started = time.perf_counter()
            obs = session.step(plan)
            if k >= WARM_UP_STEPS:
                latencies.append((time.perf_counter() - started) * 1e3)
    return percentiles(latencies)


def _event_loop(client: real2sim.Client, url: str, seconds: float) -> Figures:
    info = client.sessions.create(scene=SCENE)
    try:
        with DriveProbe(info) as probe:
            return loop_lag(probe, url, scene=SCENE, camera=CAMERA, seconds=seconds)
    finally:
        client.sessions.delete(info.session_id)


def _memory(
    client: real2sim.Client, sensors: Sequence[Mapping[str, Any]], pid: int
) -> Figures | None:
    """What a session adds to the worker, driven with sensors; None where there is no /proc."""
    if not Path(f"/proc/{pid}/statm").exists():
        return None
    infos, resident = [], []
    try:
        for _ in range(SESSIONS + 1):
            info = client.sessions.create(scene=SCENE)
            infos.append(info)
            with DriveProbe(info) as probe:
                obs, _ = probe.reset(sensors, dt_us=CAMERA_STEP_US)
                for _ in range(3):
                    obs, _ = probe.act(obs)
            resident.append(_resident_bytes(pid) / 1e6)
    finally:
        for info in infos:
            client.sessions.delete(info.session_id)
    each = (resident[-1] - resident[0]) / SESSIONS
    return {"sessions": SESSIONS, "worker_mb": resident[0], "per_session_mb": each}


def _resident_bytes(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def percentiles(values: Sequence[float]) -> Figures:
    """Count, least, p50, p95, p99 and largest of ``values``."""
    p50, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
    spread = {"min": min(values), "p50": p50, "p95": p95, "p99": p99, "max": max(values)}
    return {"count": len(values), **spread}
