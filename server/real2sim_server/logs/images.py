"""Image files of logs: size from the header, reading, writing."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .driving_log import LogError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
END_BYTES = 1024
MAX_PIXELS = 1 << 27
"""Maximum size of an image; protects from headers with huge sizes."""


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) [px] of a PNG or JPEG file, from its header only.

    Raises:
        LogError: the file is missing, empty, or neither PNG nor JPEG.
    """
    try:
        with path.open("rb") as file:
            head = file.read(24)
            if head.startswith(JPEG_START):
                head += file.read()
    except OSError as error:
        raise LogError(f"{path}: cannot be read as an image ({error})") from error
    return encoded_size(head, str(path))


def common_size(files: Iterable[Path]) -> tuple[int, int]:
    """(width, height) [px] of most of the readable images, from the headers of the first 20.

    Raises:
        LogError: none of the files is an image.
    """
    sizes: Counter[tuple[int, int]] = Counter()
    error: LogError | None = None
    for path in files:
        try:
            sizes[image_size(path)] += 1
        except LogError as found:
            error = error or found
        if sizes.total() == 20:
            break
    if not sizes:
        raise error or LogError("there are no images")
    return sizes.most_common(1)[0][0]


def encoded_size(data: bytes, where: str) -> tuple[int, int]:
    """(width, height) [px] of an encoded image, from its header only.

    Raises:
        LogError: ``data`` is neither PNG nor JPEG, or its header is truncated; names ``where``.
    """
    size: tuple[int, int] | None = None
    try:
        if len(data) >= 24 and data.startswith(PNG_START):
            size = struct.unpack(">II", data[16:24])
        if data.startswith(JPEG_START):
            size = _jpeg_size(data)
    except (struct.error, IndexError) as error:
        raise LogError(f"{where}: cannot be read as an image ({error})") from error
    if size is not None:
        if size[0] * size[1] > MAX_PIXELS:
            raise LogError(f"{where}: {size[0]}x{size[1]} pixels; {MAX_PIXELS} are allowed")
        return size
    raise LogError(f"{where}: expected a PNG or JPEG image, found {data[:8]!r}")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    position = 2
    while True:
        marker = data[position + 1]
        (length,) = struct.unpack(">H", data[position + 2 : position + 4])
        # Start-of-frame markers; C4, C8 and CC are in the range but contain tables.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        position += 2 + length


def read_image(path: Path) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] of a PNG or JPEG file.

    Raises:
        LogError: the file is missing or broken.
    """
    return decode_image(_read_bytes(path), str(path))


def decode_image(data: bytes, where: str, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] of an encoded image; ``where`` names it in errors.

    Raises:
        LogError: it is broken, truncated, or not of the expected (width, height).
    """
    import cv2

    check_encoded_image(data, where, size)
    if data.startswith(JPEG_START):
        return _decode_jpeg(data, where)
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise LogError(f"{where}: is not a readable PNG or JPEG image ({len(data)} bytes)")
    return np.ascontiguousarray(image[..., ::-1])


def _decode_jpeg(data: bytes, where: str) -> NDArray[np.uint8]:
    """Reject damaged files. OpenCV shows damaged parts in grey without an error."""
    import simplejpeg

    try:
        try:
            return np.asarray(simplejpeg.decode_jpeg(data, "RGB"))
        except ValueError as error:
            # Some cameras insert a few harmless bytes between segments.
            if "extraneous bytes" not in str(error):
                raise
            return np.asarray(simplejpeg.decode_jpeg(data, "RGB", strict=False))
    except ValueError as error:
        raise LogError(f"{where}: is a damaged JPEG image ({error})") from error


def check_image_file(path: Path, size: tuple[int, int] | None = None) -> None:
    """Check an image file by its header and its end marker; like check_encoded_image."""
    check_encoded_image(_read_bytes(path), str(path), size)


def check_encoded_image(data: bytes, where: str, size: tuple[int, int] | None = None) -> None:
    """Check an encoded image without decoding it.

    Raises:
        LogError: it is not a PNG or JPEG, its end is missing, or it has another (width, height).
    """
    found = encoded_size(data, where)
    # Some writers pad their files, so the end marker may be followed by a few bytes.
    end = PNG_END if data.startswith(PNG_START) else JPEG_END
    if end not in data[-END_BYTES:]:
        raise LogError(f"{where}: the image is cut off ({len(data)} bytes, without an end marker)")
    if size is not None and found != size:
        raise LogError(
            f"{where}: is {found[0]}x{found[1]}, but the calibration says {size[0]}x{size[1]}"
        )


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write RGB uint8 [H, W, 3] as PNG or JPEG (quality 95), by the suffix of ``path``."""
    try:
        path.write_bytes(encode_image(image, path.suffix))
    except LogError as error:
        raise LogError(f"{path}: {error}") from error


def encode_image(image: NDArray[np.uint8], suffix: str) -> bytes:
    """RGB uint8 [H, W, 3] as PNG or JPEG (quality 95), by ``suffix`` such as ``.png``."""
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, 2] if suffix == ".png" else [1, 95]
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]), options)
    if not done:
        raise LogError(f"this image could not be encoded as {suffix!r}")
    return bytes(data.tobytes())
