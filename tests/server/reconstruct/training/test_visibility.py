from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.training import SceneModel, Trainer
from real2sim_server.reconstruct.training.densify import (
    DensifyOptions,
    SelectiveAdam,
    VisibilityLimits,
)
from real2sim_server.reconstruct.training.gaussians import Gaussians, concatenate
from real2sim_server.reconstruct.training.visibility import (
    GaussianVisibility,
    OfferedPriors,
    bare_ground,
    behind_objects,
    hardly_seen,
    hidden_sky,
    occluded_priors,
    prune_hidden,
    unoccluded_weights,
    visibility,
)
from real2sim_server.render import Instance
from real2sim_server.scene import Camera, GaussianCloud, SceneObject, Trajectory

from .conftest import TINY
from .test_densify import COUNTS, marked, some_gaussians

LIMITS = DensifyOptions()


@pytest.fixture
def model(tiny_scene) -> SceneModel:
    times = np.array([tiny_scene.start_us, tiny_scene.end_us])
    return SceneModel(tiny_scene, replace(TINY, refine_poses=False), times, backend="cpu")


@pytest.fixture
def viewpoints(tiny_scene) -> list[tuple[Camera, int]]:
    return [(camera, tiny_scene.start_us) for camera in tiny_scene.rig]


def ahead(model: SceneModel, depth: float, scale: float, opacity: float) -> GaussianCloud:
    """An isotropic Gaussian on the axis of the first camera at the start."""
    scene = model.scene
    T = np.linalg.inv(scene.rig.cameras[0].viewmat(scene.ego.transform(scene.start_us)))
    mean = torch.from_numpy(T @ [0, 0, depth, 1])[:3].float()
    return GaussianCloud(
        means=mean[None],
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.full((1, 3), scale),
        opacities=torch.tensor([opacity]),
        sh=torch.zeros(1, 1, 3),
    )


def model_of(
    model: SceneModel, clouds: list[GaussianCloud], *, subject: list[GaussianCloud] | None = None
) -> SceneModel:
    """A model of ``clouds`` and of an object whose frame is the world frame."""
    objects = {}
    if subject is not None:
        times = np.array([model.scene.start_us, model.scene.end_us])
        still = Trajectory(times, np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
        cloud = GaussianCloud.concatenate(subject)
        objects["car"] = SceneObject("car", "car", (4.0, 2.0, 1.5), cloud, still)
    scene = replace(
        model.scene,
        background=GaussianCloud.concatenate(clouds),
        objects=objects,
        content_hash="",
    )
    opaque = replace(model.options, initial_opacity=0.99)
    return SceneModel(scene, opaque, np.zeros(0, np.int64), backend="cpu")


def dropped(
    gaussians: Gaussians,
    optimizer: SelectiveAdam,
    seen: GaussianVisibility,
    *,
    object_limits: VisibilityLimits = LIMITS.object_limits,
) -> Gaussians:
    return prune_hidden(
        gaussians,
        optimizer,
        seen,
        background_limits=LIMITS.background_limits,
        object_limits=object_limits,
    )


def fractions_of(model: SceneModel, viewpoints: list[tuple[Camera, int]]) -> torch.Tensor:
    return visibility(model, viewpoints).fractions


def test_a_single_gaussian_is_fully_visible(model, viewpoints):
    [fraction] = fractions_of(model_of(model, [ahead(model, 5, 0.2, 0.7)]), viewpoints)
    assert fraction == pytest.approx(1, abs=0.02)


def test_a_gaussian_behind_an_opaque_wall_is_hidden(model, viewpoints):
    wall = [ahead(model, 4 + 0.01 * k, 1.0, 0.99) for k in range(4)]
    fractions = fractions_of(model_of(model, [*wall, ahead(model, 8, 0.05, 0.7)]), viewpoints)
    assert fractions[0] > 0.8
    assert fractions[-1] < 1e-3


def test_a_gaussian_behind_a_half_transparent_wall_is_half_visible(model, viewpoints):
    fractions = fractions_of(
        model_of(model, [ahead(model, 4, 5.0, 0.5), ahead(model, 8, 0.1, 0.7)]), viewpoints
    )
    assert fractions[1] == pytest.approx(0.5, abs=0.03)


def test_a_gaussian_behind_all_cameras_is_not_visible(model, viewpoints):
    [fraction] = fractions_of(model_of(model, [ahead(model, -5, 0.2, 0.7)]), viewpoints)
    assert fraction == 0


def test_mirrored_vehicle_sides_count_as_seen(tiny_log, tiny_scene):
    viewpoints = Trainer(tiny_log, tiny_scene, TINY, backend="cpu").views.viewpoints()
    times = np.array([tiny_scene.start_us, tiny_scene.end_us])

    def seen(mirror: float) -> torch.Tensor:
        options = replace(TINY, refine_poses=False, mirror=mirror)
        model = SceneModel(tiny_scene, options, times, backend="cpu")
        return (fractions_of(model, viewpoints) > 0.05)[model.gaussians.counts[0] :]

    plain, mirrored = seen(0.0), seen(0.5)
    assert bool((mirrored & ~plain).any())


def test_the_unoccluded_weight_is_opacity_times_image_area(model):
    camera = model.scene.rig.cameras[0]
    viewmat = torch.from_numpy(camera.viewmat(model.scene.ego.transform(model.scene.start_us)))
    [weight] = unoccluded_weights(Instance(ahead(model, 5, 0.2, 0.7)), viewmat, camera)
    squared = (camera.K[0, 0] * 0.2 / 5) ** 2 + 0.3
    assert weight == pytest.approx(0.7 * 2 * math.pi * squared, rel=1e-3)


def test_hidden_gaussians_are_pruned_by_the_limits_of_their_owner():
    gaussians = some_gaussians()
    optimizer: SelectiveAdam = marked(gaussians)
    fractions = torch.full((len(gaussians),), 0.03)
    fractions[:5] = 0.001
    seen = GaussianVisibility(fractions, *torch.zeros(2, len(gaussians)))
    left = dropped(gaussians, optimizer, seen, object_limits=VisibilityLimits(fraction=0.05))
    assert left.counts == (COUNTS[0] - 5, 0, 0)
    torch.testing.assert_close(optimizer.first["means"], left.means.detach())
    torch.testing.assert_close(left.means, gaussians.means[5 : COUNTS[0]])


def test_barely_visible_gaussians_are_pruned_only_behind_the_surface():
    gaussians = some_gaussians()
    fractions, depths = torch.full((len(gaussians),), 0.02), torch.zeros(len(gaussians))
    depths[2], depths[3], fractions[3] = 0.5, 0.5, 0.5
    seen = GaussianVisibility(fractions, depths, torch.zeros_like(depths))
    left = dropped(gaussians, marked(gaussians), seen)
    kept = [i for i in range(len(gaussians)) if i != 2]
    torch.testing.assert_close(left.means, gaussians.means[kept])


def test_object_limits_prune_shallower_and_more_visible_gaussians():
    gaussians = some_gaussians()
    seen = GaussianVisibility(*(torch.full((len(gaussians),), value) for value in (0.2, 0.25, 0)))
    left = dropped(gaussians, marked(gaussians), seen, object_limits=LIMITS.last_object_limits)
    assert left.counts == (COUNTS[0], 0, 0)


def test_depth_behind_the_surface_is_measured_along_the_axis(model, viewpoints):
    wall = [ahead(model, 4, 5.0, 0.9)]
    seen = visibility(model_of(model, [*wall, ahead(model, 8, 0.1, 0.5)]), viewpoints[:1])
    surface = (4 * 0.9 + 8 * 0.1 * 0.5) / (0.9 + 0.1 * 0.5)
    assert float(seen.depths[1]) == pytest.approx(8 - surface, abs=0.15)
    assert float(seen.depths[0]) == pytest.approx(0, abs=0.1)


def test_the_sky_is_hidden_where_covered_or_out_of_view(model, viewpoints):
    wall = [ahead(model, 4, 30.0, 0.99)]
    bare, walled = model_of(model, [ahead(model, -5, 0.1, 0.5)]), model_of(model, wall)
    open_to_view = ~hidden_sky(bare, viewpoints)
    assert 0 < int(open_to_view.sum()) < open_to_view.numel()
    assert int((~hidden_sky(walled, viewpoints)).sum()) < 0.8 * int(open_to_view.sum())


def test_gaussians_are_concatenated_by_owner():
    a, b = some_gaussians(), some_gaussians()
    both, of_b = concatenate(a, b)
    assert both.counts == tuple(2 * n for n in COUNTS)
    torch.testing.assert_close(both.select((~of_b).nonzero()[:, 0]).fourier, a.fourier)
    torch.testing.assert_close(both.select(of_b.nonzero()[:, 0]).means, b.means)


def test_only_occluded_priors_are_restored(model, viewpoints):
    wall = [ahead(model, 4, 3.0, 0.99), ahead(model, 4.1, 3.0, 0.99)]
    behind, beside = ahead(model, 8, 0.2, 0.7), ahead(model, 3, 0.2, 0.7)
    trained, first = model_of(model, wall), model_of(model, [*wall, behind, beside])
    priors = occluded_priors(trained, first, viewpoints, limit=0.05)
    torch.testing.assert_close(priors.means, behind.means)
    assert len(trained.gaussians) == len(wall)


def test_priors_exposed_by_training_are_not_restored(model, viewpoints):
    wall = [ahead(model, 4, 3.0, 0.99)]
    trained = model_of(model, [ahead(model, 12, 0.2, 0.7)])
    first = model_of(model, [*wall, ahead(model, 8, 0.2, 0.7)])
    assert len(occluded_priors(trained, first, viewpoints, limit=0.05)) == 0


def test_occluded_object_priors_are_restored_even_if_initially_visible(model, viewpoints):
    shown, wall = ahead(model, 8, 0.2, 0.7), [ahead(model, 4, 3.0, 0.99)] * 3
    trained, first = model_of(model, wall, subject=wall), model_of(model, [shown], subject=[shown])
    assert occluded_priors(trained, first, viewpoints, limit=0.05).counts == (0, 1)


def test_wanted_priors_are_restored_even_if_visible(model, viewpoints):
    shown = [ahead(model, 8, 0.2, 0.7)]
    trained = model_of(model, [ahead(model, 12, 0.2, 0.7)], subject=[ahead(model, 20, 0.2, 0.7)])
    first = model_of(model, [ahead(model, 12, 0.2, 0.7)], subject=shown)
    wanted = torch.tensor([False, True])
    assert occluded_priors(trained, first, viewpoints, limit=0.05).counts == (0, 0)
    found = occluded_priors(trained, first, viewpoints, limit=0.05, wanted=wanted)
    assert found.counts == (0, 1)


def test_priors_occluded_only_by_other_priors_are_not_restored(model, viewpoints):
    wall = [ahead(model, 4, 3.0, 0.99)]
    trained = model_of(model, [ahead(model, 12, 0.2, 0.7)])
    pair = [ahead(model, 8, 0.2, 0.99), ahead(model, 8.5, 0.1, 0.99)]
    first = model_of(model, [*wall, *pair])
    assert len(occluded_priors(trained, first, viewpoints, limit=0.05)) == 0


def test_training_prunes_hidden_gaussians_at_its_rounds(tiny_log, tiny_scene):
    densify = replace(TINY.densify, method="none", hidden_round=0.05)
    trainer = Trainer(tiny_log, tiny_scene, replace(TINY, densify=densify), backend="cpu")
    before = len(trainer.model.gaussians)
    trainer.run(until=2)
    assert len(trainer.model.gaussians) == before
    trainer.run(until=3)
    assert len(trainer.model.gaussians) < before
    trainer.run(until=5)
    trainer.views.close()


def test_the_first_hidden_alternative_is_taken(model, viewpoints):
    wall = [ahead(model, 4 + 0.01 * k, 1.0, 0.99) for k in range(4)]
    trained = model_of(model, wall, subject=[ahead(model, 30, 0.02, 0.5)])
    offered = [ahead(model, depth, 0.1, 0.9) for depth in (3.0, 6.0, 7.0)]
    first = model_of(model, wall, subject=offered)
    numbers = torch.tensor([-1] * len(wall) + [9, 9, 9])
    taken = occluded_priors(trained, first, viewpoints, limit=0.005, alternatives=numbers)
    assert taken.counts[1] == 1
    assert torch.equal(taken.means[-1], first.gaussians.means[-2])


@pytest.mark.parametrize(
    ("scale", "bodies", "hardly"), [(0.02, True, True), (0.02, False, False), (1.0, True, False)]
)
def test_hardly_visible_objects_with_a_body_are_found(model, viewpoints, scale, bodies, hardly):
    wall = [ahead(model, 40, 3.0, 0.99)]
    trained = model_of(model, wall, subject=[ahead(model, 10, scale, 0.9)])
    numbers = torch.tensor([-1, 7 if bodies else -1])
    seen = visibility(trained, viewpoints)
    found = hardly_seen(trained, seen, OfferedPriors(trained.scene, numbers))
    assert found.tolist() == [False, hardly]


def test_stop_mirroring_disables_mirrored_objects(model):
    model.mirrored = (True, False)
    model.stop_mirroring()
    assert model.mirrored == (False, False)


def test_only_low_background_deep_behind_the_surface_is_removed(model):
    count = len(model.gaussians)
    deep = GaussianVisibility(*(torch.full((count,), value) for value in (0.08, 9.0, 0)))
    found = behind_objects(model, deep, LIMITS.last_background_limits)
    heights = model.gaussians.means.detach()[:, 2]
    background = model.gaussians.owners == 0
    assert found[background & (heights < 0.5) & (heights > -0.1)].float().mean() > 0.9
    assert not found[heights > 6].any()
    assert not found[~background].any()
    shallow = replace(deep, depths=torch.ones(count))
    assert not behind_objects(model, shallow, LIMITS.last_background_limits).any()


def test_ground_is_bare_where_training_removed_it(model, tiny_scene):
    kept = model.gaussians.means[:, 0] > 0
    kept |= model.gaussians.owners > 0
    first = SceneModel(tiny_scene, model.options, np.zeros(0, np.int64), backend="cpu")
    model.gaussians = model.gaussians.select(kept.nonzero()[:, 0])
    ones = torch.ones(len(model.gaussians))
    bare = bare_ground(model, first, GaussianVisibility(ones, *torch.zeros(2, len(ones))))
    means = first.gaussians.means.detach()
    height = tiny_scene.ground.height_at(means[:, :2].double().numpy())
    on_ground = torch.from_numpy(np.abs(means[:, 2].numpy() - height) < 0.01)
    on_ground &= first.gaussians.owners == 0
    assert bare[on_ground & (means[:, 0] < -3)].float().mean() > 0.9
    assert not bare[on_ground & (means[:, 0] > 0)].any()
    assert not bare[first.gaussians.owners > 0].any()
