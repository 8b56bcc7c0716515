"""People: Gaussians skinned to a walking body, and their storage."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.body import JOINTS, joint_transforms
from real2sim_server.body.gait import GaitStyle, plan_gait
from real2sim_server.geometry import quaternion_to_matrix, yaw_quaternion
from real2sim_server.scene import BundleError, SceneError, SceneObject, Stride, Trajectory
from real2sim_server.scene.asset import person_asset
from real2sim_server.scene.io import (
    load_asset,
    load_scene,
    read_packed,
    save_asset,
    save_scene,
    write_packed,
)
from real2sim_server.scene.io.summary import read_asset_summary


@pytest.fixture(scope="module")
def woman():
    style = GaitStyle(arms=1.2, phase=1.0)
    return person_asset("anna", "woman", height=1.7, gaussians=1500, style=style)


def walk(asset, speed, *, yaw=0.3, seconds=5.0):
    t = np.linspace(0, seconds, 51)
    way = speed * t
    places = np.column_stack([np.cos(yaw) * way, np.sin(yaw) * way, 0 * t + asset.figure.middle])
    return Trajectory((t * 1e6).astype(np.int64), places, yaw_quaternion(np.full(51, yaw)))


def person(asset, trajectory, object_id="anna"):
    size = asset.size
    return SceneObject(object_id, "pedestrian", size, asset.cloud, trajectory, figure=asset.figure)


def test_gaussians_are_skinned_with_the_body(woman):
    trajectory = walk(woman, 1.3)
    figure, t_us = woman.figure, 2_400_000
    posed = figure.posed(woman.cloud, trajectory, t_us)
    ground = trajectory.positions - [0, 0, figure.middle]
    yaws = np.full(51, 0.3)
    gait = plan_gait(figure.body, trajectory.times_us * 1e-6, ground, yaws, figure.style)
    transforms = joint_transforms(figure.body, gait.pose([t_us * 1e-6]))[0]
    rest = woman.cloud.means.double().numpy() + np.array([0, 0, figure.middle])
    chosen = transforms[figure.joints.long().numpy()]
    blended = (chosen * figure.weights.double().numpy()[..., None, None]).sum(axis=1)
    means = (blended[..., :3] @ rest[..., None])[..., 0] + blended[..., 3]
    np.testing.assert_allclose(posed.means, means - [0, 0, figure.middle], atol=1e-4)
    # Gaussians bound to one joint rotate with it.
    alone = figure.weights[:, 0].numpy() > 0.999
    turned = quaternion_to_matrix(posed.quats.double().numpy()[alone])
    before = quaternion_to_matrix(woman.cloud.quats.double().numpy()[alone])
    expected = transforms[figure.joints.numpy()[alone, 0], :, :3] @ before
    assert alone.sum() > 200
    np.testing.assert_allclose(turned, expected, atol=5e-3)
    assert torch.equal(posed.scales, woman.cloud.scales)


@pytest.mark.parametrize("speed", [0.7, 1.4, 2.2, 3.2])
def test_standing_feet_do_not_slide_at_any_speed(woman, speed):
    """A sole on the ground moves at less than 5 cm/s, also between tabulated poses."""
    trajectory = walk(woman, speed)
    figure = woman.figure
    slow = 0
    for side in "lr":
        own = (figure.joints[:, 0] == JOINTS.index(f"ball_{side}")) & (figure.weights[:, 0] > 0.95)
        assert own.sum() > 3
        cloud, part = woman.cloud, own
        times = np.arange(1_003_000, 4_000_000, 10_000)
        places = []
        for t_us in times:
            pose = trajectory.transform(int(t_us))
            toes = figure.posed(cloud, trajectory, int(t_us)).means[part].double().numpy()
            places.append((toes @ pose[:3, :3].T + pose[:3, 3]).mean(axis=0))
        places = np.array(places)
        speeds = np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1) / 0.01
        height = places[:-1, 2]
        standing = height < height.min() + 0.004
        # Exclude touchdown and lift-off at both ends of the stance.
        inside = standing & np.roll(standing, 2) & np.roll(standing, -2)
        slow += inside.sum()
        assert np.percentile(speeds[inside], 95) < 0.05
    assert slow > 40


@pytest.mark.parametrize("speed", [0.7, 1.4, 2.2])
def test_striding_matches_walking_straight(woman, speed):
    """Striding at constant speed matches walking along a straight path."""
    trajectory = walk(woman, speed, yaw=0.0)
    for t_us in (2_000_000, 2_210_000, 2_630_000):
        stride = woman.figure.stride_at(trajectory, t_us)
        assert stride.pace == pytest.approx(speed, abs=0.01)
        found = woman.figure.striding(woman.cloud, stride).means
        away = (found - woman.figure.posed(woman.cloud, trajectory, t_us).means).abs()
        assert float(away.max()) < 0.04
        assert float(away.mean()) < 0.01


@pytest.mark.parametrize("speed", [0.9, 1.4, 3.0])
def test_striding_feet_do_not_slide_at_constant_speed(woman, speed):
    figure, stride = woman.figure, Stride(0.0, speed)
    own = (figure.joints[:, 0] == JOINTS.index("ball_l")) & (figure.weights[:, 0] > 0.95)
    places = []
    for k in range(300):
        toes = figure.striding(woman.cloud, stride).means[own].double().numpy()
        places.append((toes + np.array([speed * 0.01 * k, 0, 0])).mean(axis=0))
        stride = figure.strode(stride, speed=speed, seconds=0.01)
    places = np.array(places)
    speeds = np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1) / 0.01
    standing = places[:-1, 2] < places[:, 2].min() + 0.004
    inside = standing & np.roll(standing, 2) & np.roll(standing, -2)
    assert inside.sum() > 20
    assert np.percentile(speeds[inside], 90) < 0.1


def test_a_halting_person_comes_to_a_standing_pose(woman):
    figure, stride = woman.figure, Stride(7.3, 1.4)
    for _ in range(40):
        stride = figure.strode(stride, speed=0.0, seconds=0.1)
    here = Trajectory(np.array([0]), np.array([[0.0, 0, figure.middle]]), np.eye(4)[:1])
    found = figure.striding(woman.cloud, stride).means
    assert float((found - figure.posed(woman.cloud, here, 0).means).abs().max()) < 0.02


def test_the_step_count_hardly_depends_on_speed(woman):
    """The number of steps depends mostly on distance, since stride length grows with speed."""

    def lifted(speed):
        trajectory = walk(woman, speed, seconds=6.0 / speed)
        own = woman.figure.joints[:, 0] == JOINTS.index("foot_l")
        steps = np.linspace(0, trajectory.end_us, 200).astype(int)
        heights = [
            float(woman.figure.posed(woman.cloud, trajectory, int(t)).means[own, 2].mean())
            for t in steps
        ]
        high = np.array(heights) > (max(heights) + min(heights)) / 2
        return int((np.diff(high.astype(int)) > 0).sum())

    assert lifted(1.0) in range(4, 7)
    assert 0 <= lifted(1.0) - lifted(1.6) <= 2


def test_posed_clouds_are_cached_and_reproducible(woman):
    trajectory = walk(woman, 1.4)
    item = person(woman, trajectory)
    first = item.cloud_at(1_234_567)
    assert item.cloud_at(1_234_567) is first
    again = person(replace(woman, figure=replace(woman.figure)), walk(woman, 1.4))
    assert torch.equal(again.cloud_at(1_234_567).means, first.means)
    assert not torch.equal(item.cloud_at(1_300_000).means, first.means)


def test_a_standing_person_has_feet_on_the_ground_and_arms_down(woman):
    here = Trajectory(np.array([0]), np.array([[3.0, 0, woman.figure.middle]]), np.eye(4)[:1])
    posed = person(woman, here).cloud_at(0)
    assert abs(float(posed.means[:, 2].min()) + woman.figure.middle) < 0.02
    assert float(posed.means[:, 1].abs().max()) < 0.4
    keypoints = woman.figure.keypoints(here, 0)
    assert keypoints.shape == (17, 3)
    assert keypoints[0, 2] > keypoints[5, 2] > keypoints[11, 2] > keypoints[15, 2]


def test_invalid_figures_are_refused(woman, make_cloud):
    trajectory = walk(woman, 1.0)
    with pytest.raises(SceneError, match="1500 rows for 7 Gaussians"):
        SceneObject("a", "pedestrian", woman.size, make_cloud(7), trajectory, figure=woman.figure)
    with pytest.raises(SceneError, match="degree 0"):
        person(replace(woman, cloud=woman.cloud), trajectory).figure.check_cloud(
            woman.cloud.with_sh_degree(1), "a"
        )
    with pytest.raises(SceneError, match="height must be"):
        replace(woman.figure, height=9.0)
    with pytest.raises(SceneError, match="uint8"):
        replace(woman.figure, joints=woman.figure.joints.long())
    with pytest.raises(SceneError, match="unknown build"):
        person_asset("a", "giraffe")
    with pytest.raises(SceneError, match="no clothes 'hat'"):
        person_asset("a", "man", clothes={"hat": (0, 0, 0)})


def same(one, other) -> bool:
    fields = ("shape", "height", "middle", "style")
    tensors = torch.equal(one.joints, other.joints) and torch.equal(one.weights, other.weights)
    return tensors and all(getattr(one, f) == getattr(other, f) for f in fields)


def test_bundles_keep_figures(scene, woman, tmp_path):
    objects = dict(scene.objects) | {"anna": person(woman, walk(woman, 1.4))}
    peopled = save_scene(replace(scene, objects=objects), tmp_path / "a.r2s")
    read = load_scene(tmp_path / "a.r2s")
    assert read.content_hash == peopled.content_hash
    assert same(read.object("anna").figure, woman.figure)
    shown, expected = (s.object("anna").cloud_at(2_000_000).means for s in (read, peopled))
    assert torch.equal(shown, expected)
    assert read.object("car_7").figure is None


def test_assets_keep_figures(woman, tmp_path):
    saved = save_asset(woman, tmp_path / "a.r2a")
    read = load_asset(tmp_path / "a.r2a")
    assert read.content_hash == saved.content_hash
    assert same(read.figure, woman.figure)
    assert read_asset_summary(tmp_path / "a.r2a").nbytes == woman.nbytes


def test_invalid_joints_and_heights_in_assets_are_refused(woman, tmp_path):
    strange = replace(woman, figure=replace(woman.figure, joints=woman.figure.joints + 22))
    with pytest.raises(SceneError, match="joint"):
        save_asset(strange, tmp_path / "a.r2a")
    save_asset(woman, tmp_path / "a.r2a")
    file = tmp_path / "a.r2a" / "scene.json"
    document = json.loads(file.read_text())
    document["content"]["figure"]["height"] = 99.0
    file.write_text(json.dumps(document))
    with pytest.raises(BundleError, match="height must be"):
        load_asset(tmp_path / "a.r2a", verify=False)


def test_packed_scenes_keep_figures(scene, woman, tmp_path):
    objects = dict(scene.objects) | {"anna": person(woman, walk(woman, 1.4))}
    peopled = replace(scene, objects=objects)
    write_packed(peopled, tmp_path / "a.r2s.zip")
    read = read_packed(tmp_path / "a.r2s.zip").object("anna")
    shown, expected = (o.cloud_at(2_000_000).means for o in (read, peopled.object("anna")))
    # Packing reorders Gaussians.
    assert len(shown) == len(expected)
    nearest = torch.cdist(shown, expected).min(dim=1).values
    assert float(nearest.max()) < 1e-3
