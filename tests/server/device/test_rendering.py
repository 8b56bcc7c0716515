"""The CUDA backend mixes no devices and matches the reference."""

from __future__ import annotations

import numpy as np
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, rasterize
from real2sim_server.render.backend import Backend
from real2sim_server.scene import GaussianCloud, Sky, TimeColour

K = np.array([[60.0, 0, 30], [0, 64, 24], [0, 0, 1]])
POSE = transform_from([0.5, 0.2, 6.0], np.array([0.9, 0.1, -0.3, 0.2]))


def random_cloud(seed: int, bands: int, count: int = 60) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform((-3, -2, -1.5), (3, 2, 8), (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-3, -0.7, (count, 3))),
        rng.uniform(0, 1, count),
        rng.normal(0, 0.3, (count, bands, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


def test_device_images_match_the_reference(cuda_backend: Backend) -> None:
    covars = torch.diag_embed(torch.rand(60, 3, generator=torch.Generator().manual_seed(1)) * 0.02)
    colour = TimeColour(torch.full((60, 2, 3), 0.1), "cosine", 0, 100)
    instances = [
        Instance(random_cloud(0, 16)),
        Instance(random_cloud(1, 4), POSE, 3, scale=(0.5, 0.2, 0.4), colour=colour, t_us=30),
        Instance(random_cloud(2, 1), POSE @ POSE, 9, covars=covars),
    ]
    viewmats = np.stack([np.eye(4), transform_from([0.3, 0, 1], np.array([0.95, 0.1, 0.2, 0]))])
    given, expected = (
        rasterize(
            instances,
            viewmats,
            np.repeat(K[None], 2, 0),
            60,
            48,
            sky=Sky.uniform((0.3, 0.5, 0.9), resolution=8),
            options=RasterOptions(median_depth=True),
            backend=backend,
        )
        for backend in (cuda_backend, "reference")
    )
    assert given.rgb.device.type == "pretended"
    assert given.depth is not None
    assert expected.depth is not None
    assert float((given.rgb.cpu() - expected.rgb).abs().max()) < 1 / 255
    solid = expected.alpha > 0.1
    assert float((given.depth.cpu() - expected.depth)[solid].abs().max()) < 0.01
    assert given.instance is not None
    assert expected.instance is not None
    same = given.instance.cpu().int() == expected.instance.int()
    assert float(same.float().mean()) > 0.999
    assert given.median_depth is not None
    assert expected.median_depth is not None
    near = (given.median_depth.cpu() - expected.median_depth).abs() < 0.01
    assert float(near.float().mean()) > 0.999
