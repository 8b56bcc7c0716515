from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.initialise.vehicle_body import fitted_body
from real2sim_server.reconstruct.training import SceneModel
from real2sim_server.reconstruct.training.visibility import (
    ViewingDirections,
    paint_unseen_sides,
    plain_lobes,
    unseen_sides,
    viewing_directions,
)
from real2sim_server.scene import GaussianCloud, SceneObject, Trajectory
from real2sim_server.scene.cloud import SH_C0, evaluate_sh

from .conftest import TINY

AHEAD = torch.tensor([1.0, 0, 0])


def model_of(sh) -> SimpleNamespace:
    """A model with one Gaussian of an object."""
    return SimpleNamespace(gaussians=SimpleNamespace(sh=sh.clone(), counts=(0, 1)))


def seen_from(directions: torch.Tensor) -> ViewingDirections:
    """Viewing statistics of one Gaussian seen along directions [V, 3]."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    products = (unit[:, :, None] * unit[:, None]).mean(0)
    count = torch.tensor([float(len(unit))])
    return ViewingDirections(count, unit.mean(0)[None], products[None], -torch.ones(1))


def colour(model, direction) -> torch.Tensor:
    return evaluate_sh(model.gaussians.sh, direction[None]) + 0.5


def test_a_colour_seen_from_one_direction_becomes_view_independent():
    sh = torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(1))
    model = model_of(sh)
    shown = colour(model, AHEAD)
    plain_lobes(model, seen_from(AHEAD[None]))
    np.testing.assert_allclose(colour(model, AHEAD), shown, atol=1e-5)
    np.testing.assert_allclose(colour(model, torch.tensor([0.0, 1, 0])), shown, atol=1e-5)


def test_a_colour_seen_from_all_sides_is_kept():
    sh = torch.randn(1, 4, 3, generator=torch.Generator().manual_seed(1))
    around = torch.randn(500, 3, generator=torch.Generator().manual_seed(2))
    model = model_of(sh)
    plain_lobes(model, seen_from(around))
    np.testing.assert_allclose(model.gaussians.sh[0], sh[0], atol=0.25)


@pytest.fixture
def model(tiny_scene) -> SceneModel:
    times = np.array([tiny_scene.start_us, tiny_scene.end_us])
    return SceneModel(tiny_scene, replace(TINY, refine_poses=False), times, backend="cpu")


def test_viewing_directions_point_from_the_camera_to_visible_gaussians(model, tiny_scene):
    camera, t_us = tiny_scene.rig.cameras[0], tiny_scene.start_us
    seen = viewing_directions(model, [(camera, t_us)])
    background = slice(0, model.gaussians.counts[0])
    views, means = seen.views[background], seen.means[background]
    pose = camera.pose(tiny_scene.ego.transform(t_us))
    offset = model.gaussians.means.detach()[background] - torch.from_numpy(pose[:3, 3]).float()
    expected = torch.nn.functional.normalize(offset, dim=-1)
    assert 0 < int((views > 0).sum()) < len(views)
    np.testing.assert_allclose(means[views > 0], expected[views > 0], atol=1e-5)
    assert (means[views == 0] == 0).all()


SALOON = (4.7, 1.82, 1.46)


RED = torch.tensor([0.8, 0.1, 0.1])


@pytest.fixture
def followed(tiny_scene):
    """The untrained model of a red car seen from behind, its views and its body."""
    body = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    times = np.array([tiny_scene.start_us, tiny_scene.end_us])
    pose = tiny_scene.ego.transform(tiny_scene.start_us) @ np.array(
        [[1, 0, 0, 12.0], [0, 1, 0, 0], [0, 0, 1, 0.75], [0, 0, 0, 1]]
    )
    path = Trajectory.from_transforms(times, np.stack([pose, pose]))
    places = torch.tensor([[-2.3, 0.0, 0.0], [0.0, 0.89, -0.1], [0.0, -0.89, -0.1], [2.3, 0, 0]])
    cloud = GaussianCloud(
        places,
        torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4),
        torch.full((4, 3), 0.05),
        torch.full((4,), 0.9),
        ((RED - 0.5) / SH_C0).expand(4, 1, 3),
    )
    car = SceneObject("car", "car", SALOON, cloud, path)
    scene = replace(tiny_scene, objects={"car": car}, content_hash="")
    model = SceneModel(scene, replace(TINY, refine_poses=False), times, backend="cpu")
    return model, [(camera, scene.start_us) for camera in scene.rig], body


def test_the_flanks_of_a_car_seen_from_behind_are_unseen(followed):
    model, viewpoints, body = followed
    unseen = unseen_sides(model, viewpoints, [body])[-4:]
    assert unseen.tolist() == [False, True, True, True]
    assert not unseen_sides(model, viewpoints, [None]).any()


def test_unseen_flanks_keep_their_seen_colour_and_get_paint_from_ahead(followed):
    model, viewpoints, body = followed
    with torch.no_grad():
        model.gaussians.sh[-4:] = torch.randn(4, 4, 3, generator=torch.Generator().manual_seed(3))
    learnt = model.gaussians.sh.detach()[-4:].clone()
    seen = viewing_directions(model, viewpoints, objects_only=True).means[-4:]
    paint_unseen_sides(model, viewpoints, [body])
    painted = model.gaussians.sh.detach()[-4:]
    assert torch.equal(painted[0], learnt[0])
    as_seen = [evaluate_sh(sh[1:3], seen[1:3]) for sh in (painted, learnt)]
    np.testing.assert_allclose(*as_seen, atol=1e-4)
    from_ahead = torch.tensor([[0.0, -1, 0], [0, 1, 0]])
    shown = evaluate_sh(painted[1:3], from_ahead) + 0.5
    np.testing.assert_allclose(shown, RED.expand(2, 3), atol=0.02)


def test_an_initial_point_in_another_colour_does_not_colour_an_unseen_flank(followed):
    model, viewpoints, body = followed
    car = model.scene.objects["car"]
    sh = car.cloud.sh.clone()
    sh[1] = (torch.tensor([0.1, 0.8, 0.1]) - 0.5) / SH_C0
    model.scene = replace(
        model.scene,
        objects={"car": replace(car, cloud=replace(car.cloud, sh=sh))},
        content_hash="",
    )
    paint_unseen_sides(model, viewpoints, [body])
    from_left = evaluate_sh(model.gaussians.sh.detach()[-3:-2], torch.tensor([[0.0, -1, 0]])) + 0.5
    np.testing.assert_allclose(from_left, RED[None], atol=0.02)
