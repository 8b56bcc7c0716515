"""Image files of logs: size from the header, reading, writing."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .driving_log import LogError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) [px] of a PNG or JPEG file, from its header only.

    Raises:
        LogError: the file is missing, empty, or neither PNG nor JPEG.
    """
    try:
        with path.open("rb") as file:
            head = file.read(24)
            if len(head) == 24 and head.startswith(b"\x89PNG\r\n\x1a\n"):
                return struct.unpack(">II", head[16:24])
            if head.startswith(b"\xff\xd8"):
                return _jpeg_size(head + file.read())
    except (OSError, struct.error, IndexError) as error:
        raise LogError(f"{path}: cannot be read as an image ({error})") from error
    raise LogError(f"{path}: expected a PNG or JPEG image, found {head[:8]!r}")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    position = 2
    while True:
        marker = data[position + 1]
        (length,) = struct.unpack(">H", data[position + 2 : position + 4])
        # Start-of-frame markers; C4, C8 and CC share the range but hold tables.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        position += 2 + length


def read_image(path: Path) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] of a PNG or JPEG file.

    Raises:
        LogError: the file is missing or broken.
    """
    import cv2

    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    if image is None:
        raise LogError(f"{path}: is no readable PNG or JPEG image ({data.size} bytes)")
    return np.ascontiguousarray(image[..., ::-1])


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write RGB uint8 [H, W, 3] as PNG or JPEG (quality 95), by the suffix of ``path``."""
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, 2] if path.suffix == ".png" else [1, 95]
    done, data = cv2.imencode(path.suffix, np.ascontiguousarray(image[..., ::-1]), options)
    if not done:
        raise LogError(f"{path}: this image could not be encoded as {path.suffix!r}")
    path.write_bytes(data.tobytes())
