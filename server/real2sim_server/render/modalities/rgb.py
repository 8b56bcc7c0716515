"""Colour images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..encode import RGB_CODECS, encode_rgb
from ..types import RenderOutput
from .base import SensorModality, register


def _pixels(output: RenderOutput) -> NDArray[np.uint8]:
    from ..quantize import to_uint8

    return to_uint8(output.rgb, between=output.between)


def _encode(image: NDArray[Any], codec: str, quality: int) -> bytes:
    return encode_rgb(image, codec, quality=quality)


RGB = register(
    SensorModality(
        name="rgb",
        dtype=np.dtype(np.uint8),
        channels=(3,),
        codecs=RGB_CODECS,
        pixels=_pixels,
        encode=_encode,
    )
)
