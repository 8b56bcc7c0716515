from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace

import numpy as np
import pytest
import torch

from real2sim_server.logs import DrivingLog, LidarSweep
from real2sim_server.reconstruct import ReconstructError
from real2sim_server.reconstruct.evaluation import render_logged_view
from real2sim_server.reconstruct.evaluation.rendering import scene_instances
from real2sim_server.reconstruct.training import (
    DensifyOptions,
    Trainer,
    held_out_frames,
    score_held_out,
)
from real2sim_server.reconstruct.training.data import TrainingViews
from real2sim_server.reconstruct.training.gaussians import mirror
from real2sim_server.reconstruct.training.losses import psnr_of
from real2sim_server.reconstruct.training.run import one_torch_thread
from real2sim_server.reconstruct.training.schedule import PRESETS, DirectionOptions
from real2sim_server.render import RasterOptions, rasterize
from real2sim_server.render.images import to_display, to_light
from real2sim_server.scene import Scene
from real2sim_server.scene.cloud import sh_basis
from real2sim_server.scene.io import load_scene, save_scene

from .conftest import TINY


@pytest.fixture(autouse=True)
def one_thread():
    with one_torch_thread():
        yield


@pytest.fixture(scope="module")
def trained(tiny_log, tiny_scene):
    trainer = Trainer(tiny_log, tiny_scene, TINY)
    before = mean_psnr(trainer)
    trainer.run()
    trainer.views.close()
    return trainer, before


def mean_psnr(trainer: Trainer) -> float:
    """Mean PSNR over the training images [dB]."""
    errors = []
    for index in range(len(trainer.views)):
        view = trainer.views.view(index)
        with torch.no_grad():
            image = trainer.model.render(view.camera, view.t_us).rgb
        errors.append(psnr_of(float((image - view.image).square().mean())))
    return float(np.mean(errors))


def test_training_improves_the_training_images(trained):
    trainer, before = trained
    assert mean_psnr(trainer) > before + 1


def test_a_grey_scene_learns_its_colours(tiny_log, tiny_scene):
    grey = replace(tiny_scene.background, sh=torch.zeros_like(tiny_scene.background.sh))
    scene = replace(tiny_scene, background=grey)
    trainer = Trainer(tiny_log, scene, replace(TINY, densify=DensifyOptions(method="none")))
    before = mean_psnr(trainer)
    trainer.run()
    assert mean_psnr(trainer) > before + 3


@dataclass(frozen=True)
class Exposed:
    """A log with a second camera, or some frames, half a stop brighter."""

    log: DrivingLog
    bright_frames: tuple[int, ...]

    def image(self, camera: str, frame: int) -> np.ndarray:
        image = self.log.image("front", frame)
        if camera == "front" and frame not in self.bright_frames:
            return image
        return to_display(to_light(image) * np.float32(2**0.5))

    def lidar(self, frame: int) -> LidarSweep:
        return self.log.lidar(frame)


def exposed(log: DrivingLog, scene: Scene, *, by_camera: bool) -> tuple[DrivingLog, Scene]:
    cameras = [log.rig["front"]]
    if by_camera:
        cameras.append(replace(log.rig["front"], name="bright"))
    rig = replace(log.rig, cameras=tuple(cameras))
    source = Exposed(log, () if by_camera else (1, 4, 5))
    return replace(log, rig=rig, source=source, image_times_us={}), replace(scene, rig=rig)


@pytest.mark.parametrize(
    "by_camera",
    [pytest.param(True, id="camera", marks=pytest.mark.slow), pytest.param(False, id="image")],
)
def test_exposure_differences_are_learnt(tiny_log, tiny_scene, by_camera):
    log, scene = exposed(tiny_log, tiny_scene, by_camera=by_camera)
    learnt = {"exposure": 0.01} if by_camera else {"image_exposure": 0.02}
    rates = replace(TINY.learning_rates, **learnt)
    still = replace(TINY, densify=DensifyOptions(method="none"), iterations=40)
    with_it = Trainer(log, scene, replace(still, learning_rates=rates))
    without = Trainer(log, scene, still)
    with_it.run()
    without.run()
    assert mean_psnr(with_it) > mean_psnr(without) + 0.5
    grey, times = torch.full((1, 1, 3), 0.5), log.frame_times_us
    model = with_it.model
    bright, frame = ("bright", 3) if by_camera else ("front", 4)
    with torch.no_grad():
        more = model.exposed(grey, log.rig[bright], int(times[frame])).mean()
        less = model.exposed(grey, log.rig["front"], int(times[3])).mean()
    # Half a stop is a factor of about 1.17 in display values at mid grey.
    assert 1.05 < float(more / less) < 1.3


@pytest.mark.parametrize("name", PRESETS)
def test_every_loss_of_a_preset_is_evaluated(tiny_log, tiny_scene, name):
    options = replace(TINY, iterations=100, losses=PRESETS[name].losses)
    options = replace(options, learning_rates=PRESETS[name].learning_rates)
    wanted = {k for k, weight in asdict(options.losses).items() if weight > 0} - {"needle_ratio"}
    if options.learning_rates.exposure == 0:
        wanted.remove("exposure")
    trainer = Trainer(tiny_log, tiny_scene, options)
    trainer.iteration = 90
    terms = trainer.step()
    trainer.views.close()
    # SSIM is part of the picture term.
    assert set(terms) == (wanted - {"ssim"}) | {"picture"}


def test_views_have_a_sky_mask_only_for_the_sky_loss(tiny_log):
    views = TrainingViews(tiny_log, [0, 3], TINY)
    for index in range(2):
        sky, half = (views.view(index, divisor).sky for divisor in (1, 2))
        assert sky.shape == (64, 96)
        assert half.shape == (32, 48)
        assert 0.02 < float((half > 0).float().mean()) <= float((sky > 0).float().mean()) < 0.4
        assert (sky[:32] >= 0).all()
        assert (sky[36:] == -1).all()
        assert (half[18:] == -1).all()
    without = replace(TINY, losses=replace(TINY.losses, sky=0.0))
    assert TrainingViews(tiny_log, [0], without).view(0).sky is None


def test_held_out_views_are_scored_overall_and_on_objects(trained, tiny_log):
    trainer, _ = trained
    score = score_held_out(trainer.model, tiny_log, TINY)
    assert score.views == 1
    assert 15 < score.psnr < 40
    assert 10 < score.psnr_objects < 40
    assert 0.3 < score.ssim < 1


def test_the_exported_scene_renders_like_the_model(trained, tiny_log):
    trainer, _ = trained
    scene = trainer.model.export(stage=1)
    camera, t_us = tiny_log.rig.cameras[0], int(tiny_log.frame_times_us[3])
    with torch.no_grad():
        model = trainer.model.render(camera, t_us).rgb.clamp(0, 1)
    exported = render_logged_view(scene, camera, t_us)
    assert np.abs(model.numpy() * 255 - exported).max() < 1.51
    assert any(o.colour is not None for o in scene.objects.values())


@pytest.mark.parametrize(
    ("changes", "rounding"),
    [({"harmonics": 0, "refine_poses": False}, 0.0), ({}, 1e-6)],
    ids=["to the last bit", "moving boxes and colours"],
)
def test_the_saved_scene_renders_like_the_model_with_a_saturated_sky(
    tiny_log, tiny_scene, tmp_path, changes, rounding
):
    rates = replace(TINY.learning_rates, sky=(0.5, 0.5))
    options = replace(TINY, iterations=20, learning_rates=rates, **changes)
    trainer = Trainer(tiny_log, tiny_scene, options)
    trainer.run()
    trainer.views.close()
    save_scene(trainer.model.export(), tmp_path / "street.r2s")
    scene = load_scene(tmp_path / "street.r2s")
    assert 0 == trainer.model.sky.min() < trainer.model.sky.max() == 1
    camera, t_us = tiny_log.rig.cameras[0], int(tiny_log.frame_times_us[3])
    with torch.no_grad():
        trained = trainer.model.render(camera, t_us).rgb
    written = rasterize(
        scene_instances(scene, t_us),
        torch.from_numpy(camera.viewmat(scene.ego.transform(t_us)))[None],
        camera.K[None],
        camera.width,
        camera.height,
        sky=scene.sky,
        options=RasterOptions(depth=False, instance=False),
    )
    assert float((trained - written.rgb[0]).abs().max()) <= rounding


def test_an_exported_scene_shares_no_memory_with_the_model(trained):
    trainer, _ = trained
    scene = trainer.model.export()
    before = scene.background.means.clone()
    with torch.no_grad():
        trainer.model.gaussians.means.add_(1)
        trainer.model.gaussians.means.sub_(1)
        trainer.model.gaussians.means[0] += 5
    assert torch.equal(scene.background.means, before)


def test_priors_are_added_at_their_round_stay_fixed_and_are_exported(tiny_log, tiny_scene):
    options = replace(TINY, iterations=20)
    trainer = Trainer(tiny_log, tiny_scene, options)
    trainer.run(until=16)
    assert trainer.model.priors is None
    trainer.run(until=17)
    priors = trainer.model.priors
    given = {name: tensor.detach().clone() for name, tensor in priors.tensors().items()}
    trainer.run()
    trainer.views.close()
    assert len(priors) > 0
    for name, tensor in given.items():
        assert torch.equal(priors.tensors()[name], tensor), name
    exported = trainer.model.export().background
    assert len(exported) == trainer.model.gaussians.counts[0] + priors.counts[0]
    torch.testing.assert_close(exported.means[-1], given["means"][priors.counts[0] - 1])


def losses_of(folder) -> list[tuple[int, float]]:
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [(line["iteration"], line["loss"]) for line in map(json.loads, lines)]


BROKEN_OFF = replace(TINY, iterations=40, mirror=0.5, directions=DirectionOptions())


@pytest.fixture(scope="module")
def whole(tiny_log, tiny_scene, tmp_path_factory):
    """A complete run and its folder."""
    folder = tmp_path_factory.mktemp("whole")
    trainer = Trainer(tiny_log, tiny_scene, BROKEN_OFF, folder=folder)
    trainer.run()
    return trainer, folder


@pytest.mark.parametrize(
    ("every", "until", "since"), [(20, 33, 20), (12, 38, 36)], ids=["early", "among priors"]
)
@pytest.mark.slow
def test_a_resumed_run_is_bit_identical(tiny_log, tiny_scene, whole, tmp_path, every, until, since):
    expected, folder = whole
    options = replace(BROKEN_OFF, checkpoint_every=every)
    Trainer(tiny_log, tiny_scene, options, folder=tmp_path).run(until=until)
    resumed = Trainer(tiny_log, tiny_scene, options, folder=tmp_path)
    resumed.resume()
    assert resumed.iteration == since
    resumed.run()
    for name, tensor in expected.model.parameters().items():
        assert torch.equal(tensor, resumed.model.parameters()[name]), name
    assert losses_of(folder) == losses_of(tmp_path)
    assert [i for i, _ in losses_of(tmp_path)] == [10, 20, 30, 40]


def test_resuming_with_other_options_is_refused(tiny_log, tiny_scene, tmp_path):
    options = replace(TINY, iterations=2)
    Trainer(tiny_log, tiny_scene, options, folder=tmp_path).run()
    other = Trainer(tiny_log, tiny_scene, replace(options, seed=1), folder=tmp_path)
    with pytest.raises(ReconstructError, match="other options"):
        other.resume()


def test_resuming_without_a_checkpoint_is_refused(tiny_log, tiny_scene, tmp_path):
    with pytest.raises(ReconstructError, match="no checkpoint"):
        Trainer(tiny_log, tiny_scene, TINY, folder=tmp_path).resume()


@pytest.mark.parametrize("paint", [True, False])
def test_unseen_sides_are_painted_once_after_the_last_step(
    tiny_log, tiny_scene, monkeypatch, paint
):
    painted = []
    monkeypatch.setattr(
        "real2sim_server.reconstruct.training.trainer.paint_unseen_sides",
        lambda model, viewpoints, bodies: painted.append(len(bodies)),
    )
    directions = DirectionOptions(paint=paint, views=1)
    trainer = Trainer(tiny_log, tiny_scene, replace(TINY, directions=directions))
    for done in (TINY.iterations - 1, TINY.iterations):
        trainer._settle_colours(done)
    assert painted == ([len(tiny_scene.objects)] if paint else [])


def test_held_out_frames_lie_between_training_frames():
    assert held_out_frames(9, 4) == [2, 6]
    assert held_out_frames(7, 4) == [2]
    assert held_out_frames(9, 0) == []


def test_sampled_viewpoints_are_evenly_spaced_for_every_camera(tiny_log):
    front = tiny_log.rig.cameras[0]
    rig = replace(tiny_log.rig, cameras=(front, replace(front, name="left")))
    views = TrainingViews(replace(tiny_log, rig=rig), [0, 1, 3, 4, 5, 6], TINY)
    sampled = views.sample_viewpoints(6)
    views.close()
    for name in rig.names:
        times = [t_us for camera, t_us in sampled if camera.name == name]
        assert times == [int(tiny_log.frame_times_us[f]) for f in (1, 4, 6)]


def test_a_mirrored_cloud_has_mirrored_colours_and_positions(trained):
    trainer, _ = trained
    gaussians = trainer.model.gaussians
    with torch.no_grad():
        cloud = gaussians.clouds(degree=1)[1].with_sh_degree(3)
    random = torch.Generator().manual_seed(0)
    cloud = replace(cloud, sh=torch.randn(len(cloud), 16, 3, generator=random))
    direction = np.array([0.3, 0.5, 0.8])
    direction /= np.linalg.norm(direction)
    basis = torch.from_numpy(sh_basis(direction, 3)).float()
    turned = torch.from_numpy(sh_basis(direction * [1, -1, 1], 3)).float()
    ours = torch.einsum("k,nkc->nc", basis, mirror(cloud).sh)
    theirs = torch.einsum("k,nkc->nc", turned, cloud.sh)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert torch.equal(mirror(cloud).means[:, 1], -cloud.means[:, 1])
