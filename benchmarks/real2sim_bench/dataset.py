"""``real2sim bench dataset``: cost of a labelled frame relative to its colour image.

CPU times cover all threads of this process and hardly depend on other load. They are the minimum
over several rounds of one frame of the demo street, with three cameras of 640x427. Frames per
second are measured in elapsed time on a complete export with a 64-beam LiDAR, and depend on other
load.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from real2sim_server.datasets.clips import write_clip
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.labels import (
    CameraImages,
    ObjectBox,
    boxes_at,
    draw_moment,
    flow_between,
    lidar_points,
    views_of,
)
from real2sim_server.datasets.plan import ExportPlan, planned_clips, planned_lidar
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.render import render_cameras
from real2sim_server.render.cast import select_caster
from real2sim_server.scene import Camera
from real2sim_server.scene.io import read_packed

WIDTH = 640
LIDAR = "hdl-64e"
ROUNDS = 5
FRAMES = 8
"""Number of frames in the timed export."""

STEP_US = 100_000
Figures = dict[str, Any]


def run(*, rounds: int = ROUNDS, frames: int = FRAMES) -> Figures:
    """CPU time by part of a frame [ms], its ratio to the colour image, and frames per second."""
    scene = read_packed(SHIPPED)
    drive = ScenarioDrive(scene, ScenarioState.of(scene))
    cameras = [camera.resized(WIDTH) for camera in scene.rig]
    figures: Figures = _cpu_times(drive, cameras, rounds)
    labels = figures["labels [ms]"]
    figures["labels, share of colours"] = round(labels / figures["colours [ms]"], 2)
    figures["Gaussians"] = sum(len(i.cloud) for i in drive.at(drive.span[0]).instances)
    seconds, busy = _written(drive, cameras, frames)
    figures["written with LiDAR, CPU [ms]"] = round(busy * 1e3)
    figures["written with LiDAR, frames/s"] = round(1 / seconds, 2)
    return figures


def _cpu_times(drive: ScenarioDrive, cameras: Sequence[Camera], rounds: int) -> Figures:
    """CPU times of a frame, and of its flow to the previous frame."""
    scene, t_us = drive.scene, sum(drive.span) // 2
    before, here = drive.at(t_us - STEP_US), drive.at(t_us)
    boxes = boxes_at(here.placed), boxes_at(before.placed)
    images = draw_moment(scene, here, cameras), draw_moment(scene, before, cameras)
    plan = ExportPlan(formats=("labels",), lidar=LIDAR)
    lidar, caster = planned_lidar(plan), select_caster()
    assert lidar is not None

    def colours() -> None:
        render_cameras(here.instances, cameras, here.T_world_ego, sky=scene.sky, modalities=["rgb"])

    def views() -> None:
        for image in images[0]:
            views_of(image, boxes[0], here.instances)

    parts: dict[str, Callable[[], object]] = {
        "colours": colours,
        "colours, depth, objects, classes": lambda: draw_moment(scene, here, cameras),
        "boxes and visibility": views,
        "flow, both ways": lambda: _flow(images, boxes),
        "LiDAR, 64 beams": lambda: lidar_points(
            drive, here, boxes[0], lidar, seed=0, caster=caster
        ),
    }
    found = {name: float("inf") for name in parts}
    for _ in range(rounds + 1):  # Interleaved; the first round also compiles.
        for name, part in parts.items():
            start = time.process_time()
            part()
            found[name] = min(found[name], (time.process_time() - start) * 1e3)
    labels = sum(found[name] for name in list(parts)[1:4]) - found["colours"]
    return {f"{name} [ms]": round(value, 1) for name, value in found.items()} | {
        "labels [ms]": round(labels, 1)
    }


def _flow(
    images: tuple[list[CameraImages], list[CameraImages]],
    boxes: tuple[list[ObjectBox], list[ObjectBox]],
) -> None:
    for here, there in zip(*images, strict=True):
        flow_between(here, there, *boxes)
        flow_between(there, here, boxes[1], boxes[0])


def _written(drive: ScenarioDrive, cameras: Sequence[Camera], frames: int) -> tuple[float, float]:
    """Elapsed and CPU time per frame of a full export to files [s]."""
    plan = ExportPlan(formats=("labels",), period_us=STEP_US, clip_s=60.0, lidar=LIDAR)
    clip = planned_clips(drive, plan)[0]
    clip = replace(clip, times_us=clip.times_us[:frames])
    with tempfile.TemporaryDirectory() as folder:
        start, busy = time.perf_counter(), time.process_time()
        write_clip(drive, plan, cameras, clip, Path(folder) / "clip")
        spent = time.perf_counter() - start, time.process_time() - busy
    count = len(clip.times_us)
    return spent[0] / count, spent[1] / count
