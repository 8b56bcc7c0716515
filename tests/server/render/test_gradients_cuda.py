"""Gradients on a GPU, and screen statistics from gsplat outputs (no GPU needed)."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, describe_backends, rasterize
from real2sim_server.render._cuda.gsplat import track_screen
from real2sim_server.render.backend import RasterRequest
from real2sim_server.scene import GaussianCloud, Sky

CUDA = next(status for status in describe_backends() if status.name == "cuda")
needs_gpu = pytest.mark.skipif(not CUDA.usable, reason=f"no CUDA backend: {CUDA.reason}")
K = np.array([[[140.0, 0, 70], [0, 150, 60], [0, 0, 1]]])
POSE = transform_from([0.5, 0.2, 6.0], np.array([0.9, 0.1, -0.3, 0.2]))
PARTS = ("means", "quats", "scales", "opacities", "sh")


def cloud_of(count: int, seed: int = 0) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform((-4, -3, 1), (4, 3, 10), (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(-4.5, -0.7, (count, 3))),
        rng.uniform(0, 1, count),
        rng.normal(0, 0.3, (count, 9, 3)),
    )
    return GaussianCloud(
        *(torch.from_numpy(part.astype(np.float32)).requires_grad_() for part in parts)
    )


def request_of(counts: list[int], cameras: int) -> RasterRequest:
    return RasterRequest(
        instances=tuple(Instance(cloud_of(count)) for count in counts),
        viewmats=torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1),
        Ks=torch.from_numpy(K).repeat(cameras, 1, 1),
        width=200,
        height=100,
        sky=None,
        options=RasterOptions(track_screen=True),
    )


def test_gsplat_centres_map_to_instances_cameras_and_gaussians() -> None:
    request = request_of([2, 0, 3], cameras=2)
    leaf = torch.zeros(4, 2, requires_grad=True)
    means2d = leaf * 1
    means2d.absgrad = torch.tensor([[1.0, 0], [0, 2], [3, 4], [0, 1]])  # type: ignore[attr-defined]
    meta = {
        "means2d": means2d,
        "gaussian_ids": torch.tensor([1, 2, 4, 2], dtype=torch.int32),
        "camera_ids": torch.tensor([0, 0, 1, 1], dtype=torch.int32),
        "radii": torch.tensor([[3, 2], [4, 9], [1, 1], [5, 6]], dtype=torch.int32),
    }
    screen = track_screen(request, meta, torch.device("cpu"))
    assert [radii.tolist() for radii in screen.radii] == [
        [[0, 3], [0, 0]],
        [[], []],
        [[9, 0, 0], [6, 0, 1]],
    ]
    assert not any(gradients.any() for gradients in screen.gradients)
    (means2d * torch.tensor([[0.5, 0], [0, 1], [0, 0], [0, 1]])).sum().backward()
    # 2 cameras, half of 200 px in x and of 100 px in y. Both cameras see Gaussian 2.
    first, empty, third = (gradients.tolist() for gradients in screen.gradients)
    assert first == [[0, 0], [100, 200]]
    assert empty == []
    assert third == [[200, 300], [0, 0], pytest.approx([0, float(np.hypot(600, 400))])]


def test_screen_statistics_are_garbage_collected() -> None:
    means2d = torch.zeros(1, 2, requires_grad=True) * 1
    zero = torch.zeros(1, dtype=torch.int32)
    meta = {"means2d": means2d, "gaussian_ids": zero, "camera_ids": zero}
    meta["radii"] = torch.ones(1, 2, dtype=torch.int32)
    screen = track_screen(request_of([1], cameras=1), meta, torch.device("cpu"))
    gone = weakref.ref(screen)
    del screen, meta, means2d
    gc.collect()
    assert gone() is None


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_cuda_gradients_match_the_reference(mode: str) -> None:
    found = []
    for backend in ("cuda", "reference"):
        clouds = [cloud_of(600), cloud_of(300, seed=1)]
        pose = torch.from_numpy(POSE).clone().requires_grad_()
        viewmats = torch.eye(4, dtype=torch.float64)[None].requires_grad_()
        faces = torch.rand(6, 4, 4, 3, generator=torch.Generator().manual_seed(2))
        output = rasterize(
            [Instance(clouds[0]), Instance(clouds[1], pose, 1)],
            viewmats,
            K,
            150,
            110,
            sky=Sky(faces.requires_grad_()),
            options=RasterOptions(rasterize_mode=mode, track_screen=True),
            backend=backend,
        )
        generator = torch.Generator().manual_seed(3)
        total = torch.zeros(())
        for image in (output.rgb, output.alpha, output.depth):
            assert image is not None
            total = total + (image.cpu() * torch.randn(image.shape, generator=generator)).sum()
        total.backward()
        assert output.screen is not None
        leaves = {f"{k}.{p}": getattr(c, p) for k, c in enumerate(clouds) for p in PARTS}
        leaves |= {"pose": pose, "viewmats": viewmats, "faces": faces}
        grads = {name: leaf.grad.cpu() for name, leaf in leaves.items()}
        screens = {f"screen {k}": s.cpu() for k, s in enumerate(output.screen.gradients)}
        found.append(grads | screens)
    for name, expected in found[1].items():
        # Single pixels at the rims may differ.
        error = (found[0][name] - expected).abs().flatten()
        assert float(error.quantile(0.98)) < 1e-3 * float(expected.abs().max()), name
