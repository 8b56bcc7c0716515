"""Jpeg of colour images: by libjpeg-turbo, or by nvJPEG on the GPU that drew them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from .types import RenderError

JpegEncoder = Callable[[NDArray[np.uint8], int], bytes]
"""Bytes of an image [H, W, 3] uint8, C order, at a quality of 1 to 100; on any thread."""

CPU_ONLY: Final = -99999
"""Device by which nvImageCodec works without a GPU, by libjpeg-turbo."""
PROOF_QUALITY = 95
PROOF_LEVELS = 12
"""Of 255, by which no channel of the smooth sample may differ after decoding."""

log = logging.getLogger(__name__)


def turbo_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """By libjpeg-turbo on this thread, 4:4:4."""
    import simplejpeg

    encoded: bytes = simplejpeg.encode_jpeg(image, quality, "RGB", "444")
    return encoded


class NvjpegEncoder:
    """Jpegs 4:4:4 by nvJPEG. An image that it cannot encode is encoded by libjpeg-turbo.

    Each thread has an encoder of its own, and with it a CUDA stream: encoders of nvImageCodec
    are not for several threads at once.

    Args:
        device: number of the GPU, or CPU_ONLY.

    Raises:
        ImportError: nvImageCodec is not installed.
    """

    def __init__(self, device: int) -> None:
        from nvidia import nvimgcodec

        self._codec: Any = nvimgcodec
        self._device = device
        self._own = threading.local()
        self._failed = False

    def __call__(self, image: NDArray[np.uint8], quality: int) -> bytes:
        """See JpegEncoder."""
        try:
            return self.encode(image, quality)
        except RenderError as error:
            if not self._failed:
                self._failed = True
                log.warning("jpegs are made by libjpeg-turbo where %s", error)
            return turbo_jpeg(image, quality)

    def encode(self, image: NDArray[np.uint8], quality: int) -> bytes:
        """By nvJPEG alone.

        Raises:
            RenderError: it could not.
        """
        codec = self._codec
        params = codec.EncodeParams(
            quality_type=codec.QualityType.QUALITY,
            quality_value=quality,
            chroma_subsampling=codec.ChromaSubsampling.CSS_444,
        )
        try:
            picture = codec.as_image(image)
            if self._device != CPU_ONLY:
                picture = picture.cuda()
            stream = self._encoder().encode(picture, "jpeg", params=params)
        except RuntimeError as error:
            raise RenderError(f"nvJPEG failed: {error}") from error
        if stream is None:
            raise RenderError(f"nvJPEG gave nothing for an image {list(image.shape)}")
        return bytes(stream)

    def _encoder(self) -> Any:
        own: Any = getattr(self._own, "encoder", None)
        if own is None:
            # One thread of its own: the encoders of several images are several threads already.
            own = self._codec.Encoder(device_id=self._device, max_num_cpu_threads=1)
            self._own.encoder = own
        return own


def jpeg_encoder_for(device: torch.device) -> tuple[JpegEncoder, str]:
    """What encodes images that were drawn on ``device``, and why.

    nvJPEG on a GPU, where it is installed and gives back a sample as it was; libjpeg-turbo
    everywhere else.
    """
    if device.type != "cuda":
        return turbo_jpeg, "libjpeg-turbo: images are drawn on the CPU"
    try:
        encoder = NvjpegEncoder(device.index or 0)
    except ImportError:
        return turbo_jpeg, (
            "libjpeg-turbo: nvImageCodec is not installed; pip install 'real2sim[server,cuda]'"
        )
    wrong = disproof(encoder)
    if wrong is not None:
        return turbo_jpeg, f"libjpeg-turbo: {wrong}"
    return encoder, "nvJPEG"


def disproof(encoder: NvjpegEncoder) -> str | None:
    """What is wrong with the jpeg of a sample; None where its colours are right."""
    import simplejpeg

    rows, columns = np.mgrid[0:48, 0:64].astype(np.uint8)
    sample = np.ascontiguousarray(np.dstack([4 * columns, 5 * rows, 255 - 2 * (rows + columns)]))
    try:
        decoded = simplejpeg.decode_jpeg(encoder.encode(sample, PROOF_QUALITY), "RGB")
    except (RenderError, ValueError) as error:
        return str(error)
    if decoded.shape != sample.shape:
        return f"nvJPEG gave a picture {list(decoded.shape)} for one {list(sample.shape)}"
    off = int(np.abs(decoded.astype(int) - sample).max())
    return None if off <= PROOF_LEVELS else f"nvJPEG is off by {off} of 255 levels"
