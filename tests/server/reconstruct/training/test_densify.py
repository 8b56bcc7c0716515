from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from real2sim_server.reconstruct import ReconstructError
from real2sim_server.reconstruct.training.densify import (
    STRATEGIES,
    DensifyOptions,
    ScreenSums,
    SelectiveAdam,
    Strategy,
    TrainingStep,
    compute_relocation,
    rotation_matrices,
)
from real2sim_server.reconstruct.training.gaussians import FIELDS, Gaussians, leaf
from real2sim_server.render import ScreenStatistics

COUNTS = (30, 10, 8)
OPTIONS = DensifyOptions(every=1, start=0.0, stop=1.0, max_gaussians=1000, split_scale=0.3)


def some_gaussians() -> Gaussians:
    random = torch.Generator().manual_seed(0)
    n = sum(COUNTS)

    def make(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    return Gaussians(
        means=leaf(make(n, 3) * 0.3),
        log_scales=leaf(make(n, 3) * 0.1 - 2),
        quats=leaf(make(n, 4)),
        logits=leaf(make(n) + 2),
        sh=leaf(make(n, 4, 3)),
        fourier=leaf(make(n - COUNTS[0], 2, 3)),
        counts=COUNTS,
    )


def marked(gaussians: Gaussians) -> SelectiveAdam:
    """An optimizer whose moments equal the parameters, to trace rows."""
    optimizer = SelectiveAdam(gaussians.tensors())
    for name, tensor in gaussians.tensors().items():
        optimizer.first[name] = tensor.detach().clone()
        optimizer.second[name] = tensor.detach().clone()
    return optimizer


def strategy_of(options: DensifyOptions = OPTIONS) -> Strategy:
    kind = STRATEGIES[options.method]
    return kind(options, torch.full((2, 3), 2.0), seed=4, iterations=100)


def round_of(
    options: DensifyOptions, gaussians: Gaussians, optimizer: SelectiveAdam, sums: ScreenSums
) -> Gaussians:
    """The Gaussians after a step with a densification round and no image."""
    strategy = strategy_of(options)
    strategy.state = sums
    return strategy.step_post_backward(gaussians, optimizer, step_without_image(0.0))


def step_without_image(means_rate: float) -> TrainingStep:
    return TrainingStep(7, [], ScreenStatistics((), ()), means_rate)


def sums_for(gaussians: Gaussians, growing: list[int]) -> ScreenSums:
    sums = ScreenSums.zeros(len(gaussians))
    sums.views[:] = 1
    sums.gradients[growing] = 1.0
    return sums


def check_alignment(gaussians: Gaussians, optimizer: SelectiveAdam) -> None:
    """Assert that moments follow their rows and are zero for new rows."""
    for name in FIELDS:
        values, moments = getattr(gaussians, name).detach(), optimizer.first[name]
        assert values.shape == moments.shape
        old = moments.reshape(len(moments), -1).any(1)
        assert torch.equal(values[old], moments[old])


def test_small_gaussians_are_cloned_and_moments_follow_their_rows():
    gaussians = some_gaussians()
    optimizer = marked(gaussians)
    grown = round_of(OPTIONS, gaussians, optimizer, sums_for(gaussians, [2, 33, 45]))
    assert grown.counts == (31, 11, 9)
    check_alignment(grown, optimizer)
    assert all(getattr(grown, name).requires_grad for name in FIELDS)
    fresh = (~optimizer.first["means"].any(1)).nonzero()[:, 0]
    assert torch.equal(grown.means[fresh], gaussians.means[[2, 33, 45]])
    of_objects = optimizer.first["fourier"].flatten(1).any(1)
    assert int((~of_objects).sum()) == 2


def test_large_gaussians_are_split_in_two():
    gaussians = some_gaussians()
    with torch.no_grad():
        gaussians.log_scales[5] = 0.0
    optimizer = marked(gaussians)
    grown = round_of(OPTIONS, gaussians, optimizer, sums_for(gaussians, [5]))
    assert grown.counts == (31, 10, 8)
    new = (~optimizer.first["means"].any(1)).nonzero()[:, 0]
    assert len(new) == 2
    np.testing.assert_allclose(grown.log_scales[new].detach().exp(), 1 / 1.6, rtol=1e-5)
    assert not torch.equal(grown.means[new[0]], grown.means[new[1]])


def test_transparent_gaussians_and_those_outside_their_box_are_pruned():
    gaussians = some_gaussians()
    with torch.no_grad():
        gaussians.logits[3] = -20
        gaussians.means[31] = 9.0
        gaussians.means[1] = 9.0
    grown = round_of(OPTIONS, gaussians, marked(gaussians), ScreenSums.zeros(48))
    assert grown.counts == (29, 9, 8)


def test_the_budget_goes_to_the_largest_gradients():
    gaussians = some_gaussians()
    sums = sums_for(gaussians, [1, 2, 3])
    sums.gradients[2] = 5.0
    options = replace(OPTIONS, max_gaussians=49)
    grown = round_of(options, gaussians, marked(gaussians), sums)
    assert len(grown) == 49
    assert int((grown.means == gaussians.means[2]).all(1).sum()) == 2


def test_mcmc_relocates_dead_gaussians():
    gaussians = some_gaussians()
    with torch.no_grad():
        gaussians.logits[:6] = -20
    options = replace(OPTIONS, method="mcmc", max_gaussians=48)
    optimizer = marked(gaussians)
    moved = round_of(options, gaussians, optimizer, ScreenSums.zeros(48))
    assert len(moved) == 48
    assert float(moved.logits.detach().min()) > -19
    assert optimizer.first["means"].shape == moved.means.shape
    assert optimizer.first["fourier"].shape == moved.fourier.shape


def test_relocation_preserves_opacity_and_scale():
    opacity, factor = compute_relocation(torch.tensor([0.6]), torch.tensor([2]), 0.005)
    assert float(1 - (1 - opacity) ** 2) == pytest.approx(0.6, rel=1e-5)
    # eq. 9 written out for N = 2: o / (2 a - a^2 / sqrt(2)).
    a = float(opacity)
    assert float(factor) == pytest.approx(0.6 / (2 * a - a * a / 2**0.5), rel=1e-5)


def test_mcmc_noise_moves_only_transparent_gaussians_along_their_shape():
    gaussians = some_gaussians()
    with torch.no_grad():
        gaussians.logits[0] = -6
        gaussians.log_scales[0] = torch.tensor([0.0, -9.0, -9.0])
    before = gaussians.means.detach().clone()
    options = replace(OPTIONS, method="mcmc", noise=1.0, every=100)
    strategy = strategy_of(options)
    strategy.step_post_backward(gaussians, marked(gaussians), step_without_image(1e-2))
    moved = (gaussians.means.detach() - before).norm(dim=1)
    assert float(moved[0]) > 1e-4
    assert float(moved[1:].max()) < 1e-6
    axis = rotation_matrices(gaussians.quats)[0, :, 0].detach()
    direction = (gaussians.means.detach() - before)[0] / moved[0]
    assert abs(float(direction @ axis)) == pytest.approx(1, abs=1e-4)


def test_splitting_is_reproducible():
    def once() -> torch.Tensor:
        gaussians = some_gaussians()
        with torch.no_grad():
            gaussians.log_scales[5] = 0.0
        return round_of(OPTIONS, gaussians, marked(gaussians), sums_for(gaussians, [5])).means

    assert torch.equal(once(), once())


def test_only_the_gradient_strategy_resets_opacities():
    options = replace(OPTIONS, reset_every=8)
    for method in ("gradient", "mcmc", "none"):
        gaussians = some_gaussians()
        strategy_of(replace(options, method=method)).step_end(gaussians, marked(gaussians), 7)
        lowered = float(gaussians.logits.detach().sigmoid().max()) <= 0.0101
        assert lowered == (method == "gradient")


def test_method_none_changes_nothing():
    gaussians = some_gaussians()
    options = replace(OPTIONS, method="none")
    sums = sums_for(gaussians, [1, 2])
    assert round_of(options, gaussians, marked(gaussians), sums) is gaussians


def test_a_renderer_without_screen_statistics_is_refused():
    output = SimpleNamespace(screen=None)
    for method in STRATEGIES:
        with pytest.raises(ReconstructError, match="does not report the contributions"):
            strategy_of(replace(OPTIONS, method=method)).step_pre_backward(output)
