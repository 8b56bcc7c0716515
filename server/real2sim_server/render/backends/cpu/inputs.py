"""What the kernels of the CPU backend are given: arrays of a request, and space to work in."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...types import Instance
from ..base import CLAMP_MARGIN, Placement, RasterRequest
from .cull import Chunks, arrays_of
from .project import project_cluster, project_small_cluster
from .records import CHUNK, RECORD, CameraParameters, Cluster, Records

NO_COVARS = np.zeros((0, 3, 3), np.float32)
NO_COEFFICIENTS = np.zeros((0, 0, 3), np.float32)
NO_TONES = np.zeros(0, np.float32)


class Workspace:
    """Uninitialised arrays by name that grow to what was needed and are kept."""

    def __init__(self) -> None:
        self._held: dict[str, NDArray[Any]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """The array of that name, its values left over from the last use."""
        size = int(np.prod(shape))
        held = self._held.get(name)
        if held is None or held.size < size:
            held = self._held[name] = np.empty(size + size // 4, dtype)
        return held[:size].reshape(shape)


def project(
    request: RasterRequest,
    placement: Placement,
    camera: int,
    chunks: Sequence[Chunks],
    space: Workspace,
) -> tuple[Records, int]:
    """Records of the given chunks of all instances, and the number of regions they fill."""
    total = sum(map(len, chunks))
    records = Records(
        space.array("values", (total * CHUNK, RECORD), np.float32),
        space.array("footprints", (total * CHUNK,), np.int64),
        space.array("depths", (total * CHUNK,), np.float32),
        space.array("counts", (total,), np.int64),
    )
    view, places = view_of(request, camera), places_of(placement, camera)
    base = 0
    for index, instance in enumerate(request.instances):
        count = len(chunks[index])
        if count:
            cluster = cluster_of(instance, places, index)
            draw = project_cluster if count > 1 else project_small_cluster
            draw(cluster, view, base * CHUNK, chunks[index], records)
        base += count
    return records, total


class Places(NamedTuple):
    """The part of a Placement that one camera needs, contiguous."""

    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]


def places_of(placement: Placement, camera: int) -> Places:
    """Where all instances stand before one camera."""
    return Places(
        linear=np.ascontiguousarray(placement.linear[camera].numpy()),
        offset=np.ascontiguousarray(placement.offset[camera].numpy()),
        camera_position=placement.camera_position[camera].numpy().astype(np.float32, order="C"),
        scale=placement.scale.numpy().astype(np.float32, order="C"),
    )


def cluster_of(instance: Instance, places: Places, index: int) -> Cluster:
    """The arrays of one instance as one camera needs them; nothing large is copied."""
    cloud, colour = arrays_of(instance.cloud), instance.colour
    return Cluster(
        *cloud,
        covars=NO_COVARS if instance.covars is None else array_of(instance.covars),
        linear=places.linear[index],
        offset=places.offset[index],
        camera_position=places.camera_position[index],
        scale=places.scale[index],
        instance_id=np.float32(instance.instance_id),
        coefficients=NO_COEFFICIENTS if colour is None else array_of(colour.coefficients),
        tones=NO_TONES if colour is None else array_of(colour.tones(instance.t_us)),
    )


def array_of(tensor: torch.Tensor) -> NDArray[np.float32]:
    """View of a CPU tensor; a copy only where it lies elsewhere or is not contiguous."""
    return tensor.detach().cpu().contiguous().numpy()


def view_of(request: RasterRequest, camera: int) -> CameraParameters:
    """Camera and options as the kernels take them."""
    options, width, height = request.options, request.width, request.height
    K = request.Ks[camera].detach().cpu().numpy()
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = CLAMP_MARGIN * 0.5 * width / fx, CLAMP_MARGIN * 0.5 * height / fy
    numbers = {
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "width": width,
        "height": height,
        "left": -cx / fx - margin_x,
        "right": (width - cx) / fx + margin_x,
        "top": -cy / fy - margin_y,
        "bottom": (height - cy) / fy + margin_y,
        "near_plane": options.near_plane,
        "far_plane": options.far_plane,
        "eps2d": options.eps2d,
        "radius_clip": options.radius_clip,
        "antialiased": options.rasterize_mode == "antialiased",
        "blur": options.eps2d**0.5,
    }
    return CameraParameters(**{name: np.float32(value) for name, value in numbers.items()})


@contextmanager
def timed(timing: dict[str, float], stage: str) -> Iterator[None]:
    """Add the milliseconds of the block to ``timing[stage]``."""
    start = time.perf_counter()
    yield
    timing[stage] = timing.get(stage, 0.0) + (time.perf_counter() - start) * 1e3
