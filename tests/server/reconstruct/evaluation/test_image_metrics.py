from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.reconstruct.evaluation import PSNR_CAP, mean_psnr, psnr, ssim


def noise_image(seed: int, shape=(40, 52, 3)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def plain_ssim(image: np.ndarray, truth: np.ndarray) -> float:
    """SSIM per pixel, as in Wang et al. 2004, zero-padded."""
    taps = np.arange(-5, 6)
    window = np.exp(-(taps[:, None] ** 2 + taps[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    x = np.pad(image / 255, ((5, 5), (5, 5), (0, 0)))
    y = np.pad(truth / 255, ((5, 5), (5, 5), (0, 0)))
    values = []
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            for channel in range(3):
                part = slice(row, row + 11), slice(column, column + 11), channel
                a, b = x[part], y[part]
                mean_a, mean_b = (window * a).sum(), (window * b).sum()
                var_a = (window * (a - mean_a) ** 2).sum()
                var_b = (window * (b - mean_b) ** 2).sum()
                cov = (window * (a - mean_a) * (b - mean_b)).sum()
                top = (2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)
                values.append(top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)))
    return float(np.mean(values))


def test_psnr_of_known_noise_matches_the_formula():
    truth = np.full((200, 300, 3), 128, np.uint8)
    noise = np.random.default_rng(1).normal(0, 10, truth.shape)
    image = np.rint(truth + noise).astype(np.uint8)
    # Rounding adds the variance of a uniform step.
    assert psnr(image, truth) == pytest.approx(10 * np.log10(255**2 / (100 + 1 / 12)), abs=0.05)


def test_psnr_ignores_pixels_outside_the_mask():
    truth = np.zeros((10, 10, 3), np.uint8)
    image = truth.copy()
    image[:, 5:] = 255
    image[:, :5] = 51
    mask = np.zeros((10, 10), bool)
    mask[2:8, :5] = True
    assert psnr(image, truth, mask) == pytest.approx(20 * np.log10(5))


def test_infinite_psnr_counts_as_the_cap_in_means():
    image = noise_image(2)
    assert psnr(image, image) == float("inf")
    assert mean_psnr([psnr(image, image), 20.0]) == (PSNR_CAP + 20) / 2


def test_means_ignore_nan():
    assert mean_psnr([float("nan"), 20.0, 30.0]) == 25
    assert np.isnan(mean_psnr([float("nan")]))


def test_ssim_matches_a_plain_implementation():
    truth = noise_image(3, (14, 17, 3))
    image = np.clip(truth.astype(int) + noise_image(4, truth.shape) // 4 - 20, 0, 255)
    image = image.astype(np.uint8)
    assert ssim(image, truth) == pytest.approx(plain_ssim(image, truth), abs=1e-9)


def test_ssim_is_one_for_equal_and_near_zero_for_unrelated_images():
    image = noise_image(5)
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)
    assert abs(ssim(image, noise_image(6))) < 0.1


def test_ssim_over_a_mask_is_the_mean_of_its_pixels():
    image, truth = noise_image(3), noise_image(3)
    image[:, 26:] = noise_image(4)[:, 26:]
    left = np.zeros(image.shape[:2], bool)
    left[:, :20] = True
    assert ssim(image, truth, left) == pytest.approx(1)
    parts = [ssim(image, truth, mask) * mask.mean() for mask in (left, ~left)]
    assert sum(parts) == pytest.approx(ssim(image, truth))
    assert np.isnan(ssim(image, truth, left & ~left))
