"""Images of logs: headers and damage."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from real2sim_server.logs import LogError
from real2sim_server.logs.images import decode_image, encoded_size


def test_a_header_with_too_many_pixels_is_refused():
    head = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", 60_000, 60_000)
    with pytest.raises(LogError, match="60000x60000 pixels"):
        encoded_size(head, "a.png")


def test_a_jpeg_without_tables_is_refused():
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    whole = cv2.imencode(".jpg", pixels)[1].tobytes()
    scan = whole.index(b"\xff\xda")
    # Extra bytes before the scan are tolerated; missing tables are not.
    table = whole.index(b"\xff\xc4")
    damaged = whole[:table] + b"\0" * (scan - table) + whole[scan:]
    with pytest.raises(LogError, match=r"a\.jpg: is a damaged JPEG"):
        decode_image(damaged, "a.jpg")
