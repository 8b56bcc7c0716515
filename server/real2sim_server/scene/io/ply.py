"""Binary PLY files: header and elements as NumPy records. Knows nothing of Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import BundleError

MAX_HEADER_BYTES = 1 << 20
"""Longer headers are refused: none of the known writers comes near."""

MAX_HEADER_LINES = 1024
"""Elements and properties together; a splat with all its harmonics has 62 properties."""

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class PlyElement:
    """One element of a header.

    Attributes:
        name: for example ``vertex``.
        count: number of records.
        properties: NumPy type strings by name, in file order.
    """

    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Record type of one entry, packed."""
        return np.dtype(list(self.properties.items()))

    @property
    def nbytes(self) -> int:
        """Bytes of all records."""
        return self.count * self.dtype.itemsize if self.properties else 0


@dataclass(frozen=True)
class PlyHeader:
    """What a PLY file says it holds.

    Attributes:
        elements: by name, in file order.
        nbytes: length of the header, that is where the data starts.
    """

    elements: Mapping[str, PlyElement]
    nbytes: int


def read_ply_header(path: Path) -> PlyHeader:
    """Parse the header of a binary PLY file.

    Raises:
        BundleError: no PLY, ascii, an unknown type, list properties, doubled names, more than
            ``MAX_HEADER_LINES``, no end.
    """
    with _open(path) as file:
        lines, nbytes = _header_lines(file.read(MAX_HEADER_BYTES), path)
    if not lines:
        raise BundleError(f"{path}: ply header has no format line")
    order = _byte_order(lines[0], path)
    elements: dict[str, PlyElement] = {}
    current: PlyElement | None = None
    for line in lines[1:]:
        match line.split():
            case ["element", name, count]:
                current = _element(name, count, path)
                if name in elements:
                    raise BundleError(f"{path}: ply header has element {name[:80]!r} twice")
                elements[name] = current
            case ["property", *definition] if current is not None:
                _add_property(current, definition, order, path)
            case _:
                raise BundleError(f"{path}: ply header line {line[:80]!r} is not understood")
    return PlyHeader(elements, nbytes)


def read_ply_elements(path: Path) -> dict[str, NDArray[np.void]]:
    """All elements of a binary PLY file, each as a memory-mapped record array [count].

    The size of the file is compared with the header before anything is read or allocated.

    Raises:
        BundleError: like :func:`read_ply_header`, and where header and file size differ.
    """
    header = read_ply_header(path)
    _check_size(path, header)
    arrays: dict[str, NDArray[np.void]] = {}
    offset = header.nbytes
    for element in header.elements.values():
        if element.nbytes:
            arrays[element.name] = np.memmap(
                path, dtype=element.dtype, mode="r", offset=offset, shape=(element.count,)
            )
        else:
            arrays[element.name] = np.empty(0, dtype=element.dtype)
        offset += element.nbytes
    return arrays


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise BundleError(f"{path}: cannot be read: {error.strerror}") from error


def _header_lines(head: bytes, path: Path) -> tuple[list[str], int]:
    """Lines that mean something between ``ply`` and ``end_header``, and where the data starts."""
    lines: list[str] = []
    start = 0
    while (end := head.find(b"\n", start)) >= 0:
        line = head[start:end].rstrip(b"\r").decode("latin-1")
        if start == 0 and line != "ply":
            break
        start = end + 1
        if line.strip() == "end_header":
            return lines, start
        if line.split()[:1] not in ([], ["ply"], ["comment"], ["obj_info"]):
            lines.append(line)
            if len(lines) > MAX_HEADER_LINES:
                raise BundleError(
                    f"{path}: ply header declares more than {MAX_HEADER_LINES} elements and "
                    "properties; a splat file has fewer than a hundred"
                )
    if start == 0:
        raise BundleError(f"{path}: not a ply file (its first line must be 'ply')")
    raise BundleError(f"{path}: ply header has no end_header line; the file is cut short or no ply")


def _byte_order(line: str, path: Path) -> str:
    words = line.split()
    if words[:2] == ["format", "ascii"]:
        raise BundleError(f"{path}: ascii ply is not supported; write it as binary_little_endian")
    if words[0] != "format" or words[2:] != ["1.0"] or words[1] not in _BYTE_ORDERS:
        raise BundleError(
            f"{path}: ply header starts with {line[:80]!r}; allowed is 'format' with one of "
            f"{sorted(_BYTE_ORDERS)} and 1.0"
        )
    return _BYTE_ORDERS[words[1]]


def _element(name: str, count: str, path: Path) -> PlyElement:
    if not (count.isascii() and count.isdigit() and len(count) <= 18):
        raise BundleError(
            f"{path}: ply element {name!r} has count {count[:40]!r}, no usable number"
        )
    return PlyElement(name, int(count))


def _add_property(element: PlyElement, definition: list[str], order: str, path: Path) -> None:
    match definition:
        case ["list", *_]:
            # Mesh tools declare an empty face element; it takes no room in the file.
            if element.count:
                raise BundleError(
                    f"{path}: ply element {element.name!r} has list properties, a splat file none"
                )
        case [kind, name] if kind in _TYPES:
            if name in element.properties:
                raise BundleError(f"{path}: ply element {element.name!r} has {name[:80]!r} twice")
            element.properties[name] = order + _TYPES[kind]
        case _:
            raise BundleError(
                f"{path}: ply property {' '.join(definition)[:80]!r} is not understood; "
                f"types are {sorted(_TYPES)}"
            )


def _check_size(path: Path, header: PlyHeader) -> None:
    expected = header.nbytes + sum(e.nbytes for e in header.elements.values())
    actual = path.stat().st_size
    if actual == expected:
        return
    counts = ", ".join(f"{e.count} {e.name}" for e in header.elements.values())
    what = "truncated" if actual < expected else "longer than its header says"
    raise BundleError(
        f"{path}: {what}: the header promises {counts} and needs {expected} bytes, "
        f"the file has {actual}; export it again"
    )
