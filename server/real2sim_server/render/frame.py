"""What the cameras of a vehicle see at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..scene import Camera
from .backends.base import Backend
from .backends.select import select_backend
from .rasterize import DEFAULT_OPTIONS, rasterize
from .types import Instance, RasterOptions, RenderError, RenderOutput, Sky


@dataclass(frozen=True, eq=False)
class Frame:
    """The images of one camera.

    Attributes:
        camera: its name.
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32 along the camera z axis [m], 0 where alpha is below 0.5; None when
            not asked for.
        instance: [H, W] uint16 instance ids, 0 is background; None when not asked for.
        T_world_camera: [4, 4] float64, OpenCV camera frame to world.
        timing_ms: by stage; cameras drawn together share their time equally.
    """

    camera: str
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None
    instance: NDArray[np.uint16] | None
    T_world_camera: NDArray[np.float64]
    timing_ms: dict[str, float] = field(default_factory=dict)


def render_cameras(
    instances: Sequence[Instance],
    cameras: Sequence[Camera],
    T_world_vehicle: ArrayLike,
    *,
    sky: Sky | None = None,
    options: RasterOptions = DEFAULT_OPTIONS,
    backend: str | Backend = "auto",
) -> list[Frame]:
    """Frames of ``cameras`` in their order; cameras of one size are drawn in one call.

    Args:
        instances: what is in the world, see rasterize().
        cameras: on the vehicle.
        T_world_vehicle: [4, 4] pose of the vehicle.

    Raises:
        RenderError: as rasterize(); also for a vehicle pose that is not rigid.
    """
    vehicle = np.asarray(T_world_vehicle, dtype=np.float64)
    if vehicle.shape != (4, 4) or not np.isfinite(vehicle).all():
        raise RenderError(f"T_world_vehicle must be [4, 4] and finite, not {vehicle.tolist()}")
    groups: dict[tuple[int, int], list[int]] = {}
    for index, camera in enumerate(cameras):
        groups.setdefault((camera.width, camera.height), []).append(index)
    frames: dict[int, Frame] = {}
    for (width, height), members in groups.items():
        group = [cameras[index] for index in members]
        output = rasterize(
            instances,
            np.stack([camera.viewmat(vehicle) for camera in group]),
            np.stack([camera.K for camera in group]),
            width,
            height,
            sky=sky,
            options=options,
            backend=backend,
        )
        frames.update(zip(members, _frames(group, vehicle, output), strict=True))
    return [frames[index] for index in range(len(cameras))]


def warm_up(backend: str | Backend = "auto") -> None:
    """Compile or load everything a first frame would wait for; takes seconds the first time."""
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    chosen.warm_up()
    camera = Camera("warm-up", 16, 16, np.array([[8.0, 0, 8], [0, 8, 8], [0, 0, 1]]), np.eye(4))
    render_cameras([], [camera], np.eye(4), backend=chosen)


def _frames(
    cameras: Sequence[Camera], vehicle: NDArray[np.float64], output: RenderOutput
) -> list[Frame]:
    from .quantize import solid_depth, to_uint8

    rgb = to_uint8(output.rgb)
    depth = None if output.depth is None else solid_depth(output.depth, output.alpha)
    instance = None if output.instance is None else output.instance.cpu().numpy()
    share = {stage: value / len(cameras) for stage, value in output.timing_ms.items()}
    return [
        Frame(
            camera=camera.name,
            rgb=rgb[c],
            depth=None if depth is None else depth[c],
            instance=None if instance is None else instance[c],
            T_world_camera=camera.pose(vehicle),
            timing_ms=dict(share),
        )
        for c, camera in enumerate(cameras)
    ]
