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

from ..demo.street import unpack_street
from ..demo.worker import worker_process
from ..scene.io import save_scene
from .drive_probe import DriveProbe, straight_on
from .large_renders import large_renders
from .loop_lag import loop_lag
from .pauses import pauses
from .report import print_report
from .street import street

SCENE = "street"
CAMERA = "front"
SHORT_STEP_US = 1_000
CAMERA_STEP_US = 50_000
REAL_TIME = "demo_street"
"""300,000 Gaussians, objects that repeat the log, three cameras of 480x320: to run at 10 Hz."""
REAL_TIME_STEP_US = 100_000
DEVICE_STAGES = ("render", "physics")
"""What a step is for; all else is overhead."""
WARM_UP_STEPS = 20
SESSIONS = 10
CROWD, CROWD_WIDTH = 3, 4096
"""Clients that render beside a drive, and the width of their pictures [px]."""

Figures = dict[str, Any]


@dataclass(frozen=True)
class ServeBenchOptions:
    """How much is measured.

    Attributes:
        gaussians: of the scene.
        width, height: of its camera [px].
        steps, camera_steps: measured, without sensors and with one raw camera.
        heavy_seconds: how long large pictures are drawn while the event loop is watched.
        real_time_steps: measured on the demo's street with its three cameras; see ``REAL_TIME``.
        pause_seconds: how long the machine itself is watched, with nothing else running.
    """

    gaussians: int = 200_000
    width: int = 640
    height: int = 427
    steps: int = 2000
    camera_steps: int = 200
    heavy_seconds: float = 15.0
    real_time_steps: int = 200
    pause_seconds: float = 3.0


def run(options: ServeBenchOptions | None = None) -> Figures:
    """Measure a worker on a procedural street; print a table and return its figures.

    Latencies are in milliseconds, memory in MB (1e6 bytes).
    """
    options = options or ServeBenchOptions()
    console = Console()
    with console.status("how often the machine stops a program"):
        machine = pauses(options.pause_seconds)
    with tempfile.TemporaryDirectory(prefix="real2sim-bench-") as folder:
        root = Path(folder)
        with console.status(f"making a street of {options.gaussians} Gaussians"):
            sizes = {"width": options.width, "height": options.height}
            scene = street(SCENE, gaussians=options.gaussians, **sizes)
            save_scene(scene, root / "scenes" / f"{SCENE}.r2s")
            unpack_street(root / "scenes", f"{REAL_TIME}.r2s")
        log_file = root / "worker.log"
        with worker_process(scenes=root / "scenes", data=root, log_file=log_file) as worker:
            figures = _measure(console, options, url=worker.url, pid=worker.process.pid)
    figures["machine"] = machine
    print_report(console, figures)
    return figures


def _measure(console: Console, options: ServeBenchOptions, *, url: str, pid: int) -> Figures:
    raw = [{"camera": CAMERA, "codec": "raw"}]
    with real2sim.connect(url) as client:
        with console.status("starting the worker"):
            info = client.wait_ready()
        setup = {"device": info.device.model_dump(), "cores": os.cpu_count(), **vars(options)}
        figures: Figures = {"setup": setup}
        # First, as long as the worker has no freed memory to fill again.
        with console.status(f"memory of {SESSIONS} sessions"):
            figures["memory"] = _memory(client, raw, pid)
        with console.status("drive steps without sensors"):
            figures["no_sensors"], _ = _drive(client, [], options.steps, SHORT_STEP_US)
        with console.status("drive steps without sensors, by the SDK"):
            figures["no_sensors_sdk"] = _drive_by_sdk(client, options.steps)
        with console.status(f"drive steps with one raw camera {options.width}x{options.height}"):
            figures["one_raw_camera"], _ = _drive(client, raw, options.camera_steps, CAMERA_STEP_US)
        with console.status("drive steps with three raw cameras on the demo's street"):
            figures["real_time"] = _real_time(client, options.real_time_steps)
        with console.status(f"drive steps beside {CROWD} clients that render {CROWD_WIDTH} px"):
            figures["crowded"] = _crowded(client, url, raw, options.camera_steps)
        with console.status("the event loop while large pictures are drawn"):
            figures["event_loop"] = _event_loop(client, url, options.heavy_seconds)
    return figures


def _real_time(client: real2sim.Client, steps: int) -> Figures:
    """All cameras of the demo's street, and the share of steps that came within 100 ms."""
    info = client.scenes.load(REAL_TIME)
    sensors = [{"camera": camera.name, "codec": "raw"} for camera in info.cameras]
    figures, latencies = _drive(client, sensors, steps, REAL_TIME_STEP_US, scene=REAL_TIME)
    within = float(np.mean(np.array(latencies) <= REAL_TIME_STEP_US / 1e3))
    sizes = [[camera.width, camera.height] for camera in info.cameras]
    return figures | {"cameras": sizes, "share_within_100_ms": within}


def _crowded(
    client: real2sim.Client, url: str, sensors: Sequence[Mapping[str, Any]], steps: int
) -> Figures:
    """Steps with one raw camera alone, and at once afterwards beside clients that render."""
    alone, _ = _drive(client, sensors, steps, CAMERA_STEP_US)
    with large_renders(url, SCENE, CAMERA, width=CROWD_WIDTH, clients=CROWD) as pictures:
        beside, _ = _drive(client, sensors, steps, CAMERA_STEP_US)
    return (
        beside
        | {"alone": alone, "p99_more_ms": beside["p99"] - alone["p99"]}
        | {
            "picture_ms": float(np.mean(pictures)) if pictures else None,
            "pictures": len(pictures),
        }
    )


def _drive(
    client: real2sim.Client,
    sensors: Sequence[Mapping[str, Any]],
    steps: int,
    dt_us: int,
    *,
    scene: str = SCENE,
) -> tuple[Figures, list[float]]:
    """Latency from the action's bytes to the observation's, its parts, and all latencies."""
    info = client.sessions.create(scene=scene)
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
    return percentiles(latencies) | _parts(latencies, stages), latencies


def _parts(latencies: Sequence[float], stages: Sequence[Mapping[str, float]]) -> Figures:
    """Milliseconds by stage, of what is in no stage, and of all that is neither render nor physics;
    and the median share of a step that is not render."""
    total = np.array(latencies)
    by_stage = {name: np.array([s.get(name, 0.0) for s in stages]) for name in stages[-1]}
    device = sum(
        (by_stage[name] for name in DEVICE_STAGES if name in by_stage), np.zeros(len(total))
    )
    by_stage["socket and rest"] = total - sum(by_stage.values())
    spread = {name: percentiles(ms.tolist()) for name, ms in by_stage.items()}
    return {
        "p50_by_stage_ms": {name: row["p50"] for name, row in spread.items()},
        "by_stage_ms": spread,
        "overhead_ms": percentiles((total - device).tolist()),
        "share_not_render": float(np.median(1 - by_stage["render"] / total)),
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
            resident.append(resident_bytes(pid) / 1e6)
    finally:
        for info in infos:
            client.sessions.delete(info.session_id)
    each = (resident[-1] - resident[0]) / SESSIONS
    return {"sessions": SESSIONS, "worker_mb": resident[0], "per_session_mb": each}


def resident_bytes(pid: int) -> int:
    """Resident memory of a process, by /proc."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def percentiles(values: Sequence[float]) -> Figures:
    """Count, least, p50, p95, p99 and largest of ``values``."""
    p50, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
    spread = {"min": min(values), "p50": p50, "p95": p95, "p99": p99, "max": max(values)}
    return {"count": len(values), **spread}
