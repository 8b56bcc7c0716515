"""Small files of preprocessed dataset folders: poses, intrinsics, JSON, sizes of images."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from ...geometry.transform import Float, is_rigid
from .checkpoint import CheckpointError

PNG_MAGIC = b"\x89PNG"


def read_numbers(path: Path) -> Float:
    """All numbers of a text file, in order. Raises CheckpointError naming it."""
    try:
        return np.array(path.read_text().split(), dtype=np.float64)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(f"{path}: must hold numbers only: {error}") from error


def read_pose(path: Path) -> Float:
    """A rigid transform [4, 4] of a text file. Raises CheckpointError naming it."""
    numbers = read_numbers(path)
    if numbers.size != 16 or not is_rigid(numbers.reshape(4, 4)):
        raise CheckpointError(f"{path}: must hold a rigid 4x4 transform")
    return numbers.reshape(4, 4)


def read_intrinsics(path: Path) -> Float:
    """Matrix K [3, 3] of a file of fx, fy, cx, cy and distortion, which is left out."""
    numbers = read_numbers(path)
    if numbers.size < 4:
        raise CheckpointError(f"{path}: must hold fx, fy, cx, cy, not {numbers.size} numbers")
    fx, fy, cx, cy = numbers[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def read_json(path: Path) -> Mapping[str, Any]:
    """A JSON object. Raises CheckpointError naming the file."""
    try:
        value = json.loads(path.read_bytes())
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise CheckpointError(f"{path}: is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise CheckpointError(f"{path}: must hold a JSON object")
    return value


def image_size(folder: Path, camera: int) -> tuple[int, int] | None:
    """Width and height [px] of a camera's images, None where there are none.

    Raises:
        CheckpointError: for an image that is neither PNG nor JPEG.
    """
    for image in sorted((folder / "images").glob(f"*_{camera}.*"))[:1]:
        data = image.read_bytes()
        if data.startswith(PNG_MAGIC) and len(data) >= 24:
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        try:
            height, width = simplejpeg.decode_jpeg_header(data)[:2]
        except ValueError as error:
            raise CheckpointError(f"{image}: is neither PNG nor JPEG, or is damaged") from error
        return width, height
    return None
