"""Encoding of images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import simplejpeg
import torch

from real2sim_server.render import (
    RenderError,
    encode_depth,
    encode_image,
    encode_instance,
    encode_rgb,
)
from real2sim_server.render.images import (
    CPU_ONLY,
    NvjpegEncoder,
    disproof,
    jpeg_encoder_for,
    turbo_jpeg,
)

GENERATOR = np.random.default_rng(0)
RGB = GENERATOR.integers(0, 256, (12, 17, 3), dtype=np.uint8)
DEPTH = GENERATOR.uniform(0.1, 200, (12, 17)).astype(np.float32)
INSTANCE = GENERATOR.integers(0, 65_536, (12, 17), dtype=np.uint16)


def read_png(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def test_raw_rgb_is_the_array() -> None:
    assert np.array_equal(np.frombuffer(encode_rgb(RGB, "raw"), np.uint8).reshape(RGB.shape), RGB)


def test_png_rgb_is_exact_and_in_rgb_order() -> None:
    assert np.array_equal(read_png(encode_rgb(RGB, "png"))[..., ::-1], RGB)


def test_jpeg_error_decreases_with_quality() -> None:
    smooth = cv2.GaussianBlur(RGB, (0, 0), 3)
    errors = [
        np.abs(simplejpeg.decode_jpeg(encode_rgb(smooth, "jpeg", quality=q)).astype(int) - smooth)
        for q in (30, 95)
    ]
    assert errors[1].max() <= 8
    assert errors[1].mean() < errors[0].mean()


def test_strided_views_can_be_encoded() -> None:
    view = RGB[::2, ::-1]
    assert np.array_equal(read_png(encode_rgb(view, "png"))[..., ::-1], view)
    assert encode_rgb(view, "raw") == view.tobytes()
    assert len(encode_rgb(view, "jpeg")) > 0


def test_raw_depth_is_exact() -> None:
    decoded = np.frombuffer(encode_depth(DEPTH, "raw"), "<f4").reshape(DEPTH.shape)
    assert np.array_equal(decoded, DEPTH)


def test_png_depth_is_accurate_to_half_a_step() -> None:
    decoded = read_png(encode_depth(DEPTH, "png"))
    assert decoded.dtype == np.uint16
    np.testing.assert_allclose(decoded / 256, DEPTH, atol=0.5 / 256 + 1e-6)


def test_png_depth_reserves_zero_and_saturates() -> None:
    depth = np.array([[0.0, 1e-4, 1e6]], np.float32)
    assert read_png(encode_depth(depth, "png")).tolist() == [[0, 1, 65_535]]


@pytest.mark.parametrize("codec", ["raw", "png"])
def test_instance_images_are_exact(codec: str) -> None:
    data = encode_instance(INSTANCE, codec)
    decoded = np.frombuffer(data, "<u2").reshape(12, 17) if codec == "raw" else read_png(data)
    assert np.array_equal(decoded, INSTANCE)


@pytest.mark.parametrize(
    ("image", "modality", "codec", "expected"),
    [
        (RGB, "rgb", "jpeg", ("jpeg", "uint8")),
        (DEPTH, "depth", "jpeg", ("png", "uint16")),
        (DEPTH, "depth", "raw", ("raw", "float32")),
        (INSTANCE, "instance", "jpeg", ("png", "uint16")),
    ],
)
def test_encoded_images_state_codec_dtype_and_shape(
    image: np.ndarray, modality: str, codec: str, expected: tuple[str, str]
) -> None:
    encoded = encode_image(image, modality, codec)
    assert (encoded.codec, encoded.dtype) == expected
    assert encoded.shape == image.shape


@pytest.mark.parametrize(
    ("image", "modality", "codec", "message"),
    [
        (RGB, "rgb", "webp", "webp"),
        (RGB.astype(np.float32), "rgb", "raw", "uint8"),
        (RGB[..., :2], "rgb", "png", r"\[12, 17, 2\]"),
        (DEPTH.astype(np.float64), "depth", "raw", "float32"),
        (RGB[:0], "rgb", "raw", r"\[0, 17, 3\]"),
        (RGB, "thermal", "raw", "thermal"),
        (RGB[..., 0].astype(np.uint16), "semantic", "png", "uint8"),
    ],
)
def test_unsupported_images_and_codecs_are_refused(
    image: np.ndarray, modality: str, codec: str, message: str
) -> None:
    with pytest.raises(RenderError, match=message):
        encode_image(image, modality, codec)


@pytest.mark.parametrize("quality", [0, 101])
def test_quality_out_of_range_is_refused(quality: int) -> None:
    with pytest.raises(RenderError, match="quality"):
        encode_rgb(RGB, "jpeg", quality=quality)


def test_nvjpeg_and_turbo_jpegs_agree() -> None:
    pytest.importorskip("nvidia.nvimgcodec")
    smooth = cv2.GaussianBlur(RGB, (0, 0), 3)
    encoder = NvjpegEncoder(CPU_ONLY)
    data = encode_rgb(smooth, "jpeg", quality=95, jpeg=encoder)
    assert simplejpeg.decode_jpeg_header(data)[3] == "444"
    by_turbo = simplejpeg.decode_jpeg(encode_rgb(smooth, "jpeg", quality=95)).astype(int)
    assert np.abs(simplejpeg.decode_jpeg(data) - by_turbo).max() <= 8
    assert disproof(encoder) is None


def test_turbo_encodes_images_that_nvjpeg_cannot(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("nvidia.nvimgcodec")

    def lost(self: NvjpegEncoder, image: object, quality: int) -> bytes:
        raise RenderError("nvJPEG failed: out of memory")

    monkeypatch.setattr(NvjpegEncoder, "encode", lost)
    encoder = NvjpegEncoder(CPU_ONLY)
    assert [encode_rgb(RGB, "jpeg", jpeg=encoder) for _ in range(2)] == 2 * [
        encode_rgb(RGB, "jpeg")
    ]
    assert [record.getMessage() for record in caplog.records] == [
        "jpegs are made by libjpeg-turbo where nvJPEG failed: out of memory"
    ]


def test_cpu_rendering_uses_turbo_jpeg() -> None:
    assert jpeg_encoder_for(torch.device("cpu"))[0] is turbo_jpeg


@pytest.mark.parametrize("wrong", ["swapped", "nothing"])
def test_an_encoder_that_fails_its_self_test_is_not_used(
    monkeypatch: pytest.MonkeyPatch, wrong: str
) -> None:
    pytest.importorskip("nvidia.nvimgcodec")

    def encode(self: NvjpegEncoder, image: np.ndarray, quality: int) -> bytes:
        if wrong == "nothing":
            raise RenderError("nvJPEG gave nothing")
        return turbo_jpeg(np.ascontiguousarray(image[..., ::-1]), quality)

    monkeypatch.setattr(NvjpegEncoder, "encode", encode)
    encoder, why = jpeg_encoder_for(torch.device("cuda"))
    assert encoder is turbo_jpeg
    assert why.startswith("libjpeg-turbo: nvJPEG ")
