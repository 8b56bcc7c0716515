"""The CUDA backend against the reference, and its instance kernel in Numba's simulator."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, describe_backends, rasterize
from real2sim_server.scene import GaussianCloud, Sky

CUDA = next(status for status in describe_backends() if status.name == "cuda")
needs_gpu = pytest.mark.skipif(not CUDA.usable, reason=f"no CUDA backend: {CUDA.reason}")
K = np.array([[[140.0, 0, 70], [0, 150, 60], [0, 0, 1]]])
POSE = transform_from([0.5, 0.2, 6.0], np.array([0.9, 0.1, -0.3, 0.2]))


def random_cloud(seed: int, bands: int = 16) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    n = 800
    parts = (
        rng.uniform((-4, -3, -1.5), (4, 3, 10), (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(-4.5, -0.7, (n, 3))),
        rng.uniform(0, 1, n),
        rng.normal(0, 0.3, (n, bands, 3)),
    )
    return GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("seed", range(4))
def test_cuda_matches_reference(seed: int, mode: str) -> None:
    covars = torch.diag_embed(torch.rand(800, 3, generator=torch.Generator().manual_seed(1)) * 0.02)
    instances = [
        Instance(random_cloud(seed)),
        Instance(random_cloud(seed + 10, bands=4), POSE, 3, scale=(0.5, 0.2, 0.4)),
        Instance(random_cloud(seed + 20, bands=1), POSE @ POSE, 65_535, covars=covars),
    ]
    viewmats = np.stack([np.eye(4), transform_from([0.3, 0, 1], np.array([0.95, 0.1, 0.2, 0]))])
    given, expected = (
        rasterize(
            instances,
            viewmats,
            np.repeat(K, 2, 0),
            150,
            110,
            sky=Sky.uniform((0.3, 0.5, 0.9)),
            options=RasterOptions(rasterize_mode=mode),
            backend=backend,
        )
        for backend in ("cuda", "reference")
    )
    difference = (given.rgb.cpu() - expected.rgb).abs().amax(-1)
    # gsplat uses float32 with fast intrinsics, so single pixels may differ.
    assert float((difference > 1 / 255).float().mean()) < 1e-3
    assert float(difference.mean()) < 1e-4
    assert given.depth is not None
    assert expected.depth is not None
    solid = expected.alpha > 0.1
    error = (given.depth.cpu() - expected.depth)[solid].abs()
    assert float(error.quantile(0.99)) < 0.01
    assert given.instance is not None
    assert expected.instance is not None
    same = given.instance.cpu().int() == expected.instance.int()
    assert float(same.float().mean()) > 0.999


@pytest.mark.gpu
@needs_gpu
def test_cuda_draws_the_background_of_an_empty_scene() -> None:
    options = RasterOptions(background=(0.1, 0.2, 0.3))
    out = rasterize([], np.eye(4)[None], K, 20, 10, options=options, backend="cuda")
    assert out.rgb[0, 3, 4].tolist() == pytest.approx([0.1, 0.2, 0.3])


SIMULATION = """
import numpy as np, torch
from real2sim_server.render import Instance
from real2sim_server.render.backend import RasterRequest, place_instances
from real2sim_server.render._cuda.gsplat_images import find_instances
from real2sim_server.render._reference import ReferenceBackend, _concatenate, _project
from real2sim_server.render.types import RasterOptions
from real2sim_server.scene import GaussianCloud

rng = np.random.default_rng(0)
n, width, height, tile = 60, 20, 18, 16
parts = (
    rng.uniform((-1, -1, 2), (1, 1, 6), (n, 3)), rng.normal(size=(n, 4)),
    np.exp(rng.uniform(-3, -1, (n, 3))), rng.uniform(0.2, 1, n), np.zeros((n, 1, 3)),
)
cloud = GaussianCloud(*(torch.from_numpy(part.astype(np.float32)) for part in parts))
half = torch.arange(n // 2)
instances = (Instance(cloud.select(half), None, 5), Instance(cloud.select(half + n // 2), None, 8))
K = torch.tensor([[20.0, 0, 10], [0, 20, 9], [0, 0, 1]], dtype=torch.float64).expand(2, 3, 3)
viewmats = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
viewmats[1, 0, 3] = 0.4
request = RasterRequest(instances, viewmats, K, width, height, None, RasterOptions())
expected = ReferenceBackend().rasterize(request).instance.int().numpy()

splats, offsets, members, base = [], [], [], 0
for camera in range(2):
    placement = place_instances(instances, viewmats)
    seen = _concatenate(
        [_project(request, placement, camera, i, torch.float64) for i in range(2)], torch.float64
    )
    seen = seen.select(torch.argsort(seen.depth_key, stable=True))
    for _ in range(4):
        offsets.append(sum(len(m) for m in members))
        members.append(np.arange(base, base + len(seen.depths)))
    base += len(seen.depths)
    splats.append(seen)
stacked = [torch.cat([getattr(s, name) for s in splats]).numpy().astype(kind) for name, kind in (
    ("means2d", np.float32), ("conics", np.float32), ("opacities", np.float32),
    ("instance_ids", np.int32),
)]
image = np.zeros((2, height, width), np.int32)
offsets = np.array(offsets, np.int32).reshape(2, 4)
members = np.concatenate(members).astype(np.int32)
find_instances[(2, 2, 2), (16, 16, 1)](*stacked, offsets, members, image, tile, 2)
assert set(np.unique(expected)) == {0, 5, 8}, np.unique(expected)
print((image != expected).sum())
"""


def test_instance_kernel_matches_the_reference() -> None:
    result = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SIMULATION],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "0"
