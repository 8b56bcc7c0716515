"""TFRecord files and protocol-buffer messages, read without TensorFlow or protobuf.

Sources: the TFRecord section of TensorFlow's guide, and the encoding section of the protocol
buffers guide.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..driving_log import LogError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_HEADER = struct.Struct("<QI")
_CRC_MASK = 0xA282EAD8


@dataclass(frozen=True)
class Record:
    """Where one record of a TFRecord file lies.

    Attributes:
        offset: of its payload in the file [bytes].
        length: of its payload [bytes].
    """

    offset: int
    length: int


def list_records(path: Path) -> list[Record]:
    """All records of a TFRecord file; headers are read and checked, payloads are skipped.

    Raises:
        LogError: the file is missing, empty, cut off, or a header's checksum is wrong.
    """
    records = []
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            position = 0
            while position < size:
                record = _record_at(path, file.read(_HEADER.size), position, size)
                records.append(record)
                position = record.offset + record.length + 4
                file.seek(position)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    if not records:
        raise LogError(f"{path}: is empty")
    return records


def _record_at(path: Path, header: bytes, position: int, size: int) -> Record:
    where = f"{path} at byte {position}"
    if len(header) < _HEADER.size:
        raise LogError(f"{where}: the file is cut off inside a record's header")
    length, checksum = _HEADER.unpack(header)
    if masked_crc32c(header[:8]) != checksum:
        raise LogError(f"{where}: the header's checksum is wrong; this is no TFRecord, or broken")
    if position + _HEADER.size + length + 4 > size:
        raise LogError(
            f"{where}: a record of {length} bytes does not fit into the file's {size}; is it cut "
            "off?"
        )
    return Record(position + _HEADER.size, length)


def read_record(path: Path, record: Record) -> bytes:
    """The payload of a record, checked by its checksum.

    Raises:
        LogError: the file cannot be read, or the checksum is wrong.
    """
    try:
        with path.open("rb") as file:
            file.seek(record.offset)
            payload = file.read(record.length)
            trailer = file.read(4)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    if len(trailer) < 4 or masked_crc32c(payload) != int.from_bytes(trailer, "little"):
        raise LogError(
            f"{path}: the record at byte {record.offset} is broken (its checksum is wrong)"
        )
    return payload


def write_records(path: Path, payloads: list[bytes]) -> None:
    """Write a TFRecord file."""
    with path.open("wb") as file:
        for payload in payloads:
            length = struct.pack("<Q", len(payload))
            file.write(length + struct.pack("<I", masked_crc32c(length)))
            file.write(payload + struct.pack("<I", masked_crc32c(payload)))


def masked_crc32c(data: bytes) -> int:
    """The checksum that TFRecord stores: CRC-32C, turned right by 15 bits, plus a constant."""
    import google_crc32c  # noqa: F401


class Message:
    """The fields of one protocol-buffer message, by number; values are decoded when asked for."""
