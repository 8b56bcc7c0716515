"""Waymo Open Dataset (perception), edition 1: TFRecord files of ``Frame`` messages.

Source of field numbers: ``waymo_open_dataset/dataset.proto`` and ``label.proto``. Beware of
``Label.Box``: width is field 4 and length field 5.
"""

from __future__ import annotations

import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....geometry.rotation import Float
from ...driving_log import DrivingLog, LidarSweep, LogError
from ...images import check_encoded_image, decode_image
from ..formats.wire_format import ProtoMessage, Record, list_records, read_record
from ..selection import select_sequence
from .lidar import TOP, Laser, RangeImage, SweepTiming, merge_range_images
from .segment import (
    WaymoBox,
    WaymoCamera,
    WaymoFrame,
    WaymoImage,
    build_waymo_log,
    sweep_timings,
    waymo_camera,
    with_sweeps,
)

SUFFIX = ".tfrecord"


class WaymoV1Reader:
    """Reads ``<segment>.tfrecord``."""

    name = "waymo_v1"
    expects = "<segment>.tfrecord (Waymo perception, edition 1)"

    def recognises(self, path: Path) -> bool:
        """Whether there is a TFRecord file."""
        return any(path.glob(f"*{SUFFIX}"))

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The file ``<sequence>.tfrecord``; the only one by default.

        Images are undistorted when they are read, all lasers and both returns are merged. Every
        record is read once to check it and to list poses and boxes. See :mod:`.waymo` for times.

        Raises:
            LogError: see :class:`LogReader`.
        """
        name = select_sequence(path, sorted(p.stem for p in path.glob(f"*{SUFFIX}")), sequence)
        file = path / f"{name}{SUFFIX}"
        records = list_records(file)
        read, first = [], None
        for i, record in enumerate(records):
            message = ProtoMessage(read_record(file, record), f"{file} frame {i}")
            read.append(_read_frame(message))
            first = first or message.message(1, "context")
        assert first is not None
        kept, left_out = with_sweeps(read)
        frames, records = [read[i] for i in kept], [records[i] for i in kept]
        cameras = [_read_camera(m) for m in first.messages(2, "camera_calibrations")]
        lasers = [_read_laser(m) for m in first.messages(3, "laser_calibrations")]
        source = _WaymoV1Source(
            file, records, {c.name: c for c in cameras}, lasers, frames, sweep_timings(frames)
        )
        return build_waymo_log(
            name=f"waymo_{first.text(1) or name}",
            cameras=sorted(cameras, key=lambda c: c.number),
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


def _read_frame(message: ProtoMessage) -> WaymoFrame:
    images = {}
    for image in message.messages(4, "image"):
        readout = image.number(8) - image.number(7) - image.number(6)
        pose = _transform(image, 3, "pose")
        images[image.integer(1)] = WaymoImage(round(image.number(5) * 1e6), pose, readout * 1e6)
    return WaymoFrame(
        start_us=message.integer(2),
        pose=_transform(message, 3, "pose"),
        images=images,
        boxes=[_read_box(m) for m in message.messages(6, "laser_label")],
        lasers=frozenset(
            laser.integer(1)
            for laser in message.messages(5, "laser")
            if any(laser.message(i, "return").blob(2) for i in (2, 3))
        ),
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
        """Raise LogError when the image is cut off or not of its camera's size."""
        data, where = self._encoded(camera, frame)
        lens = self.cameras[camera].lens
        check_encoded_image(data, where, (lens.width, lens.height))

    def check_sweep(self, frame: int) -> int:
        """Sweeps have no header of their own, so they are read."""
        return len(self.lidar(frame).points)

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
        """The frame's message; the latest is kept, since all cameras of a frame are in one."""
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
            if not part.blob(2):
                continue
            if number not in by_number:
                raise LogError(f"{message.where}: laser {number} has no calibration")
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
