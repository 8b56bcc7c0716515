"""Passes of the CPU backend that carry gradients.

The forward pass uses the same kernels as other passes and stores the records and tile lists of each
camera. The backward pass prepares the pixels, traverses the tiles front to back again, sums the
tile gradients of each Gaussian and applies the chain rule through projection and colour. Torch
computes the gradients of poses and cameras from those of the placements.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from ..._numba import PARALLEL_LOOPS
from ..backend import (
    Placement,
    RasterRequest,
    direction_matrix,
    empty_statistics,
    place_instances,
    screen_scale,
)
from ..types import RenderOutput, ScreenStatistics
from .blend import LOW_BITS, TILE_CHUNKS, blend_tiles, count_tiles, sort_records, tile_starts
from .blend_backward import BACKWARD_PLANES, HALVES, SLOT, Losses, blend_tiles_backward, open_pixels
from .drawing import (
    NO_COVARS,
    Workspace,
    all_chunks,
    array_of,
    cluster_of,
    places_of,
    project,
    timed,
    view_of,
)
from .lanes import LANES, kernel
from .project import tile_columns, tile_rows
from .project_backward import (
    PLACEMENT,
    Gradients,
    SlotSums,
    project_backward,
    project_small_backward,
)
from .records import CHUNK, EXTENT_X, EXTENT_Y, MEMBER, TILE, Images, Records
from .sky import add_sky, sample_sky, sky_backward


@kernel(parallel=PARALLEL_LOOPS)
def scatter_slots(values, footprints, order, tiles_x, first_slots, cursors, lists, slots, spans):
    """Like scatter_tiles for the whole image; also numbers the entries by record.

    Args:
        values, footprints, order, tiles_x, cursors: as for scatter_tiles.
        first_slots: [TILE_CHUNKS] int64, number of entries in the preceding chunks.
        lists: [L] int32, written: record of each entry.
        slots: [L] int32, written: slot of each entry.
        spans: [M, 2] int32, written for each record in ``order``: its slots [first, last).
    """
    total = order.shape[0]
    step = (total + TILE_CHUNKS - 1) // TILE_CHUNKS
    for chunk in prange(TILE_CHUNKS):
        slot = first_slots[chunk]
        for i in range(chunk * step, min(total, (chunk + 1) * step)):
            index = np.int64(order[i] & LOW_BITS)
            footprint = footprints[i]
            first, last = tile_rows(footprint)
            spans[index, 0] = slot
            for row in range(first, last):
                left, right = tile_columns(values, footprint, index, row)
                for column in range(left, right):
                    tile = row * tiles_x + column
                    place = cursors[chunk, tile]
                    lists[place] = index
                    slots[place] = slot
                    cursors[chunk, tile] = place + 1
                    slot += 1
            spans[index, 1] = slot


# Forward pass of one camera, with state for the backward pass


@dataclass(frozen=True, eq=False)
class CameraPass:
    """State of one camera for the backward pass.

    Attributes:
        records: Records, and the number of regions in use.
        lists, slots, spans: see scatter_slots.
        starts: [tiles + 1] int64, start of each tile's list.
    """

    records: Records
    lists: NDArray[np.int32]
    slots: NDArray[np.int32]
    spans: NDArray[np.int32]
    starts: NDArray[np.int64]


def draw_camera(
    request: RasterRequest,
    placement: Placement,
    timing: dict[str, float],
    camera: int,
    images: Images,
    space: Workspace,
) -> CameraPass:
    """Draw one camera and return its state; adds to ``timing`` [ms] by stage."""
    with timed(timing, "project"):
        records, regions = project(request, placement, camera, all_chunks(request), space)
    with timed(timing, "sort"):
        pairs = space.array("pairs", (int(records.counts[:regions].sum()),), np.uint64)
        scratch = space.array("pairs_scratch", pairs.shape, np.uint64)
        order = sort_records(records, regions, pairs, scratch)
    with timed(timing, "tile"):
        seen = _make_lists(request, records, order, space)
    with timed(timing, "blend"):
        tiles_x, tiles = -(-request.width // TILE), len(seen.starts) - 1
        behind = constant_behind(request)
        blend_tiles(records.values, seen.lists, seen.starts, tiles_x, 0, tiles, behind, images)
    if request.sky is not None:
        with timed(timing, "sky"):
            matrix = array_of(direction_matrix(request, camera))
            add_sky(array_of(request.sky.faces), matrix, 0, images.rgb, images.alpha)
    return seen


def _make_lists(
    request: RasterRequest, records: Records, order: NDArray[np.uint64], space: Workspace
) -> CameraPass:
    tiles_x, tiles_y = -(-request.width // TILE), -(-request.height // TILE)
    tiles = tiles_x * tiles_y
    cursors = space.array("cursors", (TILE_CHUNKS, tiles), np.int64)
    footprints = space.array("ordered_footprints", order.shape, np.int64)
    starts = space.array("starts", (tiles + 1,), np.int64)
    count_tiles(records.values, records.footprints, order, tiles_x, footprints, cursors)
    by_chunk = cursors.sum(1)
    first_slots = np.cumsum(by_chunk) - by_chunk
    tile_starts(cursors, 0, tiles, starts)
    length = int(by_chunk.sum())
    seen = CameraPass(
        records=records,
        lists=space.array("lists", (length,), np.int32),
        slots=space.array("slots", (length,), np.int32),
        spans=space.array("spans", (len(records.footprints), 2), np.int32),
        starts=starts,
    )
    scatter_slots(
        records.values,
        footprints,
        order,
        tiles_x,
        first_slots,
        cursors,
        seen.lists,
        seen.slots,
        seen.spans,
    )
    return seen


def constant_behind(request: RasterRequest) -> NDArray[np.float32]:
    """Colour over which the image is composited."""
    color = (0.0, 0.0, 0.0) if request.sky is not None else request.options.background
    return np.array(color, np.float32)


def note_radii(
    request: RasterRequest, seen: CameraPass, screen: ScreenStatistics, camera: int
) -> None:
    """Write the screen radii [px] of the drawn Gaussians to ``screen``."""
    values, counts = seen.records.values, seen.records.counts
    region = 0
    for index, instance in enumerate(request.instances):
        radii = screen.radii[index][camera].numpy()
        for start in range(0, len(instance.cloud), CHUNK):
            used = values[region * CHUNK : region * CHUNK + counts[region]]
            extents = np.maximum(used[:, EXTENT_X], used[:, EXTENT_Y])
            radii[start + used[:, MEMBER].astype(np.int64)] = np.ceil(extents)
            region += 1


# Forward and backward passes

CLOUD_PARTS = ("means", "quats", "scales", "opacities", "sh")
STAGES = ("project", "sort", "tile", "blend", "sky")
NOTHING = np.zeros((0, 0), np.float32)
NO_INSTANCES = np.zeros((0, 0), np.uint16)
NO_MEDIAN = np.zeros((0, 0), np.float32)


class TrainingPass:
    """State of one rasterize() call for the forward and backward pass.

    Attributes:
        placement: placement of all instances, detached.
        cameras: state by camera, filled by the forward pass.
    """

    def __init__(self, request: RasterRequest, placement: Placement) -> None:
        self.request = request
        self.placement = placement
        self.cameras: list[CameraPass] = []
        self.timing = dict.fromkeys(STAGES, 0.0)
        self.instance: Tensor | None = None
        self.median_depth: Tensor | None = None
        self.screen: ScreenStatistics | None = None
        if request.options.track_screen:
            self.screen = empty_statistics(request)


class TrainingPasses:
    """Runs passes with gradients, one at a time, with a reused work space.

    Args:
        lock: held while kernels run; shared with passes without gradients.
    """

    def __init__(self, lock: threading.RLock) -> None:
        self.lock = lock
        self.space = Workspace()
        self._idle: list[Workspace] = []

    def rasterize(self, request: RasterRequest) -> RenderOutput:
        """Draw the request as a differentiable torch operation."""
        placement = place_instances(request.instances, request.viewmats.cpu())
        fixed = Placement(*(tensor.detach() for tensor in vars(placement).values()))
        training = TrainingPass(request, fixed)
        rgb, alpha, depth = _Rasterization.apply(
            self,
            training,
            placement.linear,
            placement.offset,
            placement.camera_position,
            None if request.sky is None else request.sky.faces,
            *_cloud_tensors(request),
        )
        return RenderOutput(
            rgb=rgb,
            alpha=alpha,
            depth=depth if request.options.depth else None,
            instance=training.instance,
            median_depth=training.median_depth,
            timing_ms=training.timing,
            screen=training.screen,
        )

    def forward(self, training: TrainingPass) -> tuple[Tensor, Tensor, Tensor]:
        """RGB, alpha and depth of all cameras."""
        request, options = training.request, training.request.options
        shape = (request.cameras, request.height, request.width)
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (shape[0], 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (shape[0], 0, 0), np.uint16)
        median = np.empty(shape if options.median_depth else (shape[0], 0, 0), np.float32)
        spaces = []
        with self.lock:
            for camera in range(request.cameras):
                spaces.append(self._idle.pop() if self._idle else Workspace())
                images = Images(
                    rgb[camera], alpha[camera], depth[camera], instance[camera], median[camera]
                )
                seen = draw_camera(
                    request, training.placement, training.timing, camera, images, spaces[-1]
                )
                training.cameras.append(seen)
                if training.screen is not None:
                    note_radii(request, seen, training.screen, camera)
        weakref.finalize(training, self._idle.extend, spaces)
        if options.instance:
            training.instance = torch.from_numpy(instance)
        if options.median_depth:
            training.median_depth = torch.from_numpy(median)
        return torch.from_numpy(rgb), torch.from_numpy(alpha), torch.from_numpy(depth)

    def backward(
        self, training: TrainingPass, images: tuple[Tensor, ...], losses: tuple[Tensor | None, ...]
    ) -> BackwardResult:
        """Gradients of placements, sky and clouds, from the gradients of RGB, alpha and depth."""
        result = BackwardResult(training.request)
        with self.lock:
            for camera in range(training.request.cameras):
                rgb, alpha, depth = (_camera_image(image, camera) for image in images)
                seen = Images(rgb, alpha, depth, NO_INSTANCES, NO_MEDIAN)
                by_image = Losses(*(_camera_image(loss, camera) for loss in losses))
                if losses[0] is None:
                    by_image = by_image._replace(rgb=NOTHING[..., None])
                backward = _BackwardPass(training, camera, seen, by_image, self.space)
                backward.add_to(result)
        if training.screen is not None:
            for held, new in zip(training.screen.gradients, result.screen, strict=True):
                held.add_(torch.from_numpy(new))
        return result


class BackwardResult:
    """Loss gradients of one pass, initially zero.

    Attributes:
        placements: [C, I, PLACEMENT] float64.
        faces: [6, R, R, 3] float32; None without a sky or if the sky requires no gradient.
        clusters: gradients of each instance.
    """

    def __init__(self, request: RasterRequest) -> None:
        count = len(request.instances)
        self.placements = np.zeros((request.cameras, count, PLACEMENT))
        self.faces: NDArray[np.float32] | None = None
        if request.sky is not None and request.sky.faces.requires_grad:
            self.faces = np.zeros(request.sky.faces.shape, np.float32)
        self.screen: list[NDArray[np.float32]] = []
        self.clusters = [self._cluster(request, index) for index in range(count)]

    def _cluster(self, request: RasterRequest, index: int) -> Gradients:
        instance = request.instances[index]
        n = len(instance.cloud)
        self.screen.append(np.zeros((n if request.options.track_screen else 0, 2), np.float32))
        parts = {
            name: np.zeros(tuple(getattr(instance.cloud, name).shape), np.float32)
            for name in CLOUD_PARTS
        }
        covars = NO_COVARS if instance.covars is None else np.zeros((n, 3, 3), np.float32)
        return Gradients(**parts, covars=covars, screen=self.screen[index])

    def tensors(self) -> list[Tensor | None]:
        """Gradients in the order of the inputs of the autograd function."""
        sums = torch.from_numpy(self.placements)
        linear, offset, position = sums.split((9, 3, 3), dim=-1)
        gradients: list[Tensor | None] = [linear.unflatten(-1, (3, 3)), offset, position]
        gradients.append(None if self.faces is None else torch.from_numpy(self.faces))
        for cluster in self.clusters:
            gradients += [torch.from_numpy(getattr(cluster, name)) for name in CLOUD_PARTS]
            gradients.append(torch.from_numpy(cluster.covars) if len(cluster.covars) else None)
        return gradients


class _Rasterization(torch.autograd.Function):
    """Autograd function of the kernels; inputs after the first two are differentiable."""

    @staticmethod
    def forward(
        ctx: Any, passes: TrainingPasses, training: TrainingPass, *inputs: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        images = passes.forward(training)
        ctx.set_materialize_grads(False)
        ctx.passes, ctx.training = passes, training
        # The backward pass reads inputs through the request. Saving them lets torch detect in-place
        # changes.
        ctx.save_for_backward(*images, *inputs)
        if not training.request.options.depth:
            ctx.mark_non_differentiable(images[2])
        return images

    @staticmethod
    def backward(ctx: Any, *losses: Tensor | None) -> tuple[Tensor | None, ...]:
        rgb, alpha, depth, *inputs = ctx.saved_tensors
        result = ctx.passes.backward(ctx.training, (rgb, alpha, depth), losses)
        gradients = zip(result.tensors(), inputs, ctx.needs_input_grad[2:], strict=True)
        return (
            None,
            None,
            *(
                gradient.to(given.device) if needed and gradient is not None else None
                for gradient, given, needed in gradients
            ),
        )


def _cloud_tensors(request: RasterRequest) -> list[Tensor | None]:
    tensors: list[Tensor | None] = []
    for instance in request.instances:
        tensors += [getattr(instance.cloud, name) for name in CLOUD_PARTS]
        tensors.append(instance.covars)
    return tensors


def _camera_image(images: Tensor | None, camera: int) -> NDArray[np.float32]:
    return NOTHING if images is None else array_of(images[camera])


@dataclass(frozen=True, eq=False)
class _BackwardPass:
    """Backward pass of one camera."""

    training: TrainingPass
    camera: int
    images: Images
    losses: Losses
    space: Workspace

    def add_to(self, result: BackwardResult) -> None:
        """Add the gradients of this camera to ``result``."""
        timing = self.training.timing
        with timed(timing, "sky_backward"):
            behind = self._through_sky(result)
        with timed(timing, "blend_backward"):
            slots = self._through_tiles(behind)
        with timed(timing, "project_backward"):
            self._through_projection(slots, result)

    def _through_sky(self, result: BackwardResult) -> NDArray[np.float32]:
        """Return the colour behind the image, and add the gradient of the sky faces."""
        request = self.training.request
        if request.sky is None or not self.losses.rgb.shape[0]:
            return constant_behind(request)[None, None]
        shape = (request.height, request.width)
        behind = self.space.array("behind", (*shape, 3), np.float32)
        rows = self.space.array("texel_rows", shape, np.int32)
        places = self.space.array("texel_places", (*shape, 2), np.float32)
        matrix = array_of(direction_matrix(request, self.camera))
        sample_sky(array_of(request.sky.faces), matrix, behind, rows, places)
        if result.faces is not None:
            sky_backward(rows, places, self.images.alpha, self.losses.rgb, result.faces)
        return behind

    def _through_tiles(self, behind: NDArray[np.float32]) -> SlotSums:
        request, seen = self.training.request, self.training.cameras[self.camera]
        tiles_x, tiles = -(-request.width // TILE), len(seen.starts) - 1
        size = tiles * HALVES * BACKWARD_PLANES * LANES
        pixels = self.space.array("pixels", (size,), np.float32)
        open_pixels(self.images, self.losses, behind, tiles_x, pixels)
        gradients = self.space.array("slot_gradients", (len(seen.lists), SLOT), np.float32)
        used = self.space.array("slots_used", seen.lists.shape, np.uint8)
        blend_tiles_backward(
            seen.records.values,
            seen.lists,
            seen.slots,
            seen.starts,
            tiles_x,
            (request.height, request.width),
            pixels,
            gradients,
            used,
        )
        return SlotSums(gradients, used, seen.spans)

    def _through_projection(self, slots: SlotSums, result: BackwardResult) -> None:
        training, camera = self.training, self.camera
        request, records = training.request, training.cameras[camera].records
        view, scale = view_of(request, camera), screen_scale(request)
        places = places_of(training.placement, camera)
        base = 0
        for index, instance in enumerate(request.instances):
            regions = -(-len(instance.cloud) // CHUNK)
            if regions:
                cluster = cluster_of(instance, places, index)
                sums = np.empty((regions, PLACEMENT))
                out = result.clusters[index]
                go_back = project_backward if regions > 1 else project_small_backward
                go_back(cluster, view, base * CHUNK, records, slots, scale, out, sums)
                result.placements[camera, index] = sums.sum(0)
            base += regions
