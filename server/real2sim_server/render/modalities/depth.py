"""Depth along the camera's z axis [m]; 0 where nothing was hit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..encode import EXACT_CODECS, encode_depth
from ..types import RenderError, RenderOutput
from .base import SensorModality, register


def _pixels(output: RenderOutput) -> NDArray[np.float32]:
    from ..quantize import solid_depth

    if output.depth is None:
        raise RenderError("the pass has drawn no depth")
    return solid_depth(output.depth, output.alpha, between=output.between)


def _encode(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_depth(image, codec)


DEPTH = register(
    SensorModality(
        name="depth",
        dtype=np.dtype("<f4"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_pixels,
        encode=_encode,
        switch="depth",
        encoded_dtypes={"png": "uint16"},
    )
)
