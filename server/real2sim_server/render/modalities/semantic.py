"""Classes of what is in front: of objects by their category, the background, the sky."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..encode import EXACT_CODECS, encode_lossless
from ..types import RenderError, RenderOutput
from .base import SensorModality, register

DTYPE = np.dtype(np.uint8)


def _pixels(output: RenderOutput) -> NDArray[np.uint8]:
    from ..quantize import SOLID_ALPHA

    if output.instance is None or output.classes is None:
        raise RenderError("the pass has drawn no classes")
    found: NDArray[np.uint8] = output.classes[output.instance.cpu().numpy()]
    # Alpha reaches one half where a Gaussian takes half of the light, and there alone.
    found[(output.alpha < SOLID_ALPHA).cpu().numpy()] = output.behind
    return found


def _encode(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_lossless(image, codec, name="semantic", dtype=DTYPE)


SEMANTIC = register(
    SensorModality(
        name="semantic",
        dtype=DTYPE,
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_pixels,
        encode=_encode,
        switch="instance",
    )
)
