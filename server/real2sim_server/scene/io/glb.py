"""Binary glTF 2.0 containers: accessors collected one by one, then written in one go."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..._files import atomic_file
from ..errors import SceneError

FLOAT, UNSIGNED_BYTE = 5126, 5121
ARRAY_BUFFER = 34962
MAX_BYTES = 0xFFFFFFFF
"""Lengths in a glb file are 32 bits."""

_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"float32": FLOAT, "uint8": UNSIGNED_BYTE}


class GlbWriter:
    """Collects arrays as accessors with a buffer view each, and writes the file."""

    def __init__(self) -> None:
        self._parts: list[NDArray[Any]] = []
        self._nbytes = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, bounds: bool = False, vertices: bool = True) -> int:
        """Append an array [N] or [N, 3 or 4], N >= 1, float32 or (normalised) uint8.

        Args:
            array: the values; kept, not copied.
            bounds: also state lowest and highest, which positions and key times must have.
            vertices: whether it belongs to vertices or to an animation.

        Returns:
            Index of the accessor.
        """
        width = 1 if array.ndim == 1 else array.shape[1]
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": self._nbytes,
            "byteLength": array.nbytes,
        }
        if vertices:
            view["target"] = ARRAY_BUFFER
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": _COMPONENTS[array.dtype.name],
            "count": len(array),
            "type": _TYPES[width],
        }
        if array.dtype == np.uint8:
            accessor["normalized"] = True
        if bounds:
            rows = array.reshape(len(array), width)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self._views.append(view)
        self._accessors.append(accessor)
        self._parts.append(array)
        self._nbytes += array.nbytes + -array.nbytes % 4
        return len(self._accessors) - 1

    def write(self, document: dict[str, Any], path: Path) -> None:
        """Write ``document`` with all accessors so far, atomically.

        Raises:
            SceneError: for values JSON cannot hold, or more than 4 GiB.
            OSError: the file cannot be written.
        """
        if self._parts:
            document = document | {
                "buffers": [{"byteLength": self._nbytes}],
                "bufferViews": self._views,
                "accessors": self._accessors,
            }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + (8 + self._nbytes if self._parts else 0)
        if total > MAX_BYTES:
            raise SceneError(
                f"{path}: {total} bytes; a glb file holds at most {MAX_BYTES}; export objects "
                "one by one or as spz"
            )
        with atomic_file(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON"))
            file.write(text)
            if self._parts:
                file.write(struct.pack("<I4s", self._nbytes, b"BIN\0"))
            for part in self._parts:
                # As vertices lie in memory: little-endian, row by row.
                file.write(np.ascontiguousarray(part, dtype=part.dtype.newbyteorder("<")).data)
                file.write(b"\0" * (-part.nbytes % 4))
