from dataclasses import replace

import numpy as np
import pytest
import torch

from real2sim_server.geometry import apply_transform, quaternion_to_matrix, transform_from
from real2sim_server.scene import UNSEEN, GaussianCloud, SceneError
from real2sim_server.scene.cloud import sh_basis


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degree_follows_from_the_number_of_coefficients(make_cloud, degree):
    cloud = make_cloud(7, degree=degree)
    assert (len(cloud), cloud.sh_degree) == (7, degree)
    assert cloud.nbytes == 7 * 4 * (3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"means": torch.zeros(50)}, r"means must be \[N, 3\]"),
        ({"means": torch.zeros(50, 2)}, "means"),
        ({"quats": torch.zeros(50, 3)}, "quats"),
        ({"scales": torch.zeros(49, 3)}, "scales"),
        ({"opacities": torch.zeros(50, 1)}, "opacities"),
        ({"sh": torch.zeros(50, 4)}, "sh"),
        ({"sh": torch.zeros(50, 5, 3)}, "5 coefficients"),
        ({"means": torch.zeros(50, 3, dtype=torch.float64)}, "float32"),
    ],
)
def test_tensors_with_a_wrong_shape_or_dtype_are_refused(make_cloud, change, reason):
    with pytest.raises(SceneError, match=reason):
        replace(make_cloud(), **change)


def test_a_tensor_on_another_device_is_refused(make_cloud):
    with pytest.raises(SceneError, match="opacities is on meta"):
        replace(make_cloud(), opacities=torch.zeros(50, device="meta"))


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("means", float("nan"), "3 of 150 values: means not finite"),
        ("sh", float("inf"), "sh not finite"),
        ("scales", 0.0, "scales not positive"),
        ("opacities", 1.5, "1 of 50 values: opacities outside"),
        ("quats", 2.0, "unit length"),
    ],
)
def test_invalid_values_are_reported_with_their_count(make_cloud, field, value, reason):
    cloud = make_cloud()
    cloud.check_values("cloud")
    getattr(cloud, field)[13] = value
    with pytest.raises(SceneError, match=f"car_1: .*{reason}"):
        cloud.check_values("car_1")


def test_select_takes_masks_and_indices(make_cloud):
    cloud = make_cloud(10)
    mask = torch.arange(10) % 3 == 0
    by_mask, by_index = cloud.select(mask), cloud.select(torch.tensor([0, 3, 6, 9]))
    assert torch.equal(by_mask.means, cloud.means[::3])
    assert torch.equal(by_mask.sh, by_index.sh)


def test_concatenation_pads_harmonics_with_zeros(make_cloud):
    low, high = make_cloud(3, degree=0), make_cloud(4, degree=2)
    both = GaussianCloud.concatenate([low, high])
    assert (len(both), both.sh_degree) == (7, 2)
    assert torch.equal(both.sh[:3, :1], low.sh)
    assert not both.sh[:3, 1:].any()
    assert torch.equal(both.sh[3:], high.sh)


def test_concatenation_of_nothing_is_empty():
    assert len(GaussianCloud.concatenate([])) == 0


def test_harmonics_are_truncated_to_a_lower_degree(make_cloud):
    cloud = make_cloud(degree=3)
    assert torch.equal(cloud.with_sh_degree(1).sh, cloud.sh[:, :4])


def colours(cloud: GaussianCloud, directions: np.ndarray) -> np.ndarray:
    return np.einsum("dk,nkc->dnc", sh_basis(directions, cloud.sh_degree), cloud.sh.numpy())


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_moving_a_cloud_rotates_its_view_dependent_colour(make_cloud, degree):
    cloud = make_cloud(20, degree=degree)
    transform = transform_from([3.0, -2, 1], np.array([0.5, -0.1, 0.7, 0.4]))
    directions = np.random.default_rng(3).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = cloud.moved(transform)
    np.testing.assert_allclose(
        colours(turned, directions @ transform[:3, :3].T), colours(cloud, directions), atol=1e-5
    )


def covariances(cloud: GaussianCloud) -> np.ndarray:
    half = quaternion_to_matrix(cloud.quats.numpy()) * cloud.scales.numpy()[:, None, :]
    return half @ half.transpose(0, 2, 1)


def test_moving_transforms_means_and_covariances(make_cloud):
    cloud = make_cloud()
    transform = transform_from([3.0, -2, 1], np.array([0.5, -0.1, 0.7, 0.4]))
    moved = cloud.moved(transform, scale=2.0)
    rotation = transform[:3, :3]
    np.testing.assert_allclose(
        moved.means, apply_transform(transform, 2 * cloud.means.numpy()), atol=1e-5
    )
    np.testing.assert_allclose(
        covariances(moved), 4 * rotation @ covariances(cloud) @ rotation.T, atol=1e-5
    )
    moved.check_values("moved")


def test_moving_by_the_identity_is_exact(make_cloud):
    cloud = make_cloud(degree=3)
    same = cloud.moved(np.eye(4))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(same, name), getattr(cloud, name))


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_moving_with_a_non_positive_scale_is_refused(make_cloud, scale):
    with pytest.raises(SceneError, match="positive"):
        make_cloud().moved(np.eye(4), scale=scale)


def test_moving_by_a_non_rigid_transform_is_refused(make_cloud):
    with pytest.raises(SceneError, match="rigid"):
        make_cloud().moved(np.diag([1.0, 2, 1, 1]))


def with_uncertainties(cloud: GaussianCloud) -> GaussianCloud:
    return replace(cloud, uncertainties=torch.linspace(0, 1, len(cloud)))


def test_uncertainties_follow_their_gaussians(make_cloud):
    cloud = with_uncertainties(make_cloud(9))
    picked = torch.tensor([7, 2, 2])
    assert torch.equal(cloud.select(picked).uncertainties, cloud.uncertainties[picked])
    turned = transform_from([1, 2, 3], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    for changed in (cloud.moved(turned, scale=2.0), cloud.with_sh_degree(0), cloud.to("meta")):
        assert changed.uncertainties.shape == (9,)
    assert torch.equal(cloud.moved(turned).uncertainties, cloud.uncertainties)
    assert cloud.nbytes == make_cloud(9).nbytes + 9 * 4


def test_concatenation_fills_missing_uncertainties_as_unseen(make_cloud):
    known, unknown = with_uncertainties(make_cloud(3)), make_cloud(2)
    joined = GaussianCloud.concatenate([known, unknown])
    assert joined.uncertainties.tolist() == [0, 0.5, 1, UNSEEN, UNSEEN]
    assert GaussianCloud.concatenate([unknown, unknown]).uncertainties is None


@pytest.mark.parametrize("value", [-0.1, 1.5, float("nan")])
def test_uncertainties_out_of_range_are_reported(make_cloud, value):
    bad = replace(make_cloud(4), uncertainties=torch.tensor([0, 0, 1, value]))
    with pytest.raises(SceneError, match="1 of 4 values: uncertainties"):
        bad.check_values("x")


def test_a_stretched_cloud_has_stretched_covariances(make_cloud):
    cloud, factors = make_cloud(40), (1.5, 0.5, 2.0)
    found = cloud.stretched(factors)
    by = np.diag(factors)

    def covariances(given):
        axes = quaternion_to_matrix(given.quats.numpy()) * given.scales.numpy()[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    np.testing.assert_allclose(
        covariances(found), by @ covariances(cloud) @ by, rtol=1e-3, atol=1e-7
    )
    np.testing.assert_allclose(found.means, cloud.means.numpy() * factors, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, atol=1e-6)
    with pytest.raises(SceneError, match="positive"):
        cloud.stretched((1.0, 0.0, 1.0))
