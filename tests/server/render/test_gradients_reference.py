"""Gradients of the reference against central differences.

The scene is differentiable: every Gaussian covers the whole of a small image with alpha between
1/255 and 0.999, no pixel terminates early, no colour is clamped, and the depth order is stable.
Images are float64.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, rasterize
from real2sim_server.render._reference import ReferenceBackend
from real2sim_server.scene import GaussianCloud, Sky

WIDTH, HEIGHT = 9, 7
K = np.array([[[30.0, 0, 4.2], [0, 28, 3.4], [0, 0, 1]]])
BACKEND = ReferenceBackend(image_dtype=torch.float64)
STEP = 2.0**-9
"""Step of the differences, exact in float32 for values of order one."""


def smooth_leaves() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    n = 4
    turn = transform_from([0.1, -0.2, 0.4], np.array([0.95, 0.1, -0.1, 0.2]))
    view = transform_from([0.05, 0.1, 0.2], np.array([0.99, 0.02, 0.05, -0.03]))
    leaves = {
        "means": torch.stack(
            [uniform(n) * 0.4 - 0.2, uniform(n) * 0.4 - 0.2, 3 + torch.arange(n) * 0.7], -1
        ),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": 0.7 + 0.6 * uniform(n, 3),
        "opacities": 0.2 + 0.4 * uniform(n),
        "sh": (uniform(n, 16, 3) - 0.5) * 0.15,
        "faces": uniform(6, 3, 3, 3),
    }
    # Coarse values leave room for STEP in float32.
    coarse = {name: (leaf * 1024).round() / 1024 for name, leaf in leaves.items()}
    return coarse | {
        "T_world_object": torch.from_numpy(turn),
        "viewmats": torch.from_numpy(view[None]),
    }


def loss(leaves: dict[str, Tensor], mode: str) -> Tensor:
    parts = ("means", "quats", "scales", "opacities", "sh")
    cloud = GaussianCloud(*(leaves[part] for part in parts))
    options = RasterOptions(rasterize_mode=mode, instance=False)
    output = rasterize(
        [Instance(cloud, leaves["T_world_object"])],
        leaves["viewmats"],
        K,
        WIDTH,
        HEIGHT,
        sky=Sky(leaves["faces"]),
        options=options,
        backend=BACKEND,
    )
    assert output.depth is not None
    generator = torch.Generator().manual_seed(5)
    images = (output.rgb, output.alpha, output.depth)
    weights = (
        torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in images
    )
    return sum((image * weight).sum() for image, weight in zip(images, weights, strict=True))  # type: ignore[return-value]


def central_differences(name: str, leaves: dict[str, Tensor], mode: str) -> Tensor:
    result = torch.zeros(leaves[name].shape, dtype=torch.float64)
    flat = leaves[name].reshape(-1)
    for index in range(flat.numel()):
        values = []
        for sign in (1, -1):
            moved = flat.clone()
            moved[index] += sign * STEP
            values.append(loss(leaves | {name: moved.reshape(leaves[name].shape)}, mode))
        result.view(-1)[index] = (values[0] - values[1]) / (2 * STEP)
    return result


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh", "faces"])
def test_gradients_match_central_differences(name: str, mode: str) -> None:
    leaves = smooth_leaves()
    leaf = leaves[name].clone().requires_grad_()
    loss(leaves | {name: leaf}, mode).backward()
    expected = central_differences(name, leaves, mode)
    assert leaf.grad is not None
    assert expected.abs().max() > 0.01
    # Error: third derivative times STEP^2 / 6, and float32 rounding of the gradient.
    torch.testing.assert_close(leaf.grad.double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["T_world_object", "viewmats"])
def test_pose_gradients_match_central_differences(name: str) -> None:
    leaves = smooth_leaves()
    pose = leaves[name].double()
    constant_sky = leaves | {"faces": torch.full((6, 1, 1, 3), 0.3)}
    leaf = pose.clone().requires_grad_()
    loss(constant_sky | {name: leaf}, "classic").backward()
    assert leaf.grad is not None
    for axis in range(6):
        motion = torch.zeros(4, 4, dtype=torch.float64)
        if axis < 3:
            motion[axis, 3] = 1
        else:
            i, j = [(2, 1), (0, 2), (1, 0)][axis - 3]
            motion[i, j], motion[j, i] = 1, -1
        ahead, behind = (
            loss(
                constant_sky | {name: torch.linalg.matrix_exp(sign * 1e-4 * motion) @ pose},
                "classic",
            )
            for sign in (1, -1)
        )
        expected = (ahead - behind) / 2e-4
        given = (leaf.grad * (motion @ pose)).sum()
        assert float(given) == pytest.approx(float(expected), rel=1e-4, abs=1e-4), axis


def test_float32_reference_is_close_to_float64() -> None:
    leaves = {name: leaf.requires_grad_() for name, leaf in smooth_leaves().items()}
    loss(leaves, "classic").backward()
    exact = leaves["means"].grad
    copies = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
    output = rasterize(
        [
            Instance(
                GaussianCloud(
                    *(copies[p] for p in ("means", "quats", "scales", "opacities", "sh"))
                ),
                copies["T_world_object"],
            )
        ],
        copies["viewmats"],
        K,
        WIDTH,
        HEIGHT,
        sky=Sky(copies["faces"]),
        options=replace(RasterOptions(), instance=False),
        backend=ReferenceBackend(torch.float32),
    )
    generator = torch.Generator().manual_seed(5)
    total = torch.zeros(())
    for image in (output.rgb, output.alpha, output.depth):
        assert image is not None
        weight = torch.randn(image.shape, generator=generator, dtype=torch.float64)
        total = total + (image * weight.float()).sum()
    total.backward()
    torch.testing.assert_close(copies["means"].grad, exact, rtol=1e-3, atol=1e-3)
