"""Which backends draw lenses and rolling shutters, and their kernels made ready."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from .._numba import is_on_disk
from ..scene import BrownConrady, Camera, GaussianCloud, Shutter, Sky
from .backends.base import Backend, draws_lens, no_lens
from .backends.select import select_backend
from .frame import render_cameras
from .types import Instance, RasterOptions, RenderError

EVERYTHING = RasterOptions(median_depth=True)


def refuse_lenses(backend: Backend, cameras: Sequence[Camera]) -> None:
    """Raises RenderError where ``backend`` cannot draw one of the cameras."""
    for camera in cameras:
        if not camera.is_pinhole and not draws_lens(backend):
            raise RenderError(no_lens(backend, camera))


def kernels_of_lenses_on_disk() -> bool:
    """Whether an earlier run left what :func:`warm_up_lenses` compiles longest."""
    from .backends.cpu.ray_project import project_rays  # Imported only where it is needed.

    return is_on_disk(project_rays)


def warm_up_lenses(backend: str | Backend = "auto") -> None:
    """Compile or load everything that a first frame through a lens or a rolling shutter would wait
    for; takes half a minute the first time."""
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    cloud = GaussianCloud(
        means=torch.tensor([[0.0, 0.0, 3.0], [0.2, 0.1, 0.4]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.full((2, 3), 0.3),
        opacities=torch.full((2,), 0.5),
        sh=torch.zeros(2, 1, 3),
    )
    K = np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]])
    for shutter in (Shutter(), Shutter("top_to_bottom", 1000)):
        camera = Camera("warm-up", 16, 16, K, np.eye(4), BrownConrady(), shutter)
        sky = Sky.uniform((0.1, 0.2, 0.3))
        render_cameras(
            [Instance(cloud)], [camera], np.eye(4), sky=sky, options=EVERYTHING, backend=chosen
        )
