"""The CPU backend: Numba kernels on all cores.

One camera at a time: every cluster is projected where it lies, the records are sorted by depth,
dealt to tiles and blended. Work space grows to what was needed and is kept.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..types import Instance, RenderOutput
from .base import CLAMP_MARGIN, Placement, RasterRequest, direction_matrix, place_instances
from .cpu_blend import blend_tiles
from .cpu_project import project_cluster
from .cpu_records import CHUNK, RECORD, TILE, Cluster, Images, Records, View
from .cpu_sky import add_sky
from .cpu_sort import sort_records
from .cpu_tile import TILE_CHUNKS, count_tiles, scatter_tiles, tile_starts
from .warm_up import warm_up_requests

LIST_BUDGET = 1 << 26
"""Entries of tile lists held at once; larger pictures are made in bands of tile rows."""
NO_COVARS = np.zeros((0, 3, 3), np.float32)


class CpuBackend:
    """Rasterizer for any CPU. One call at a time; further ones wait."""

    name = "cpu"

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._space: dict[str, NDArray[Any]] = {}

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw one camera after the other into shared output arrays."""
        shape = (request.cameras, request.height, request.width)
        options = request.options
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (shape[0], 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (shape[0], 0, 0), np.uint16)
        timing: dict[str, float] = dict.fromkeys(("project", "sort", "tile", "blend", "sky"), 0.0)
        placement = place_instances(request.instances, request.viewmats.detach().cpu())
        with self._lock:
            for c in range(request.cameras):
                images = Images(rgb[c], alpha[c], depth[c], instance[c])
                self._draw(request, placement, c, images, timing)
        return RenderOutput(
            rgb=torch.from_numpy(rgb),
            alpha=torch.from_numpy(alpha),
            depth=torch.from_numpy(depth) if options.depth else None,
            instance=torch.from_numpy(instance) if options.instance else None,
            timing_ms=timing,
        )

    def warm_up(self) -> None:
        """Compile every kernel, or load it from the disk cache."""
        for request in warm_up_requests():
            self.rasterize(request)

    def _draw(
        self,
        request: RasterRequest,
        placement: Placement,
        camera: int,
        images: Images,
        timing: dict[str, float],
    ) -> None:
        with _timed(timing, "project"):
            records, regions = self._project(request, placement, camera)
        with _timed(timing, "sort"):
            pairs = self._array("pairs", (int(records.counts[:regions].sum()),), np.uint64)
            scratch = self._array("pairs_scratch", pairs.shape, np.uint64)
            order = sort_records(records, regions, pairs, scratch)
        self._blend(request, records, order, images, timing)
        if request.sky is not None:
            with _timed(timing, "sky"):
                faces = np.ascontiguousarray(request.sky.faces.detach().cpu().numpy())
                matrix = direction_matrix(request, camera).cpu().contiguous().numpy()
                add_sky(faces, matrix, images.rgb, images.alpha)

    def _project(
        self, request: RasterRequest, placement: Placement, camera: int
    ) -> tuple[Records, int]:
        regions = [-(-len(instance.cloud) // CHUNK) for instance in request.instances]
        total = sum(regions)
        records = Records(
            self._array("values", (total * CHUNK, RECORD), np.float32),
            self._array("boxes", (total * CHUNK,), np.int64),
            self._array("depths", (total * CHUNK,), np.float32),
            self._array("counts", (total,), np.int64),
        )
        view = _view(request, camera)
        base = 0
        for index, instance in enumerate(request.instances):
            if regions[index]:
                cluster = _cluster(instance, placement, camera, index)
                project_cluster(cluster, view, base * CHUNK, records)
            base += regions[index]
        return records, total

    def _blend(
        self,
        request: RasterRequest,
        records: Records,
        order: NDArray[np.uint64],
        images: Images,
        timing: dict[str, float],
    ) -> None:
        tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
        background = (0.0, 0.0, 0.0) if request.sky is not None else request.options.background
        behind = np.array(background, np.float32)
        starts = self._array("starts", (tiles_x * tiles_y + 1,), np.int64)
        with _timed(timing, "tile"):
            cursors = self._array("cursors", (TILE_CHUNKS, tiles_x * tiles_y), np.int64)
            boxes = self._array("ordered_boxes", order.shape, np.int64)
            count_tiles(records.values, records.boxes, order, tiles_x, boxes, cursors)
            bands = _bands(cursors.sum(0).reshape(tiles_y, tiles_x).sum(1))
        for first, last in bands:
            tiles = first * tiles_x, last * tiles_x
            with _timed(timing, "tile"):
                tile_starts(cursors, *tiles, starts)
                lists = self._array("lists", (int(starts[tiles[1]]),), np.int32)
                scatter_tiles(records.values, boxes, order, tiles_x, first, last, cursors, lists)
            with _timed(timing, "blend"):
                blend_tiles(records.values, lists, starts, tiles_x, *tiles, behind, images)

    def _array(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray[Any]:
        """Uninitialised work space that is kept from call to call."""
        size = int(np.prod(shape))
        held = self._space.get(name)
        if held is None or held.size < size:
            held = self._space[name] = np.empty(size + size // 4, dtype)
        return held[:size].reshape(shape)


def _bands(row_totals: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Ranges of tile rows whose lists fit LIST_BUDGET together, at least one row each."""
    first, held = 0, 0
    for row, total in enumerate(row_totals):
        if row > first and held + total > LIST_BUDGET:
            yield first, row
            first, held = row, 0
        held += int(total)
    yield first, len(row_totals)


def _cluster(instance: Instance, placement: Placement, camera: int, index: int) -> Cluster:
    cloud = instance.cloud
    covars = NO_COVARS if instance.covars is None else _numpy(instance.covars)
    return Cluster(
        means=_numpy(cloud.means),
        quats=_numpy(cloud.quats),
        scales=_numpy(cloud.scales),
        opacities=_numpy(cloud.opacities),
        sh=_numpy(cloud.sh),
        covars=covars,
        linear=np.ascontiguousarray(placement.linear[camera, index].numpy()),
        offset=placement.offset[camera, index].numpy(),
        camera_position=placement.camera_position[camera, index].numpy().astype(np.float32),
        scale=placement.scale[index].numpy().astype(np.float32),
        instance_id=np.float32(instance.instance_id),
    )


def _numpy(tensor: torch.Tensor) -> NDArray[np.float32]:
    """View of a CPU tensor; a copy only where it lies elsewhere or is not contiguous."""
    return tensor.detach().cpu().contiguous().numpy()


def _view(request: RasterRequest, camera: int) -> View:
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
    return View(**{name: np.float32(value) for name, value in numbers.items()})


@contextmanager
def _timed(timing: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    timing[stage] += (time.perf_counter() - start) * 1e3
