"""Recorded sweeps as rays, fitted beam tables and LiDAR surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from real2sim_server.geometry import wrapped
from real2sim_server.logs import LidarSweep
from real2sim_server.logs.driving_log import FrameSource
from real2sim_server.reconstruct.evaluation.lidar import evaluate_sweeps, synthetic_lidar
from real2sim_server.reconstruct.initialise.stage0 import initialise_scene
from real2sim_server.reconstruct.lidar import RecordedRays, fit_lidar_surfaces, recorded_rays
from real2sim_server.reconstruct.lidar.rays import fit_rings
from real2sim_server.reconstruct.options import InitialiseOptions, ReconstructError
from real2sim_server.scene import Beams, GaussianCloud, Lidar, Scene
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log
from real2sim_server.synthetic.street import CameraSpec

CONFIG = SyntheticConfig(
    seed=3,
    frames=5,
    width=96,
    height=64,
    samples=1,
    cameras=(CameraSpec("front"),),
    moving_cars=1,
    parked_cars=2,
    lidar_beams=24,
    lidar_columns=256,
    lidar_noise=0.01,
)


EMPTY = GaussianCloud(
    torch.zeros(0, 3), torch.zeros(0, 4), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 1, 3)
)


@pytest.fixture(scope="module")
def log() -> SyntheticLog:
    return generate_log(CONFIG)


def test_recorded_rays_match_the_ray_cast_ground_truth(log: SyntheticLog) -> None:
    rays = recorded_rays(log, 2)
    assert rays is not None
    lidar = synthetic_lidar(CONFIG)
    truth, reflectivity = log.sweep(lidar, int(log.frame_times_us[2]))
    beams = rays.lidar.beams
    # The rays lie on the casting grid, so compare at its nodes.
    row = np.abs(beams.elevation[:, None] - lidar.beams.elevation[:, 0]).argmin(1)
    turned = np.abs(wrapped(beams.azimuth[:, None] - lidar.beams.azimuth[0]))
    column = turned.argmin(1)
    assert np.abs(beams.elevation - lidar.beams.elevation[row, 0]).max() < 1e-4
    assert turned.min(1).max() < 1e-4
    error = rays.range - truth[row, column]
    assert np.abs(error).max() < 6 * CONFIG.lidar_noise
    assert np.std(error) == pytest.approx(CONFIG.lidar_noise, rel=0.2)
    assert np.abs(rays.intensity - reflectivity[row, column]).mean() < 0.02


def ring_scan(elevations: np.ndarray, jitter: float) -> RecordedRays:  # type: ignore[type-arg]
    """A scan in ring order, anticlockwise from straight ahead, with gaps."""
    rng = np.random.default_rng(0)
    azimuth, elevation, time = [], [], []
    for height in elevations:
        turned = np.sort(rng.choice(np.arange(1000), 900, replace=False)) * 2 * np.pi / 1000
        azimuth.append((turned + np.pi) % (2 * np.pi) - np.pi)
        elevation.append(height + rng.normal(0, jitter, 900))
        time.append(-azimuth[-1] / (2 * np.pi) * 1e5)
    beams = Beams(*(np.concatenate(parts) for parts in (azimuth, elevation, time)))
    count = beams.count
    distance = rng.uniform(3, 40, count)
    return RecordedRays(
        Lidar("scan", beams), distance, np.ones(count, np.float32), np.zeros((count, 3))
    )


def test_rings_are_found_from_a_raw_scan() -> None:
    elevations = np.radians(np.linspace(2, -24, 32))
    rays = ring_scan(elevations, np.radians(0.02))
    rings = fit_rings(rays)
    assert rings is not None
    assert np.allclose(rings.elevation, elevations, atol=np.radians(0.005))
    assert np.degrees(rings.residual) == pytest.approx(0.02, rel=0.2)
    assert np.abs(rings.offset).max() < 0.02
    assert rings.columns == pytest.approx(1000, abs=5)
    assert rings.clockwise
    grid = rings.beams(rays)
    assert grid.shape == (32, rings.columns)
    # Column times match the scan.
    expected = -grid.azimuth[0] / (2 * np.pi) * 1e5
    assert np.abs(grid.time_us[0] - expected)[np.abs(grid.azimuth[0]) < 3].max() < 200


def test_missing_returns_are_recovered() -> None:
    rays = ring_scan(np.radians(np.linspace(2, -24, 32)), np.radians(0.02))
    rings = fit_rings(rays)
    assert rings is not None
    missing = rings.missing(rays)
    # Each of 32 rings fired 1,000 times and received 900 returns.
    assert sum(lidar.beams.count for lidar in missing) == 3200
    fired = np.concatenate([rings.azimuth, *(lidar.beams.azimuth for lidar in missing)])
    steps = fired / (2 * np.pi / 1000)
    assert np.abs(steps - np.rint(steps)).max() < 0.05


def test_surfaces_of_unknown_training_frames_are_refused(log: SyntheticLog) -> None:
    scene = Scene(
        name="made", background=EMPTY, objects={}, sky=None, rig=log.rig, ego=log.ego,
        frame_times_us=log.frame_times_us,
        provenance={"reconstruction": {"held_out_frames": [2]}},
    )  # fmt: skip
    with pytest.raises(ReconstructError, match=r"holds out 1 frames.*do not say"):
        fit_lidar_surfaces(scene, log, surfaces=replace(scene, provenance={}))


def test_a_scan_without_rings_is_not_fitted() -> None:
    rays = ring_scan(np.radians(np.linspace(2, -24, 32)), np.radians(2.0))
    assert fit_rings(rays) is None


@dataclass(frozen=True, eq=False)
class Withholding:
    """A source that fails on access to a held-out frame."""

    source: FrameSource
    held_out: int

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        assert frame != self.held_out
        return self.source.image(camera, frame)

    def lidar(self, frame: int) -> LidarSweep:
        assert frame != self.held_out
        return self.source.lidar(frame)


@pytest.mark.slow
def test_learned_surfaces_improve_held_out_sweeps(log: SyntheticLog) -> None:
    options = InitialiseOptions(max_background=20_000, voxel=0.2, ground_spacing=0.2)
    scene = initialise_scene(log, options=options)
    scene = replace(scene, provenance={"reconstruction": {"held_out_frames": [2]}})
    seen = replace(log, source=Withholding(log.source, 2))
    made, report = fit_lidar_surfaces(scene, seen, options=options, steps=20)
    assert made.lidar is not None
    assert (report.sweeps, report.held_out) == (4, (2,))
    assert set(made.lidar.objects) == set(scene.objects)
    before, after = (evaluate_sweeps(s, log, [2]) for s in (scene, made))
    assert before is not None
    assert after is not None
    assert after.against == "ray-cast truth"
    assert after.mean.median_m < 0.03
    assert after.mean.median_m < before.mean.median_m
    assert after.mean.hit_miss > 0.95
    assert after.mean.intensity_rmse < 0.7 * before.mean.intensity_rmse
