"""The CPU backend: Numba kernels on all cores.

Cameras are drawn one at a time: clusters are projected in place, then records are sorted by depth,
assigned to tiles and blended. Work space grows on demand and is reused.

Interruptible requests are processed in pieces; requests drawn in between use a separate work space.
Results are bitwise equal, because tiles and rows are independent.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..._numba import made
from ..backend import (
    RasterRequest,
    is_reduced,
    needs_gradients,
    picture_requests,
    place_instances,
    with_colours,
)
from ..types import LabelOutput, RenderError, RenderOutput, Window, WorldViews
from .drawing import Drawing, Workspace, seen_chunks, timed, view_of
from .gradients import TrainingPasses
from .labels import draw_labels
from .ray_drawing import draw_rays
from .records import Images
from .small_images import SmallImages

PICTURE_KERNELS = 9
"""Number of kernels that :meth:`CpuBackend.warm_up` compiles or loads."""


class CpuBackend:
    """Rasterizer for any CPU. Calls from several threads are serialised."""

    name = "cpu"
    draws_lenses = True

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._idle_spaces: list[Workspace] = []
        self._training = TrainingPasses(self._lock)
        self._small = SmallImages()

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw one camera after the other into shared output arrays."""
        if is_reduced(request):
            return self.rasterize_batch([request])
        if needs_gradients(request):
            if request.optics is not None:
                raise RenderError(
                    "the backend 'cpu' carries no gradients through lenses and rolling shutters; "
                    "train with images freed of distortion, or draw with 'reference'"
                )
            return self._training.rasterize(with_colours(request))
        shape = (request.cameras, request.height, request.width)
        options = request.options
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (shape[0], 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (shape[0], 0, 0), np.uint16)
        median = np.empty(shape if options.median_depth else (shape[0], 0, 0), np.float32)
        timing: dict[str, float] = dict.fromkeys(("project", "sort", "tile", "blend", "sky"), 0.0)
        placement = place_instances(request.instances, request.viewmats.detach().cpu())
        with self._work_space() as space:
            if request.optics is not None:
                images = Images(rgb[0], alpha[0], depth[0], instance[0], median[0])
                draw_rays(request, placement, images, space, timing)
                return _output(request, (rgb, alpha, depth, instance, median), timing)
            with timed(timing, "project"):
                views = [view_of(request, c) for c in range(request.cameras)]
                seen = seen_chunks(request, placement, views)
            for c in range(request.cameras):
                images = Images(rgb[c], alpha[c], depth[c], instance[c], median[c])
                drawing = Drawing(request, c, images, space, timing)
                drawing.draw(placement, seen[c])
        return _output(request, (rgb, alpha, depth, instance, median), timing)

    def rasterize_batch(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """Draw small images of many requests, see SmallImages."""
        with self._lock:
            return self._small.draw(requests)

    def rasterize_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """Draw small images of many worlds with the same instances, see SmallImages."""
        with self._lock:
            return self._small.draw_worlds(worlds, like)

    def label(
        self,
        request: RasterRequest,
        windows: Sequence[Sequence[Window]],
        *,
        level: float,
        along_rays: bool = True,
    ) -> list[LabelOutput]:
        """Draw images and labels in one pass, see LabelBackend."""
        with self._work_space() as space, torch.no_grad():
            return draw_labels(request, windows, space, level=level, along_rays=along_rays)

    def warm_up(self) -> None:
        """Compile the kernels of a first image, or load them from the disk cache.

        Excludes the kernels for small images and for clouds of few Gaussians.
        """
        made.expect(PICTURE_KERNELS)
        for request in picture_requests():
            self.rasterize(request)

    @contextmanager
    def _work_space(self) -> Iterator[Workspace]:
        """Context with exclusive work space, even if another request interrupts it."""
        with self._lock:
            space = self._idle_spaces.pop() if self._idle_spaces else Workspace()
            try:
                yield space
            finally:
                self._idle_spaces.append(space)


def _output(
    request: RasterRequest, images: Sequence[NDArray[Any]], timing: dict[str, float]
) -> RenderOutput:
    """RenderOutput with the requested images of RGB, alpha, depth, instance and median depth."""
    options = request.options
    rgb, alpha, depth, instance, median = map(torch.from_numpy, images)
    return RenderOutput(
        rgb=rgb,
        alpha=alpha,
        depth=depth if options.depth else None,
        instance=instance if options.instance else None,
        timing_ms=timing,
        between=request.between,
        median_depth=median if options.median_depth else None,
    )
