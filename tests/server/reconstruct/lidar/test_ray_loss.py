"""The ray loss and its gradients."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_server.reconstruct.lidar.learn import LOGIT, REACH, SHIFT, SIZE, ray_gradients

BEGINS = np.array([0, 3], np.int64)
MEMBERS = np.array([0, 1, 2], np.int32)
MEASURED = np.array([10.0])
DIRECTIONS = np.array([[[0.8, 0.0, 0.6]]], np.float32)
SCALES = np.tile(np.array([[0.5, 0.5, 1e-4]], np.float32), (3, 1))
"""Flat discs across z. A shift along the normal moves the sample by shift / 0.6."""
LOGITS = np.array([-0.5, 0.7, 1.0])
EXPONENTS = np.array([0.4, 1.1, 0.2])
PLACES = np.array([9.2, 9.9, 10.1])


def cost_of(
    logits: np.ndarray,
    sizes: np.ndarray,
    shifts: np.ndarray,  # type: ignore[type-arg]
) -> tuple[float, np.ndarray]:  # type: ignore[type-arg]
    """The cost of the ray and its gradients."""
    opacities = 1 / (1 + np.exp(-logits))
    alpha = opacities * np.exp(-EXPONENTS / 2 * np.exp(-2 * sizes))
    out, costs = np.zeros((3, 3), np.float32), np.zeros(1)
    ray_gradients(
        BEGINS, MEMBERS, alpha, PLACES + shifts / 0.6, MEASURED, DIRECTIONS,
        np.zeros(3, np.int32), np.tile(np.eye(3, dtype=np.float32), (3, 1, 1)), SCALES,
        opacities, out, costs,
    )  # fmt: skip
    return float(costs[0]), out


@pytest.mark.parametrize("column", [LOGIT, SIZE, SHIFT])
@pytest.mark.parametrize("member", [0, 1, 2])
def test_gradients_match_finite_differences(column: int, member: int) -> None:
    step = np.zeros((3, 3))
    step[column, member] = 1e-4
    given = np.stack([LOGITS, np.zeros(3), np.zeros(3)])
    ahead, behind = cost_of(*(given + step))[0], cost_of(*(given - step))[0]
    slope = cost_of(*given)[1][member, column]
    assert slope == pytest.approx((ahead - behind) / 2e-4, abs=2e-4)


def test_the_loss_favours_stopping_at_the_measured_range() -> None:
    # Gaussians far in front of the return should fade; those near it should stay.
    slopes = cost_of(LOGITS, np.zeros(3), np.zeros(3))[1][:, LOGIT]
    assert slopes[0] > 0
    assert slopes[1] < 0
    assert abs(PLACES[0] - MEASURED[0]) > REACH
