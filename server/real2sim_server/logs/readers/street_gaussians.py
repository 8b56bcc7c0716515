"""The preprocessed folder of Street Gaussians (Yan et al. 2024), made from Waymo segments.

Source: ``script/waymo`` and ``lib/utils/waymo_utils.py`` of the released program. Extrinsics are
already in OpenCV's axes, boxes and points in the vehicle frame. Images are stored with lens
distortion and undistorted when they are read.
"""

from __future__ import annotations

import math
import pickle
import re
import tempfile
import threading
import zipfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from ..._confined import ConfinedError, Limits, run_confined
from ...geometry import invert_transform
from ...scene.camera import T_VEHICLE_OPTICAL
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LidarSweep, LogError
from .files import ImageFiles, parse_numbers, read_json, read_lines, read_rigid
from .waymo_common import (
    CAMERA_NAMES,
    MAX_TIME_S,
    WaymoBox,
    WaymoCamera,
    WaymoFrame,
    WaymoImage,
    build_waymo_log,
    folder_cameras,
    folder_images,
    usable_frames,
)

# --- Pickled arrays ------------------------------------------------------------------------------

# Read a pickle without running its code.

MAX_ENTRY_BYTES = 4 << 30
"""Maximum size of an unpacked entry [bytes]; a drive of 200 frames has less than 1 GiB."""
MAX_ARRAYS = 100_000
MAX_DIMENSIONS = 8
SECONDS = 300.0

_NUMBERS = re.compile(r"[<>=|]?(b1|[iu][1248]|f[248])")


def read_pickled_arrays(path: Path, name: str) -> dict[Any, NDArray[Any]]:
    """The dictionary of arrays that ``numpy.savez`` stored under ``name`` as a pickled object.

    A pickle is a program, and Python's unpickler is not safe for untrusted files. It is read in a
    separate process that returns only plain ``.npy`` files of numbers.

    Raises:
        LogError: the file is missing or broken, lacks the entry, or its pickle is not a dictionary
            of numeric arrays.
    """
    try:
        size = path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error})") from error
    with tempfile.TemporaryDirectory(prefix="real2sim-") as folder:
        try:
            keys = run_confined(
                f"{__name__}:unpack_arrays",
                {"path": str(path.absolute()), "name": name, "folder": folder},
                limits=Limits(
                    memory_bytes=size + 2 * MAX_ENTRY_BYTES,
                    seconds=SECONDS,
                    written_bytes=MAX_ENTRY_BYTES,
                ),
                errors=(LogError,),
            )
            files = [Path(folder) / f"{number}.npy" for number in range(len(keys))]
            return {k: np.load(f, allow_pickle=False) for k, f in zip(keys, files, strict=True)}
        except LogError:
            raise
        except (ConfinedError, OSError, ValueError, TypeError) as error:
            raise LogError(f"{path}: entry {name!r} cannot be read: {error}") from error


def unpack_arrays(path: str, name: str, folder: str) -> list[int | str]:
    """Write the arrays of a pickled dictionary as ``0.npy``, ``1.npy``, ...; return their keys.

    Raises:
        LogError: as :func:`read_pickled_arrays`.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = _read_entry(archive, f"{name}.npy")
    except KeyError as error:
        raise LogError(f"{path}: has no entry {name!r}") from error
    except MemoryError:
        raise
    # Damaged files can raise almost any error.
    except Exception as error:
        raise LogError(
            f"{path}: entry {name!r} is not a pickled dictionary of arrays: {error}"
        ) from error
    for number, array in enumerate(arrays.values()):
        np.save(Path(folder) / f"{number}.npy", array, allow_pickle=False)
    return list(arrays)


def _read_entry(archive: zipfile.ZipFile, name: str) -> dict[int | str, NDArray[Any]]:
    size = archive.getinfo(name).file_size
    if size > MAX_ENTRY_BYTES:
        raise ValueError(f"it has {size} bytes; allowed are {MAX_ENTRY_BYTES}")
    with archive.open(name) as entry:
        value = _read_object(entry)
    if not isinstance(value, dict) or len(value) > MAX_ARRAYS:
        raise ValueError(f"it must be a dictionary of at most {MAX_ARRAYS} arrays")
    arrays = {_key(key): _numbers(array) for key, array in value.items()}
    if sum(array.nbytes for array in arrays.values()) > MAX_ENTRY_BYTES:
        raise ValueError(f"its arrays have more than {MAX_ENTRY_BYTES} bytes together")
    return arrays


def _read_object(entry: IO[bytes]) -> Any:
    version = np.lib.format.read_magic(entry)
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read_header(entry)
    if shape != () or dtype != np.dtype(object):
        raise ValueError(f"expected one object, found {dtype} of shape {shape}")
    value = _Unpickler(entry).load()
    if isinstance(value, _Array) and value.holds_object:
        return value.data[0]
    return value


# --- the pickle -------------------------------------------------------------------------------


class _Unpickler(pickle.Unpickler):
    """Reads the components of an array without building any object.

    A pickle can call functions of any module by name. Here the names of NumPy are mapped to the
    classes below, which only store their arguments. All other names are rejected, so the file
    cannot reach any class or function of NumPy.
    """

    def find_class(self, module: str, name: str) -> Any:
        found = _STUBS.get((module.replace("numpy._core", "numpy.core"), name))
        if found is None:
            raise pickle.UnpicklingError(f"it contains {module}.{name}, which is not an array")
        return found


class _Kept:
    """A value made by a pickle. It can only be changed by a state of the right form."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"{type(self).__name__[1:]} takes no state")


class _ArrayClass(_Kept):
    """``numpy.ndarray``: an argument of ``_reconstruct`` that cannot be called."""

    __slots__ = ()


class _Type(_Kept):
    """A ``numpy.dtype``: its text, with the byte order from its state."""

    __slots__ = ("text",)

    def __init__(self, text: Any) -> None:
        if not isinstance(text, str) or len(text) > 16:
            raise pickle.UnpicklingError("a type of values must be given as text")
        self.text = text

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("the state of a type of values is not understood")
        if any(part is not None for part in state[2:5]):
            raise pickle.UnpicklingError("records and arrays as values are not read")
        self.text = state[1] + self.text.lstrip("<>=|")

    def numbers(self) -> np.dtype[Any]:
        """The type, if it is one of plain numbers."""
        if not _NUMBERS.fullmatch(self.text):
            raise pickle.UnpicklingError(f"values of type {self.text!r} are not read")
        return np.dtype(self.text)


class _Array(_Kept):
    """An array: shape, type, order and bytes."""

    __slots__ = ("data", "order", "shape", "type")

    def __init__(self, shape: Any = (), kind: Any = None, data: Any = b"", order: str = "C"):
        self.shape, self.type, self.data, self.order = shape, kind, data, order

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("the state of an array is not understood")
        _, self.shape, self.type, is_fortran, self.data = state
        self.order = "F" if is_fortran else "C"

    @property
    def holds_object(self) -> bool:
        """Whether this is the one-object array in which ``numpy.savez`` wraps a dictionary."""
        is_object = isinstance(self.type, _Type) and self.type.text.strip("<>=|") in ("O", "O8")
        return is_object and self.shape == () and isinstance(self.data, list) and bool(self.data)


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    if not isinstance(kind, _ArrayClass):
        raise pickle.UnpicklingError("only arrays are made, no other class")
    return _Array()


def _scalar(kind: Any, data: Any = b"") -> _Array:
    return _Array((), kind, data)


def _from_buffer(data: Any, kind: Any, shape: Any, order: Any) -> _Array:
    return _Array(shape, kind, data, "F" if order == "F" else "C")


def _type_of(text: Any, align: Any = False, copy: Any = False) -> _Type:
    return _Type(text)


_STUBS: Final = {
    ("numpy", "ndarray"): _ArrayClass(),
    ("numpy", "dtype"): _type_of,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy.core.numeric", "_frombuffer"): _from_buffer,
}


# --- conversion -------------------------------------------------------------------------------


def _numbers(array: Any) -> NDArray[Any]:
    """The array that a pickle describes, after checking that type, shape and bytes agree."""
    if not isinstance(array, _Array) or not isinstance(array.type, _Type):
        raise ValueError(f"holds a {type(array).__name__}, where an array must be")
    dtype, shape, data = array.type.numbers(), array.shape, array.data
    if not isinstance(shape, tuple) or len(shape) > MAX_DIMENSIONS:
        raise ValueError("the shape of an array is not understood")
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"the shape {shape} of an array holds no lengths")
    if not isinstance(data, bytes | bytearray):
        raise ValueError("the values of an array are not bytes")
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"{len(data)} bytes do not fit {dtype} of shape {shape}")
    # A copy is writable and in native byte order.
    in_order = np.frombuffer(data, dtype)
    numbers = in_order.reshape(shape, order="F" if array.order == "F" else "C")
    return numbers.astype(dtype.newbyteorder("="))


def _key(key: Any) -> int | str:
    if isinstance(key, int | str) and not isinstance(key, bool):
        return key
    if isinstance(key, _Array) and key.shape == ():
        number = _numbers(key)
        if number.dtype.kind in "iu":
            return int(number)
    raise ValueError(f"the name of an array is a {type(key).__name__}, no number or text")


MAX_FRAMES = 1_000_000
TYPES = {"vehicle": 1, "pedestrian": 2, "sign": 3, "cyclist": 4, "misc": 0}
LASER = (1.43, 0.0, 2.184)
"""Position of Waymo's TOP laser on the vehicle [m]; it is not in the folder."""


class StreetGaussiansReader:
    """Reads ``images``, ``ego_pose``, ``extrinsics``, ``intrinsics``, ``track``."""

    name = "street_gaussians"
    expects = (
        "images/%06d_<camera>.png, ego_pose/%06d.txt, ego_pose/%06d_<camera>.txt, extrinsics/, "
        "intrinsics/, timestamps.json, track/track_info.txt, pointcloud.npz"
    )

    def recognises(self, path: Path) -> bool:
        """Whether there are ``ego_pose`` and ``timestamps.json``."""
        return (path / "ego_pose").is_dir() and (path / "timestamps.json").is_file()

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The drive in the folder ``path``; ``sequence`` is rejected: a folder contains one.

        Raises:
            LogError: see :class:`LogReader`.
        """
        if sequence is not None:
            raise LogError(f"{path}: holds one drive; it has no sequence {sequence!r}")
        times, left_out = _Times(path / "timestamps.json"), LeftOut()
        cameras = folder_cameras(path, invert_transform(T_VEHICLE_OPTICAL), left_out)
        boxes = _read_boxes(path / "track" / "track_info.txt", left_out)
        numbers = _frame_numbers(path / "ego_pose")
        frames: list[WaymoFrame] = []
        by_start: dict[int, int] = {}
        for number in numbers:
            with left_out.damaged("frames"):
                frame = _read_frame(path, number, times, cameras, left_out)
                frames.append(replace(frame, boxes=boxes.pop(number, ())))
                by_start.setdefault(frame.start_us, number)
        for number, lost in boxes.items():
            for box in lost:
                left_out["boxes"].append(f"{box.where}: there is no usable frame {number}")
        frames = usable_frames(frames, left_out, str(path))
        numbers = [by_start[frame.start_us] for frame in frames]
        files = {c.name: folder_images(path, c, numbers, 6) for c in cameras}
        images = ImageFiles(files, {c.name: c.lens for c in cameras})
        points = path / "pointcloud.npz"
        return build_waymo_log(
            name=f"street_gaussians_{path.resolve().name}",
            cameras=cameras,
            frames=frames,
            source=_StreetSource(images, numbers, points if points.exists() else None),
            where=str(path),
            provenance={
                "dataset": "Street Gaussians folder",
                "sequence": path.resolve().name,
                "reader": self.name,
            },
            left_out=left_out,
        )


def _frame_numbers(folder: Path) -> list[int]:
    numbers = [int(p.stem) for p in folder.glob("*.txt") if p.stem.isdecimal()]
    if not numbers or max(numbers) >= MAX_FRAMES:
        raise LogError(f"{folder}: holds no poses %06d.txt")
    return list(range(max(numbers) + 1))


class _Times:
    """``timestamps.json``: seconds by sensor and frame."""

    def __init__(self, path: Path) -> None:
        self._path, self._content = path, read_json(path)
        if not isinstance(self._content, dict) or "FRAME" not in self._content:
            raise LogError(f"{path}: expected an object with 'FRAME'")

    def time_us(self, sensor: str, frame: int) -> int | None:
        """Time stamp [us]; None if the file does not contain the sensor."""
        by_frame = self._content.get(sensor)
        if by_frame is None:
            return None
        value = by_frame.get(f"{frame:06d}") if isinstance(by_frame, dict) else None
        if not isinstance(value, int | float) or not abs(value) < MAX_TIME_S:
            raise LogError(f"{self._path}: {sensor!r} has no time of frame {frame:06d}")
        return round(value * 1e6)


def _read_frame(
    path: Path, frame: int, times: _Times, cameras: Sequence[WaymoCamera], left_out: LeftOut
) -> WaymoFrame:
    start_us = times.time_us("FRAME", frame)
    pose = read_rigid(path / "ego_pose" / f"{frame:06d}.txt")
    assert start_us is not None
    images = {}
    for camera in cameras:
        own, time_us = pose, start_us
        with left_out.damaged("times"):
            sensor = CAMERA_NAMES[camera.number].upper()
            time_us = times.time_us(sensor, frame) or start_us
        with left_out.damaged("poses"):
            file = path / "ego_pose" / f"{frame:06d}_{camera.number - 1}.txt"
            own = read_rigid(file) if file.exists() else pose
        images[camera.number] = WaymoImage(time_us, own, 0.0)
    return WaymoFrame(start_us, pose, images)


def _read_boxes(path: Path, left_out: LeftOut) -> dict[int, list[WaymoBox]]:
    boxes: dict[int, list[WaymoBox]] = defaultdict(list)
    if not path.exists():
        return boxes
    for number, line in enumerate(read_lines(path)[1:], start=2):
        words, where = line.split(), f"{path} line {number}"
        if not words:
            continue
        with left_out.damaged("boxes"):
            if len(words) < 12:
                raise LogError(
                    f"{where}: expected 12 columns (frame track class alpha height width length "
                    f"x y z heading speed), found {len(words)}"
                )
            if words[2] not in TYPES:
                raise LogError(f"{where}: unknown class {words[2]!r}; known are {list(TYPES)}")
            height, width, length, x, y, z, heading = parse_numbers(words[4:11], where).tolist()
            box = WaymoBox(
                words[1], TYPES[words[2]], (x, y, z), (length, width, height), heading, where
            )
            boxes[int(parse_numbers(words[:1], where)[0])].append(box)
    return boxes


@dataclass(frozen=True, eq=False)
class _StreetSource:
    images: ImageFiles
    numbers: Sequence[int]
    points: Path | None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _clouds: dict[str, Mapping[Any, NDArray[Any]]] = field(default_factory=dict)

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        return self.images.read(camera, frame)

    def check_image(self, camera: str, frame: int) -> None:
        """Raise LogError if the image is truncated or has a wrong size."""
        self.images.check(camera, frame)

    def check_sweep(self, frame: int) -> int:
        """Number of points of a frame; reads it, because the file has no header per frame."""
        return len(self.lidar(frame).points)

    def lidar(self, frame: int) -> LidarSweep:
        points = np.zeros((0, 3)) if self.points is None else self._cloud(self.numbers[frame])
        n = len(points)
        return LidarSweep(
            points=points.astype(np.float32),
            intensity=np.zeros(n, np.float32),
            offset_us=np.zeros(n, np.int32),
            origin=np.array(LASER, np.float32),
        )

    def _cloud(self, frame: int) -> NDArray[Any]:
        """All frames are in one file, which is read once."""
        assert self.points is not None
        with self._lock:
            if "pointcloud" not in self._clouds:
                self._clouds["pointcloud"] = read_pickled_arrays(self.points, "pointcloud")
            clouds = self._clouds["pointcloud"]
        points = clouds.get(frame, clouds.get(f"{frame:06d}"))
        if points is None or points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind != "f":
            raise LogError(f"{self.points}: has no points [N, 3] of frame {frame}")
        finite: NDArray[Any] = points[np.isfinite(points[:, :3]).all(axis=1), :3]
        return finite
