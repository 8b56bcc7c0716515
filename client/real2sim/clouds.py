"""Point clouds of LiDARs and radars: encoded bytes, decoded to arrays on access."""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ._handles import Handle
from .errors import MalformedReplyError
from .images import matrix_from_wire, write_atomically

if TYPE_CHECKING:
    from real2sim_proto.drive import PointCloud as WireCloud

Columns = Mapping[str, NDArray[Any]]
MAX_CLOUD_BYTES = 256 * 1024 * 1024
"""Maximum size of an unpacked cloud."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointCloud(Handle):
    """Points of one sensor at one instant.

    Attributes:
        sensor: its name.
        modality: ``lidar`` or ``radar``.
        t_us: time of the cloud; for a LiDAR, the time of the last ray.
        duration_us: time from the first ray to the last; 0 for radars.
        frame: frame of ``points``: ``sensor`` or ``vehicle`` (x forward, y left, z up in both).
        compensated: True: points are as seen from the pose at ``t_us``; False: from the sensor's
            pose when each ray was fired.
        T_world_sensor: [4, 4] float64 at ``t_us``.
        T_vehicle_sensor: [4, 4] float64.
        count: number of points, N.

    Examples:
        >>> client = real2sim.connect()
        >>> with client.session(scene="street") as session:
        ...     cloud = session.reset(lidars=["vlp-16"]).lidar("vlp-16")
        >>> cloud.points.shape == (cloud.count, 3), cloud.modality
        (True, 'lidar')
    """

    _instead: ClassVar = {
        "colors": "cloud['intensity']",
        "data": "cloud.points, or cloud.columns",
        "nbr_points": "len(cloud)",
        "numpy": "cloud.points",
        "pose": "cloud.T_world_sensor",
        "shape": "cloud.points.shape",
        "timestamp": "cloud.t_us",
        "xyz": "cloud.points",
    }

    sensor: str
    modality: str
    t_us: int
    duration_us: int
    frame: str
    compensated: bool
    T_world_sensor: NDArray[np.float64] = field(repr=False)
    T_vehicle_sensor: NDArray[np.float64] = field(repr=False)
    count: int
    wire: WireCloud = field(repr=False)

    @cached_property
    def columns(self) -> Columns:
        """All columns by name, [N] or [N, width] each; decoded on first access, read-only.

        Raises:
            MalformedReplyError: broken data.

        Examples:
            >>> sorted(cloud.columns)
            ['instance', 'intensity', 'points', 'return_number', 'ring', 'time_us']
        """
        return _columns(self.wire)

    @property
    def points(self) -> NDArray[np.float32]:
        """[N, 3] float32 in ``frame`` [m]."""
        return self._column("points")

    @property
    def instance(self) -> NDArray[np.uint16]:
        """[N] uint16 id of the hit object; 0 is background."""
        return self._column("instance")

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """For NumPy: ``np.asarray(cloud)`` is :attr:`points`."""
        return np.array(self.points, dtype=dtype, copy=copy)

    def __getitem__(self, key: Any) -> NDArray[Any]:
        """A column by its name, such as ``intensity``; else rows of :attr:`points`."""
        return self._column(key) if isinstance(key, str) else self.points[key]

    def __len__(self) -> int:
        return self.count

    def in_world(self) -> NDArray[np.float64]:
        """Points [N, 3] float64 in the world frame, with motion compensation [m].

        Examples:
            >>> cloud.in_world().shape == (cloud.count, 3)
            True
        """
        pose = self.T_world_sensor
        if self.frame == "vehicle":
            pose = pose @ np.linalg.inv(self.T_vehicle_sensor)
        placed: NDArray[np.float64] = self.points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        return placed

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all columns atomically: ``.npz``, or ``.ply`` for viewers; returns the path.

        Raises:
            ValueError: another suffix.

        Examples:
            >>> cloud.save(folder / "sweep.ply").suffix
            '.ply'
        """
        target = Path(path)
        writers = {".npz": self._as_npz, ".ply": self._as_ply}
        if target.suffix.lower() not in writers:
            raise ValueError(f"a cloud cannot be written as {target.suffix!r}; use .npz or .ply")
        write_atomically(target, writers[target.suffix.lower()]())
        return target

    def _column(self, name: str) -> NDArray[Any]:
        try:
            return self.columns[name]
        except KeyError:
            there = ", ".join(self.columns)
            raise KeyError(f"cloud {self.sensor!r} has no {name}; it has {there}") from None

    def _as_npz(self) -> bytes:
        buffer = io.BytesIO()
        poses = {name: getattr(self, name) for name in ("T_world_sensor", "T_vehicle_sensor")}
        np.savez_compressed(buffer, allow_pickle=False, **self.columns, **poses)
        return buffer.getvalue()

    def _as_ply(self) -> bytes:
        kinds = {"f4": "float", "u1": "uchar", "u2": "ushort", "i4": "int"}
        names = {"points": ("x", "y", "z")}
        parts = [
            (name, column[:, k] if column.ndim > 1 else column)
            for field_name, column in self.columns.items()
            for k, name in enumerate(names.get(field_name, (field_name,)))
        ]
        table = np.zeros(self.count, [(name, part.dtype.str) for name, part in parts])
        for name, part in parts:
            table[name] = part
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {self.count}"]
        head += [f"property {kinds[part.dtype.str[1:]]} {name}" for name, part in parts]
        return "\n".join([*head, "end_header", ""]).encode("ascii") + table.tobytes()


class LidarCloud(PointCloud):
    """A sweep of a LiDAR: one point per return; rays without a return are absent."""

    @property
    def intensity(self) -> NDArray[np.float32]:
        """[N] float32 reflectivity, 0 to 1."""
        return self._column("intensity")

    @property
    def ring(self) -> NDArray[np.uint16]:
        """[N] uint16 row of a spinning sensor, in its model's order; 0 for other sensors."""
        return self._column("ring")

    @property
    def time_us(self) -> NDArray[np.int32]:
        """[N] int32 time at which each ray was fired, relative to ``t_us``; at most 0 [us]."""
        return self._column("time_us")

    @property
    def return_number(self) -> NDArray[np.uint8]:
        """[N] uint8, 1 is the nearest return of a ray."""
        return self._column("return_number")


class RadarCloud(PointCloud):
    """A scan of a radar: one point per detection, nearest first."""

    @property
    def range(self) -> NDArray[np.float32]:
        """[N] float32 distance [m]."""
        return self._column("range")

    @property
    def azimuth(self) -> NDArray[np.float32]:
        """[N] float32 angle from the sensor's x axis towards y [rad]."""
        return self._column("azimuth")

    @property
    def elevation(self) -> NDArray[np.float32]:
        """[N] float32 angle upwards [rad]."""
        return self._column("elevation")

    @property
    def velocity(self) -> NDArray[np.float32]:
        """[N] float32 radial velocity relative to the sensor; negative when approaching [m/s]."""
        return self._column("velocity")

    @property
    def rcs(self) -> NDArray[np.float32]:
        """[N] float32 radar cross section [dBsm]."""
        return self._column("rcs")

    @property
    def snr(self) -> NDArray[np.float32]:
        """[N] float32 power above the detection threshold [dB]."""
        return self._column("snr")

    @property
    def kind(self) -> NDArray[np.uint8]:
        """[N] uint8: 0 for a real target, 1 for clutter, 2 for a ghost."""
        return self._column("kind")


KINDS = {"lidar": LidarCloud, "radar": RadarCloud}


def cloud_from_wire(wire: WireCloud) -> PointCloud:
    """Parse the cloud in a message; an unknown modality gives a plain :class:`PointCloud`.

    Raises:
        MalformedReplyError: a matrix has the wrong shape.
    """
    kind = KINDS.get(wire.modality, PointCloud)
    return kind(
        sensor=wire.sensor,
        modality=wire.modality,
        t_us=wire.t_us,
        duration_us=wire.duration_us,
        frame=wire.frame,
        compensated=wire.compensated,
        T_world_sensor=matrix_from_wire(wire.T_world_sensor, (4, 4), "T_world_sensor"),
        T_vehicle_sensor=matrix_from_wire(wire.T_vehicle_sensor, (4, 4), "T_vehicle_sensor"),
        count=wire.count,
        wire=wire,
    )


def clouds_by_sensor(wires: Sequence[WireCloud]) -> dict[str, PointCloud]:
    """Clouds by sensor name."""
    return {wire.sensor: cloud_from_wire(wire) for wire in wires}


def _columns(wire: WireCloud) -> dict[str, NDArray[Any]]:
    sizes = [wire.count * f.width * np.dtype(f.dtype).itemsize for f in wire.fields]
    data = _unpacked(wire, sum(sizes))
    found, begin = {}, 0
    for form, size in zip(wire.fields, sizes, strict=True):
        part, begin = data[begin : begin + size], begin + size
        dtype = np.dtype(form.dtype).newbyteorder("<")
        if wire.codec == "deflate":
            planes = np.frombuffer(part, np.uint8).reshape(dtype.itemsize, -1)
            part = np.ascontiguousarray(planes.T).tobytes()
        column = np.frombuffer(part, dtype)
        found[form.name] = column.reshape(wire.count, form.width) if form.width > 1 else column
    return found


def _unpacked(wire: WireCloud, size: int) -> bytes:
    data = wire.data
    if size > MAX_CLOUD_BYTES:
        raise MalformedReplyError(f"a cloud of {size} bytes; at most {MAX_CLOUD_BYTES}")
    if wire.codec == "deflate":
        try:
            data = zlib.decompressobj().decompress(data, size + 1)
        except zlib.error as error:
            raise MalformedReplyError(f"cloud {wire.sensor!r} cannot be read: {error}") from error
    elif wire.codec != "raw":
        raise MalformedReplyError(f"a cloud of codec {wire.codec!r}; known are raw and deflate")
    if len(data) != size:
        raise MalformedReplyError(
            f"cloud {wire.sensor!r} has {len(data)} bytes where {size} were announced"
        )
    return data
