"""Gaussians in PLY files: INRIA's format, and the compressed one of PlayCanvas and SuperSplat.

INRIA's format (Kerbl et al. 2023) stores parameters before activation. The compressed format stores
chunks of 256 splats, 16 bytes per splat. A chunk stores the minimum and maximum of position, log
scale and (in newer files) colour; a splat stores fractions in between. Sources:
github.com/playcanvas/engine, gsplat-compressed-data.js, and github.com/playcanvas/splat-transform,
decompress-ply.ts.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from ..._files import atomic_file
from ...geometry import Float
from ..cloud import SH_C0, SH_DEGREES, GaussianCloud
from ..errors import BundleError
from .splat_format import (
    UpAxis,
    build_cloud,
    check_memory,
    column,
    columns,
    host_array,
    note,
    require_properties,
)

MAX_HEADER_BYTES = 1 << 20
"""Longer headers are rejected; known writers stay far below."""

MAX_HEADER_LINES = 1024
"""Maximum number of elements and properties; a splat with all its harmonics has 62 properties."""

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
ASCII = "ascii"
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", ASCII: "="}


@dataclass
class PlyElement:
    """One element of a header.

    Attributes:
        name: for example ``vertex``.
        count: number of records.
        properties: NumPy type strings by name, in file order, without lists.
        has_lists: whether a record has lists, so that its length varies.
    """

    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)
    has_lists: bool = False

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
    """Header of a PLY file.

    Attributes:
        elements: by name, in file order.
        nbytes: length of the header, the offset of the data.
        comments: text of the comment lines.
        is_text: whether the records are lines of text.
    """

    elements: Mapping[str, PlyElement]
    nbytes: int
    comments: tuple[str, ...] = ()
    is_text: bool = False


def read_ply_header(path: Path) -> PlyHeader:
    """Parse the header of a PLY file.

    Raises:
        BundleError: not a PLY file, an unknown type, duplicate names, more than
            ``MAX_HEADER_LINES``, or no end of the header.
    """
    with _open(path) as file:
        lines, comments, nbytes = _header_lines(file.read(MAX_HEADER_BYTES), path)
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
    return PlyHeader(elements, nbytes, comments, lines[0].split()[1] == ASCII)


def read_ply_elements(path: Path, notes: list[str] | None = None) -> dict[str, NDArray[np.void]]:
    """All elements of a PLY file, each as a record array [count].

    Records of binary files are memory-mapped. The size of the file is compared with the header
    before anything is read or allocated. An element with lists and those after it are left out,
    with a sentence in ``notes``.

    Raises:
        BundleError: like :func:`read_ply_header`, header and file size do not match, vertices have
            lists, or without ``notes``, another element has.
    """
    header = read_ply_header(path)
    elements = list(header.elements.values())
    for index, element in enumerate(elements):
        if element.has_lists and element.count:
            sentence = f"ply element {element.name!r} has list properties"
            if "vertex" not in [known.name for known in elements[:index]]:
                raise BundleError(f"{path}: {sentence}; those of a splat file are plain numbers")
            note(path, notes, sentence, "it and the elements after it are left out")
            elements = elements[:index]
            break
    _check_size(path, header, elements)
    if header.is_text:
        return _text_records(path, header, elements)
    arrays: dict[str, NDArray[np.void]] = {}
    offset = header.nbytes
    for element in elements:
        if element.nbytes:
            arrays[element.name] = np.memmap(
                path, dtype=element.dtype, mode="r", offset=offset, shape=(element.count,)
            )
        else:
            arrays[element.name] = np.empty(0, dtype=element.dtype)
        offset += element.nbytes
    return arrays


def _text_records(
    path: Path, header: PlyHeader, elements: Sequence[PlyElement]
) -> dict[str, NDArray[np.void]]:
    arrays: dict[str, NDArray[np.void]] = {}
    with _open(path) as file:
        file.seek(header.nbytes)
        for element in elements:
            arrays[element.name] = np.empty(element.count, dtype=element.dtype)
            if not (element.count and element.properties):
                continue
            # Lines are taken one by one, since loadtxt reads ahead in files.
            lines = itertools.islice((line for line in file if line.strip()), element.count)
            try:
                rows = np.loadtxt(lines, comments=None, ndmin=2)
            except ValueError as error:
                reason = str(error)[:120]
                raise BundleError(f"{path}: ply element {element.name!r}: {reason}") from error
            if rows.shape != (element.count, len(element.properties)):
                raise BundleError(
                    f"{path}: the header promises {element.count} {element.name} of "
                    f"{len(element.properties)} values, the file has {len(rows)} of "
                    f"{rows.shape[1]}; export it again"
                )
            with np.errstate(invalid="ignore", over="ignore"):
                for name, values in zip(element.properties, rows.T, strict=True):
                    arrays[element.name][name] = values
        if len(elements) == len(header.elements) and file.read().strip():
            raise BundleError(f"{path}: longer than its header says; export it again")
    return arrays


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise BundleError(f"{path}: cannot be read: {error.strerror}") from error


def _header_lines(head: bytes, path: Path) -> tuple[list[str], tuple[str, ...], int]:
    """Lines between ``ply`` and ``end_header``, comments, and the offset of the data."""
    lines: list[str] = []
    comments: list[str] = []
    start = 0
    while (end := head.find(b"\n", start)) >= 0:
        line = head[start:end].rstrip(b"\r").decode("latin-1")
        if start == 0 and line != "ply":
            break
        start = end + 1
        if line.strip() == "end_header":
            return lines, tuple(comments), start
        if line.split()[:1] == ["comment"]:
            comments.append(line.strip().removeprefix("comment").strip())
        elif line.split()[:1] not in ([], ["ply"], ["obj_info"]):
            lines.append(line)
            if len(lines) > MAX_HEADER_LINES:
                raise BundleError(
                    f"{path}: ply header declares more than {MAX_HEADER_LINES} elements and "
                    "properties; a splat file has fewer than a hundred"
                )
    if start == 0:
        raise BundleError(f"{path}: not a ply file (its first line must be 'ply')")
    raise BundleError(f"{path}: ply header has no end_header line; truncated, or not a PLY file")


def _byte_order(line: str, path: Path) -> str:
    words = line.split()
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
            # Mesh tools declare an empty face element; it has no data in the file.
            element.has_lists = True
        case [kind, name] if kind in _TYPES:
            if name in element.properties:
                raise BundleError(f"{path}: ply element {element.name!r} has {name[:80]!r} twice")
            element.properties[name] = order + _TYPES[kind]
        case _:
            raise BundleError(
                f"{path}: ply property {' '.join(definition)[:80]!r} is not understood; "
                f"types are {sorted(_TYPES)}"
            )


def _check_size(path: Path, header: PlyHeader, elements: Sequence[PlyElement]) -> None:
    """Raise BundleError unless the file has the size of ``elements``, the first of the header."""
    if header.is_text:
        # A digit and a separator for each value; the last separator may be missing.
        expected = header.nbytes - 1 + sum(2 * e.count * len(e.properties) for e in elements)
    else:
        expected = header.nbytes + sum(e.nbytes for e in elements)
    actual = path.stat().st_size
    is_exact = not header.is_text and len(elements) == len(header.elements)
    if actual == expected or (actual > expected and not is_exact):
        return
    counts = ", ".join(f"{e.count} {e.name}" for e in elements)
    what = "truncated" if actual < expected else "longer than its header says"
    raise BundleError(
        f"{path}: {what}: the header promises {counts} and needs {expected} bytes, "
        f"the file has {actual}; export it again"
    )


# INRIA's format.

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

FILTER = "filter_3D"

COMMENT = "real2sim: opacity is a logit, scale a logarithm"
"""Comment in the header of own files, because readers guess the meaning in files without it."""

MAX_LOGIT = 40.0
"""Logit for opacities of 0 and 1, which have no finite logit."""


class InriaPly:
    """One ``vertex`` element; log scales, logit opacities, rotation wxyz, f_rest channel-major.

    Properties may come in any order and number type; normals and unknown ones are skipped. The
    ``filter_3D`` of Mip-Splatting is applied. A file in which all opacities are between 0 and 1 and
    all scales are positive is read as opacities and scales.
    """

    name = "INRIA ply"
    suffix = ".ply"
    has_signature = True
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        """Whether ``head`` belongs to a PLY file; the compressed variant is checked first."""
        return head.startswith((b"ply\n", b"ply\r\n"))

    def read(
        self, path: Path, *, max_bytes: int | None = None, notes: list[str] | None = None
    ) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        elements = read_ply_elements(path, notes)
        vertex = elements.get("vertex")
        names = vertex.dtype.names or () if vertex is not None else None
        require_properties(path, "vertex", names, POSITION + DC + ("opacity",) + SCALE + ROTATION)
        assert vertex is not None
        rest = _rest_properties(path, vertex, notes)
        check_memory(path, len(vertex), 1 + len(rest) // 3, max_bytes)
        opacities, log_scales = _activated(path, vertex, notes)
        return build_cloud(
            path,
            means=columns(path, vertex, POSITION, np.float32, notes),
            quats=columns(path, vertex, ROTATION, notes=notes),
            log_scales=log_scales,
            opacities=opacities,
            sh=_spherical_harmonics(path, vertex, rest, notes),
            notes=notes,
        )

    def write(self, cloud: GaussianCloud, path: Path, *, comment: str = "") -> None:
        """Write ``cloud``; see :func:`write_inria_ply`."""
        write_inria_ply(cloud, path, comment=comment)


def write_inria_ply(cloud: GaussianCloud, path: Path, *, comment: str = "") -> None:
    """Write ``cloud`` as an INRIA-style binary little-endian PLY, atomically.

    Positions and harmonics keep their bits; scales and opacities pass through log and logit in
    float64 and are exact to float32 rounding. Normals are written as zeros, as viewers expect.

    Raises:
        OSError: the file cannot be written.
    """
    rest = 3 * (cloud.sh.shape[1] - 1)
    names = POSITION + NORMAL + DC + _rest_names(rest) + ("opacity",) + SCALE + ROTATION
    sh = cloud.sh.detach().cpu().numpy()
    opacities = cloud.opacities.detach().cpu().numpy().astype(np.float64)
    with np.errstate(divide="ignore"):
        logits = np.log(opacities) - np.log1p(-opacities)
    parts = [
        cloud.means.detach().cpu().numpy(),
        np.zeros((len(cloud), 3)),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(len(cloud), rest),
        np.clip(logits, -MAX_LOGIT, MAX_LOGIT)[:, None],
        np.log(cloud.scales.detach().cpu().numpy().astype(np.float64)),
        cloud.quats.detach().cpu().numpy(),
    ]
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0"]
        + [f"comment {COMMENT}"]
        + [f"comment {comment}"] * bool(comment)
        + [f"element vertex {len(cloud)}"]
        + [f"property float {name}" for name in names]
        + ["end_header\n"]
    )
    with atomic_file(path) as file:
        file.write(header.encode("ascii"))
        file.write(np.concatenate(parts, axis=1).astype("<f4").tobytes())


DEGREE_4 = 24
"""Harmonics past the first of degree 4, for each channel."""


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _activated(
    path: Path, vertex: NDArray[np.void], notes: list[str] | None
) -> tuple[Float, Float]:
    """Opacities [N] and log scales [N, 3], whichever of the two the file stores."""
    opacity = column(path, vertex, "opacity", infinite=True, notes=notes)
    scale = columns(path, vertex, SCALE, notes=notes)
    # NaN compares as false, so rows with NaN are skipped.
    is_share = len(vertex) > 0 and not ((opacity < 0) | (opacity > 1)).any()
    is_length = len(vertex) > 0 and not (scale <= 0).any()
    if COMMENT in read_ply_header(path).comments:
        is_share = is_length = False
    with np.errstate(over="ignore", under="ignore", invalid="ignore", divide="ignore"):
        if is_share and is_length:
            note(
                path,
                notes,
                "all opacities are between 0 and 1 and all scales positive",
                "they are read as they are, not as logits and logarithms",
            )
            opacities, log_scales = opacity, np.log(scale)
        else:
            opacities, log_scales = 1 / (1 + np.exp(-opacity)), scale
            if notes is not None and is_share:
                notes.append(
                    "all opacities are between 0 and 1: they are read as logits, 0.5 to 0.73 opaque"
                )
            if notes is not None and is_length:
                notes.append(
                    "all scales are positive: they are read as logarithms, at least 1 unit wide"
                )
        if FILTER in (vertex.dtype.names or ()):
            # Source: Yu et al., "Mip-Splatting: Alias-free 3D Gaussian Splatting", CVPR 2024.
            width = column(path, vertex, FILTER, notes=notes)[:, None]
            filtered = np.log(np.exp(2 * log_scales) + width * width) / 2
            opacities = opacities * np.exp((log_scales - filtered).sum(axis=1))
            log_scales = filtered
            note(
                path,
                notes,
                "the splats have the filter_3D of Mip-Splatting",
                "it is applied to their scales and opacities",
            )
    return opacities, log_scales


def _rest_properties(
    path: Path, vertex: NDArray[np.void], notes: list[str] | None
) -> tuple[str, ...]:
    """Names of the harmonics past the first; checks that they form a whole degree."""
    given = [name for name in vertex.dtype.names or () if name.startswith("f_rest_")]
    names = _rest_names(len(given))
    if set(given) == set(names) and len(names) == 3 * DEGREE_4:
        note(path, notes, "the spherical harmonics have degree 4", "only degrees 0 to 3 are read")
        return tuple(name for k, name in enumerate(names) if k % DEGREE_4 < max(SH_DEGREES) - 1)
    if set(given) != set(names) or len(names) // 3 + 1 not in SH_DEGREES or len(names) % 3:
        raise BundleError(
            f"{path}: {len(given)} f_rest properties; allowed are f_rest_0 to f_rest_8, _23, _44 "
            "without gaps, or none"
        )
    return names


def _spherical_harmonics(
    path: Path, vertex: NDArray[np.void], rest: tuple[str, ...], notes: list[str] | None
) -> NDArray[np.float32]:
    """Coefficients [N, K, 3]; the file stores those past the first channel by channel."""
    per_channel = len(rest) // 3
    sh = np.empty((len(vertex), 1 + per_channel, 3), dtype=np.float32)
    sh[:, 0] = columns(path, vertex, DC, np.float32, notes)
    for channel in range(3):
        names = rest[channel * per_channel : (channel + 1) * per_channel]
        sh[:, 1:, channel] = columns(path, vertex, names, np.float32, notes)
    return sh


# Z-order curve, for better compression.

BITS = 21
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(points: Float) -> NDArray[np.int64]:
    """Indices [N] that sort ``points`` [N, 3] along a Z curve of 2^21 cells per side.

    Cells are cubes over the longest extent of the points. Equal cells keep their order.
    """
    if not len(points):
        return np.empty(0, dtype=np.int64)
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    cells = (points - low) / (extent or 1.0) * (2**BITS - 1)
    x, y, z = (_spread(cells[:, axis].astype(np.uint64)) for axis in range(3))
    return np.argsort(x | y << np.uint64(1) | z << np.uint64(2), kind="stable")


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zero bits between each pair of the lowest 21 bits."""
    for shift, mask in _SPREAD:
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values


# The compressed format of PlayCanvas.

CHUNK_SIZE = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
LOW_POSITION, HIGH_POSITION = ("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")
LOW_SCALE = ("min_scale_x", "min_scale_y", "min_scale_z")
HIGH_SCALE = ("max_scale_x", "max_scale_y", "max_scale_z")
LOW_COLOUR, HIGH_COLOUR = ("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")

Words = NDArray[np.uint32]


CHUNK_FIELDS = LOW_POSITION + HIGH_POSITION + LOW_SCALE + HIGH_SCALE + LOW_COLOUR + HIGH_COLOUR

MAX_LOG_SCALE = 20.0
"""Log scales are clamped to plus or minus this value, as in the format's original writer."""


class PlayCanvasPly:
    """Elements ``chunk`` (12 or 18 floats), ``vertex`` (4 uint32) and, for degree > 0, ``sh``.

    Axes: those of the source splats, mostly y down. Reading and writing preserve the coordinates.

    Quantisation: within a chunk of 256, positions and log scales are divided into 2047 (x, z) and
    1023 (y) steps of the chunk's extent, colours of the first harmonic into 255; opacities are
    multiples of 1/255; the three small components of a quaternion are multiples of sqrt(2)/1023;
    further harmonics are clamped to [-4, 4] and divided into 256 bins.
    """

    name = "PlayCanvas compressed ply"
    suffix = ".compressed.ply"
    has_signature = True
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        """Whether ``head`` belongs to a PLY file with packed positions."""
        header = head.split(b"end_header", 1)[0]
        return header.startswith((b"ply\n", b"ply\r\n")) and b" packed_position" in header

    def read(
        self, path: Path, *, max_bytes: int | None = None, notes: list[str] | None = None
    ) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        elements = read_ply_elements(path, notes)
        vertex, chunks = self._checked(path, elements)
        sh = elements.get("sh")
        rest = 0 if sh is None else len(sh.dtype.names or ()) // 3
        check_memory(path, len(vertex), 1 + rest, max_bytes)
        chunk_of = np.arange(len(vertex)) // CHUNK_SIZE

        def between(low: tuple[str, ...], high: tuple[str, ...], fraction: Float) -> Float:
            a = columns(path, chunks, low, notes=notes)[chunk_of]
            b = columns(path, chunks, high, notes=notes)[chunk_of]
            return a * (1 - fraction) + b * fraction

        rgba = _unpack_8888(vertex["packed_color"])
        has_colours = LOW_COLOUR[0] in (chunks.dtype.names or ())
        rgb = between(LOW_COLOUR, HIGH_COLOUR, rgba[:, :3]) if has_colours else rgba[:, :3]
        first = ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None, :]
        return build_cloud(
            path,
            means=between(LOW_POSITION, HIGH_POSITION, _unpack_11_10_11(vertex["packed_position"])),
            quats=_unpack_rotation(vertex["packed_rotation"]),
            log_scales=between(LOW_SCALE, HIGH_SCALE, _unpack_11_10_11(vertex["packed_scale"])),
            opacities=rgba[:, 3],
            sh=np.concatenate([first, _rest(path, sh, len(vertex))], axis=1),
            notes=notes,
        )

    def write(self, cloud: GaussianCloud, path: Path, *, comment: str = "") -> None:
        """Write ``cloud`` in Z-curve order, so that chunks are small; the original order is lost.

        Raises:
            OSError: the file cannot be written.
        """
        cloud = cloud.select(torch.from_numpy(morton_order(host_array(cloud.means))))
        chunks, words = _packed(cloud)
        sh = _packed_rest(host_array(cloud.sh[:, 1:]))
        lines = ["ply", "format binary_little_endian 1.0"]
        lines += [f"comment {comment}"] * bool(comment) + [f"element chunk {len(chunks)}"]
        lines += [f"property float {name}" for name in CHUNK_FIELDS]
        lines += [f"element vertex {len(cloud)}", *(f"property uint {name}" for name in PACKED)]
        if sh.shape[1]:
            lines.append(f"element sh {len(cloud)}")
            lines += [f"property uchar f_rest_{i}" for i in range(sh.shape[1])]
        with atomic_file(path) as file:
            file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
            for part in (chunks.astype("<f4"), words.astype("<u4"), sh):
                file.write(part.tobytes())

    def _checked(
        self, path: Path, elements: dict[str, NDArray[np.void]]
    ) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """Elements ``vertex`` and ``chunk``, with a check of their properties and counts."""
        vertex, chunks = elements.get("vertex"), elements.get("chunk")
        vertex_names = vertex.dtype.names or () if vertex is not None else None
        chunk_names = chunks.dtype.names or () if chunks is not None else None
        needed: tuple[str, ...] = LOW_POSITION + HIGH_POSITION + LOW_SCALE + HIGH_SCALE
        if chunk_names and LOW_COLOUR[0] in chunk_names:
            needed += LOW_COLOUR + HIGH_COLOUR
        require_properties(path, "chunk", chunk_names, needed)
        require_properties(path, "vertex", vertex_names, PACKED)
        assert vertex is not None
        assert chunks is not None
        if any(
            vertex.dtype[name].kind != "u" or vertex.dtype[name].itemsize != 4 for name in PACKED
        ):
            raise BundleError(f"{path}: the packed properties must be of type uint")
        if len(chunks) != -(-len(vertex) // CHUNK_SIZE):
            raise BundleError(
                f"{path}: {len(chunks)} chunks of {CHUNK_SIZE} do not fit {len(vertex)} splats"
            )
        return vertex, chunks


def _unpack_11_10_11(words: Words) -> Float:
    """Fractions [N, 3] in [0, 1]; the first component is in the highest bits."""
    w = np.asarray(words, dtype=np.uint32)
    return np.stack([(w >> 21) / 2047, (w >> 11 & 1023) / 1023, (w & 2047) / 2047], axis=-1)


def _unpack_8888(words: Words) -> Float:
    """Red, green, blue, alpha [N, 4] in [0, 1]; red is in the highest bits."""
    w = np.asarray(words, dtype=np.uint32)
    return np.stack([(w >> shift & 255) / 255 for shift in (24, 16, 8, 0)], axis=-1)


def _unpack_rotation(words: Words) -> Float:
    """Quaternions [N, 4] wxyz.

    The highest two bits give the index of the largest component, which is omitted; the other three
    follow in the order w, x, y, z with 10 bits each over [-1/sqrt(2), 1/sqrt(2)].
    """
    w = np.asarray(words, dtype=np.uint32)
    small = (np.stack([w >> s & 1023 for s in (20, 10, 0)], axis=-1) / 1023 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (small * small).sum(axis=-1)))
    quats = np.empty((len(w), 4))
    for place in range(4):
        chosen = (w >> 30) == place
        others = [k for k in range(4) if k != place]
        quats[np.ix_(chosen, others)] = small[chosen]
        quats[chosen, place] = largest[chosen]
    return quats


def _rest(path: Path, sh: NDArray[np.void] | None, count: int) -> NDArray[np.float32]:
    """Harmonics past the first [N, K - 1, 3]: bytes over [-4, 4], channel by channel."""
    if sh is None:
        return np.empty((count, 0, 3), dtype=np.float32)
    names = tuple(f"f_rest_{i}" for i in range(len(sh.dtype.names or ())))
    if len(names) % 3 or len(names) // 3 + 1 not in SH_DEGREES or len(sh) != count:
        raise BundleError(
            f"{path}: element 'sh' has {len(sh)} records of {len(names)} properties; "
            f"allowed are {count} of 9, 24 or 45"
        )
    require_properties(path, "sh", sh.dtype.names, names)
    per_channel = len(names) // 3
    rest = np.empty((count, per_channel, 3), dtype=np.float32)
    for index, name in enumerate(names):
        codes = column(path, sh, name)
        # The writer uses 256 equal bins; reading returns their centres, and the limits for clamped
        # values.
        fraction = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, (codes + 0.5) / 256))
        rest[:, index % per_channel, index // per_channel] = (fraction - 0.5) * 8
    return rest


def _packed(cloud: GaussianCloud) -> tuple[Float, Words]:
    """Bounds [C, 18] of all chunks in the order of ``CHUNK_FIELDS``, and words [N, 4]."""
    log_scales = np.log(host_array(cloud.scales))
    position, low_position, high_position = _fractions(host_array(cloud.means))
    scale, low_scale, high_scale = _fractions(np.clip(log_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE))
    colour, low_colour, high_colour = _fractions(0.5 + SH_C0 * host_array(cloud.sh[:, 0]))
    rgba = np.concatenate([colour, host_array(cloud.opacities)[:, None]], axis=1)
    words = [
        _pack(position, (11, 10, 11)),
        _pack_rotation(host_array(cloud.quats)),
        _pack(scale, (11, 10, 11)),
        _pack(rgba, (8, 8, 8, 8)),
    ]
    bounds = [low_position, high_position, low_scale, high_scale, low_colour, high_colour]
    return np.concatenate(bounds, axis=1), np.stack(words, axis=1)


def _fractions(values: Float) -> tuple[Float, Float, Float]:
    """Values [N, 3] as fractions between the bounds [C, 3] of their chunks, and these bounds."""
    starts = np.arange(0, len(values), CHUNK_SIZE)
    if not len(starts):
        return values, np.empty((0, 3)), np.empty((0, 3))
    # The file stores bounds as float32, so fractions refer to the rounded bounds.
    low = np.minimum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    chunk_of = np.arange(len(values)) // CHUNK_SIZE
    span = (high - low)[chunk_of]
    fractions = (values - low[chunk_of]) / np.where(span > 0, span, 1.0)
    return np.clip(fractions, 0.0, 1.0), low, high


def _pack(fractions: Float, bits: tuple[int, ...]) -> Words:
    """Pack each row of fractions into one word; the first component is in the highest bits."""
    words = np.zeros(len(fractions), dtype=np.uint32)
    for axis, width in enumerate(bits):
        codes = np.rint(fractions[:, axis] * (2**width - 1)).astype(np.uint32)
        words = words << np.uint32(width) | codes
    return words


def _pack_rotation(quats: Float) -> Words:
    """Inverse of :func:`_unpack_rotation`."""
    place = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    positive = np.where(quats[rows, place] < 0, -1.0, 1.0)[:, None] * quats
    others = np.array([[k for k in range(4) if k != p] for p in range(4)])[place]
    small = np.take_along_axis(positive, others, axis=1) / np.sqrt(2) + 0.5
    words: Words = place.astype(np.uint32) << np.uint32(30)
    return words | _pack(np.clip(small, 0, 1), (10, 10, 10))


def _packed_rest(rest: Float) -> NDArray[np.uint8]:
    """Bytes [N, 3 (K - 1)] of harmonics [N, K - 1, 3], channel by channel."""
    codes = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(codes.transpose(0, 2, 1).reshape(len(rest), 3 * rest.shape[1]))
