"""Images as a person looks at them, in a notebook: every modality as a small jpeg."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FAR_PERCENTILE = 98.0
"""Of what is hit: depths and uncertainties beyond it are all alike."""
HUES = np.array([[37, 151, 211], [101, 67, 173], [23, 59, 131]])
"""Of each channel: spread the numbers of neighbouring ids far apart."""


def preview_jpeg(array: NDArray[Any], modality: str) -> bytes:
    """An image as jpeg: colours as they are, near surfaces and certain pixels bright, each number
    of ``instance`` and ``semantic`` in a colour of its own and 0 in black.

    Args:
        array: of the image, see :class:`~.images.Image`.
        modality: of the image.
    """
    import simplejpeg

    picture = array if modality == "rgb" else _coloured(array)
    encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(picture), quality=90)
    return encoded


def _coloured(array: NDArray[Any]) -> NDArray[np.uint8]:
    if np.issubdtype(array.dtype, np.integer):
        numbers = array.astype(np.int64)[..., None]
        spread = 64 + (numbers * HUES[:, 0] + HUES[:, 1]) % 192
        return np.where(numbers == 0, 0, spread).astype(np.uint8)
    hit = array[array > 0]
    farthest = float(np.percentile(hit, FAR_PERCENTILE)) if hit.size else 1.0
    level = np.where(array > 0, 255.0 - 235.0 * np.minimum(array / farthest, 1.0), 0.0)
    return np.repeat(level.astype(np.uint8)[..., None], 3, axis=-1)
