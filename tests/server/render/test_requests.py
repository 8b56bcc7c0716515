"""Requests that rasterize() refuses, and their messages."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from real2sim_server.geometry import transform_from
from real2sim_server.render import Instance, RasterOptions, RenderError, rasterize
from real2sim_server.scene import GaussianCloud

K = np.array([[[10.0, 0, 5], [0, 10, 5], [0, 0, 1]]])
EYE = np.eye(4)[None]


def one(**parts: torch.Tensor) -> GaussianCloud:
    cloud = GaussianCloud(
        torch.tensor([[0.0, 0, 3]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 0.1),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )
    return replace(cloud, **parts)


def skewed() -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 1] = 0.5
    return matrix


NAN = float("nan")
CASES: dict[str, tuple[dict[str, Any], str]] = {
    "view that is not a matrix": ({"viewmats": np.eye(4)}, r"viewmats must be \[C, 4, 4\]"),
    "view that is not finite": ({"viewmats": np.full((1, 4, 4), NAN)}, "viewmats"),
    "view that is not rigid": ({"viewmats": skewed()[None]}, r"viewmats\[0\].*rigid"),
    "view that is scaled": ({"viewmats": 2 * EYE}, "rigid"),
    "view that mirrors": ({"viewmats": np.diag([1.0, 1, -1, 1])[None]}, "rigid"),
    "fewer intrinsics than views": ({"viewmats": np.repeat(EYE, 2, 0)}, "2 viewmats but 1 Ks"),
    "intrinsics with skew": ({"Ks": np.array([[[9.0, 1, 5], [0, 9, 5], [0, 0, 1]]])}, r"Ks\[0\]"),
    "negative focal length": ({"Ks": K * [[[-1.0], [1], [1]]]}, "positive focal"),
    "no width": ({"width": 0}, "width must be 1 to"),
    "huge height": ({"height": 10**6}, "height must be 1 to"),
    "unknown mode": ({"options": RasterOptions(rasterize_mode="mip")}, "'mip'"),
    "planes the wrong way": ({"options": RasterOptions(near_plane=2, far_plane=1)}, "increase"),
    "plane at zero": ({"options": RasterOptions(near_plane=0)}, "near_plane"),
    "negative blur": ({"options": RasterOptions(eps2d=-1)}, "eps2d"),
    "background of NaN": ({"options": RasterOptions(background=(NAN, 0, 0))}, "background"),
    "unknown backend": ({"backend": "vulkan"}, "'vulkan'"),
    "pose that is not rigid": ({"instances": [Instance(one(), skewed())]}, "T_world_object"),
    "pose that is not finite": (
        {"instances": [Instance(one(), transform_from([NAN, 0, 0], [1, 0, 0, 0]))]},
        "T_world_object",
    ),
    "instance id too large": ({"instances": [Instance(one(), instance_id=65_536)]}, "65535"),
    "negative instance id": ({"instances": [Instance(one(), instance_id=-1)]}, "instance_id"),
    "scale of zero": ({"instances": [Instance(one(), scale=(1, 0, 1))]}, "scale"),
    "covariances of another count": (
        {"instances": [Instance(one(), covars=torch.zeros(2, 3, 3))]},
        r"covars must be \[1, 3, 3\]",
    ),
    "covariances that are not finite": (
        {"instances": [Instance(one(), covars=torch.full((1, 3, 3), NAN))]},
        "covars hold values",
    ),
    "means that are not finite": (
        {"instances": [Instance(one(means=torch.tensor([[0.0, NAN, 1]])))]},
        r"instances\[0\].cloud.means of Gaussian 0",
    ),
    "logarithmic scales": (
        {"instances": [Instance(one()), Instance(one(scales=torch.full((1, 3), -3.0)))]},
        r"instances\[1\].cloud.scales.*logarithms",
    ),
    "opacity logits": (
        {"instances": [Instance(one(opacities=torch.tensor([2.5])))]},
        "logits",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_invalid_requests_are_refused_with_a_reason(name: str) -> None:
    arguments: dict[str, Any] = {
        "instances": [],
        "viewmats": EYE,
        "Ks": K,
        "width": 10,
        "height": 10,
        "backend": "cpu",
    }
    changes, message = CASES[name]
    with pytest.raises(RenderError, match=message):
        rasterize(**arguments | changes)
