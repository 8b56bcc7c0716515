from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.training import losses
from real2sim_server.reconstruct.training.kernels import gaussian_window


@pytest.fixture
def pictures() -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(1)
    truth = torch.rand(23, 31, 3, generator=random)
    return (truth + 0.2 * torch.randn(23, 31, 3, generator=random)), truth


def test_the_window_sums_to_one_and_is_symmetric():
    window = gaussian_window()
    assert window.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_array_equal(window, window[::-1])


def test_ssim_matches_the_plain_version(pictures):
    image, truth = pictures
    assert losses.ssim(image, truth) == pytest.approx(
        float(losses.ssim_plain(image, truth)), abs=1e-5
    )


def test_ssim_of_equal_images_is_one(pictures):
    assert losses.ssim(pictures[1], pictures[1]) == pytest.approx(1, abs=1e-6)


def test_sky_opacity_loss_has_gradients_up_to_full_opacity():
    alpha = torch.tensor([[0.0, 0.5], [1 - 1e-4, 0.9]], requires_grad=True)
    loss = losses.sky_opacity(alpha, torch.tensor([[1.0, 1.0], [1.0, 0.0]]))
    assert float(loss.detach()) == pytest.approx((np.log(2) + np.log(1e4)) / 4, rel=1e-3)
    loss.backward()
    expected = np.array([[1, 2], [1e4, 0]]) / 4
    np.testing.assert_allclose(alpha.grad.numpy(), expected, rtol=1e-3)


def test_sky_opacity_loss_closes_what_is_below_the_horizon():
    alpha = torch.tensor([[0.25, 1 - 1e-4]], requires_grad=True)
    loss = losses.sky_opacity(alpha, torch.tensor([[-1.0, -1.0]]))
    assert float(loss.detach()) == pytest.approx(np.log(4) / 2, rel=1e-3)
    loss.backward()
    np.testing.assert_allclose(alpha.grad.numpy(), [[-2, -0.5]], rtol=1e-3)


@pytest.mark.parametrize("fraction", [0.0, 0.2, 1.0])
def test_photometric_loss_and_gradient_match_torch(pictures, fraction):
    image, truth = pictures
    ours, plain = image.clone().requires_grad_(), image.clone().double().requires_grad_()
    loss, l1, similarity, squared = losses.photometric(ours, truth, ssim_weight=fraction)
    (3 * loss).backward()
    difference = plain - truth
    expected = (1 - fraction) * difference.abs().mean()
    expected = expected + fraction * (1 - losses.ssim_plain(plain, truth.double()))
    (3 * expected).backward()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), abs=1e-5)
    assert float(l1) == pytest.approx(float(difference.detach().abs().mean()), rel=1e-5)
    assert float(similarity) == pytest.approx(losses.ssim(image, truth))
    assert float(squared) == pytest.approx(float(difference.detach().square().mean()), rel=1e-5)
    scale = float(plain.grad.abs().max())
    np.testing.assert_allclose(ours.grad, plain.grad, atol=2e-4 * scale)


def test_lidar_depth_ignores_the_worst_points():
    depth = torch.full((4, 25), 10.0, requires_grad=True)
    measured = torch.full((100,), 10.5)
    measured[:5] = 70.0
    loss = losses.lidar_depth(depth, torch.arange(100), measured)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.5)
    assert not depth.grad.reshape(-1)[:5].any()


def test_object_accumulation_is_lowest_for_solid_or_absent_objects():
    inside = torch.ones(2, 2, dtype=torch.bool)
    solid, half = torch.full((2, 2), 0.999), torch.full((2, 2), 0.5)
    assert losses.object_accumulation(solid, inside) < losses.object_accumulation(half, inside)
    assert float(losses.object_accumulation(half, inside)) == pytest.approx(np.log(2))
    assert losses.object_accumulation(half, ~inside) > losses.object_accumulation(
        half * 0.1, ~inside
    )


def test_outside_box_loss_counts_only_the_excess():
    means = torch.tensor([[0.5, 0.0, 0.0], [1.5, -2.0, 0.0]])
    half = torch.ones(2, 3)
    assert float(losses.outside_box(means, half)) == pytest.approx((0.5 + 1.0) / 2)


def test_the_needle_loss_ignores_discs():
    disc, needle = torch.tensor([[1.0, 1.0, 0.01]]).log(), torch.tensor([[1.0, 0.02, 0.01]]).log()
    assert float(losses.needles(disc, 10)) == 0
    assert float(losses.needles(needle, 10)) == pytest.approx(40, rel=1e-4)


def test_steady_motion_has_no_cost_with_uneven_frames():
    times = np.array([0.0, 0.1, 0.3, 0.4, 0.5, 0.7])
    steady = torch.from_numpy(times).float()[:, None] * torch.tensor([[8.0, -2.0, 0.5]])
    assert float(losses.second_differences(steady, times)) < 1e-10


def test_an_outlier_pose_costs_its_second_differences():
    line = torch.zeros(8, 2)
    line[3, 0] = 0.1
    cost = losses.second_differences(line, np.arange(8) * 0.1)
    assert float(cost) == pytest.approx((0.01 + 0.04 + 0.01) / 6, rel=1e-4)
