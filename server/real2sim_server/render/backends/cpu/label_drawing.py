"""One camera on its way from Gaussians to a picture and the depths and objects of its fronts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...types import LabelOutput, Window
from ..base import Placement, RasterRequest, place_instances
from .cull import Chunks, seen_chunks
from .drawing import Drawing
from .inputs import Workspace, cluster_of, places_of, view_of
from .label_blend import blend_labels
from .label_depth import SHAPE, read_fronts, shape_fronts
from .records import CHUNK, TILE, Images, Records

MAX_ID = 65_535
NO_SHAPES = np.zeros((0, SHAPE), np.float32)
NOT_ASKED = np.zeros((0, 0), np.float32)


class Objects(NamedTuple):
    """Objects that are also asked for alone.

    Attributes:
        windows: [K, 5] int64, left, top, right, bottom [px], and where its pixels start.
        slots: [65536] int16, which of them an instance id is, -1 for none.
        first_record: before which no record is of one of them.
    """

    windows: NDArray[np.int64]
    slots: NDArray[np.int16]
    first_record: np.int64


class Fronts(NamedTuple):
    """Numbers of records plus one, 0 where there is none.

    Attributes:
        pixels: [H, W] int32.
        alone: [P] int32, of the windows of objects one after the other.
        used: [1 + M] uint8, not 0 for each number that is in one of these.
    """

    pixels: NDArray[np.int32]
    alone: NDArray[np.int32]
    used: NDArray[np.uint8]


@dataclass
class Walk:
    """What one camera asks for, and what its walk has found.

    Attributes:
        windows: of objects alone.
        level: transmittance at which a pixel's front lies.
        along_rays: whether depth is that along each pixel's ray, or that of the front's centre.
        objects, fronts, records: of the walk, once it has begun.
    """

    windows: Sequence[Window]
    level: float
    along_rays: bool
    objects: Objects | None = None
    fronts: Fronts | None = None
    records: Records | None = None


@dataclass(frozen=True, eq=False)
class LabelDrawing(Drawing):
    """A Drawing that also finds fronts; it is not interrupted."""

    walk: Walk = field(default_factory=lambda: Walk((), 0.5, along_rays=True))

    def label(
        self, placement: Placement, chunks: Sequence[Chunks]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint16], list[NDArray[np.float32]]]:
        """Draw; depth and object [H, W], and depths [h, w] of the windows."""
        self._prepare(chunks)
        self.draw(placement, chunks)
        walk, view = self.walk, view_of(self.request, self.camera)
        assert walk.records is not None
        assert walk.fronts is not None
        assert walk.objects is not None
        shapes = self._shapes(placement, chunks) if walk.along_rays else NO_SHAPES
        values, fronts = walk.records.values, walk.fronts
        shape = fronts.pixels.shape
        depth, instance = np.empty(shape, np.float32), np.empty(shape, np.uint16)
        read_fronts(fronts.pixels, 0, 0, view, values, shapes, depth, instance)
        alone = []
        for left, top, right, bottom, first in walk.objects.windows.tolist():
            high, wide = bottom - top, right - left
            own = np.empty((high, wide), np.float32)
            ids = self.space.array("own_ids", (high, wide), np.uint16)
            pixels = fronts.alone[first : first + high * wide].reshape(high, wide)
            read_fronts(pixels, left, top, view, values, shapes, own, ids)
            alone.append(own)
        return depth, instance, alone

    def _prepare(self, chunks: Sequence[Chunks]) -> None:
        """Lay out the windows; what is found starts empty."""
        windows = np.zeros((len(self.walk.windows), 5), np.int64)
        slots = np.full(MAX_ID + 1, -1, np.int16)
        pixels = 0
        for slot, window in enumerate(self.walk.windows):
            windows[slot] = window.left, window.top, window.right, window.bottom, pixels
            slots[window.instance_id] = slot
            pixels += (window.right - window.left) * (window.bottom - window.top)
        before = 0
        for instance, own in zip(self.request.instances, chunks, strict=True):
            if slots[instance.instance_id] >= 0:
                break
            before += len(own)
        records = sum(map(len, chunks)) * CHUNK
        fronts = Fronts(
            self.space.array("fronts", (self.request.height, self.request.width), np.int32),
            self.space.array("alone", (pixels,), np.int32),
            self.space.array("used", (1 + records,), np.uint8),
        )
        fronts.alone[:] = 0
        fronts.used[:] = 0
        self.walk.objects = Objects(windows, slots, np.int64(before * CHUNK))
        self.walk.fronts = fronts

    def _blend_tiles(
        self,
        records: Records,
        lists: NDArray[np.int32],
        starts: NDArray[np.int64],
        tiles: tuple[int, int],
        behind: NDArray[np.float32],
    ) -> None:
        walk, tiles_x = self.walk, -(-self.request.width // TILE)
        walk.records = records
        blend_labels(
            records.values,
            lists,
            starts,
            tiles_x,
            *tiles,
            behind,
            np.float32(walk.level),
            walk.objects,
            walk.fronts,
            self.images,
        )

    def _shapes(self, placement: Placement, chunks: Sequence[Chunks]) -> NDArray[np.float32]:
        """Of the records that are a front; others hold what was there before."""
        walk, request = self.walk, self.request
        assert walk.records is not None
        assert walk.fronts is not None
        values, counts = walk.records.values, walk.records.counts
        shapes = self.space.array("shapes", (len(values), SHAPE), np.float32)
        view, places = view_of(request, self.camera), places_of(placement, self.camera)
        base = 0
        for index, instance in enumerate(request.instances):
            if len(chunks[index]):
                cluster = cluster_of(instance, places, index)
                used = walk.fronts.used
                shape_fronts(
                    cluster, view, base * CHUNK, chunks[index], values, counts, used, shapes
                )
            base += len(chunks[index])
        return shapes


def draw_labels(
    request: RasterRequest,
    windows: Sequence[Sequence[Window]],
    space: Workspace,
    *,
    level: float,
    along_rays: bool,
) -> list[LabelOutput]:
    """Pictures and labels of all cameras of a request, one after the other."""
    placement = place_instances(request.instances, request.viewmats.detach().cpu())
    views = [view_of(request, c) for c in range(request.cameras)]
    seen = seen_chunks(request, placement, views)
    found = []
    for c in range(request.cameras):
        shape = (request.height, request.width)
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        images = Images(rgb, alpha, NOT_ASKED, np.zeros((0, 0), np.uint16), NOT_ASKED)
        timing = dict.fromkeys(("project", "sort", "tile", "blend", "sky"), 0.0)
        walk = Walk(windows[c], level, along_rays)
        drawing = LabelDrawing(request, c, images, space, timing, walk)
        depth, instance, alone = drawing.label(placement, seen[c])
        found.append(LabelOutput(torch.from_numpy(rgb), depth, instance, tuple(alone), timing))
    return found
