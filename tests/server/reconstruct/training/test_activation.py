from __future__ import annotations

import pytest
import torch

from real2sim_server.reconstruct.training.gaussians import Activated, activated, activated_plain

COUNTS = (3000, 0, 40, 2200)
FUNCTIONS, HARMONICS = 9, 4


def parameters(dtype: torch.dtype) -> list[torch.Tensor]:
    rng = torch.Generator().manual_seed(3)
    n, objects = sum(COUNTS), sum(COUNTS[1:])
    shapes = ((n, 3), (n,), (n, FUNCTIONS, 3), (objects, HARMONICS, 3))
    drawn = [torch.randn(shape, generator=rng, dtype=torch.float64) for shape in shapes]
    return [part.to(dtype).requires_grad_() for part in drawn]


def loss(drawn: Activated) -> torch.Tensor:
    """Weight every element differently, except those of owner 2, which no camera shows."""
    total = torch.zeros((), dtype=torch.float64)
    for parts in drawn:
        for index, part in enumerate(parts):
            if index != 2 and part.numel():
                weights = torch.arange(part.numel(), dtype=torch.float64).sin().reshape(part.shape)
                total = total + (part.double() * weights).sum()
    return total


@pytest.mark.parametrize(("functions", "tones"), [(9, True), (4, True), (1, False)])
def test_compiled_values_and_gradients_match_plain_torch_in_float64(functions, tones):
    rng = torch.Generator().manual_seed(5)
    weights = torch.randn(len(COUNTS) - 1, HARMONICS if tones else 0, generator=rng)
    ours, truth = parameters(torch.float32), parameters(torch.float64)
    given = {"counts": COUNTS, "functions": functions}
    fast = activated(*ours, tones=weights, **given)
    plain = activated_plain(*truth, tones=weights.double(), **given)
    for mine, theirs in zip(fast, plain, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            torch.testing.assert_close(a.double(), b, rtol=2e-6, atol=2e-6)
    loss(fast).backward()
    loss(plain).backward()
    for mine, theirs in zip(ours, truth, strict=True):
        expected = torch.zeros_like(theirs) if theirs.grad is None else theirs.grad
        torch.testing.assert_close(mine.grad.double(), expected, rtol=1e-5, atol=1e-5)


def test_a_scene_without_objects_is_activated():
    log_scales, logits, sh, _ = (part[:10].detach() for part in parameters(torch.float32))
    drawn = activated(
        log_scales,
        logits,
        sh,
        torch.zeros(0, HARMONICS, 3),
        tones=torch.zeros(0, 0),
        counts=(10,),
        functions=FUNCTIONS,
    )
    torch.testing.assert_close(drawn.sh[0], sh)
    assert [len(part) for part in drawn.scales] == [10]
