from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import invert_transform
from real2sim_server.reconstruct.initialise.vehicle_body import VehicleBody, fitted_body
from real2sim_server.reconstruct.training import SceneModel, closed_vehicles
from real2sim_server.reconstruct.training.closed_vehicles import (
    INSETS,
    close_followed,
    offer_bodies,
)
from real2sim_server.reconstruct.training.densify import SelectiveAdam, rotation_matrices
from real2sim_server.scene import GaussianCloud, SceneObject, Trajectory
from real2sim_server.scene.cloud import SH_C0

from .conftest import TINY

FORWARD = torch.nn.functional.normalize(torch.tensor([[1.0, 0.1, 0.0]]), dim=1)
SALOON = (4.7, 1.82, 1.46)
GREEN = torch.tensor([0.1, 0.4, 0.2])


@pytest.fixture(scope="module")
def body() -> VehicleBody:
    found = fitted_body(np.zeros((0, 3), np.float32), SALOON, "car")
    assert found is not None
    return found


@pytest.fixture
def ahead(tiny_scene):
    """Camera, time and the pose of a car 12 m ahead."""
    pose = tiny_scene.ego.transform(tiny_scene.start_us)
    pose = pose @ np.array([[1, 0, 0, 12.0], [0, 1, 0, 0], [0, 0, 1, 0.75], [0, 0, 0, 1]])
    return tiny_scene.rig.cameras[0], tiny_scene.start_us, pose


@pytest.mark.parametrize(
    ("origin", "distance", "normal"),
    [
        ((-2.0, 0.0, 0.0), 2.0, (-1, 0, 0)),  # the nearer wall, not the one behind it
        ((0.5, 0.0, 0.0), -0.5, (-1, 0, 0)),  # lines also hit what is behind their origin
        ((-2.0, 9.0, 0.0), None, None),  # a miss
    ],
)
def test_lines_hit_the_first_wall_that_faces_them(origin, distance, normal):
    y, z = np.meshgrid(*[np.arange(-1, 1, 0.03)] * 2)
    wall = np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1)
    places = [np.add(wall, (x, 0, 0)) for x in (0, 1, -1)]
    points = torch.from_numpy(np.concatenate(places)).float()
    normals = torch.tensor([[-1.0, 0, 0], [-1, 0, 0], [1, 0, 0]]).repeat_interleave(len(wall), 0)
    found, at = closed_vehicles._hits(torch.tensor([origin]), FORWARD, points, normals)
    if normal is None:
        torch.testing.assert_close(at, -FORWARD)
        return
    torch.testing.assert_close(found, distance / FORWARD[:, 0], atol=1e-4, rtol=0)
    torch.testing.assert_close(at, torch.tensor([normal], dtype=torch.float32))


def model_of(scene, pose, means: torch.Tensor) -> SceneModel:
    times = np.array([scene.start_us, scene.end_us])
    count = len(means)
    cloud = GaussianCloud(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4),
        torch.full((count, 3), 0.04),
        torch.full((count,), 0.9),
        ((GREEN - 0.5) / SH_C0).expand(count, 1, 3),
    )
    path = Trajectory.from_transforms(times, np.stack([pose, pose]))
    car = SceneObject("car", "car", SALOON, cloud, path)
    scene = replace(scene, objects={"car": car}, content_hash="")
    return SceneModel(scene, replace(TINY, refine_poses=False), times, backend="cpu")


def pixels(camera, scene, t_us, pose, means) -> np.ndarray:
    at = camera.viewmat(scene.ego.transform(t_us)) @ pose
    seen = means.detach().numpy() @ at[:3, :3].T + at[:3, 3]
    projected = seen @ camera.K.T
    return projected[:, :2] / projected[:, 2:]


def deep_tail(body, camera, scene, t_us, pose) -> torch.Tensor:
    """Tail points as after training: correct in the image, but up to 1 m off in depth."""
    tail = body.points[(body.points[:, 0] < -2.2) & (body.normals[:, 0] < -0.7)][::8]
    eye = (invert_transform(pose) @ camera.pose(scene.ego.transform(t_us)))[:3, 3]
    away = (tail - eye) / np.linalg.norm(tail - eye, axis=1, keepdims=True)
    off = np.random.default_rng(5).uniform(-1, 1, (len(tail), 1))
    return torch.from_numpy(tail + off * away).float()


def test_a_tail_spread_in_depth_is_flattened_along_its_rays(tiny_scene, ahead, body):
    camera, t_us, pose = ahead
    means = deep_tail(body, camera, tiny_scene, t_us, pose)
    model = model_of(tiny_scene, pose, means)
    close_followed(model, SelectiveAdam(model.parameters()), [(camera, t_us)], [body])
    count = model.gaussians.counts[0]
    pressed = model.gaussians.means.detach()[count:]
    places = body.points[body.nearest(pressed.numpy().astype(np.float64))]
    assert np.linalg.norm(places - pressed.numpy(), axis=1).max() < 0.12
    was, now = (pixels(camera, tiny_scene, t_us, pose, m) for m in (means, pressed))
    np.testing.assert_allclose(now, was, atol=0.01)
    thickness = model.gaussians.log_scales.detach()[count:].exp().amin(1)
    assert float(thickness.max()) < 0.01


def test_vehicles_seen_from_several_sides_are_unchanged(tiny_scene, ahead, body):
    camera, t_us, pose = ahead
    means = deep_tail(body, camera, tiny_scene, t_us, pose)
    near = replace(camera, T_vehicle_camera=camera.T_vehicle_camera.copy())
    near.T_vehicle_camera[:2, 3] += [4.0, 1.5]
    model = model_of(tiny_scene, pose, means)
    views = [(camera, t_us), (near, t_us)]
    assert close_followed(model, SelectiveAdam(model.parameters()), views, [body]) == [False]
    assert torch.equal(model.gaussians.means.detach()[model.gaussians.counts[0] :], means)


def test_a_vehicle_without_a_body_is_offered_its_initial_cloud(tiny_scene, ahead, body):
    camera, t_us, pose = ahead
    model = model_of(tiny_scene, pose, deep_tail(body, camera, tiny_scene, t_us, pose))
    offered = offer_bodies(model, [False], [None])
    assert offered.scene.objects["car"] is model.scene.objects["car"]
    assert (offered.alternatives < 0).all()


def test_a_followed_vehicle_is_offered_a_painted_body_at_every_inset(tiny_scene, ahead, body):
    camera, t_us, pose = ahead
    means = deep_tail(body, camera, tiny_scene, t_us, pose)
    model = model_of(tiny_scene, pose, means)
    offered = offer_bodies(model, [True], [body])
    drawn = body.drawn > 0
    cloud, count = offered.scene.objects["car"].cloud, int(drawn.sum())
    assert len(cloud) == len(INSETS) * count
    np.testing.assert_allclose(cloud.means[:count], body.points[drawn], atol=1e-5)
    flank = (body.is_paint & (np.abs(body.normals[:, 1]) > 0.95))[drawn]
    colours = 0.5 + SH_C0 * cloud.sh[:count, 0].numpy()[flank]
    np.testing.assert_allclose(colours, np.tile(GREEN, (flank.sum(), 1)), atol=0.06)
    numbers = offered.alternatives[-len(cloud) :].reshape(len(INSETS), count)
    assert (numbers == numbers[0]).all()
    assert len(numbers[0].unique()) == count
    assert (offered.alternatives[: len(model.scene.background)] < 0).all()
    seen_round = offer_bodies(model, [False], [body])
    assert len(seen_round.scene.objects["car"].cloud) == count


def test_bodies_hardly_reach_beyond_their_boxes(tiny_scene, ahead, body):
    camera, t_us, pose = ahead
    model = model_of(tiny_scene, pose, deep_tail(body, camera, tiny_scene, t_us, pose))
    cloud = offer_bodies(model, [False], [body]).scene.objects["car"].cloud
    axes = rotation_matrices(cloud.quats) * cloud.scales[:, None]
    # The distance at which a Gaussian is half transparent.
    spread = 1.18 * axes.square().sum(-1).sqrt()
    over = (cloud.means.abs() + spread).amax(0) - torch.tensor(model.scene.objects["car"].size) / 2
    assert over.max() < 0.05
