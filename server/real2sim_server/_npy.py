"""Arrays of ``.npy`` files and entries of zip archives, with untrusted headers."""

from __future__ import annotations

import io
import math
import zipfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def read_npy(data: bytes) -> NDArray[Any]:
    """The array of a ``.npy`` file of plain values.

    Shape and type are checked against the number of bytes before anything is allocated.

    Raises:
        ValueError: not such a file, object values, or a wrong number of bytes.
    """
    stream = io.BytesIO(data)
    shape, fortran, dtype = _read_header(stream, len(data))
    start = stream.tell()
    values = np.frombuffer(data, dtype, offset=start) if start < len(data) else np.zeros(0, dtype)
    array: NDArray[Any] = values.reshape(shape, order="F" if fortran else "C")
    return array.copy()


def _read_header(stream: IO[bytes], total: int) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether the order is Fortran's, and type of a ``.npy`` file of ``total`` bytes."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of .npy is not read")
    try:
        shape, fortran, dtype = _HEADERS[version](stream)
    # The header is an expression of Python, read by its parser.
    except Exception as error:
        raise ValueError(f"its header is damaged: {error}") from error
    if dtype.hasobject:
        raise ValueError("arrays of objects are not read")
    if any(n < 0 for n in shape):
        raise ValueError(f"shape {shape} holds no lengths")
    expected, given = math.prod(shape) * dtype.itemsize, total - stream.tell()
    if given != expected:
        raise ValueError(f"{dtype} of shape {shape} needs {expected} bytes, not {given}")
    return shape, fortran, dtype


def read_entries(archive: zipfile.ZipFile, *, max_bytes: int) -> dict[str, bytes]:
    """All entries of an archive by name, unpacked.

    Raises:
        ValueError: they are more than ``max_bytes`` together, or a name is there twice.
        Exception: damage shows as almost any error of the libraries that unpack.
    """
    return {info.filename: archive.read(info) for info in _entries(archive, max_bytes)}


def read_headers(
    archive: zipfile.ZipFile, *, max_bytes: int
) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
    """Shape and type of every ``.npy`` entry of an archive by name, without its values.

    Raises:
        Exception: as :func:`read_entries` and :func:`read_npy` do.
    """
    found = {}
    for info in _entries(archive, max_bytes):
        if info.filename.endswith(".npy"):
            with archive.open(info) as stream:
                shape, _, dtype = _read_header(stream, info.file_size)
            found[info.filename] = shape, dtype
    return found


def _entries(archive: zipfile.ZipFile, max_bytes: int) -> list[zipfile.ZipInfo]:
    infos = archive.infolist()
    total = sum(info.file_size for info in infos)
    if total > max_bytes:
        raise ValueError(f"it unpacks to {total} bytes; allowed are {max_bytes}")
    if len({info.filename for info in infos}) != len(infos):
        raise ValueError("a name is in it twice")
    return infos
