"""``real2sim bench learn``: steps and images a second, for planners that learn.

Each figure stands beside what it replaces, measured in the same run: worlds in a batch beside a
single world, small images beside those of all Gaussians, many sessions beside one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control

from ..console import print_figures
from ..demo.street import SHIPPED
from ..edit import ScenarioState, instances_at
from ..learning import VectorDriveEnv
from ..learning.batch_images import fitted
from ..render import RasterOptions, View, rasterize, rasterize_batch
from ..scene import Scene
from ..scene.io import read_packed
from ..world import World
from ..world.batch import BatchWorld
from . import socket_sessions

Figures = dict[str, Any]

SIZE = 84
LARGER = 6
"""How many times as large the image is that is scaled down as the truth."""
IMAGE_TIMES_S = (0.0, 2.0, 5.0, 8.0)
FULL = RasterOptions(depth=False, instance=False)
REDUCED = RasterOptions(depth=False, instance=False, detail="auto")


@dataclass(frozen=True)
class LearnBenchOptions:
    """How much is measured.

    Attributes:
        worlds: of a batch.
        steps: of the batch, of each kind.
        image_steps: of the environment with images.
        repetitions: of a single image; the best counts.
        sessions: that are driven over sockets at once.
        socket_steps: of each.
        echo: whether they stand beside servers without worlds.
    """

    worlds: int = 64
    steps: int = 200
    image_steps: int = 30
    repetitions: int = 10
    sessions: int = 16
    socket_steps: int = 300
    echo: bool = True


def run(options: LearnBenchOptions | None = None) -> Figures:
    """Measure, print and return all figures."""
    options = options or LearnBenchOptions()
    console = Console()
    scene = read_packed(SHIPPED)
    figures: Figures = {}
    for name, measure in PARTS.items():
        with console.status(name):
            figures[name] = measure(scene, options)
        print_figures(name, figures[name])
    return figures


def batched_worlds(scene: Scene, options: LearnBenchOptions) -> Figures:
    """World steps a second, in a batch and one by one."""
    return {
        traffic: _batched(scene, ResetSpec(action="control", agents={"default": traffic}), options)
        for traffic in ("log", "idm")
    }


def _batched(scene: Scene, spec: ResetSpec, options: LearnBenchOptions) -> Figures:
    batch = BatchWorld(scene, spec, options.worlds)
    commands = np.tile([0.5, 0.0], (options.worlds, 1))

    def step() -> int:
        going = int((~batch.over).sum())
        batch.step(commands)
        if batch.over.any():
            batch.reset(batch.over)
        return going

    step()
    batched = _rate(step, options.steps)
    alone = _single_rate(scene, spec, options.steps)
    return {"steps_per_s": batched, "single_world_steps_per_s": alone, "ratio": batched / alone}


def _single_rate(scene: Scene, spec: ResetSpec, steps: int) -> float:
    """Steps a second of one world; making the next one when it is over does not count."""
    state = ScenarioState.of(scene)
    plan = Control(acceleration=0.5, steering=0.0)
    world = World(scene, state, spec)
    world.step(plan)
    spent = 0.0
    for _ in range(steps):
        if world.over:
            world = World(scene, state, spec)
        started = time.perf_counter()
        world.step(plan)
        spent += time.perf_counter() - started
    return steps / spent


def vector_environment(_scene: Scene, options: LearnBenchOptions) -> Figures:
    """Images a second of the environment, steps of its worlds included."""
    env = VectorDriveEnv(
        options.worlds,
        cameras=["front"],
        size=(SIZE, SIZE),
        options={"horizon": 50},
        random_start=4.0,
    )
    env.reset(seed=0)
    actions = np.tile([0.2, 0.0], (options.worlds, 1))

    def step() -> int:
        env.step(actions)
        return options.worlds

    step()
    return {"worlds": options.worlds, "images_per_s": _rate(step, options.image_steps)}


def small_images(scene: Scene, options: LearnBenchOptions) -> Figures:
    """Milliseconds of one image, and how near it is to a large one scaled down."""
    rows = [_small_image(scene, t, options.repetitions) for t in IMAGE_TIMES_S]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return {
        **means,
        "worst_ms": max(row["ms"] for row in rows),
        "worst_gain_db": min(row["psnr_db"] - row["full_psnr_db"] for row in rows),
        "ratio": means["full_ms"] / means["ms"],
    }


def _small_image(scene: Scene, seconds: float, repetitions: int) -> dict[str, float]:
    t_us = scene.start_us + round(seconds * 1e6)
    camera = fitted(scene.rig["front"], SIZE, SIZE)
    instances = instances_at(scene, ScenarioState.of(scene), t_us)
    viewmat = camera.viewmat(scene.ego.transform(t_us))

    def full(times: int = 1) -> np.ndarray:
        K = np.diag([times, times, 1.0]) @ camera.K
        size = SIZE * times
        drawn = rasterize(
            instances, viewmat[None], K[None], size, size, sky=scene.sky, options=FULL
        )
        return drawn.rgb[0].cpu().numpy().clip(0, 1)

    def reduced() -> np.ndarray:
        views = [View(instances, viewmat, camera.K)]
        drawn = rasterize_batch(views, SIZE, SIZE, sky=scene.sky, options=REDUCED)
        return drawn.rgb[0].cpu().numpy().clip(0, 1)

    truth = full(LARGER).reshape(SIZE, LARGER, SIZE, LARGER, 3).mean((1, 3))
    return {
        "ms": _best_ms(reduced, repetitions),
        "full_ms": _best_ms(full, repetitions),
        "psnr_db": _psnr(reduced(), truth),
        "full_psnr_db": _psnr(full(), truth),
    }


def sessions_over_sockets(_scene: Scene, options: LearnBenchOptions) -> Figures:
    """Steps a second of sessions without cameras, see :mod:`.socket_sessions`."""
    steps, echo = options.socket_steps, options.echo
    return socket_sessions.of_one_worker(options.sessions, steps, echo=echo)


def sessions_of_two_workers(_scene: Scene, options: LearnBenchOptions) -> Figures:
    """The same sessions, half of them in a second worker on the same machine."""
    steps, echo = options.socket_steps, options.echo
    return socket_sessions.of_two_workers(options.sessions, steps, echo=echo)


PARTS: dict[str, Callable[[Scene, LearnBenchOptions], Figures]] = {
    "small_images": small_images,
    "batched_worlds": batched_worlds,
    "vector_environment": vector_environment,
    "sessions_over_sockets": sessions_over_sockets,
    "sessions_of_two_workers": sessions_of_two_workers,
}


def _rate(call: Callable[[], int], times: int) -> float:
    """What calls say that they did, a second."""
    started = time.perf_counter()
    done = sum(call() for _ in range(times))
    return done / (time.perf_counter() - started)


def _best_ms(draw: Callable[[], object], repetitions: int) -> float:
    draw()
    times = []
    for _ in range(repetitions):
        started = time.perf_counter()
        draw()
        times.append((time.perf_counter() - started) * 1e3)
    return min(times)


def _psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(((image - truth) ** 2).mean()))
