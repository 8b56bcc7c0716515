"""``real2sim bench serve``: latency of a drive step, and load on other clients.

The worker runs in a separate process, as for a planner. Measurements are taken by a client over
loopback.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
from rich.console import Console
from rich.table import Table

import real2sim
from real2sim_server.demo.run import worker_process
from real2sim_server.demo.street import unpack_street
from real2sim_server.scene.io import save_scene
from real2sim_server.synthetic.gaussian_street import street

from .drive_probe import DriveProbe, straight_on

# Clients that request large images in a loop.

TIMEOUT_S = 120.0


@contextlib.contextmanager
def large_renders(
    url: str, scene: str, camera: str, *, width: int, clients: int = 1
) -> Iterator[list[float]]:
    """Render images of ``width`` px during the block; yields the list of their times [ms]."""
    taken: list[float] = []
    stop = threading.Event()

    def work() -> None:
        query = {"camera": camera, "width": str(width)}
        with httpx2.Client(base_url=url, timeout=TIMEOUT_S) as client:
            while not stop.is_set():
                started = time.perf_counter()
                answer = client.get(f"/v1/scenes/{scene}/render", params=query)
                answer.raise_for_status()
                taken.append((time.perf_counter() - started) * 1e3)

    threads = [threading.Thread(target=work, name="render", daemon=True) for _ in range(clients)]
    for thread in threads:
        thread.start()
    try:
        yield taken
    finally:
        stop.set()
        for thread in threads:
            thread.join(TIMEOUT_S)


# Lag of the worker's event loop while it draws large images.

HEAVY_WIDTH = 1920
PING_EVERY_S = 0.005
IDLE_SECONDS = 3.0
BUCKET = re.compile(r'^real2sim_event_loop_lag_seconds_bucket{le="([^"]+)"} (\S+)', re.MULTILINE)


def loop_lag(
    probe: DriveProbe, url: str, *, scene: str, camera: str, seconds: float
) -> dict[str, Any]:
    """Event loop lag with the worker idle and under load, measured by client and worker.

    ``ping`` has round trips of WebSocket pings [ms], which the event loop answers; they include the
    wake-up of the client. ``own`` has the worker's histogram of loop lag.
    """
    idle = _pings(probe, IDLE_SECONDS)
    before = _buckets(url)
    with large_renders(url, scene, camera, width=HEAVY_WIDTH) as pictures:
        loaded = _pings(probe, seconds)
    own = {le: count - before[le] for le, count in _buckets(url).items()}
    samples = own.get("+Inf", 0.0)
    within = own.get("0.005", 0.0) / samples if samples else float("nan")
    return {
        "heavy_picture_ms": float(np.mean(pictures)) if pictures else None,
        "pictures": len(pictures),
        "ping_idle_ms": _spread(idle),
        "ping_loaded_ms": _spread(loaded),
        "own_samples": int(samples),
        "own_share_within_5_ms": within,
        "own_p99_below_ms": _quantile_bound(own, 0.99),
    }


def _pings(probe: DriveProbe, seconds: float) -> list[float]:
    """Ping round trip times [ms]."""
    trips = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        trips.append(probe.socket.ping(10) * 1e3)
        time.sleep(PING_EVERY_S)
    return trips


def _buckets(url: str) -> dict[str, float]:
    text = httpx2.get(f"{url}/metrics", timeout=10).text
    return {le: float(count) for le, count in BUCKET.findall(text)}


def _quantile_bound(buckets: dict[str, float], fraction: float) -> float | None:
    """Upper bound of the first bucket that covers ``fraction`` of all samples [ms]."""
    total = buckets.get("+Inf", 0.0)
    for le, count in buckets.items():
        if total and count >= fraction * total:
            return float(le) * 1e3
    return None


def _spread(values: list[float]) -> dict[str, float]:
    p50, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
    return {"count": len(values), "p50": p50, "p95": p95, "p99": p99, "max": max(values)}


# Pauses of the machine: a lower bound of every latency.

MIN_PAUSE_S = 1e-3
"""Minimum pause; shorter ones are ordinary kernel ticks."""
START_S = 1.0
"""Time for all processes to start, so that each occupies a core [s]."""


def pauses(seconds: float) -> dict[str, Any]:
    """Measure the pauses of processes that only read the clock, one per core.

    Returns:
        ``cores``; ``per_second``: pauses above 1 ms per core and second; ``longest_ms``.
    """
    cores = os.cpu_count() or 1
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(cores, mp_context=spawn) as pool:
        # Wait until all processes have started, so that all cores are busy.
        list(pool.map(time.sleep, [START_S] * cores))
        found = list(pool.map(_read_the_clock, [seconds] * cores))
    pauses_seen = [pause for of_core in found for pause in of_core]
    return {
        "cores": cores,
        "per_second": len(pauses_seen) / (cores * seconds),
        "longest_ms": 1e3 * max(pauses_seen, default=0.0),
    }


def _read_the_clock(seconds: float) -> list[float]:
    """Pauses above ``MIN_PAUSE_S`` [s]."""
    pauses_seen = []
    before = time.perf_counter()
    end = before + seconds
    while before < end:
        now = time.perf_counter()
        if now - before > MIN_PAUSE_S:
            pauses_seen.append(now - before)
        before = now
    return pauses_seen


# The table of figures.

TITLES = {
    "no_sensors": "drive step, no sensors",
    "no_sensors_sdk": "the same, in the SDK",
    "one_raw_camera": "drive step, one raw camera",
    "real_time": "drive step, demo's street, three raw cameras",
    "crowded": "drive step, one raw camera, during large renders",
}
BY_STAGE = ("no_sensors", "one_raw_camera", "real_time")


def print_report(console: Console, figures: Mapping[str, Any]) -> None:
    """Print latencies, stages, event loop lag, memory and pauses of the machine."""
    console.print(_latencies(figures))
    for name in BY_STAGE:
        console.print(_stages(TITLES[name], figures[name]))
    lag, memory = figures["event_loop"], figures["memory"]
    share, bound = lag["own_share_within_5_ms"], lag["own_p99_below_ms"]
    console.print(
        f"event loop under load: {share:.1%} of {lag['own_samples']} samples within 5 ms, "
        f"p99 below {bound:g} ms; one heavy picture takes {lag['heavy_picture_ms']:.0f} ms"
    )
    crowded = figures["crowded"]
    console.print(
        f"beside {crowded['pictures']} large renders p99 of a step is "
        f"{crowded['p99_more_ms']:.1f} ms more than alone just before "
        f"({crowded['alone']['p99']:.1f} ms)"
    )
    if memory:
        console.print(
            f"memory: {memory['per_session_mb']:.2f} MB for each of {memory['sessions']} sessions"
        )
    machine = figures["machine"]
    console.print(
        f"machine: a program that only reads the clock, one on each of {machine['cores']} cores, "
        f"is stopped {machine['per_second']:.1f} times a second for more than 1 ms, at most for "
        f"{machine['longest_ms']:.1f} ms"
    )


def _latencies(figures: Mapping[str, Any]) -> Table:
    table = Table(r"\[ms]", "p50", "p95", "p99", "max", "n", title="latency", title_justify="left")
    rows = {title: figures[name] for name, title in TITLES.items()}
    lag = figures["event_loop"]
    rows["ping, worker idle"] = lag["ping_idle_ms"]
    rows["ping, worker drawing"] = lag["ping_loaded_ms"]
    for title, row in rows.items():
        numbers = [f"{row[name]:.2f}" for name in ("p50", "p95", "p99", "max")]
        table.add_row(title, *numbers, str(row["count"]))
    return table


def _stages(title: str, case: Mapping[str, Any]) -> Table:
    table = Table(r"stage \[ms]", "p50", "p95", "p99", title=title, title_justify="left")
    rows = {**case["by_stage_ms"], "all but render and physics": case["overhead_ms"]}
    for stage, row in rows.items():
        table.add_row(stage, *(f"{row[name]:.2f}" for name in ("p50", "p95", "p99")))
    table.add_row("share that is not render", f"{case['share_not_render']:.1%}", "", "")
    if "share_within_100_ms" in case:
        table.add_row("steps within 100 ms", f"{case['share_within_100_ms']:.1%}", "", "")
    return table


SCENE = "street"
CAMERA = "front"
SHORT_STEP_US = 1_000
CAMERA_STEP_US = 50_000
REAL_TIME = "demo_street"
"""Scene of the 10 Hz benchmark: 300,000 Gaussians, log replay, three cameras of 480x320."""
REAL_TIME_STEP_US = 100_000
DEVICE_STAGES = ("render", "physics")
"""Stages that are the purpose of a step; all others are overhead."""
WARM_UP_STEPS = 20
SESSIONS = 10
CROWD, CROWD_WIDTH = 3, 4096
"""Number of clients that render during a drive, and the width of their images [px]."""

Figures = dict[str, Any]


@dataclass(frozen=True)
class ServeBenchOptions:
    """Size of the benchmark.

    Attributes:
        gaussians: Gaussians of the scene.
        width, height: image size of its camera [px].
        steps, camera_steps: steps without sensors, and with one raw camera.
        heavy_seconds: duration of the event loop measurement under load [s].
        real_time_steps: steps on the demo street with its three cameras; see ``REAL_TIME``.
        pause_seconds: duration of the pause measurement on the idle machine [s].
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
        # Measure memory first, before the worker has free memory to reuse.
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
        with console.status(f"drive steps during {CROWD} clients that render {CROWD_WIDTH} px"):
            figures["crowded"] = _crowded(client, url, raw, options.camera_steps)
        with console.status("the event loop while large pictures are drawn"):
            figures["event_loop"] = _event_loop(client, url, options.heavy_seconds)
    return figures


def _real_time(client: real2sim.Client, steps: int) -> Figures:
    """Measure all cameras of the demo street, and the fraction of steps within 100 ms."""
    info = client.scenes.load(REAL_TIME)
    sensors = [{"camera": camera.name, "codec": "raw"} for camera in info.cameras]
    figures, latencies = _drive(client, sensors, steps, REAL_TIME_STEP_US, scene=REAL_TIME)
    within = float(np.mean(np.array(latencies) <= REAL_TIME_STEP_US / 1e3))
    sizes = [[camera.width, camera.height] for camera in info.cameras]
    return figures | {"cameras": sizes, "share_within_100_ms": within}


def _crowded(
    client: real2sim.Client, url: str, sensors: Sequence[Mapping[str, Any]], steps: int
) -> Figures:
    """Measure steps with one raw camera alone, then immediately with rendering clients."""
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
    """Latency from sending an action to receiving the observation: summary, and all values."""
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
    """Milliseconds by stage, outside stages, and of overhead (neither render nor physics), and the
    median fraction of a step outside render."""
    total = np.array(latencies)
    names = dict.fromkeys(name for stage in stages for name in stage)
    by_stage = {name: np.array([s.get(name, 0.0) for s in stages]) for name in names}
    share_rendering = by_stage["render"] / total if "render" in by_stage else np.zeros(len(total))
    device = sum(
        (by_stage[name] for name in DEVICE_STAGES if name in by_stage), np.zeros(len(total))
    )
    by_stage["socket and rest"] = total - sum(by_stage.values())
    spread = {name: percentiles(ms.tolist()) for name, ms in by_stage.items()}
    return {
        "p50_by_stage_ms": {name: row["p50"] for name, row in spread.items()},
        "by_stage_ms": spread,
        "overhead_ms": percentiles((total - device).tolist()),
        "share_not_render": float(np.median(1 - share_rendering)),
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
    """Memory of a driven session with sensors in the worker; None without /proc."""
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
    """Resident memory of a process from /proc [bytes]."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def percentiles(values: Sequence[float]) -> Figures:
    """Count, minimum, p50, p95, p99 and maximum of ``values``."""
    p50, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
    spread = {"min": min(values), "p50": p50, "p95": p95, "p99": p99, "max": max(values)}
    return {"count": len(values), **spread}
