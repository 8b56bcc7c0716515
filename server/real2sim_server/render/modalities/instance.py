"""Ids of the objects in front; 0 is background."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..encode import EXACT_CODECS, encode_instance
from ..types import RenderError, RenderOutput
from .base import SensorModality, register


def _pixels(output: RenderOutput) -> NDArray[np.uint16]:
    if output.instance is None:
        raise RenderError("the pass has drawn no instances")
    pixels: NDArray[np.uint16] = output.instance.cpu().numpy()
    return pixels


def _encode(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_instance(image, codec)


INSTANCE = register(
    SensorModality(
        name="instance",
        dtype=np.dtype("<u2"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_pixels,
        encode=_encode,
        switch="instance",
    )
)
