"""TFRecord files and protocol-buffer messages, read without TensorFlow or protobuf.

Sources: the TFRecord section of TensorFlow's guide, the encoding section of the protocol buffers
guide, RFC 3720 appendix B.4 for CRC-32C.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...driving_log import LogError

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_HEADER = struct.Struct("<QI")
_CRC_MASK = 0xA282EAD8
_CRC_POLYNOMIAL = 0x82F63B78


@dataclass(frozen=True)
class Record:
    """Where the payload of one record lies: offset in the file and length [bytes]."""

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
        raise LogError(f"{where}: a header's checksum is wrong; this is no TFRecord, or broken")
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
            payload, trailer = file.read(record.length), file.read(4)
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    if len(trailer) < 4 or masked_crc32c(payload) != int.from_bytes(trailer, "little"):
        raise LogError(
            f"{path}: the record at byte {record.offset} is broken (its checksum is wrong)"
        )
    return payload


def masked_crc32c(data: bytes) -> int:
    """The checksum that TFRecord stores: CRC-32C, turned right by 15 bits, plus a constant."""
    crc = _crc_kernel()(np.frombuffer(data, dtype=np.uint8), _crc_table())
    return int(((crc >> 15 | crc << 17) + _CRC_MASK) & 0xFFFFFFFF)


@lru_cache(maxsize=1)
def _crc_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_CRC_POLYNOMIAL), table >> 1)
    return table


@lru_cache(maxsize=1)
def _crc_kernel() -> Any:
    """Compiled where it is used: a segment has a gigabyte to check, byte by byte."""
    from ...._numba import kernel

    @kernel
    def crc32c(data: Any, table: Any) -> int:
        crc = np.uint32(0xFFFFFFFF)
        for byte in data:
            crc = table[(crc ^ byte) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
        return int(crc ^ np.uint32(0xFFFFFFFF))

    return crc32c


class ProtoMessage:
    """The fields of one protocol-buffer message, by number; nested messages stay bytes."""

    def __init__(self, data: bytes, where: str) -> None:
        """Split ``data`` into fields. Raises LogError naming ``where`` when it is no message."""
        self.where = where
        self._fields: dict[int, list[int | bytes]] = defaultdict(list)
        try:
            for number, value in _split(data):
                self._fields[number].append(value)
        except (IndexError, ValueError) as error:
            raise LogError(f"{where}: is no protocol-buffer message ({error})") from error

    def message(self, number: int, name: str) -> ProtoMessage:
        """The nested message of a field; an empty one where it is absent."""
        found = self.messages(number, name)
        return found[-1] if found else ProtoMessage(b"", f"{self.where}: {name}")

    def messages(self, number: int, name: str) -> list[ProtoMessage]:
        """All nested messages of a repeated field."""
        return [ProtoMessage(value, f"{self.where}: {name}") for value in self.blobs(number)]

    def blobs(self, number: int) -> list[bytes]:
        """All values of a repeated field of bytes."""
        values = self._fields.get(number, [])
        if any(isinstance(v, int) for v in values):
            raise LogError(f"{self.where}: field {number} should hold bytes")
        return [v for v in values if isinstance(v, bytes)]

    def blob(self, number: int) -> bytes:
        """Bytes of a field, empty where it is absent."""
        return (self.blobs(number) or [b""])[-1]

    def text(self, number: int) -> str:
        """Text of a field, empty where it is absent."""
        return self.blob(number).decode("utf-8", errors="replace")

    def integer(self, number: int) -> int:
        """Signed integer of a field, 0 where it is absent."""
        value = (self._fields.get(number) or [0])[-1]
        if not isinstance(value, int):
            raise LogError(f"{self.where}: field {number} should hold a whole number")
        return value - (1 << 64) if value >= 1 << 63 else value

    def number(self, number: int) -> float:
        """Double of a field, 0 where it is absent."""
        values = self.doubles(number)
        return float(values[-1]) if len(values) else 0.0

    def doubles(self, number: int) -> NDArray[np.float64]:
        """All doubles of a repeated field, packed or not."""
        data = b"".join(self.blobs(number))
        if len(data) % 8:
            raise LogError(f"{self.where}: field {number} should hold doubles")
        return np.frombuffer(data, dtype="<f8").astype(np.float64)

    def floats(self, number: int) -> NDArray[np.float32]:
        """All floats of a repeated field, packed or not."""
        data = b"".join(self.blobs(number))
        if len(data) % 4:
            raise LogError(f"{self.where}: field {number} should hold floats")
        return np.frombuffer(data, dtype="<f4").astype(np.float32)

    def integers(self, number: int) -> list[int]:
        """All integers of a repeated field, packed or not."""
        found: list[int] = []
        for value in self._fields.get(number, []):
            if isinstance(value, int):
                found.append(value)
                continue
            position = 0
            try:
                while position < len(value):
                    item, position = _varint(value, position)
                    found.append(item)
            except (IndexError, ValueError) as error:
                raise LogError(f"{self.where}: field {number} is cut off ({error})") from error
        return found


def _split(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        kind = key & 7
        if kind == _VARINT:
            value, position = _varint(data, position)
            yield key >> 3, value
            continue
        if kind == _BYTES:
            length, position = _varint(data, position)
        elif kind in (_FIXED64, _FIXED32):
            length = 8 if kind == _FIXED64 else 4
        else:
            raise ValueError(f"wire type {kind} at byte {position}")
        if position + length > len(data):
            raise ValueError(f"field {key >> 3} is cut off")
        yield key >> 3, data[position : position + length]
        position += length


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            return value, position
        if shift > 63:
            raise ValueError(f"a number of more than 64 bits at byte {position}")
