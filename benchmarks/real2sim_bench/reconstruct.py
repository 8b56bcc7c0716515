"""``real2sim bench reconstruct``: training steps per second, and time by stage."""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from real2sim_server.logs import DrivingLog
from real2sim_server.reconstruct.initialise.stage0 import initialise_scene
from real2sim_server.reconstruct.options import InitialiseOptions
from real2sim_server.reconstruct.training.densify import DensifyOptions
from real2sim_server.reconstruct.training.run import one_torch_thread
from real2sim_server.reconstruct.training.schedule import TrainOptions
from real2sim_server.reconstruct.training.trainer import Trainer
from real2sim_server.scene import GaussianCloud, Scene
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

GAUSSIANS = 76_000
SIZE = (621, 188)
"""Number of Gaussians and image size at which OpenSplat's CPU trainer takes 0.85 s per step."""
WARM_UP, ROUND = 6, 10


def run(*, rounds: int = 4, gaussians: int = GAUSSIANS) -> dict[str, Any]:
    """Train on a synthetic street and time it.

    All rounds have the same number of steps. Each figure is the best of all rounds, to reduce the
    effect of other load.

    Args:
        rounds: number of rounds of ROUND steps each.
        gaussians: Gaussians in the scene.

    Returns:
        ``gaussians``, ``width``, ``height``, ``threads``; ``iterations_per_s``; ``stage_ms``:
        milliseconds per step of data, forward, loss, backward, optimiser and densify (once per
        round of ten steps, ten times as often as in training); ``backward_per_forward``.
    """
    import numba

    options = _options(rounds)
    log = _street()
    scene = _first_scene(log, options, gaussians)
    best_s, stages = math.inf, dict[str, float]()
    with tempfile.TemporaryDirectory(prefix="real2sim-bench-") as folder, one_torch_thread():
        trainer = Trainer(log, scene, options, folder=Path(folder))
        trainer.run(until=WARM_UP)
        for index in range(rounds):
            trainer.running.stages.clear()
            start = time.perf_counter()
            trainer.run(until=WARM_UP + ROUND * (index + 1))
            best_s = min(best_s, (time.perf_counter() - start) / ROUND)
            for name, spent in trainer.running.stages.items():
                stages[name] = min(stages.get(name, math.inf), 1e3 * spent / ROUND)
        trainer.views.close()
        count = len(trainer.model.gaussians)
    return {
        "gaussians": count,
        "width": SIZE[0],
        "height": SIZE[1],
        "threads": numba.get_num_threads(),
        "iterations_per_s": 1 / best_s,
        "stage_ms": stages,
        "backward_per_forward": stages["backward"] / stages["forward"],
    }


def _options(rounds: int) -> TrainOptions:
    """Options for steps only: densification stays below its cap, and nothing is written."""
    steps = WARM_UP + ROUND * rounds
    return TrainOptions(
        iterations=4 * steps,
        sh_every=1e-6,
        hold_out=0,
        mirror=0.0,
        sky_resolution=128,
        checkpoint_every=0,
        log_every=10 * steps,
        initialise=InitialiseOptions(max_background=110_000, max_object=6_000, sky_resolution=128),
        densify=DensifyOptions(start=0.0, stop=1.0, every=ROUND, max_gaussians=1, reset_every=0),
    )


def _street() -> DrivingLog:
    config = SyntheticConfig(
        seed=5,
        frames=4,
        width=SIZE[0],
        height=SIZE[1],
        samples=1,
        cameras=(CameraSpec("front", fov=math.radians(81)),),
    )
    return generate_log(config)


def _first_scene(log: DrivingLog, options: TrainOptions, gaussians: int) -> Scene:
    scene = initialise_scene(log, options=options.initialise)
    fraction = min(1.0, gaussians / scene.gaussian_count)
    objects = {k: replace(o, cloud=_thinned(o.cloud, fraction)) for k, o in scene.objects.items()}
    held = sum(len(o.cloud) for o in objects.values())
    rest = max(0, gaussians - held) / max(1, len(scene.background))
    return replace(scene, background=_thinned(scene.background, rest), objects=objects)


def _thinned(cloud: GaussianCloud, fraction: float) -> GaussianCloud:
    kept = np.linspace(0, len(cloud) - 1, round(len(cloud) * min(fraction, 1.0))).round()
    return cloud.select(torch.from_numpy(kept.astype(np.int64)))
