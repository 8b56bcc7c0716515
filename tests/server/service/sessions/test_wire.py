"""Messages assembled from parts equal those of the codec."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from real2sim_proto import decode
from real2sim_proto.base import Modality
from real2sim_proto.drive import SERVER_MESSAGE
from real2sim_proto.episode import SensorSpec
from real2sim_server.geometry import transform_from
from real2sim_server.service.frames import RenderedImage, encode_frame
from real2sim_server.service.sessions.wire import (
    PhaseTimer,
    pack_members,
    pack_message,
    pack_with_frames,
)

MOUNTED = transform_from(np.array([1.5, 0.0, 1.6]), np.array([0.5, -0.5, 0.5, -0.5]))


def image(codec: str, modality: str = "rgb", height: int = 20, width: int = 30) -> RenderedImage:
    rng = np.random.default_rng(3)
    pixels = {
        "rgb": rng.integers(0, 255, (height, width, 3)).astype(np.uint8),
        "depth": rng.uniform(0, 90, (height, width)).astype(np.float32),
        "instance": rng.integers(0, 65535, (height, width)).astype(np.uint16),
        "median_depth": rng.uniform(0, 90, (height, width)).astype(np.float32),
        "semantic": rng.integers(0, 34, (height, width)).astype(np.uint8),
        "uncertainty": rng.uniform(0, 1, (height, width)).astype(np.float32),
    }[modality]
    sensor = SensorSpec(camera="front", modalities=[modality], codec=codec)
    return RenderedImage(sensor, modality, 7, np.eye(4), np.eye(3), pixels)


def view(frames: int, codec: str = "raw") -> bytes:
    encoded = [encode_frame(image(codec)) for _ in range(frames)]
    fields = {"t_us": 7, "revision": 2}
    return pack_with_frames("view", pack_members(fields), encoded, PhaseTimer()).joined(5)


@given(st.integers(min_value=0, max_value=2**53))
def test_the_message_id_is_set_when_joining(message_id):
    assert decode(pack_message("progress", {"phase": "x"}).joined(message_id))["id"] == message_id


@pytest.mark.parametrize("members", [0, 1, 12, 13, 14, 40])
def test_maps_of_any_size_are_encoded(members):
    fields = {f"f{i}": i for i in range(members)}
    message = decode(pack_message("error", fields).joined(1))
    assert message == {"v": 1, "type": "error", "id": 1, **fields}


@pytest.mark.parametrize("frames", [0, 1, 15, 16, 48])
def test_any_number_of_frames_makes_a_valid_message(frames):
    message = SERVER_MESSAGE.validate_python(decode(view(frames)))
    assert len(message.frames) == frames
    assert message.id == 5


@pytest.mark.parametrize("modality", get_args(Modality))
def test_raw_pixels_are_unchanged(modality):
    drawn = image("raw", modality)
    frame = encode_frame(drawn)
    pixels = np.frombuffer(frame.data, frame.header.fields["dtype"]).reshape(
        frame.header.fields["shape"]
    )
    np.testing.assert_array_equal(pixels, drawn.pixels)


def test_raw_pixels_are_not_copied_before_joining():
    drawn = image("raw")
    assert np.shares_memory(np.asarray(encode_frame(drawn).data), drawn.pixels)


def test_jpeg_depth_is_sent_as_png():
    assert encode_frame(image("jpeg", "depth")).codec == "png"


def test_pack_time_is_measured_and_sent():
    timing = decode(view(1))["timing"]
    assert set(timing) == {"pack"}
    assert timing["pack"] >= 0
