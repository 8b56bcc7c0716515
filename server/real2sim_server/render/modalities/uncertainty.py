"""How well the training rays determine what a pixel shows: the error they let expect, in [0, 1].

Of a colour in [0, 1], as a mean of its channels; in every pixel, the sky's too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..encode import EXACT_CODECS, encode_uncertainty
from ..types import RenderError, RenderOutput
from .base import SensorModality, register


def _pixels(output: RenderOutput) -> NDArray[np.float32]:
    if output.uncertainty is None:
        raise RenderError("the pass has drawn no uncertainty")
    pixels: NDArray[np.float32] = output.uncertainty.detach().clamp(0, 1).cpu().numpy()
    return pixels


def _encode(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_uncertainty(image, codec)


UNCERTAINTY = register(
    SensorModality(
        name="uncertainty",
        dtype=np.dtype("<f4"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_pixels,
        encode=_encode,
        encoded_dtypes={"png": "uint16"},
    )
)
