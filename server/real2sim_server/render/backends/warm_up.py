"""Small requests that together use every path of a backend."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from ...scene import GaussianCloud
from ..types import Detail, Instance, RasterOptions, Sky
from .base import RasterRequest

MANY = 5_000
"""More Gaussians than a backend treats as one block."""


def warm_up_requests() -> Iterator[RasterRequest]:
    """One request for each combination that could be compiled on its own."""
    yield from picture_requests()
    yield from small_requests()


def picture_requests() -> Iterator[RasterRequest]:
    """Those of a scene's first picture, which shows clouds of many Gaussians."""
    for labels in (False, True):
        yield _request(_cloud(MANY), labels=labels)


def small_requests() -> Iterator[RasterRequest]:
    """Those of clouds of few Gaussians, and of small images, for which Gaussians are merged."""
    details: tuple[Detail, ...] = ("full", "auto")
    for detail in details:
        yield _request(_cloud(2), _cloud(MANY), labels=True, detail=detail)


def _request(
    placed: GaussianCloud, *others: GaussianCloud, labels: bool, detail: Detail = "full"
) -> RasterRequest:
    covars = (0.01 * torch.eye(3)).repeat(len(placed), 1, 1)
    K = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]], dtype=torch.float64)
    return RasterRequest(
        instances=(
            *map(Instance, (placed, *others)),
            Instance(placed, T_world_object=np.eye(4), instance_id=1, covars=covars),
        ),
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=K,
        width=16,
        height=16,
        sky=Sky.uniform((0.5, 0.6, 0.7)),
        options=RasterOptions(depth=labels, instance=labels, detail=detail),
    )


def _cloud(count: int) -> GaussianCloud:
    """A cloud of this many Gaussians, at two places in front of the camera."""
    two = GaussianCloud(
        means=torch.tensor([[0.0, 0, 2], [0, 0, 3]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 16, 3),
    )
    return two.select(torch.arange(count) % 2)
