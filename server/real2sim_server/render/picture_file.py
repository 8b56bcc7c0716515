"""Pictures as files, whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .._files import atomic_file
from .encode import encode_rgb


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image uint8 [H, W, 3] as PNG; folders on the way are made.

    Raises:
        RenderError: the image has another shape or dtype.
        OSError: the file cannot be written.
    """
    data = encode_rgb(image, "png")
    with atomic_file(path) as file:
        file.write(data)


__all__ = ["write_png"]
