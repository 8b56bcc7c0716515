"""The figures of the training bench are of passes that were really made."""

from __future__ import annotations

import json

import pytest

from real2sim_server.benchmarks.render_training import run, training_case
from real2sim_server.render.backends.select import select_backend


def test_figures_hang_together_and_are_json() -> None:
    result = run(gaussians=21_000, backend="cpu", repetitions=2)
    assert json.loads(json.dumps(result)) == result
    assert result["gaussians"] == pytest.approx(21_000, rel=2e-3)
    assert 0 < result["forward_ms"] <= result["forward_median_ms"]
    assert 0 < result["backward_ms"] <= result["backward_median_ms"]
    assert result["backward_per_forward"] == result["backward_ms"] / result["forward_ms"]
    assert result["within_needed_ratio"] == (result["backward_per_forward"] <= 3)
    stages = result["stages_ms"]
    assert {"project", "blend", "sky_backward", "blend_backward", "project_backward"} <= set(stages)


def test_most_of_the_street_is_seen_and_everything_gets_a_gradient() -> None:
    case = training_case(60_000)
    output = case.draw(select_backend("cpu"))
    (output.rgb.square().sum() + output.alpha.sum()).backward()
    assert output.screen is not None
    drawn = sum(int((radii > 0).sum()) for radii in output.screen.radii)
    assert drawn > 0.5 * case.gaussian_count
    assert float((output.alpha.detach() > 0.9).float().mean()) > 0.5
    seen = [leaf.grad is not None and bool(leaf.grad.any()) for leaf in case.leaves]
    # A parked car may stand behind the camera; all else is in view.
    assert sum(seen) > 0.8 * len(seen)
    assert all(seen[-2:])
