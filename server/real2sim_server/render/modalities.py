"""Camera modalities (image types) and their registry."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .images import (
    EXACT_CODECS,
    RGB_CODECS,
    SOLID_ALPHA,
    EncodedImage,
    JpegEncoder,
    encode_depth,
    encode_instance,
    encode_lossless,
    encode_rgb,
    encode_uncertainty,
    solid_depth,
    to_uint8,
    turbo_jpeg,
)
from .types import RasterOptions, RenderError, RenderOutput

SWITCHES = ("depth", "instance", "median_depth")
"""Fields of RasterOptions that enable an image of the pass."""


@dataclass(frozen=True, eq=False)
class SensorModality:
    """An image type of a camera, from the rasterizer output to bytes.

    Attributes:
        name: name in sensor requests.
        dtype: dtype of a raw pixel; little-endian.
        channels: trailing shape of an image: ``(3,)`` is [H, W, 3], ``()`` is [H, W].
        codecs: supported codecs; an unsupported ``jpeg`` becomes ``png``.
        pixels: function that returns images [C, H, W, *channels] of ``dtype`` from a pass.
        encode: function that encodes an image by codec and quality; raises RenderError for a wrong
            dtype or shape.
        switch: field of RasterOptions that enables it, or None.
        encoded_dtypes: dtype of the decoded array by codec, if it differs from ``dtype``.
    """

    name: str
    dtype: np.dtype[Any]
    channels: tuple[int, ...]
    codecs: tuple[str, ...]
    pixels: Callable[[RenderOutput], NDArray[Any]]
    encode: Callable[[NDArray[Any], str, int], bytes]
    switch: str | None = None
    encoded_dtypes: dict[str, str] = field(default_factory=dict)

    def shape(self, width: int, height: int) -> tuple[int, ...]:
        """Shape of an image of that size [px]."""
        return (height, width, *self.channels)

    def raw_bytes(self, width: int, height: int) -> int:
        """Size of a raw image."""
        return int(np.prod(self.shape(width, height))) * self.dtype.itemsize


_registry: dict[str, SensorModality] = {}


def register(modality: SensorModality) -> SensorModality:
    """Register a modality under its name.

    Raises:
        ValueError: the name is taken, ``raw`` or ``png`` is missing in the codecs, or the switch is
            unknown.
    """
    if modality.name in _registry:
        raise ValueError(f"there is a modality {modality.name!r} already")
    if not {"raw", "png"} <= set(modality.codecs):
        raise ValueError(f"modality {modality.name!r} must know the codecs 'raw' and 'png'")
    if modality.switch is not None and modality.switch not in SWITCHES:
        raise ValueError(f"switch {modality.switch!r} is none of {', '.join(SWITCHES)}")
    _registry[modality.name] = modality
    return modality


def unregister(name: str) -> None:
    """Remove a modality; for tests."""
    del _registry[name]


def modality_names() -> tuple[str, ...]:
    """All modalities in the order of their registration."""
    return tuple(_registry)


def modality_of(name: str) -> SensorModality:
    """The modality with a name. Raises a RenderError that lists the known names."""
    found = _registry.get(name)
    if found is None:
        allowed = ", ".join(repr(known) for known in _registry)
        raise RenderError(f"unknown modality {name!r}; allowed are {allowed}")
    return found


def options_for(names: Iterable[str], options: RasterOptions) -> RasterOptions:
    """``options`` with the switches of the named modalities set."""
    wanted = {modality_of(name).switch for name in names}
    return replace(
        options,
        depth="depth" in wanted,
        instance="instance" in wanted,
        median_depth="median_depth" in wanted,
    )


def modalities_drawn(options: RasterOptions) -> tuple[str, ...]:
    """``rgb`` and the modalities enabled by the switches of ``options``."""
    return ("rgb", *(switch for switch in SWITCHES if getattr(options, switch)))


def encode_image(
    image: NDArray[Any],
    modality: str,
    codec: str,
    *,
    quality: int = 90,
    jpeg: JpegEncoder = turbo_jpeg,
) -> EncodedImage:
    """Encode an image of a modality; lossless modalities use png if jpeg is requested.

    Args:
        image: [H, W, 3] uint8 ``rgb``, [H, W] float32 ``depth`` or ``median_depth`` [m], [H, W]
            uint16 ``instance``, [H, W] uint8 ``semantic``, or [H, W] float32 ``uncertainty``.
        modality: name of a registered modality.
        codec: ``raw``, ``jpeg`` or ``png``.
        quality: jpeg quality, 1 to 100.
        jpeg: jpeg encoder.

    Raises:
        RenderError: unknown modality or codec, or an image that does not match the modality.
    """
    kind = modality_of(modality)
    if codec == "jpeg" and codec not in kind.codecs:
        codec = "png"
    if codec == "jpeg":
        data = encode_rgb(image, codec, quality=quality, jpeg=jpeg)
    else:
        data = kind.encode(image, codec, quality)
    dtype = kind.encoded_dtypes.get(codec, kind.dtype.name)
    return EncodedImage(data, codec, dtype, image.shape)


# Colour


def _rgb_pixels(output: RenderOutput) -> NDArray[np.uint8]:
    return to_uint8(output.rgb, between=output.between)


def _encode_rgb(image: NDArray[Any], codec: str, quality: int) -> bytes:
    return encode_rgb(image, codec, quality=quality)


RGB = register(
    SensorModality(
        name="rgb",
        dtype=np.dtype(np.uint8),
        channels=(3,),
        codecs=RGB_CODECS,
        pixels=_rgb_pixels,
        encode=_encode_rgb,
    )
)


# Depth along the z axis of the camera [m]; 0 without a hit


def _depth_pixels(output: RenderOutput) -> NDArray[np.float32]:
    if output.depth is None:
        raise RenderError("the pass has drawn no depth")
    return solid_depth(output.depth, output.alpha, between=output.between)


def _encode_depth(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_depth(image, codec)


DEPTH = register(
    SensorModality(
        name="depth",
        dtype=np.dtype("<f4"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_depth_pixels,
        encode=_encode_depth,
        switch="depth",
        encoded_dtypes={"png": "uint16"},
    )
)


# Ids of the objects in front; 0 is background.


def _instance_pixels(output: RenderOutput) -> NDArray[np.uint16]:
    if output.instance is None:
        raise RenderError("the pass has drawn no instances")
    pixels: NDArray[np.uint16] = output.instance.cpu().numpy()
    return pixels


def _encode_instance(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_instance(image, codec)


INSTANCE = register(
    SensorModality(
        name="instance",
        dtype=np.dtype("<u2"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_instance_pixels,
        encode=_encode_instance,
        switch="instance",
    )
)


# Depth of the Gaussian at which half of the light is absorbed [m]; 0 without one. At edges, the
# expected depth is a mean between two surfaces; the median depth is that of one of them.


def _median_depth_pixels(output: RenderOutput) -> NDArray[np.float32]:
    if output.median_depth is None:
        raise RenderError("the pass has drawn no median depth")
    pixels: NDArray[np.float32] = output.median_depth.cpu().numpy()
    return pixels


def _encode_median_depth(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_depth(image, codec, name="median_depth")


MEDIAN_DEPTH = register(
    SensorModality(
        name="median_depth",
        dtype=np.dtype("<f4"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_median_depth_pixels,
        encode=_encode_median_depth,
        switch="median_depth",
        encoded_dtypes={"png": "uint16"},
    )
)


# Classes: of objects by their category, the background, the sky

SEMANTIC_DTYPE = np.dtype(np.uint8)


def _semantic_pixels(output: RenderOutput) -> NDArray[np.uint8]:
    if output.instance is None or output.classes is None:
        raise RenderError("the pass has drawn no classes")
    found: NDArray[np.uint8] = output.classes[output.instance.cpu().numpy()]
    # Equivalent to a Gaussian at which half of the light is absorbed.
    found[(output.alpha < SOLID_ALPHA).cpu().numpy()] = output.behind
    return found


def _encode_semantic(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_lossless(image, codec, name="semantic", dtype=SEMANTIC_DTYPE)


SEMANTIC = register(
    SensorModality(
        name="semantic",
        dtype=SEMANTIC_DTYPE,
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_semantic_pixels,
        encode=_encode_semantic,
        switch="instance",
    )
)


# Expected colour error in [0, 1], mean over the channels, for every pixel including the sky


def _uncertainty_pixels(output: RenderOutput) -> NDArray[np.float32]:
    if output.uncertainty is None:
        raise RenderError("the pass has drawn no uncertainty")
    pixels: NDArray[np.float32] = output.uncertainty.detach().clamp(0, 1).cpu().numpy()
    return pixels


def _encode_uncertainty(image: NDArray[Any], codec: str, _quality: int) -> bytes:
    return encode_uncertainty(image, codec)


UNCERTAINTY = register(
    SensorModality(
        name="uncertainty",
        dtype=np.dtype("<f4"),
        channels=(),
        codecs=EXACT_CODECS,
        pixels=_uncertainty_pixels,
        encode=_encode_uncertainty,
        encoded_dtypes={"png": "uint16"},
    )
)
