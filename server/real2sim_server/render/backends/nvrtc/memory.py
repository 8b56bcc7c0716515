"""Memory of a frame on the device: what is uploaded, worked in, and given out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...types import RasterOptions, RenderError
from .launcher import Launcher
from .records import COUNTERS, DIGITS, FRAME, IMAGES, PIECE, SPLAT_BYTES, WORDS
from .tables import Tables

ALIGNMENT = 256
REPORT_BYTES = COUNTERS * 4
SORT_BLOCKS = 512
"""At most so many blocks share a list that is sorted."""
MAX_PAIRS = 1 << 31
PAIRS_PER_SPLAT = 4
"""Room for tiles of each splat, to begin with."""


@dataclass(frozen=True, eq=False)
class Images:
    """Where the images of a frame lie, behind a report of REPORT_BYTES.

    Attributes:
        memory: [bytes] uint8 on the device.
        places: first byte, and bytes, of each image.
    """

    memory: Tensor
    places: dict[str, tuple[int, int]]


class FrameMemory:
    """Work space that grows to what was needed and is kept. For one frame at a time."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._spaces: dict[str, Tensor] = {}
        self._staged: Tensor = launcher.host_memory(0)
        self._counters = torch.zeros(COUNTERS, dtype=torch.int32, device=launcher.device)
        self.seen_capacity = 0
        self.pair_capacity = 0

    def reserve(self, seen: int, pairs: int) -> None:
        """Make room for splats, and for the tiles that they touch.

        Raises:
            RenderError: more than a frame can have.
        """
        if pairs > MAX_PAIRS or seen > MAX_PAIRS:
            raise RenderError(
                f"a frame with {seen} splats on {pairs} tiles is more than the {MAX_PAIRS} that "
                "can be sorted at once; draw fewer cameras in a call, or smaller ones"
            )
        self.seen_capacity = max(self.seen_capacity, -(-seen // PIECE) * PIECE)
        self.pair_capacity = max(self.pair_capacity, -(-pairs // PIECE) * PIECE)

    @property
    def sort_blocks(self) -> int:
        """Blocks that share a list."""
        return min(SORT_BLOCKS, max(1, self.pair_capacity // (4 * PIECE)))

    def images(self, names: Sequence[str], pixels: int) -> Images:
        """New memory for images of all cameras."""
        places, used = {}, _aligned(REPORT_BYTES)
        for name in names:
            dtype, channels = IMAGES[name]
            nbytes = pixels * np.dtype(dtype).itemsize * int(np.prod(channels))
            places[name] = (used, nbytes)
            used += _aligned(nbytes)
        memory = torch.empty(used, dtype=torch.uint8, device=self._launcher.device)
        return Images(memory, places)

    def upload(self, tables: Tables, images: Images, options: RasterOptions) -> int:
        """Copy the tables and the Frame over, in one copy; the address of the Frame."""
        parts = (tables.objects, tables.placements, tables.cameras, tables.tones)
        sizes = [FRAME.itemsize, *(part.nbytes for part in parts)]
        starts = [0, *np.cumsum([_aligned(size) for size in sizes]).tolist()]
        held = self._space("tables", starts[-1])
        base = self._launcher.pointer(held)
        tables.objects["tones"] = base + starts[4] + 4 * tables.objects["tones"]
        frame = np.zeros(1, FRAME)
        frame["objects"], frame["placements"], frame["cameras"] = (base + s for s in starts[1:4])
        self._fill(frame, tables, images, options)
        if len(self._staged) < starts[-1]:
            self._staged = self._launcher.host_memory(2 * starts[-1])
        staged = self._staged.numpy()
        for start, part in zip(starts, (frame, *parts), strict=False):
            staged[start : start + part.nbytes] = part.reshape(-1).view(np.uint8)
        held[: starts[-1]].copy_(self._staged[: starts[-1]], non_blocking=True)
        return base

    def _fill(
        self, frame: NDArray[np.void], tables: Tables, images: Images, options: RasterOptions
    ) -> None:
        seen, pairs = self.seen_capacity, self.pair_capacity
        sizes = {
            "seen_masks": tables.entries * WORDS * 4,
            "entry_starts": (tables.entries + 1) * 4,
            "splats": seen * SPLAT_BYTES,
            "boxes": seen * 8,
            **dict.fromkeys(("depths_0", "depths_1", "order_0", "order_1"), seen * 4),
            **dict.fromkeys(("tiles_0", "tiles_1", "members_0", "members_1"), pairs * 4),
            "pair_starts": (seen // PIECE + 1) * 4,
            "digit_counts": self.sort_blocks * DIGITS * 4,
            "digit_starts": DIGITS * 4,
            "tile_ranges": tables.tiles * 8,
        }
        for name, nbytes in sizes.items():
            frame[name] = self._launcher.pointer(self._space(name, nbytes))
        frame["counters"] = self._launcher.pointer(self._counters)
        output = self._launcher.pointer(images.memory)
        frame["report"] = output
        for name, (start, _) in images.places.items():
            frame[name] = output + start
        frame["object_count"], frame["camera_count"] = len(tables.objects), len(tables.cameras)
        frame["pieces"], frame["entries"] = tables.pieces, tables.entries
        frame["tile_count"], frame["tile_passes"] = tables.tiles, tile_passes(tables.tiles)
        frame["seen_capacity"], frame["pair_capacity"] = seen, pairs
        frame["sort_blocks"] = self.sort_blocks
        frame["antialiased"] = options.rasterize_mode == "antialiased"
        for name in ("near_plane", "far_plane", "eps2d", "radius_clip"):
            frame[name] = getattr(options, name)

    def _space(self, name: str, nbytes: int) -> Tensor:
        held = self._spaces.get(name)
        if held is None or len(held) < nbytes:
            self._spaces.pop(name, None)
            size = max(ALIGNMENT, nbytes)
            held = torch.empty(size, dtype=torch.uint8, device=self._launcher.device)
            self._spaces[name] = held
        return held


def tile_passes(tiles: int) -> int:
    """Passes of eight bits that sort by tile."""
    return max(1, -(-(tiles - 1).bit_length() // 8))


def _aligned(nbytes: int) -> int:
    return -(-nbytes // ALIGNMENT) * ALIGNMENT
