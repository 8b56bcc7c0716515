"""Kernels of casting made ready."""

from __future__ import annotations

import numpy as np
import torch

from ..._numba import is_on_disk
from ...scene import Beams, GaussianCloud, Lidar
from ..types import Instance
from .call import cast


def kernels_of_casting_on_disk() -> bool:
    """Whether an earlier run left what :func:`warm_up_casting` compiles."""
    from .cpu.blend import follow_rays  # Imported only where it is needed.

    return is_on_disk(follow_rays)


def warm_up_casting() -> None:
    """Compile or load everything that a first sweep would wait for; takes twenty seconds the first
    time."""
    cloud = GaussianCloud(
        means=torch.tensor([[3.0, 0.0, 0.0], [0.4, 0.1, 0.2]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.full((2, 3), 0.3),
        opacities=torch.full((2,), 0.9),
        sh=torch.zeros(2, 1, 3),
    )
    covars = torch.eye(3).repeat(2, 1, 1) * 0.09
    turning = Beams.spinning(np.array([0.0, 0.1]), columns=32)
    table = Beams(np.zeros(8), np.linspace(-0.1, 0.1, 8), np.zeros(8))
    for beams in (turning, table):
        for returns in (1, 3):
            lidar = Lidar("warm-up", beams, returns=returns, divergence=(1e-3, 1e-3))
            moving = np.tile(np.eye(4), (len(beams.slots[0]), 1, 1))
            moving[:, 0, 3] = np.linspace(0.0, 0.1, len(moving))
            cast(
                [Instance(cloud), Instance(cloud, np.eye(4), 1, covars=covars)],
                lidar,
                moving,
                object_poses=[None, moving],
                attributes=[np.full((2, 2), 0.5, np.float32), None],
            )
