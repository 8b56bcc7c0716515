"""Waymo Open Dataset (perception), edition 1: TFRecord files of ``Frame`` messages.

Source of field numbers: ``waymo_open_dataset/dataset.proto`` and ``label.proto``. Beware of
``Label.Box``: width is field 4 and length field 5.
"""

from __future__ import annotations

import struct
import threading
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LidarSweep, LogError
from ..images import check_encoded_image, decode_image
from .common import select_sequence
from .waymo_common import (
    MAX_TIME_S,
    TOP,
    Laser,
    RangeImage,
    SweepTiming,
    WaymoBox,
    WaymoCamera,
    WaymoFrame,
    WaymoImage,
    build_waymo_log,
    merge_range_images,
    sweep_timings,
    usable_frames,
    waymo_camera,
)

# --- TFRecord and protocol buffers ---------------------------------------------------------------

# Read without TensorFlow or protobuf. Sources: the TFRecord section of TensorFlow's guide, the
# encoding section of the protocol buffers guide, RFC 3720 appendix B.4 for CRC-32C.

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_HEADER = struct.Struct("<QI")
_CRC_MASK = 0xA282EAD8
_CRC_POLYNOMIAL = 0x82F63B78


@dataclass(frozen=True)
class Record:
    """Payload of one record: offset in the file and length [bytes]."""

    offset: int
    length: int


def list_records(path: Path, left_out: LeftOut) -> list[Record]:
    """All records of a TFRecord file; headers are read and checked, payloads are skipped.

    If a header is damaged, or the file is cut off, the rest of the file is left out.

    Raises:
        LogError: the file cannot be read, or has no whole record.
    """
    records: list[Record] = []
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            position = 0
            while position < size:
                try:
                    record = _record_at(path, file.read(_HEADER.size), position, size)
                except LogError as error:
                    if not records:
                        raise
                    left_out["ends of files"].append(f"{error}; the rest is not read")
                    break
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
        raise LogError(
            f"{where}: a header's checksum is wrong; the file is damaged, or not a TFRecord"
        )
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
    """The checksum of TFRecord: CRC-32C, rotated right by 15 bits, plus a constant."""
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
    """Compiled CRC-32C, on first use: a segment has a gigabyte to check, byte by byte."""
    from ..._numba import kernel

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
        """Split ``data`` into fields. Raises LogError naming ``where`` if it is not a message."""
        self.where = where
        self._fields: dict[int, list[int | bytes]] = defaultdict(list)
        try:
            for number, value in _split(data):
                self._fields[number].append(value)
        except (IndexError, ValueError) as error:
            raise LogError(f"{where}: is not a protocol-buffer message ({error})") from error

    def message(self, number: int, name: str) -> ProtoMessage:
        """The nested message of a field; an empty one if it is absent."""
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
        """Bytes of a field, empty if it is absent."""
        return (self.blobs(number) or [b""])[-1]

    def text(self, number: int) -> str:
        """Text of a field, empty if it is absent."""
        return self.blob(number).decode("utf-8", errors="replace")

    def integer(self, number: int) -> int:
        """Signed integer of a field, 0 if it is absent."""
        value = (self._fields.get(number) or [0])[-1]
        if not isinstance(value, int):
            raise LogError(f"{self.where}: field {number} should hold a whole number")
        return value - (1 << 64) if value >= 1 << 63 else value

    def number(self, number: int) -> float:
        """Double of a field, 0 if it is absent."""
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


SUFFIX = ".tfrecord"


class WaymoV1Reader:
    """Reads ``<segment>.tfrecord``."""

    name = "waymo_v1"
    expects = "<segment>.tfrecord (Waymo perception, edition 1)"

    def recognises(self, path: Path) -> bool:
        """Whether this is a TFRecord file, or a folder with at least one."""
        return bool(_segments(path))

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The file ``path``, or ``<sequence>.tfrecord`` in it; the only one by default.

        Images are undistorted when they are read, all lasers and both returns are merged. Every
        record is read once to check it and to list poses and boxes. Times: :mod:`.waymo_common`.

        Raises:
            LogError: see :class:`LogReader`.
        """
        files = _segments(path)
        name = select_sequence(path, sorted(files), sequence)
        file = files[name]
        left_out = LeftOut()
        first, read = None, []
        places: dict[int, Record] = {}
        for i, record in enumerate(list_records(file, left_out)):
            with left_out.damaged("frames"):
                message = ProtoMessage(read_record(file, record), f"{file} frame {i}")
                frame = _read_frame(message, left_out)
                read.append(frame)
                places.setdefault(frame.start_us, record)
                first = first or message.message(1, "context")
        frames = usable_frames(read, left_out, str(file))
        assert first is not None
        cameras = _by_number(
            _read_camera, first.messages(2, "camera_calibrations"), left_out, "cameras"
        )
        lasers = _by_number(
            _read_laser, first.messages(3, "laser_calibrations"), left_out, "LiDARs"
        )
        source = _WaymoV1Source(
            file,
            [places[f.start_us] for f in frames],
            {c.name: c for c in cameras},
            lasers,
            frames,
            sweep_timings(frames),
        )
        return build_waymo_log(
            name=f"waymo_{first.text(1) or name}",
            cameras=cameras,
            frames=frames,
            source=source,
            where=str(file),
            provenance={
                "dataset": "Waymo Open Dataset v1",
                "sequence": first.text(1) or name,
                "reader": self.name,
            },
            left_out=left_out,
        )


def _segments(path: Path) -> dict[str, Path]:
    """TFRecord files by name of their segment: ``path`` itself, or those in it."""
    files = path.glob(f"*{SUFFIX}") if path.is_dir() else [path]
    return {p.stem: p for p in files if p.suffix == SUFFIX and p.is_file()}


Calibrated = TypeVar("Calibrated", WaymoCamera, Laser)


def _by_number(
    read: Callable[[ProtoMessage], Calibrated],
    messages: list[ProtoMessage],
    left_out: LeftOut,
    kind: str,
) -> list[Calibrated]:
    """The calibrations that can be read, in order of their sensors' numbers."""
    found: dict[int, Calibrated] = {}
    for message in messages:
        with left_out.damaged(kind):
            sensor = read(message)
            if sensor.number in found:
                raise LogError(f"{message.where}: sensor {sensor.number} is there twice")
            found[sensor.number] = sensor
    return [found[number] for number in sorted(found)]


def _read_camera(message: ProtoMessage) -> WaymoCamera:
    return waymo_camera(
        message.integer(1),
        size=(message.integer(4), message.integer(5)),
        intrinsic=message.doubles(2).tolist(),
        extrinsic=_transform(message, 3, "extrinsic"),
        shutter=message.integer(6),
        where=message.where,
    )


def _read_laser(message: ProtoMessage) -> Laser:
    beams = message.doubles(2)
    return Laser(
        number=message.integer(1),
        inclinations=beams if len(beams) else None,
        limits=(message.number(3), message.number(4)),
        T_vehicle_laser=_transform(message, 5, "extrinsic"),
    )


def _transform(message: ProtoMessage, number: int, name: str) -> Float:
    values = message.message(number, name).doubles(1)
    if len(values) != 16:
        raise LogError(f"{message.where}: {name} must hold 16 numbers, not {len(values)}")
    return values.reshape(4, 4)


def _read_frame(message: ProtoMessage, left_out: LeftOut) -> WaymoFrame:
    images: dict[int, WaymoImage] = {}
    for image in message.messages(4, "image"):
        with left_out.damaged("records"):
            number, seconds = image.integer(1), image.number(5)
            if number in images or not abs(seconds) < MAX_TIME_S:
                raise LogError(f"{image.where}: image {number} is there twice, or has no time")
            readout = image.number(8) - image.number(7) - image.number(6)
            pose = _transform(image, 3, "pose")
            images[number] = WaymoImage(round(seconds * 1e6), pose, readout * 1e6)
    boxes, has_top = [], False
    for label in message.messages(6, "laser_label"):
        with left_out.damaged("boxes"):
            boxes.append(_read_box(label))
    for laser in message.messages(5, "laser"):
        with left_out.damaged("records"):
            returns = any(laser.message(i, "return").blob(2) for i in (2, 3))
            has_top |= returns and laser.integer(1) == TOP
    return WaymoFrame(
        start_us=message.integer(2),
        pose=_transform(message, 3, "pose"),
        images=images,
        boxes=boxes,
        has_sweep=has_top,
    )


def _read_box(message: ProtoMessage) -> WaymoBox:
    box = message.message(1, "box")
    x, y, z, width, length, height, heading = (box.number(i) for i in range(1, 8))
    key = message.text(4)
    return WaymoBox(
        key=key,
        type=message.integer(3),
        centre=(x, y, z),
        size=(length, width, height),
        heading=heading,
        where=f"{message.where} {key!r}",
    )


@dataclass(frozen=True, eq=False)
class _WaymoV1Source:
    file: Path
    records: Sequence[Record]
    cameras: dict[str, WaymoCamera]
    lasers: Sequence[Laser]
    frames: Sequence[WaymoFrame]
    timings: Sequence[SweepTiming]
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _latest: dict[int, ProtoMessage] = field(default_factory=dict)

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        data, where = self._encoded(camera, frame)
        lens = self.cameras[camera].lens
        return lens.undistort(decode_image(data, where, (lens.width, lens.height)))

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is truncated or has a wrong size."""
        data, where = self._encoded(camera, frame)
        lens = self.cameras[camera].lens
        check_encoded_image(data, where, (lens.width, lens.height))

    def check_sweep(self, frame: int) -> None:
        """Nothing to check: sweeps have no header of their own."""

    def lidar(self, frame: int) -> LidarSweep:
        images = _range_images(self._message(frame), self.lasers)
        return merge_range_images(images, self.frames[frame].pose, self.timings[frame])

    def _encoded(self, camera: str, frame: int) -> tuple[bytes, str]:
        number = self.cameras[camera].number
        for image in self._message(frame).messages(4, "image"):
            if image.integer(1) == number:
                return image.blob(2), f"{image.where} of camera {camera!r}"
        raise LogError(f"{self.file} frame {frame}: has no image of camera {camera!r}")

    def _message(self, frame: int) -> ProtoMessage:
        """The frame's message; the latest is cached, because all cameras of a frame are in one."""
        with self._lock:
            if frame not in self._latest:
                payload = read_record(self.file, self.records[frame])
                self._latest.clear()
                self._latest[frame] = ProtoMessage(payload, f"{self.file} frame {frame}")
            return self._latest[frame]


def _range_images(frame: ProtoMessage, lasers: Sequence[Laser]) -> list[RangeImage]:
    by_number = {laser.number: laser for laser in lasers}
    images = []
    for message in frame.messages(5, "laser"):
        number, poses = message.integer(1), None
        for i in (2, 3):
            part = message.message(i, f"return {i - 1}")
            if not part.blob(2) or number not in by_number:
                continue
            values = _matrix(part, 2, channels=2)
            if number == TOP and part.blob(4):
                poses = _matrix(part, 4, channels=6)
            if poses is not None and poses.shape[:2] != values.shape[:2]:
                raise LogError(f"{part.where}: {values.shape[:2]} pixels, {poses.shape[:2]} poses")
            images.append(RangeImage(by_number[number], values, poses, part.where))
    return images


def _matrix(message: ProtoMessage, number: int, *, channels: int) -> NDArray[np.float32]:
    """[H, W, C >= channels] of a zlib-compressed ``MatrixFloat``."""
    try:
        matrix = ProtoMessage(zlib.decompress(message.blob(number)), message.where)
    except zlib.error as error:
        raise LogError(f"{message.where}: a compressed matrix is broken ({error})") from error
    shape, values = matrix.message(2, "shape").integers(1), matrix.floats(1)
    if len(shape) != 3 or shape[2] < channels or int(np.prod(shape)) != values.size:
        raise LogError(
            f"{message.where}: a matrix of {values.size} values has shape {shape}; expected "
            f"height x width x at least {channels}"
        )
    return values.reshape(shape)
