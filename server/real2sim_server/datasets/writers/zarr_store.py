"""A zarr store, version 2, as a folder: groups, arrays of one chunk, and NCore's metadata in one.

Source: the specification of zarr's storage, version 2; RFC 8949 (CBOR) for the one file that holds
the metadata of all.
"""

from __future__ import annotations

import json
import lzma
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ZLIB_LEVEL = 1
SIMPLE = {False: b"\xf4", True: b"\xf5", None: b"\xf6"}
CONSOLIDATED = ".zmetadata.cbor.xz"


class ZarrStore:
    """A store that is written once, from its root on.

    Args:
        folder: of the store; made anew.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._metadata: dict[str, Any] = {}

    def group(self, path: str, attributes: Mapping[str, Any] | None = None) -> str:
        """A group at ``path`` (empty: the root), which is given back."""
        self._write(path, ".zgroup", {"zarr_format": 2})
        if attributes is not None:
            self._write(path, ".zattrs", dict(attributes))
        return path

    def array(
        self, path: str, values: NDArray[Any], attributes: Mapping[str, Any] | None = None
    ) -> None:
        """An array in one chunk."""
        values = np.ascontiguousarray(values)
        content = {
            "zarr_format": 2,
            "shape": list(values.shape),
            "chunks": [max(1, side) for side in values.shape],
            "dtype": values.dtype.str,
            "compressor": {"id": "zlib", "level": ZLIB_LEVEL},
            "fill_value": 0,
            "order": "C",
            "filters": None,
        }
        self._write(path, ".zarray", content)
        if attributes is not None:
            self._write(path, ".zattrs", dict(attributes))
        if values.size:
            chunk = zlib.compress(values.tobytes(), ZLIB_LEVEL)
            (self._folder / path / ".".join("0" * values.ndim)).write_bytes(chunk)

    def encoded(self, path: str, data: bytes, attributes: Mapping[str, Any]) -> None:
        """Bytes that do not end with a zero, as they are."""
        content = {
            "zarr_format": 2,
            "shape": [],
            "chunks": [],
            "dtype": f"|S{len(data)}",
            "compressor": None,
            "fill_value": None,
            "order": "C",
            "filters": None,
        }
        self._write(path, ".zarray", content)
        self._write(path, ".zattrs", dict(attributes))
        (self._folder / path / "0").write_bytes(data)

    def consolidate(self) -> None:
        """Write the metadata of all groups and arrays into one file."""
        content = {"zarr_consolidated_format": 1, "metadata": self._metadata}
        (self._folder / CONSOLIDATED).write_bytes(lzma.compress(cbor(content)))

    def _write(self, path: str, name: str, content: dict[str, Any]) -> None:
        self._metadata[f"{path}/{name}" if path else name] = content
        place = self._folder / path
        place.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def cbor(value: Any) -> bytes:
    """A JSON value as CBOR."""
    if value is None or isinstance(value, bool):
        return SIMPLE[value]
    if isinstance(value, int):
        return _head(0, value) if value >= 0 else _head(1, -1 - value)
    if isinstance(value, float):
        return b"\xfb" + struct.pack(">d", value)
    if isinstance(value, str):
        text = value.encode()
        return _head(3, len(text)) + text
    if isinstance(value, Mapping):
        pairs = (cbor(key) + cbor(part) for key, part in value.items())
        return _head(5, len(value)) + b"".join(pairs)
    return _head(4, len(value)) + b"".join(cbor(part) for part in value)


def _head(kind: int, number: int) -> bytes:
    """Major type and argument."""
    if number < 24:
        return bytes([kind << 5 | number])
    for extra, code in enumerate("BHIQ"):
        if number < 1 << (8 << extra):
            return bytes([kind << 5 | 24 + extra]) + struct.pack(f">{code}", number)
    raise ValueError(f"{number} does not fit 64 bits")
