"""The ground of a scene: queries and fitting."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import multiply_quaternions, transform_from, yaw_quaternion
from real2sim_server.scene import GaussianCloud, Ground, SceneError, Trajectory
from real2sim_server.scene.ground_fit import (
    BoxBottoms,
    DrivenPath,
    find_road_plane,
    fit_ground,
    fit_scene_ground,
    road_under,
)

NO_BOXES = BoxBottoms(np.zeros((0, 3)), np.zeros((0, 4, 2)))
NOTHING = GaussianCloud.empty()


def along(positions: np.ndarray, quaternion) -> Trajectory:
    count = len(positions)
    return Trajectory(np.arange(count) * 100_000, positions, np.tile(quaternion, (count, 1)))


def straight(*, bias: float = 0.0) -> Trajectory:
    way = np.arange(0.0, 40.0)
    return along(np.stack([way, 0 * way, 0 * way + bias], axis=1), [1.0, 0.0, 0.0, 0.0])


def slope(*, pitch: float, roll: float) -> Trajectory:
    """East along a plane that rises to the east by ``pitch`` and to the south by ``roll``."""
    nose_up = np.array([math.cos(pitch / 2), 0, -math.sin(pitch / 2), 0])
    banked = np.array([math.cos(roll / 2), math.sin(roll / 2), 0, 0])
    way = np.arange(30.0)
    positions = np.stack([way * math.cos(pitch), 0 * way, way * math.sin(pitch)], axis=1)
    return along(positions, multiply_quaternions(nose_up, banked))


def driven_ground(ego: Trajectory) -> Ground:
    return fit_scene_ground(NOTHING, ego, [])


def box(x: float, y: float, bottom: float) -> SimpleNamespace:
    track = Trajectory(np.array([0]), np.array([[x, y, bottom + 0.75]]), yaw_quaternion(0.3)[None])
    return SimpleNamespace(size=(4.0, 2.0, 1.5), trajectory=track)


# --- queries -----------------------------------------------------------------------------------


def test_heights_are_bilinear_between_the_centres_of_cells():
    ground = Ground(np.array([10.0, 20.0]), 2.0, np.array([[0, 1], [2, 5]]), np.ones((2, 2)))

    at = np.array([[11.0, 21.0], [13.0, 23.0], [12.0, 22.0], [11.0, 22.0]])
    np.testing.assert_allclose(ground.height_at(at), [0, 5, 2, 0.5])


def test_heights_are_clamped_outside_the_grid():
    ground = Ground(np.zeros(2), 1.0, np.array([[0, 1], [2, 5]]), np.ones((2, 2)))

    far = np.array([[-90.0, -90.0], [90.0, 90.0], [90.0, 1.0]])
    np.testing.assert_allclose(ground.height_at(far), [0, 5, 3.5])


def test_single_and_batched_queries_agree_exactly():
    rng = np.random.default_rng(0)
    ground = Ground(np.zeros(2), 0.25, rng.normal(size=(90, 70)), np.ones((90, 70)))
    places = rng.uniform(-5, 30, (200, 2))

    one_by_one = [ground.height(x, y) for x, y in places.tolist()]
    np.testing.assert_array_equal(ground.height_at(places), one_by_one)
    poses = [ground.pose_on(x, y, 0.4)[2, 3] for x, y in places.tolist()]
    np.testing.assert_array_equal(poses, one_by_one)


@pytest.mark.parametrize("yaw", [-3.0, -1.2, 0.0, 0.7, 2.5])
def test_pose_on_a_slope_follows_normal_and_heading(yaw):
    trajectory = slope(pitch=0.15, roll=-0.1)
    T = driven_ground(trajectory).pose_on(12.0, 3.0, yaw)

    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(T[:3, 2], trajectory.transform(0)[:3, 2], atol=1e-5)
    assert math.atan2(T[1, 0], T[0, 0]) == pytest.approx(yaw)


def test_normals_follow_the_slope():
    trajectory = slope(pitch=0.1, roll=0.05)
    normals = driven_ground(trajectory).normal_at([[10.0, 0.0], [20.0, 4.0]])

    np.testing.assert_allclose(normals, np.tile(trajectory.transform(0)[:3, 2], (2, 1)), atol=1e-5)


@pytest.mark.parametrize(
    "change",
    [
        {"heights": np.zeros((1, 4))},
        {"heights": np.full((4, 4), np.nan)},
        {"is_ground": np.ones((4, 5))},
        {"cell": 0.0},
        {"origin": np.zeros(3)},
    ],
)
def test_invalid_grids_are_refused(change):
    given = {"origin": np.zeros(2), "cell": 1.0, "heights": np.zeros((4, 4))}
    with pytest.raises(SceneError, match="ground"):
        Ground(**({"is_ground": np.ones((4, 4))} | given | change))


# --- from path and boxes alone -----------------------------------------------------------------


@pytest.mark.parametrize(("x", "y"), [(10.0, 0.0), (5.0, 4.0), (20.0, -6.0)])
def test_the_ground_beside_the_path_extends_the_vehicle_plane(x, y):
    trajectory = slope(pitch=0.1, roll=0.05)
    normal = trajectory.transform(0)[:3, 2]
    expected = -(normal[0] * x + normal[1] * y) / normal[2]

    assert driven_ground(trajectory).height(x, y) == pytest.approx(expected, abs=1e-3)


def test_poses_on_the_path_match_the_recording():
    trajectory = slope(pitch=0.15, roll=-0.1)
    recorded = trajectory.transform(1_000_000)
    x, y = recorded[:2, 3].tolist()
    yaw = math.atan2(recorded[1, 0], recorded[0, 0])

    stood = driven_ground(trajectory).pose_on(x, y, yaw)
    np.testing.assert_allclose(stood, recorded, atol=1e-5)


def test_far_from_the_path_the_plane_is_not_extended():
    ground = driven_ground(slope(pitch=0.0, roll=0.1))

    assert ground.height(10.0, 50.0) == pytest.approx(ground.height(10.0, 12.0), abs=0.02)


def test_boxes_reveal_a_raised_pavement():
    kerb = [box(x, 6.0, 0.15) for x in (10, 15, 20, 25)]
    ground = fit_scene_ground(NOTHING, straight(), kerb)

    assert abs(ground.height(17.0, 0.0)) < 0.001
    assert 0.1 < ground.height(17.0, 6.5) < 0.16


def test_floating_boxes_are_ignored():
    ground = fit_scene_ground(NOTHING, straight(), [box(20, 4, 3.0)])

    assert ground.height(20.0, 4.0) == pytest.approx(0, abs=1e-6)


def test_a_stationary_vehicle_has_level_ground():
    standing = Trajectory(np.array([0]), np.array([[3.0, 4.0, 0.5]]), yaw_quaternion(0.0)[None])

    np.testing.assert_allclose(driven_ground(standing).height_at([[3, 4], [40, -30]]), 0.5)


# --- from points -------------------------------------------------------------------------------


def tilted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.02 * y + 0.001 * x


def street(seed: int = 0) -> np.ndarray:
    """Points of a tilted road with noise, a wall beside it and reflections below it."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-15, 55, 100_000), rng.uniform(-12, 12, 100_000)
    road = np.stack([x, y, tilted(x, y) + rng.normal(0, 0.01, x.size)], axis=1)
    wall = np.stack([x[:8000], np.full(8000, 9.0), rng.uniform(0.3, 5, 8000)], axis=1)
    below = np.stack([x[:300], y[:300], np.full(300, -4.0)], axis=1)
    return np.concatenate([road, wall, below])


@pytest.mark.parametrize("place", [2e29, -1.1e6])
def test_a_path_far_from_the_origin_is_refused(tiny_scene, place):
    positions = np.array([[place, 0.0, 0.0]] * 2)
    ego = Trajectory(np.array([0, 1]), positions, np.array([[1.0, 0, 0, 0]] * 2))
    with pytest.raises(SceneError, match="from the origin"):
        fit_scene_ground(tiny_scene.background, ego, ())


def test_heights_follow_the_road_despite_walls_and_reflections():
    surface = fit_ground(street(), DrivenPath.of(straight()), NO_BOXES).surface
    xy = np.stack(np.meshgrid(np.arange(-10, 50, 0.5), np.arange(-8, 8, 0.5)), -1).reshape(-1, 2)
    np.testing.assert_allclose(surface.height_at(xy), tilted(*xy.T), atol=0.03)
    assert surface.covers(xy).all()


def test_the_road_continues_under_an_occluding_box():
    points = street()
    hidden = (np.abs(points[:, 0] - 12) < 3) & (np.abs(points[:, 1] + 4) < 1.5)
    corners = np.array([[9.0, -5.5], [15, -5.5], [15, -2.5], [9, -2.5]])
    bottoms = BoxBottoms(np.array([[12.0, -4.0, tilted(12.0, -4.0)]]), corners[None])
    surface = fit_ground(points[~hidden], DrivenPath.of(straight()), bottoms).surface
    xy = np.stack(np.meshgrid(np.arange(9.2, 15, 0.2), np.arange(-5.3, -2.6, 0.2)), -1)
    xy = xy.reshape(-1, 2)
    assert surface.covers(xy).all()
    np.testing.assert_allclose(surface.height_at(xy), tilted(*xy.T), atol=0.05)


def test_the_ground_is_shifted_to_the_path_only_near_it():
    ego = straight(bias=0.06)
    fit = fit_ground(street(), DrivenPath.of(ego), NO_BOXES)
    on_path = ego.positions[:, :2]

    np.testing.assert_allclose(fit.ground.height_at(on_path), 0.06, atol=0.002)
    aside = on_path + np.array([0.0, 8.5])
    np.testing.assert_allclose(fit.ground.height_at(aside), fit.surface.height_at(aside))


def test_fitting_is_reproducible():
    path = DrivenPath.of(straight())
    a, b = (fit_ground(street(), path, NO_BOXES).ground for _ in range(2))
    assert np.array_equal(a.heights, b.heights)


# --- from Gaussians: the paper's planes --------------------------------------------------------

BOXES = [(transform_from([x, y, 1.0], [1, 0, 0, 0]), (4.5, 1.8, 1.5)) for x, y in ((0, 0), (12, 3))]


def littered(clutter: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    xy = rng.uniform([-12, -12], [32, 12], size=(60_000, 2))
    z = 0.25 + 0.04 * xy[:, 0] - 0.02 * xy[:, 1] + 0.01 * rng.normal(size=len(xy))
    stands = rng.random(len(xy)) < clutter
    z[stands] += rng.uniform(0.2, 2.0, size=stands.sum())
    return np.column_stack([xy, z])


def test_the_plane_fits_the_road_despite_clutter():
    cloud = littered(0.4)
    plane = find_road_plane(cloud, BOXES)
    normal = np.array([-0.04, 0.02, 1.0]) / np.linalg.norm([-0.04, 0.02, 1.0])
    np.testing.assert_allclose(plane.normal, normal, atol=2e-3)
    assert plane.height_at(np.zeros((1, 2)))[0] == pytest.approx(0.25, abs=0.01)
    looked_at = cloud[plane.candidates]
    on_road = np.abs(looked_at[:, 2] - (0.25 + looked_at[:, :2] @ [0.04, -0.02])) < 0.08
    assert 0.7 < on_road.mean() < 0.99
    assert (plane.inliers == on_road).mean() > 0.999


def test_only_points_around_the_boxes_are_candidates():
    cloud = littered(0.1)
    plane = find_road_plane(cloud, BOXES[:1])
    assert np.abs(cloud[plane.candidates, 0]).max() < 2.25 + 2.5 + 1e-9


def test_a_plane_without_points_or_boxes_is_refused():
    with pytest.raises(SceneError, match="0 of 5 points"):
        find_road_plane(np.full((5, 3), 500.0), BOXES)
    with pytest.raises(SceneError, match="at least one"):
        find_road_plane(littered(0.1), [])


def test_road_under_finds_planes_below_the_path():
    found = road_under(street(), DrivenPath.of(straight(bias=0.1)))

    np.testing.assert_allclose(found.points[:, 2], tilted(*found.points[:, :2].T), atol=0.01)
    np.testing.assert_allclose(found.driven, 0.1)


def test_upright_gaussians_are_ignored():
    points = street()[:100_000]
    x = np.linspace(0, 40, 4000)
    wall = np.stack([x, np.full(4000, 5.0), np.tile(np.linspace(0.15, 0.5, 40), 100)], axis=1)
    means = torch.from_numpy(np.concatenate([points, wall])).float()
    count = len(means)
    upright = torch.arange(count) >= len(points)
    scales = torch.tensor([0.1, 0.1, 0.01]).repeat(count, 1)
    scales[upright] = torch.tensor([0.1, 0.01, 0.1])
    cloud = GaussianCloud(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=scales,
        opacities=torch.full((count,), 0.9),
        sh=torch.zeros(count, 1, 3),
    )
    heights = fit_scene_ground(cloud, straight(), []).height_at([[20.0, 5.0], [30.0, 5.0]])

    np.testing.assert_allclose(heights, [0.12, 0.13], atol=0.02)


# --- of a scene --------------------------------------------------------------------------------


def test_a_scene_shares_its_fitted_ground_with_copies(tiny_scene):
    assert tiny_scene.ground is tiny_scene.ground
    assert tiny_scene.to("cpu").ground is tiny_scene.ground


def test_a_stored_ground_takes_precedence(tiny_scene):
    stored = Ground.level(3.0)
    assert replace(tiny_scene, stored_ground=stored).ground is stored
