"""``real2sim bench sensors``: time of a LiDAR sweep, and of images with lenses and shutters."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import posed_instances
from real2sim_server.render import render_cameras
from real2sim_server.render.cast import cast, detect
from real2sim_server.scene import BrownConrady, Camera, Fisheye, Shutter
from real2sim_server.scene.io import read_packed
from real2sim_server.scene.range_sensors import catalogue_lidar
from real2sim_server.synthetic.gaussian_street import street_scene

GAUSSIANS = 300_000
LIDAR = "synthetic-64"
SWEEP = "65,536 beams over 300,000 Gaussians"
PINHOLE = "pinhole"
WIDTH, HEIGHT = 640, 427
AT_US = 4_000_000
TURNS = 9


def run() -> dict[str, Any]:
    """Measure interleaved runs; print a table and return wall and processor times [ms]."""
    console = Console()
    with console.status("measuring sensors"):
        figures = _by_turns(_sweep() | _lenses())
    table = Table("", "best", "median", "processor", "by the pinhole's", title=r"sensors \[ms]")
    pinhole = figures[PINHOLE]["processor_ms"]
    for name, row in figures.items():
        row["by_pinhole"] = row["processor_ms"] / pinhole
        shown = (f"{row[key]:.1f}" for key in ("best_ms", "median_ms", "processor_ms"))
        table.add_row(name, *shown, "" if name == SWEEP else f"{row['by_pinhole']:.2f}")
    console.print(table)
    return figures


def _by_turns(drawn: Mapping[str, Callable[[], object]]) -> dict[str, dict[str, float]]:
    """Minimum and median wall time and minimum processor time of TURNS, after a warm-up turn."""
    wall: dict[str, list[float]] = {name: [] for name in drawn}
    processor: dict[str, list[float]] = {name: [] for name in drawn}
    for turn in range(TURNS + 1):
        for name, draw in drawn.items():
            before, began = time.process_time(), time.perf_counter()
            draw()
            if turn:
                wall[name].append(1e3 * (time.perf_counter() - began))
                processor[name].append(1e3 * (time.process_time() - before))
    return {
        name: {
            "best_ms": min(wall[name]),
            "median_ms": float(np.median(wall[name])),
            "processor_ms": min(processor[name]),
        }
        for name in drawn
    }


def _sweep() -> dict[str, Callable[[], object]]:
    """A sweep of 64 rings with 1,024 beams on the benchmark's street."""
    instances, lidar = street_scene(GAUSSIANS).instances, catalogue_lidar(LIDAR)
    pose = np.eye(4)
    pose[2, 3] = 1.73
    return {SWEEP: lambda: detect(cast(instances, lidar, pose, backend="cpu"), lidar)}


def _lenses() -> dict[str, Callable[[], object]]:
    """The demo's front camera as a pinhole, with lenses, and with a rolling shutter."""
    scene = read_packed(SHIPPED)
    vehicle, instances = scene.ego.transform(AT_US), posed_instances(scene, AT_US, {})
    front = scene.rig["front"].resized(WIDTH)
    K = front.K.copy()
    K[:2, 2] = WIDTH / 2, HEIGHT / 2
    front = replace(front, K=K, width=WIDTH, height=HEIGHT)
    wide = np.diag([WIDTH / np.radians(190), WIDTH / np.radians(190), 1.0])
    wide[:2, 2] = WIDTH / 2, HEIGHT / 2
    cameras = {
        PINHOLE: front,
        "Brown-Conrady": replace(front, lens=BrownConrady((-0.2, 0.05, 0, 0, 0, 0))),
        "rolling shutter at 15 m/s": replace(front, shutter=Shutter("top_to_bottom", 30_000)),
        "fisheye of 190 degrees": replace(
            front, K=wide, lens=Fisheye((0.0, 0.0, 0.0, 0.0), np.radians(95))
        ),
    }
    fast = np.concatenate([15 * vehicle[:3, 0], np.zeros(3)])

    def draw(camera: Camera) -> object:
        return render_cameras(
            instances, [camera], vehicle, sky=scene.sky, backend="cpu", twist=fast
        )

    return {name: partial(draw, camera) for name, camera in cameras.items()}
