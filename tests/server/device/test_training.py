"""Training on the device mixes no devices, copies no parameters, and learns the same as the CPU."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from real2sim_server.logs import DrivingLog
from real2sim_server.reconstruct.initialise.stage0 import initialise_scene
from real2sim_server.reconstruct.options import InitialiseOptions
from real2sim_server.reconstruct.training.run import one_torch_thread
from real2sim_server.reconstruct.training.schedule import (
    DensifyOptions,
    DirectionOptions,
    TrainOptions,
)
from real2sim_server.reconstruct.training.trainer import Trainer
from real2sim_server.render.backend import Backend
from real2sim_server.scene import GaussianCloud, Scene
from real2sim_server.synthetic import CameraSpec, SyntheticConfig, generate_log

from . import pretended

OPTIONS = TrainOptions(
    iterations=50,
    hold_out=0,
    sky_resolution=8,
    checkpoint_every=0,
    log_every=1000,
    width=32,
    max_width=32,
    # Full people have more Gaussians than the stand-in renders in a minute.
    directions=DirectionOptions(close=False),
    initialise=InitialiseOptions(
        voxel=1.0, ground_spacing=2.0, object_voxel=0.5, sky_resolution=8, max_colour_frames=2
    ),
)


@pytest.fixture(scope="module")
def log() -> DrivingLog:
    camera = CameraSpec("front", fov=math.radians(81))
    return generate_log(
        SyntheticConfig(
            seed=5,
            frames=2,
            width=32,
            height=32,
            samples=1,
            cameras=(camera,),
            lidar_beams=16,
            lidar_columns=180,
            parked_cars=2,
            moving_cars=1,
        )
    )


@pytest.fixture(scope="module")
def scene(log: DrivingLog) -> Scene:
    made = initialise_scene(log, options=OPTIONS.initialise)
    objects = {
        name: replace(item, cloud=thinned(item.cloud, 8)) for name, item in made.objects.items()
    }
    return replace(made, background=thinned(made.background, 150), objects=objects)


def thinned(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """At most this many Gaussians, enlarged, so that the stand-in renders in seconds."""
    step = max(1, -(-len(cloud) // count))
    kept = cloud.select(torch.arange(0, len(cloud), step))
    return replace(kept, scales=kept.scales * step**0.5)


def trained(
    log: DrivingLog, scene: Scene, options: TrainOptions, backend: str | Backend, steps: int
) -> tuple[Trainer, list[float]]:
    trainer = Trainer(log, scene, options, backend=backend)
    losses = [sum(trainer.step().values()) for _ in range(steps)]
    trainer.views.close()
    return trainer, losses


@pytest.mark.parametrize(
    ("method", "steps"),
    [
        ("gradient", 6),
        ("mcmc", 5),
        pytest.param("gradient", 50, marks=pytest.mark.slow),
        pytest.param("mcmc", 50, marks=pytest.mark.slow),
    ],
)
def test_parameters_and_optimizer_state_are_on_the_device(
    log: DrivingLog, scene: Scene, cuda_backend: Backend, method: str, steps: int, tmp_path: Path
) -> None:
    densify = DensifyOptions(
        method=method, every=max(1, steps // 5), reset_every=max(2, steps // 3), start=0.0, stop=0.8
    )
    weights = replace(OPTIONS.losses, object_entropy=0.1, sky=0.1, opacity=0.01, scale=0.01)
    rates = replace(OPTIONS.learning_rates, camera=1e-4)
    options = replace(
        OPTIONS,
        iterations=steps,
        densify=densify,
        losses=weights,
        learning_rates=rates,
        harmonics=2,
        checkpoint_every=steps,
    )
    trainer = Trainer(log, scene, options, folder=tmp_path, backend=cuda_backend)
    with one_torch_thread():
        trainer.run()
    trainer.views.close()
    state = {**trainer.model.parameters(), **trainer.optimizer.state()}
    assert {tensor.device.type for tensor in state.values()} == {"pretended"}
    exported = trainer.model.export()
    assert exported.background.device == torch.device("cpu")
    resumed = Trainer(log, scene, options, folder=tmp_path, backend=cuda_backend)
    resumed.resume()
    resumed.views.close()
    assert resumed.iteration == steps
    assert resumed.model.gaussians.means.device.type == "pretended"


def test_training_on_the_device_matches_the_cpu(
    log: DrivingLog, scene: Scene, cuda_backend: Backend
) -> None:
    densify = DensifyOptions(method="none", hidden_round=0, prior_round=0)
    options = replace(OPTIONS, densify=densify)
    here, losses = trained(log, scene, options, cuda_backend, 6)
    there, expected = trained(log, scene, options, "cpu", 6)
    assert losses == pytest.approx(expected, rel=2e-3)
    for name in ("means", "log_scales", "sh"):
        given = here.model.gaussians.tensors()[name].detach().cpu()
        wanted = there.model.gaussians.tensors()[name].detach()
        assert float((given - wanted).abs().mean()) < 1e-3


def test_a_training_step_copies_no_parameter_and_waits_once_for_its_loss(
    log: DrivingLog,
    scene: Scene,
    cuda_backend: Backend,
    device_counts: pretended.Counts,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trainer = Trainer(log, scene, OPTIONS, backend=cuda_backend)
    for _ in range(len(trainer.views)):
        trainer.step()
    moved: list[tuple[int, ...]] = []
    monkeypatch.setattr(pretended, "on_copy", lambda shape: moved.append(tuple(shape)))
    before = replace(device_counts)
    trainer.step()
    trainer.views.close()
    count = len(trainer.model.gaussians)
    assert [shape for shape in moved if shape and max(shape) >= 64] == []
    assert device_counts.to_host - before.to_host <= 1
    assert count > 64
