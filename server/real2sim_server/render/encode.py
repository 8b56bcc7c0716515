"""Images to bytes. Pure functions of arrays; they run on any thread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .jpeg import JpegEncoder, turbo_jpeg
from .types import RenderError

RGB_CODECS = ("raw", "jpeg", "png")
EXACT_CODECS = ("raw", "png")
DEPTH_PNG_UNIT = 1 / 256
"""Metres of one level of a depth png, as in KITTI: 4 mm steps up to 255.99 m."""
UNCERTAINTY_PNG_UNIT = 1 / 65535
"""Of one level of an uncertainty png."""
PNG_COMPRESSION = 1
"""zlib level; higher ones are several times slower and shrink pictures little more. With runs alone
and one filter for all rows (Paeth's) pictures take two thirds of the time, and less room."""


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """Bytes of one image and what is needed to read them.

    Attributes:
        data: the bytes; of codec ``raw`` the array in C order, little-endian.
        codec: ``raw``, ``jpeg`` or ``png``.
        dtype: of the decoded array: ``uint8``, ``uint16`` or ``float32``. Depth as ``uint16``
            is in steps of DEPTH_PNG_UNIT, uncertainty in steps of UNCERTAINTY_PNG_UNIT.
        shape: of the decoded array.
    """

    data: bytes
    codec: str
    dtype: str
    shape: tuple[int, ...]


def encode_rgb(
    image: NDArray[np.uint8], codec: str, *, quality: int = 90, jpeg: JpegEncoder = turbo_jpeg
) -> bytes:
    """RGB [H, W, 3] uint8 as raw bytes, jpeg (4:4:4, no loss beyond ``quality``) or png.

    Raises:
        RenderError: another codec, an image of another dtype or shape, or a quality outside 1 to
            100.
    """
    _check_codec("rgb", codec, RGB_CODECS)
    _check_array("rgb", image, np.uint8, 3)
    contiguous = np.ascontiguousarray(image)
    if codec == "raw":
        return contiguous.tobytes()
    if codec == "png":
        return _png(contiguous[..., ::-1])
    if not 1 <= quality <= 100:
        raise RenderError(f"quality must be 1 to 100, not {quality!r}")
    return jpeg(contiguous, quality)


def encode_depth(depth: NDArray[np.float32], codec: str, *, name: str = "depth") -> bytes:
    """Depth [H, W] float32 [m] as raw float32, or 16-bit png in steps of DEPTH_PNG_UNIT.

    In a png a hit is never 0, and everything beyond the range has the largest level. Messages call
    the image ``name``.
    """
    _check_codec(name, codec, EXACT_CODECS)
    _check_array(name, depth, np.float32, 2)
    if codec == "raw":
        return depth.astype("<f4", order="C", copy=False).tobytes()
    levels = np.clip(np.rint(depth / DEPTH_PNG_UNIT), 1, np.iinfo(np.uint16).max)
    return _png(np.where(depth > 0, levels, 0).astype(np.uint16))


def encode_uncertainty(image: NDArray[np.float32], codec: str) -> bytes:
    """Uncertainty [H, W] float32 in [0, 1] as raw float32, or 16-bit png in steps of
    UNCERTAINTY_PNG_UNIT."""
    _check_codec("uncertainty", codec, EXACT_CODECS)
    _check_array("uncertainty", image, np.float32, 2)
    if codec == "raw":
        return image.astype("<f4", order="C", copy=False).tobytes()
    return _png(np.rint(np.clip(image, 0, 1) / UNCERTAINTY_PNG_UNIT).astype(np.uint16))


def encode_instance(instance: NDArray[np.uint16], codec: str) -> bytes:
    """Instance ids [H, W] uint16 as raw uint16 or 16-bit png."""
    return encode_lossless(instance, codec, name="instance", dtype=np.dtype("<u2"))


def encode_lossless(image: NDArray[Any], codec: str, *, name: str, dtype: np.dtype[Any]) -> bytes:
    """An image [H, W] of uint8 or uint16 as raw values, little-endian, or as png.

    Args:
        image: of ``dtype``.
        codec: ``raw`` or ``png``.
        name: of the modality, for messages.
        dtype: of a pixel.

    Raises:
        RenderError: another codec, or an image of another dtype or shape.
    """
    _check_codec(name, codec, EXACT_CODECS)
    _check_array(name, image, dtype, 2)
    if codec == "raw":
        return image.astype(dtype, order="C", copy=False).tobytes()
    return _png(image)


def _check_codec(name: str, codec: str, codecs: tuple[str, ...]) -> None:
    if codec not in codecs:
        raise RenderError(f"{name} cannot be encoded as {codec!r}; allowed are {list(codecs)}")


def _check_array(name: str, image: NDArray[Any], dtype: DTypeLike, ndim: int) -> None:
    fits = image.dtype == dtype and image.ndim == ndim and (ndim == 2 or image.shape[2] == 3)
    if not fits or image.size == 0:
        shape = "[H, W, 3]" if ndim == 3 else "[H, W]"
        raise RenderError(
            f"{name} must be {shape} {np.dtype(dtype)}, not {list(image.shape)} {image.dtype}"
        )


def _png(image: NDArray[Any]) -> bytes:
    import cv2

    runs = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    paeth = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH]
    options = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION, *runs, *paeth]
    done, encoded = cv2.imencode(".png", image, options)
    if not done:
        raise RenderError(f"png encoding failed for an image {list(image.shape)} {image.dtype}")
    return bytes(encoded)
