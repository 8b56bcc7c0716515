"""Individual ray hits, and the effect of incidence."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from real2sim_server.render import Instance, RenderError
from real2sim_server.render.cast import cast
from real2sim_server.render.cast.call import checked_request
from real2sim_server.render.cast.cpu import CpuCaster
from real2sim_server.scene import Beams, GaussianCloud, Lidar

LIDAR = Lidar("fan", Beams(np.linspace(-0.2, 0.2, 40), np.zeros(40), np.zeros(40)))


def sheets(centres: list[list[float]], opacity: float) -> GaussianCloud:
    """Flat Gaussians across the x axis."""
    n = len(centres)
    return GaussianCloud(
        torch.tensor(centres),
        torch.tensor([[1.0, 0, 0, 0]] * n),
        torch.tensor([[1e-3, 2.0, 2.0]] * n),
        torch.full((n,), opacity),
        torch.zeros(n, 1, 3),
    )


def test_ray_hits_compose_the_echo() -> None:
    bodies = [
        Instance(sheets([[5.0, 0, 0], [20.0, 1, 0]], 0.4)),
        Instance(sheets([[9.0, 0, 0]], 0.7)),
    ]
    request = checked_request(bodies, LIDAR, np.eye(4))
    echo = CpuCaster().cast(request)
    found = CpuCaster().trace(request, np.zeros(40, np.float32))
    assert set(found.members.tolist()) == {0, 1, 2}
    for ray in range(40):
        own = slice(found.begins[ray], found.begins[ray + 1])
        alpha, tau = found.alpha[own], found.tau[own]
        weight = alpha * np.concatenate([[1], np.cumprod(1 - alpha)[:-1]])
        assert weight.sum() == pytest.approx(echo.opacity[ray], abs=1e-5)
        assert (weight * tau).sum() / weight.sum() == pytest.approx(echo.expected[ray], rel=1e-5)


def test_rays_are_traced_up_to_their_reach() -> None:
    # Opaque Gaussians do not end a trace, since training may have to make those behind opaque.
    body = Instance(sheets([[5.0, 0, 0], [9.0, 0, 0], [20.0, 0, 0]], 0.99))
    request = checked_request([body], LIDAR, np.eye(4))
    found = CpuCaster().trace(request, np.full(40, 12.0, np.float32))
    assert set(found.members.tolist()) == {0, 1}
    assert (np.diff(found.begins) == 2).all()


def test_oblique_incidence_lowers_intensity() -> None:
    body = Instance(sheets([[10.0, 0, 0], [10.0, 10, 0]], 0.9))
    lidar = Lidar("two", Beams([0.0, np.pi / 4], [0.0, 0.0], [0.0, 0.0]))
    known = [np.array([[0.8, 0], [0.8, 0]], np.float32)]
    squarely = cast([body], lidar, np.eye(4), attributes=known)
    assert np.allclose(squarely.intensity, 0.8, atol=1e-5)
    partly = cast([body], lidar, np.eye(4), attributes=known, incidence=0.25)
    assert np.allclose(partly.intensity, [0.8, 0.8 * (0.25 + 0.75 * np.sqrt(0.5))], atol=1e-3)


def test_an_incidence_outside_0_to_1_is_refused() -> None:
    with pytest.raises(RenderError, match=r"incidence must be from 0 to 1, not 1\.5"):
        cast([], LIDAR, np.eye(4), incidence=1.5)
