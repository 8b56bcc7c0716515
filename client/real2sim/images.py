"""Images: encoded bytes, decoded to arrays on access."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ._handles import Handle
from .errors import ImageDecodeError, MalformedReplyError

if TYPE_CHECKING:
    from real2sim_proto.drive import Frame as WireFrame


# Previews for notebooks: every modality as a small JPEG.

FAR_PERCENTILE = 98.0
"""Percentile of valid pixels; larger depths and uncertainties are clipped to it."""
HUES = np.array([[37, 151, 211], [101, 67, 173], [23, 59, 131]])
"""Factors per channel that give neighbouring ids distinct colours."""


def preview_jpeg(array: NDArray[Any], modality: str) -> bytes:
    """Encode an image as jpeg, with false colours unless it is ``rgb``.

    Near surfaces and pixels with low uncertainty are bright. Each number of ``instance`` and
    ``semantic`` has a distinct colour; 0 is black.

    Args:
        array: pixels, see :class:`~.images.Image`.
        modality: modality of the image.
    """
    import simplejpeg

    picture = array if modality == "rgb" else _coloured(array)
    encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(picture), quality=90)
    return encoded


def _coloured(array: NDArray[Any]) -> NDArray[np.uint8]:
    if np.issubdtype(array.dtype, np.integer):
        numbers = array.astype(np.int64)[..., None]
        spread = 64 + (numbers * HUES[:, 0] + HUES[:, 1]) % 192
        return np.where(numbers == 0, 0, spread).astype(np.uint8)
    hit = array[array > 0]
    farthest = float(np.percentile(hit, FAR_PERCENTILE)) if hit.size else 1.0
    level = np.where(array > 0, 255.0 - 235.0 * np.minimum(array / farthest, 1.0), 0.0)
    return np.repeat(level.astype(np.uint8)[..., None], 3, axis=-1)


DEPTH_PNG_UNIT = 1 / 256
"""Metres of one level of depth sent as 16-bit png."""
UNCERTAINTY_PNG_UNIT = 1 / 65535
"""Step of uncertainty in a 16-bit png."""
PNG_UNITS = {
    "depth": DEPTH_PNG_UNIT,
    "median_depth": DEPTH_PNG_UNIT,
    "uncertainty": UNCERTAINTY_PNG_UNIT,
}
"""Units of 16-bit pngs of float32 images, by modality."""
AS_SENT = {"jpeg": (".jpg", ".jpeg"), "png": (".png",), "raw": ()}
"""Suffixes of files that hold the bytes of a codec."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Image(Handle):
    """One image.

    Attributes:
        data: encoded bytes; of codec ``raw`` the array in C order, little-endian.
        codec: ``raw``, ``jpeg`` or ``png``.
        modality: ``rgb`` (uint8 [H, W, 3]), ``depth`` or ``median_depth`` (float32 [H, W], metres
            along the camera z axis, 0 without a hit), ``instance`` (uint16 [H, W], 0 is
            background), ``semantic`` (uint8 [H, W], numbers of
            ``real2sim_proto.SEMANTIC_CLASSES``) or ``uncertainty`` (float32 [H, W], expected
            absolute error of the colour, 0 to 1).
        dtype: data type of the transmitted pixels; ``uint16`` depth is in steps of
            ``DEPTH_PNG_UNIT``, ``uint16`` uncertainty in steps of ``UNCERTAINTY_PNG_UNIT``.
        shape: shape of the array: [H, W, 3] or [H, W].

    Examples:
        >>> client = real2sim.connect()
        >>> image = client.scenes.render("street", camera="front")
        >>> np.asarray(image).shape, image.modality
        ((64, 96, 3), 'rgb')
    """

    _instead: ClassVar = {
        "camera": "frame.sensor",
        "extrinsics": "frame.T_world_sensor",
        "height": "image.array.shape[0]",
        "intrinsics": "frame.K",
        "mean": "image.array.mean()",
        "numpy": "image.array",
        "pose": "frame.T_world_sensor",
        "pixels": "image.array",
        "rgb": "image.array",
        "show": "image.save('front.jpg'); a notebook shows images automatically",
        "size": "image.array.shape",
        "time": "frame.t_us",
        "timestamp": "frame.t_us",
        "to_numpy": "image.array",
        "to_pil": "PIL.Image.fromarray(image.array)",
        "tobytes": "image.array.tobytes(), or image.data as the worker sent it",
        "width": "image.array.shape[1]",
    }

    data: bytes = field(repr=False)
    codec: str
    modality: str
    dtype: str
    shape: tuple[int, ...] = ()

    @cached_property
    def array(self) -> NDArray[Any]:
        """The image, decoded on first access; read-only if it is a view of ``data``.

        Raises:
            ImageDecodeError: broken data, or a png where neither Pillow nor OpenCV is installed.

        Examples:
            >>> image.array.dtype
            dtype('uint8')
        """
        array = _DECODERS[self.codec](self)
        if (self.shape and array.shape != self.shape) or array.dtype != np.dtype(self.dtype):
            raise ImageDecodeError(
                f"{self.codec} image holds {array.dtype} {array.shape} where "
                f"{self.dtype} {self.shape or ''} was announced"
            )
        if self.modality in PNG_UNITS and array.dtype == np.uint16:
            return array * np.float32(PNG_UNITS[self.modality])
        return array

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """For NumPy: ``np.asarray(image)`` is :attr:`array`."""
        return np.array(self.array, dtype=dtype, copy=copy)

    def __getitem__(self, key: Any) -> Any:
        """Pixels of :attr:`array` at an index."""
        return self.array[key]

    def __len__(self) -> int:
        return len(self.array)

    def _repr_jpeg_(self) -> bytes:
        """For notebooks: rgb as it is, depth in grey, numbers in false colours."""
        if self.codec == "jpeg":
            return self.data
        return preview_jpeg(self.array, self.modality)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the image atomically and return its path.

        The bytes are written unchanged if the suffix fits the codec (``.jpg``, ``.png``,
        ``.npy`` for raw); rgb can also be written as ``.jpg`` or ``.png``, and any image as
        ``.npy``.

        Raises:
            ValueError: the image cannot be written with this suffix; or ``.png`` encoding
                without Pillow or OpenCV installed.

        Examples:
            >>> image.save(folder / "front.jpg").suffix
            '.jpg'
        """
        target = Path(path)
        write_atomically(target, self._bytes_for(target.suffix.lower()))
        return target

    def _bytes_for(self, suffix: str) -> bytes:
        writers = self._writers()
        if suffix not in writers:
            raise ValueError(
                f"a {self.modality} image of codec {self.codec!r} cannot be written as "
                f"{suffix!r}; use {' or '.join(map(repr, sorted(writers)))}"
            )
        return writers[suffix]()

    def _writers(self) -> dict[str, Callable[[], bytes]]:
        """Encoders of the image by supported suffix."""
        writers: dict[str, Callable[[], bytes]] = {".npy": self._as_npy}
        if self.modality == "rgb":
            writers |= {".jpg": self._as_jpeg, ".jpeg": self._as_jpeg, ".png": self._as_png}
        return writers | dict.fromkeys(AS_SENT[self.codec], lambda: self.data)

    def _as_npy(self) -> bytes:
        buffer = io.BytesIO()
        np.save(buffer, self.array)
        return buffer.getvalue()

    def _as_jpeg(self) -> bytes:
        import simplejpeg

        encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(self.array), quality=92)
        return encoded

    def _as_png(self) -> bytes:
        if importlib.util.find_spec("PIL") is not None:
            buffer = io.BytesIO()
            importlib.import_module("PIL.Image").fromarray(self.array).save(buffer, format="PNG")
            return buffer.getvalue()
        if importlib.util.find_spec("cv2") is not None:
            cv2 = importlib.import_module("cv2")
            encoded: bytes = cv2.imencode(".png", self.array[..., ::-1])[1].tobytes()
            return encoded
        raise ValueError("to write '.png' install Pillow or OpenCV; '.jpg' needs neither")


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame(Image):
    """One image of one camera of an observation.

    Attributes:
        sensor: name of the camera.
        t_us: time of the image.
        T_world_sensor: [4, 4] float64, camera frame (x right, y down, z forward) to world.
        K: [3, 3] float64 intrinsics [px].

    Examples:
        >>> client = real2sim.connect()
        >>> session = client.session(scene="street").open()
        >>> frame = session.reset(sensors=["front"]).frames["front"]["rgb"]
        >>> frame.sensor, float(frame.K[0, 0]), frame.array.shape
        ('front', 60.0, (64, 96, 3))
        >>> result = session.close()
    """

    sensor: str
    t_us: int
    T_world_sensor: NDArray[np.float64] = field(repr=False)
    K: NDArray[np.float64] = field(repr=False)


class PlacedFrame(Frame):
    """A raw frame in shared memory; its bytes are copied on access."""

    @cached_property
    def data(self) -> bytes:
        """The array in C order, little-endian."""
        return self.array.tobytes()


def frame_from_wire(wire: WireFrame, pixels: memoryview | None = None) -> Frame:
    """Parse the frame in a message.

    Args:
        wire: the frame.
        pixels: bytes of a raw image in shared memory; their number matches the image's shape.

    Raises:
        MalformedReplyError: a matrix has the wrong shape, or an image in shared memory is not raw.
    """
    kind = Frame if pixels is None else PlacedFrame
    frame = kind(
        data=wire.data,
        codec=wire.codec,
        modality=wire.modality,
        dtype=wire.dtype,
        shape=tuple(wire.shape),
        sensor=wire.sensor,
        t_us=wire.t_us,
        T_world_sensor=matrix_from_wire(wire.T_world_sensor, (4, 4), "T_world_sensor"),
        K=matrix_from_wire(wire.K, (3, 3), "K"),
    )
    if pixels is not None:
        if wire.codec != "raw":
            raise MalformedReplyError(f"an image of codec {wire.codec!r} in shared memory")
        # Cached properties store their value in ``__dict__``.
        del frame.__dict__["data"]
        frame.__dict__["array"] = _raw_array(frame, pixels)
    return frame


def frames_by_camera(
    wires: Sequence[WireFrame], pixels: Sequence[memoryview | None] = ()
) -> dict[str, Mapping[str, Frame]]:
    """Frames by camera, then by modality; ``pixels`` of each as in :func:`frame_from_wire`."""
    frames: dict[str, dict[str, Frame]] = {}
    for wire, found in zip(wires, pixels or [None] * len(wires), strict=True):
        frames.setdefault(wire.sensor, {})[wire.modality] = frame_from_wire(wire, found)
    return dict(frames)


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically; creates its folder if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # tempfile would create a file that only its owner can read.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def matrix_from_wire(value: Any, shape: tuple[int, int], name: str) -> NDArray[np.float64]:
    """A matrix of a frame. Raises MalformedReplyError if it has another shape."""
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MalformedReplyError(f"{name} of a frame is not a matrix: {error}") from error
    if matrix.shape != shape:
        raise MalformedReplyError(f"{name} of a frame has shape {matrix.shape}, not {shape}")
    return matrix


def encoded_shape(data: bytes, codec: str) -> tuple[int, ...]:
    """Shape of the array in a jpeg or png; empty if the header is broken."""
    if codec == "png" and data[12:16] == b"IHDR" and len(data) > 25:
        width, height = (int.from_bytes(data[k : k + 4], "big") for k in (16, 20))
        return (height, width, 3) if data[25] == 2 else (height, width)
    if codec == "jpeg":
        import simplejpeg

        with contextlib.suppress(ValueError):
            height, width, *_ = simplejpeg.decode_jpeg_header(data)
            return (height, width, 3)
    return ()


def _decode_raw(image: Image) -> NDArray[Any]:
    return _raw_array(image, image.data)


def _raw_array(image: Image, data: bytes | memoryview) -> NDArray[Any]:
    """The array in ``data``. Raises ImageDecodeError if it does not fit the image."""
    dtype = np.dtype(image.dtype).newbyteorder("<")
    try:
        return np.frombuffer(data, dtype=dtype).reshape(image.shape)
    except ValueError as error:
        raise ImageDecodeError(
            f"raw image of {len(data)} bytes is not {image.dtype} {image.shape}"
        ) from error


def _decode_jpeg(image: Image) -> NDArray[Any]:
    import simplejpeg

    try:
        array: NDArray[Any] = simplejpeg.decode_jpeg(image.data, colorspace="RGB")
    except ValueError as error:
        raise ImageDecodeError(f"jpeg image cannot be decoded: {error}") from error
    return array


def _decode_png(image: Image) -> NDArray[Any]:
    try:
        if importlib.util.find_spec("PIL") is not None:
            return _decode_png_pillow(image.data)
        if importlib.util.find_spec("cv2") is not None:
            return _decode_png_opencv(image.data)
    except (OSError, ValueError, SyntaxError) as error:
        raise ImageDecodeError(f"png image cannot be decoded: {error}") from error
    raise ImageDecodeError(
        "png images need Pillow or OpenCV to become arrays",
        hint="pip install pillow, or ask for codec 'raw' or 'jpeg'; .data holds the png bytes",
    )


def _decode_png_pillow(data: bytes) -> NDArray[Any]:
    pil = importlib.import_module("PIL.Image")
    with pil.open(io.BytesIO(data), formats=["PNG"]) as picture:
        wide = picture.mode.startswith("I")
        array = np.asarray(picture)
    return array.astype(np.uint16) if wide else array


def _decode_png_opencv(data: bytes) -> NDArray[Any]:
    cv2 = importlib.import_module("cv2")
    array: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if array is None:
        raise ValueError("not a png")
    return array[..., ::-1] if array.ndim == 3 else array


_DECODERS = {"raw": _decode_raw, "jpeg": _decode_jpeg, "png": _decode_png}
