from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct.training.densify import SelectiveAdam, _update_plain


def gradients(step: int) -> torch.Tensor:
    return torch.randn(6, 3, generator=torch.Generator().manual_seed(step))


def test_selective_adam_matches_adam_when_all_rows_are_seen():
    ours = torch.ones(6, 3, requires_grad=True)
    theirs = torch.ones(6, 3, requires_grad=True)
    optimizer, torch_adam = SelectiveAdam({"x": ours}), torch.optim.Adam([theirs], 0.01, eps=1e-15)
    for step in range(5):
        ours.grad, theirs.grad = gradients(step), gradients(step)
        optimizer.step({"x": ours}, {"x": 0.01}, {})
        torch_adam.step()
    np.testing.assert_allclose(ours.detach(), theirs.detach(), rtol=1e-5)


def test_unseen_rows_keep_value_and_moments():
    x = torch.ones(6, 3, requires_grad=True)
    optimizer = SelectiveAdam({"x": x})
    x.grad = gradients(0)
    seen = torch.tensor([True, False, True, True, False, True])
    optimizer.step({"x": x}, {"x": 0.01}, {"x": seen})
    assert torch.equal((x.detach() != 1).any(1), seen)
    assert torch.equal(optimizer.first["x"].any(1), seen)


def test_columns_can_have_separate_learning_rates():
    x = torch.zeros(6, 3, requires_grad=True)
    x.grad = torch.ones(6, 3)
    optimizer = SelectiveAdam({"x": x})
    optimizer.step({"x": x}, {"x": torch.tensor([0.1, 0.2, 0.0])}, {})
    np.testing.assert_allclose(x.detach()[0], [-0.1, -0.2, 0], rtol=1e-5)


def test_moments_follow_their_rows():
    x = torch.zeros(4, 2, requires_grad=True)
    x.grad = torch.arange(8.0).reshape(4, 2)
    optimizer = SelectiveAdam({"x": x})
    optimizer.step({"x": x}, {"x": 0.1}, {})
    before = optimizer.first["x"].clone()
    source = torch.tensor([3, 1, 1])
    optimizer.gather("x", source, torch.tensor([False, False, True]))
    assert torch.equal(optimizer.first["x"][:2], before[[3, 1]])
    assert not optimizer.first["x"][2].any()


def test_steps_of_means_turn_with_their_gradients():
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(9)))[0]
    moved = []
    for axes in (torch.eye(3), turn):
        means = torch.zeros(6, 3, requires_grad=True)
        optimizer = SelectiveAdam({"means": means})
        for step in range(4):
            # Images hardly tell the depth, here along the first axis.
            gradient = gradients(step) * torch.tensor([0.01, 1.0, 1.0])
            means.grad = gradient @ axes.T
            optimizer.step({"means": means}, {"means": 0.01}, {})
        moved.append(means.detach() @ axes)
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-6)
    assert moved[0][:, 0].abs().max() < 0.05 * moved[0][:, 1:].abs().mean()


@pytest.mark.parametrize("joint", [False, True])
def test_the_compiled_update_matches_the_plain_one(joint):
    name = "means" if joint else "x"
    x = torch.ones(6, 3, requires_grad=True)
    optimizer = SelectiveAdam({name: x})
    views = [x.detach().clone(), torch.zeros(6, 3), torch.zeros(6, 3), torch.zeros(6, 3)]
    seen = torch.tensor([True, False, True, True, False, True])
    for step in range(4):
        x.grad = views[1] = gradients(step)
        optimizer.step({name: x}, {name: 0.01}, {name: seen})
        rate = torch.full((3,), 0.01 / (1 - 0.9**optimizer.steps))
        correction = (1 - 0.999**optimizer.steps) ** -0.5
        _update_plain(views, seen, rate, correction, joint=joint)
    np.testing.assert_allclose(x.detach(), views[0], rtol=1e-5)
