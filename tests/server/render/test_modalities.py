"""The contract of sensor modalities, for every registered modality."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import torch

from real2sim_proto.base import Codec, Modality
from real2sim_server.render import RasterOptions, RenderError, RenderOutput
from real2sim_server.render.modalities import (
    SensorModality,
    encode_image,
    modality_names,
    modality_of,
    options_for,
    register,
)

HEIGHT, WIDTH = 6, 9


@pytest.fixture
def output() -> RenderOutput:
    """Output of a pass with two cameras and all images."""
    values = torch.linspace(0.0, 1.0, 2 * HEIGHT * WIDTH).reshape(2, HEIGHT, WIDTH)
    return RenderOutput(
        rgb=values[..., None].repeat(1, 1, 1, 3),
        alpha=values,
        depth=values * 50,
        instance=(values * 100).to(torch.uint16),
        median_depth=values * 49,
        classes=np.arange(65_536, dtype=np.uint8),
        uncertainty=values,
    )


def test_every_public_modality_is_registered():
    assert set(get_args(Modality)) <= set(modality_names())


@pytest.mark.parametrize("name", modality_names())
def test_pixels_have_the_declared_dtype_and_shape(name, output):
    modality = modality_of(name)
    pixels = modality.pixels(output)
    assert pixels.dtype == modality.dtype
    assert pixels.shape == (2, *modality.shape(WIDTH, HEIGHT))


@pytest.mark.parametrize("name", modality_names())
def test_raw_bytes_are_the_pixels(name, output):
    modality = modality_of(name)
    image = modality.pixels(output)[0]
    encoded = encode_image(image, name, "raw")
    assert encoded.data == image.tobytes()
    assert len(encoded.data) == modality.raw_bytes(WIDTH, HEIGHT)


@pytest.mark.parametrize("codec", get_args(Codec))
@pytest.mark.parametrize("name", modality_names())
def test_every_protocol_codec_is_encoded(name, codec, output):
    encoded = encode_image(modality_of(name).pixels(output)[0], name, codec)
    assert encoded.codec in modality_of(name).codecs
    assert np.dtype(encoded.dtype).name == encoded.dtype


@pytest.mark.parametrize("name", modality_names())
def test_an_image_of_another_dtype_is_refused(name):
    modality = modality_of(name)
    with pytest.raises(RenderError, match=name):
        encode_image(np.zeros(modality.shape(WIDTH, HEIGHT), np.complex64), name, "png")


@pytest.mark.parametrize("name", modality_names())
def test_a_modality_enables_only_its_switch(name):
    options = options_for([name], RasterOptions())
    switch = modality_of(name).switch
    assert (options.depth, options.instance) == (switch == "depth", switch == "instance")


def changed(**values) -> SensorModality:
    rgb = modality_of("rgb")
    return SensorModality(**(vars(rgb) | {"name": "other"} | values))


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"name": "rgb"}, "already"),
        ({"codecs": ("jpeg",)}, "'raw' and 'png'"),
        ({"switch": "heat"}, "heat"),
    ],
)
def test_an_invalid_modality_is_not_registered(values, reason):
    with pytest.raises(ValueError, match=reason):
        register(changed(**values))
    assert "other" not in modality_names()
