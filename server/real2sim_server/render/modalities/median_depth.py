"""Depth of the Gaussian that takes half of the light [m]; 0 where none does.

The expected depth of :mod:`.depth` is a mean over what a pixel shows, and lies between two things
at the edge of one; this is the depth of one of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..encode import EXACT_CODECS, encode_depth
from ..types import RenderError, RenderOutput
from .base import SensorModality, register


def _pixels(output: RenderOutput) -> NDArray[np.float32]:
    if output.median_depth is None:
        raise RenderError("the pass has drawn no median depth")
    pixels: NDArray[np.float32] = output.median_depth.cpu().numpy()
    return pixels


def _encode(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_depth(image, codec, name="median_depth")


MEDIAN_DEPTH = register(
    SensorModality(
        name="median_depth",
        dtype=np.dtype("<f4"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_pixels,
        encode=_encode,
        switch="median_depth",
        encoded_dtypes={"png": "uint16"},
    )
)
