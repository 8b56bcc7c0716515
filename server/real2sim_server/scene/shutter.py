"""When the pixels of an image are taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.cameras import ShutterDirection

from ..geometry.transform import Float
from .errors import SceneError

DIRECTIONS = get_args(ShutterDirection)
MAX_READOUT_US = 200_000


@dataclass(frozen=True)
class Shutter:
    """How an image is read out.

    Attributes:
        direction: ``global``: all pixels at once; or which rows or columns come first.
        readout_us: time from the first to the last row or column [us]; 0 where ``global``. The
            instant of an image is the middle of it.

    Raises:
        SceneError: for an unknown direction, or a read-out that is not 1 to 200,000 us.
    """

    direction: ShutterDirection = "global"
    readout_us: int = 0

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise SceneError(
                f"shutter: direction must be one of {list(DIRECTIONS)}, not {self.direction!r}"
            )
        rolls = self.direction != "global"
        if not (rolls <= self.readout_us <= MAX_READOUT_US * rolls):
            raise SceneError(
                f"shutter: readout_us must be 1 to {MAX_READOUT_US}, and 0 where global, "
                f"not {self.readout_us!r} with {self.direction!r}"
            )

    @property
    def rolls(self) -> bool:
        """Whether rows or columns are taken one after the other."""
        return self.direction != "global"

    @property
    def by_row(self) -> bool:
        """Whether the pixels of a row are taken together, else those of a column."""
        return self.direction in {"top_to_bottom", "bottom_to_top"}

    def line_times(self, width: int, height: int) -> NDArray[np.float64]:
        """When each row (or column) is taken, 0 to 1 over the read-out; NCore's convention: the
        first at 0, the last at 1."""
        count = height if self.by_row else width
        times = np.arange(count) / max(count - 1, 1)
        return times if self.direction in {"top_to_bottom", "left_to_right"} else 1 - times

    def times_at(self, pixels: Float, width: int, height: int) -> Float:
        """When the pixels at positions [..., 2] [px] are taken; beyond the image as its edge."""
        axis, count = (1, height) if self.by_row else (0, width)
        line = np.clip(np.floor(np.nan_to_num(pixels[..., axis])), 0, count - 1).astype(np.int64)
        return self.line_times(width, height)[line]


GLOBAL = Shutter()
"""All pixels at once."""
