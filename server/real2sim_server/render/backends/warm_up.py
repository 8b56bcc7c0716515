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

WARM_UPS: dict[Detail, tuple[bool, ...]] = {"full": (False, True), "auto": (True,)}
"""Whether with depth and instances, by detail."""


def warm_up_requests(*details: Detail) -> Iterator[RasterRequest]:
    """One request for each combination that could be compiled on its own.

    Args:
        details: ``full``, and ``auto`` for small images; both where none is given.
    """
    cloud = GaussianCloud(
        means=torch.tensor([[0.0, 0, 2], [0, 0, 3]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scales=torch.full((2, 3), 0.1),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 16, 3),
    )
    many = cloud.select(torch.zeros(MANY, dtype=torch.int64))
    covars = (0.01 * torch.eye(3)).repeat(2, 1, 1)
    K = torch.tensor([[[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]], dtype=torch.float64)
    combinations = [(d, labels) for d in details or WARM_UPS for labels in WARM_UPS[d]]
    for detail, labels in combinations:
        yield RasterRequest(
            instances=(
                Instance(cloud),
                Instance(many),
                Instance(cloud, T_world_object=np.eye(4), instance_id=1, covars=covars),
            ),
            viewmats=torch.eye(4, dtype=torch.float64)[None],
            Ks=K,
            width=16,
            height=16,
            sky=Sky.uniform((0.5, 0.6, 0.7)),
            options=RasterOptions(depth=labels, instance=labels, detail=detail),
        )
