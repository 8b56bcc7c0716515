"""How fast this machine draws for training: forward and back through a street, by stage."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..render.backends.base import Backend
from ..render.backends.select import describe_backends, select_backend
from ..render.rasterize import rasterize
from ..render.types import Instance, RasterOptions, RenderOutput
from ..scene import GaussianCloud, Sky
from .gaussian_street import street_scene

WIDTH, HEIGHT, FOCAL = 621, 188, 360.0
"""A KITTI image at half resolution [px]."""
DENSE_FACTOR = 5
"""The street is made with so many times the Gaussians and thinned out, to be long enough."""
SH_DEGREE = 3
NEEDED_RATIO = 3.0


@dataclass(frozen=True, eq=False)
class TrainingCase:
    """A picture to draw and the tensors that want gradients."""

    instances: list[Instance]
    viewmats: Tensor
    K: NDArray[np.float64]
    sky: Sky
    leaves: list[Tensor]

    @property
    def gaussian_count(self) -> int:
        """Gaussians of all instances together."""
        return sum(len(instance.cloud) for instance in self.instances)

    def draw(self, backend: Backend) -> RenderOutput:
        """RGB, alpha, depth and screen statistics, as densification wants them."""
        return rasterize(
            self.instances,
            self.viewmats,
            self.K[None],
            WIDTH,
            HEIGHT,
            sky=self.sky,
            options=RasterOptions(instance=False, track_screen=True),
            backend=backend,
        )


def run(*, gaussians: int = 76_000, backend: str = "auto", repetitions: int = 20) -> dict[str, Any]:
    """Measure forward and backward passes with gradients for everything a trainer learns.

    Clouds with harmonics of degree 3, object poses, the camera and the sky require gradients.

    Args:
        gaussians: in the scene, within one in a thousand.
        backend: as in rasterize().
        repetitions: passes measured, after two that warm up.

    Returns:
        Best and median milliseconds of ``forward_ms`` and ``backward_ms``, their ``stages_ms`` in
        the best pass, ``backward_per_forward`` of the best, whether it is within
        ``needed_ratio``, and ``passes_per_second`` of both together.
    """
    chosen = select_backend(backend)
    case = training_case(gaussians)
    passes = [_measure(case, chosen) for _ in range(repetitions + 2)][2:]
    best = min(passes, key=lambda timing: timing.forward_ms + timing.backward_ms)
    forward = min(timing.forward_ms for timing in passes)
    backward = min(timing.backward_ms for timing in passes)
    return {
        "backend": chosen.name,
        "device": next(s.reason for s in describe_backends() if s.name == chosen.name),
        "gaussians": case.gaussian_count,
        "width": WIDTH,
        "height": HEIGHT,
        "forward_ms": forward,
        "forward_median_ms": statistics.median(timing.forward_ms for timing in passes),
        "backward_ms": backward,
        "backward_median_ms": statistics.median(timing.backward_ms for timing in passes),
        "backward_per_forward": backward / forward,
        "needed_ratio": NEEDED_RATIO,
        "within_needed_ratio": backward <= NEEDED_RATIO * forward,
        "passes_per_second": 1e3 / (best.forward_ms + best.backward_ms),
        "stages_ms": best.stages_ms,
    }


def training_case(gaussians: int) -> TrainingCase:
    """A street with parked cars as a trainer holds it, seen along its axis."""
    street = street_scene(DENSE_FACTOR * gaussians)
    thinned: dict[int, GaussianCloud] = {}
    instances, leaves = [], []
    for instance in street.instances:
        cloud = thinned.get(id(instance.cloud))
        if cloud is None:
            cloud = thinned[id(instance.cloud)] = _thinned(instance.cloud)
            leaves += list(vars(cloud).values())
        pose = instance.T_world_object
        if pose is not None:
            pose = torch.tensor(pose, dtype=torch.float64, requires_grad=True)
            leaves.append(pose)
        instances.append(replace(instance, cloud=cloud, T_world_object=pose))
    viewmats = torch.from_numpy(street.camera.viewmat(street.T_world_vehicle)[None])
    viewmats = viewmats.clone().requires_grad_()
    sky = Sky(street.sky.faces.clone().requires_grad_())
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return TrainingCase(instances, viewmats, K, sky, [*leaves, viewmats, sky.faces])


def _thinned(cloud: GaussianCloud) -> GaussianCloud:
    """Every so many-th Gaussian, larger in turn so that surfaces stay closed."""
    generator = torch.Generator().manual_seed(0)
    kept = torch.randperm(len(cloud), generator=generator)[: len(cloud) // DENSE_FACTOR]
    few = cloud.select(kept).with_sh_degree(SH_DEGREE)
    parts = replace(few, scales=few.scales * DENSE_FACTOR**0.5)
    return GaussianCloud(*(part.clone().requires_grad_() for part in vars(parts).values()))


@dataclass(frozen=True)
class _PassTiming:
    forward_ms: float
    backward_ms: float
    stages_ms: dict[str, float]


def _measure(case: TrainingCase, backend: Backend) -> _PassTiming:
    for leaf in case.leaves:
        leaf.grad = None
    start = time.perf_counter()
    output = case.draw(backend)
    _wait(output.alpha)
    drawn = time.perf_counter()
    losses = _loss_gradients(output)
    ready = time.perf_counter()
    images = [image for image in (output.rgb, output.alpha, output.depth) if image is not None]
    torch.autograd.backward(images, losses)
    _wait(case.leaves[-1].grad)
    done = time.perf_counter()
    return _PassTiming(
        forward_ms=(drawn - start) * 1e3,
        backward_ms=(done - ready) * 1e3,
        stages_ms=dict(output.timing_ms),
    )


def _loss_gradients(output: RenderOutput) -> Sequence[Tensor]:
    """Fixed noise in place of a loss, which is not what is measured here."""
    generator = torch.Generator().manual_seed(0)
    images = (output.rgb, output.alpha, output.depth)
    return [
        torch.randn(image.shape, generator=generator).to(image.device) / image.numel()
        for image in images
        if image is not None
    ]


def _wait(tensor: Tensor | None) -> None:
    """Until a GPU has computed it."""
    if tensor is not None:
        float(tensor.detach().reshape(-1)[0])
