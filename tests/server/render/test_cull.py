"""Culling of chunks outside the view leaves images unchanged."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, rasterize
from real2sim_server.render._cpu import backend as cpu
from real2sim_server.render._cpu.drawing import all_chunks, bounds_of, seen_chunks, view_of
from real2sim_server.render._cpu.records import CHUNK
from real2sim_server.render.backend import RasterRequest, place_instances
from real2sim_server.render.types import RasterOptions
from real2sim_server.scene import GaussianCloud

WIDTH, HEIGHT = 160, 96
K = np.array([[120.0, 0, 70], [0, 130, 50], [0, 0, 1]])


def street(seed: int, *, size: float = 0.05) -> GaussianCloud:
    """A long cloud along z whose chunks are slices along z."""
    random = torch.Generator().manual_seed(seed)
    n = 12 * CHUNK
    means = torch.rand(n, 3, generator=random) * torch.tensor([30.0, 6, 1]) - 3
    means[:, 2] += torch.linspace(-40, 80, n)
    return GaussianCloud(
        means=means,
        quats=torch.nn.functional.normalize(torch.randn(n, 4, generator=random), dim=-1),
        scales=torch.rand(n, 3, generator=random) * size + 1e-3,
        opacities=torch.rand(n, generator=random),
        sh=torch.rand(n, 1, 3, generator=random),
    )


def looking(yaw: float) -> np.ndarray:
    half = yaw / 2
    return np.linalg.inv(
        transform_from([1.0, 0.5, 0.0], np.array([math.cos(half), 0, math.sin(half), 0]))
    )


def request_of(instances: list[Instance], yaws: list[float], **options) -> RasterRequest:
    return RasterRequest(
        instances=tuple(instances),
        viewmats=torch.from_numpy(np.stack([looking(yaw) for yaw in yaws])),
        Ks=torch.from_numpy(np.stack([K] * len(yaws))),
        width=WIDTH,
        height=HEIGHT,
        sky=None,
        options=RasterOptions(**options),
    )


def chunks_of(request: RasterRequest) -> list[list[np.ndarray]]:
    placement = place_instances(request.instances, request.viewmats)
    views = [view_of(request, c) for c in range(request.cameras)]
    return seen_chunks(request, placement, views)


@pytest.mark.parametrize("yaw", [0.0, 0.6, 1.57, 3.1, -2.0])
@pytest.mark.parametrize("size", [0.05, 5.0])
@pytest.mark.parametrize("options", [{}, {"near_plane": 5.0, "far_plane": 20.0}])
def test_culled_images_equal_unculled_ones(yaw, size, options, monkeypatch):
    pose = transform_from([-5.0, 1, 3], np.array([0.9, 0.1, 0.4, 0.0]))
    placed = Instance(street(1, size=size), pose, 3, (0.7, 1.5, 1.0))
    instances = [Instance(street(0, size=size)), placed]

    def draw():
        return rasterize(
            instances,
            looking(yaw)[None],
            K[None],
            WIDTH,
            HEIGHT,
            options=RasterOptions(**options),
            backend=cpu.CpuBackend(),
        )

    culled = draw()
    monkeypatch.setattr(cpu, "seen_chunks", lambda request, *_: [all_chunks(request)])
    for name in ("rgb", "alpha", "depth", "instance"):
        assert torch.equal(getattr(culled, name), getattr(draw(), name)), name


def test_chunks_behind_each_camera_are_culled():
    instances = [Instance(street(0)), Instance(street(1))]
    ahead, behind = chunks_of(request_of(instances, [0.0, math.pi]))
    for forward, backward in zip(ahead, behind, strict=True):
        assert forward.min() > 2
        assert backward.max() < 6
        assert len(forward) + len(backward) < 14


def test_objects_out_of_view_are_culled():
    aside = Instance(street(0), transform_from([500.0, 0, 0], np.array([1.0, 0, 0, 0])))
    ((chunks,),) = chunks_of(request_of([aside], [0.0]))
    assert len(chunks) == 0


def test_deformed_clouds_are_not_culled():
    cloud = street(0)
    covars = torch.eye(3).expand(len(cloud), 3, 3).contiguous()
    ((chunks,),) = chunks_of(request_of([Instance(cloud, covars=covars)], [0.0]))
    assert chunks.tolist() == list(range(12))


def test_bounds_enclose_the_means_and_scales_of_a_chunk():
    cloud = street(2)
    bounds, means = bounds_of(cloud), cloud.means.numpy()
    for chunk in range(12):
        part = slice(chunk * CHUNK, (chunk + 1) * CHUNK)
        off = np.abs(means[part] - bounds.centres[chunk])
        assert (off <= bounds.halves[chunk] + 1e-12).all()
        assert bounds.sigmas[chunk] == cloud.scales[part].max()
    assert bounds_of(cloud) is bounds
