"""Pictures with labels in one walk: colours, and depth and object of each pixel, also of objects as
if they stood alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera
from .backends.base import Backend, RasterRequest
from .frame import alike
from .quantize import to_uint8
from .rasterize import DEFAULT_OPTIONS, checked_request
from .types import Instance, LabelOutput, Sky, Window

FRONT = 0.2
"""Transmittance at which the front of a pixel lies, of what labels show."""


@runtime_checkable
class LabelBackend(Protocol):
    """A Backend that finds labels while it draws colours."""

    def label(
        self,
        request: RasterRequest,
        windows: Sequence[Sequence[Window]],
        *,
        level: float,
        along_rays: bool = True,
    ) -> list[LabelOutput]:
        """Picture and labels of each camera.

        Args:
            request: without optics.
            windows: of objects, one each, by camera.
            level: transmittance at which the front of a pixel lies, the Gaussian that brings it
                there or below; at most a half, which counts where it is not reached.
            along_rays: whether depth is where a pixel's ray meets its front most, or the depth of
                the front's centre.
        """
        ...


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """One camera's picture and labels, see LabelOutput.

    Attributes:
        rgb: [H, W, 3] uint8, the bytes of a picture alone.
        depth: [H, W] float32 [m].
        instance: [H, W] uint16.
        alone: depths [h, w] float32 by window.
        T_world_camera: [4, 4].
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    alone: Sequence[NDArray[np.float32]]
    T_world_camera: NDArray[np.float64]


def labels_while_drawing(backend: Backend, cameras: Sequence[Camera]) -> bool:
    """Whether :func:`label_cameras` can do it: others draw a pass for each label."""
    return isinstance(backend, LabelBackend) and all(camera.is_pinhole for camera in cameras)


def label_cameras(
    instances: Sequence[Instance],
    cameras: Sequence[Camera],
    T_world_vehicle: NDArray[np.float64],
    windows: Sequence[Sequence[Window]],
    *,
    sky: Sky | None,
    backend: LabelBackend,
) -> list[LabelledFrame]:
    """Pictures and labels of ``cameras`` in their order.

    Args:
        instances: what is in the world, see rasterize().
        cameras: pinholes on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle.
        windows: of objects that are also asked for alone, by camera.
        sky: behind everything.
        backend: draws.

    Raises:
        RenderError: as rasterize().
    """
    frames: dict[int, LabelledFrame] = {}
    for members in alike(cameras):
        first = cameras[members[0]]
        request = checked_request(
            instances,
            np.stack([cameras[index].viewmat(T_world_vehicle) for index in members]),
            np.stack([cameras[index].K for index in members]),
            (first.width, first.height),
            sky=sky,
            options=DEFAULT_OPTIONS,
        )
        outputs = backend.label(request, [windows[index] for index in members], level=FRONT)
        for index, output in zip(members, outputs, strict=True):
            frames[index] = LabelledFrame(
                to_uint8(output.rgb),
                output.depth,
                output.instance,
                output.alone,
                cameras[index].pose(T_world_vehicle),
            )
    return [frames[index] for index in range(len(cameras))]
