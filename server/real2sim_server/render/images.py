"""Camera effects, quantization, encoding and videos of rendered images."""

from __future__ import annotations

import errno
import functools
import logging
import os
import secrets
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import torch
from numba import prange
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from real2sim_proto.sensors import CameraEffects, NoiseSpec

from .._files import atomic_file
from .._numba import PARALLEL_LOOPS, kernel
from .types import RenderError

# Effects work on linear light: sRGB values are linearised before and encoded afterwards. All
# functions are pure and thread-safe.

# JPEG by libjpeg-turbo, or by nvJPEG on the GPU that drew the image

JpegEncoder = Callable[[NDArray[np.uint8], int], bytes]
"""Encodes an image [H, W, 3] uint8, C order, at a quality of 1 to 100; thread-safe."""

CPU_ONLY: Final = -99999
"""Device id with which nvImageCodec uses the CPU (libjpeg-turbo)."""
PROOF_QUALITY = 95
PROOF_LEVELS = 12
"""Maximum channel error of the decoded sample image, in 8-bit levels."""

log = logging.getLogger(__name__)


def turbo_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode with libjpeg-turbo on this thread, 4:4:4."""
    import simplejpeg

    encoded: bytes = simplejpeg.encode_jpeg(image, quality, "RGB", "444")
    return encoded


class NvjpegEncoder:
    """JPEG encoder (4:4:4) with nvJPEG; falls back to libjpeg-turbo for images that it rejects.

    Each thread has its own encoder and CUDA stream, because nvImageCodec encoders are not
    thread-safe.

    Args:
        device: index of the GPU, or CPU_ONLY.

    Raises:
        ImportError: nvImageCodec is not installed.
    """

    def __init__(self, device: int) -> None:
        from nvidia import nvimgcodec

        self._codec: Any = nvimgcodec
        self._device = device
        self._own = threading.local()
        self._failed = False

    def __call__(self, image: NDArray[np.uint8], quality: int) -> bytes:
        """See JpegEncoder."""
        try:
            return self.encode(image, quality)
        except RenderError as error:
            if not self._failed:
                self._failed = True
                log.warning("jpegs are made by libjpeg-turbo where %s", error)
            return turbo_jpeg(image, quality)

    def encode(self, image: NDArray[np.uint8], quality: int) -> bytes:
        """Encode with nvJPEG only.

        Raises:
            RenderError: encoding failed.
        """
        codec = self._codec
        params = codec.EncodeParams(
            quality_type=codec.QualityType.QUALITY,
            quality_value=quality,
            chroma_subsampling=codec.ChromaSubsampling.CSS_444,
        )
        try:
            picture = codec.as_image(image)
            if self._device != CPU_ONLY:
                picture = picture.cuda()
            stream = self._encoder().encode(picture, "jpeg", params=params)
        except RuntimeError as error:
            raise RenderError(f"nvJPEG failed: {error}") from error
        if stream is None:
            raise RenderError(f"nvJPEG gave nothing for an image {list(image.shape)}")
        return bytes(stream)

    def _encoder(self) -> Any:
        own: Any = getattr(self._own, "encoder", None)
        if own is None:
            # One internal thread: images are already encoded on several threads.
            own = self._codec.Encoder(device_id=self._device, max_num_cpu_threads=1)
            self._own.encoder = own
        return own


def jpeg_encoder_for(device: torch.device) -> tuple[JpegEncoder, str]:
    """The JPEG encoder for images drawn on ``device``, and the reason for the choice.

    nvJPEG on a GPU if it is installed and reproduces a sample; otherwise libjpeg-turbo.
    """
    if device.type != "cuda":
        return turbo_jpeg, "libjpeg-turbo: images are drawn on the CPU"
    try:
        encoder = NvjpegEncoder(device.index or 0)
    except ImportError:
        return turbo_jpeg, (
            "libjpeg-turbo: nvImageCodec is not installed; pip install 'real2sim[server,cuda]'"
        )
    wrong = disproof(encoder)
    if wrong is not None:
        return turbo_jpeg, f"libjpeg-turbo: {wrong}"
    return encoder, "nvJPEG"


def disproof(encoder: NvjpegEncoder) -> str | None:
    """Error of the encoder on a sample image; None if its colours are correct."""
    import simplejpeg

    rows, columns = np.mgrid[0:48, 0:64].astype(np.uint8)
    sample = np.ascontiguousarray(np.dstack([4 * columns, 5 * rows, 255 - 2 * (rows + columns)]))
    try:
        decoded = simplejpeg.decode_jpeg(encoder.encode(sample, PROOF_QUALITY), "RGB")
    except (RenderError, ValueError) as error:
        return str(error)
    if decoded.shape != sample.shape:
        return f"nvJPEG gave a picture {list(decoded.shape)} for one {list(sample.shape)}"
    off = int(np.abs(decoded.astype(int) - sample).max())
    return None if off <= PROOF_LEVELS else f"nvJPEG is off by {off} of 255 levels"


RGB_CODECS = ("raw", "jpeg", "png")
EXACT_CODECS = ("raw", "png")
DEPTH_PNG_UNIT = 1 / 256
"""Metres of one level of a depth png, as in KITTI: 4 mm steps up to 255.99 m."""
UNCERTAINTY_PNG_UNIT = 1 / 65535
"""Step of one level of an uncertainty png."""
PNG_COMPRESSION = 1
"""zlib level. Higher levels are several times slower for little gain in size. Run-length encoding
with the Paeth filter for all rows takes 2/3 of the time and is smaller."""


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """Bytes of one image, with the metadata to decode them.

    Attributes:
        data: the bytes; for codec ``raw`` the array in C order, little-endian.
        codec: ``raw``, ``jpeg`` or ``png``.
        dtype: dtype of the decoded array: ``uint8``, ``uint16`` or ``float32``. Depth as ``uint16``
            is in steps of DEPTH_PNG_UNIT, uncertainty in steps of UNCERTAINTY_PNG_UNIT.
        shape: shape of the decoded array.
    """

    data: bytes
    codec: str
    dtype: str
    shape: tuple[int, ...]


def encode_rgb(
    image: NDArray[np.uint8], codec: str, *, quality: int = 90, jpeg: JpegEncoder = turbo_jpeg
) -> bytes:
    """Encode RGB [H, W, 3] uint8 as raw bytes, jpeg (4:4:4) or png.

    Raises:
        RenderError: unsupported codec, wrong dtype or shape, or a quality outside 1 to 100.
    """
    _check_codec("rgb", codec, RGB_CODECS)
    _check_array("rgb", image, np.uint8, 3)
    contiguous = np.ascontiguousarray(image)
    if codec == "raw":
        return contiguous.tobytes()
    if codec == "png":
        return _png(contiguous[..., ::-1])
    if not 1 <= quality <= 100:
        raise RenderError(f"quality must be 1 to 100, not {quality!r}")
    return jpeg(contiguous, quality)


def encode_depth(depth: NDArray[np.float32], codec: str, *, name: str = "depth") -> bytes:
    """Encode depth [H, W] float32 [m] as raw float32, or 16-bit png in steps of DEPTH_PNG_UNIT.

    In a png, a hit is at least 1 and values beyond the range have the largest level. ``name`` is
    used in error messages.
    """
    _check_codec(name, codec, EXACT_CODECS)
    _check_array(name, depth, np.float32, 2)
    if codec == "raw":
        return depth.astype("<f4", order="C", copy=False).tobytes()
    levels = np.clip(np.rint(depth / DEPTH_PNG_UNIT), 1, np.iinfo(np.uint16).max)
    return _png(np.where(depth > 0, levels, 0).astype(np.uint16))


def encode_uncertainty(image: NDArray[np.float32], codec: str) -> bytes:
    """Encode uncertainty [H, W] float32 in [0, 1] as raw float32 or 16-bit png.

    The png is in steps of UNCERTAINTY_PNG_UNIT.
    """
    _check_codec("uncertainty", codec, EXACT_CODECS)
    _check_array("uncertainty", image, np.float32, 2)
    if codec == "raw":
        return image.astype("<f4", order="C", copy=False).tobytes()
    return _png(np.rint(np.clip(image, 0, 1) / UNCERTAINTY_PNG_UNIT).astype(np.uint16))


def encode_instance(instance: NDArray[np.uint16], codec: str) -> bytes:
    """Encode instance ids [H, W] uint16 as raw uint16 or 16-bit png."""
    return encode_lossless(instance, codec, name="instance", dtype=np.dtype("<u2"))


def encode_lossless(image: NDArray[Any], codec: str, *, name: str, dtype: np.dtype[Any]) -> bytes:
    """Encode an image [H, W] of uint8 or uint16 as raw values, little-endian, or as png.

    Args:
        image: image of ``dtype``.
        codec: ``raw`` or ``png``.
        name: name of the modality, for error messages.
        dtype: pixel dtype.

    Raises:
        RenderError: unsupported codec, or wrong dtype or shape.
    """
    _check_codec(name, codec, EXACT_CODECS)
    _check_array(name, image, dtype, 2)
    if codec == "raw":
        return image.astype(dtype, order="C", copy=False).tobytes()
    return _png(image)


def _check_codec(name: str, codec: str, codecs: tuple[str, ...]) -> None:
    if codec not in codecs:
        raise RenderError(f"{name} cannot be encoded as {codec!r}; allowed are {list(codecs)}")


def _check_array(name: str, image: NDArray[Any], dtype: DTypeLike, ndim: int) -> None:
    fits = image.dtype == dtype and image.ndim == ndim and (ndim == 2 or image.shape[2] == 3)
    if not fits or image.size == 0:
        shape = "[H, W, 3]" if ndim == 3 else "[H, W]"
        raise RenderError(
            f"{name} must be {shape} {np.dtype(dtype)}, not {list(image.shape)} {image.dtype}"
        )


def _png(image: NDArray[Any]) -> bytes:
    import cv2

    runs = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    paeth = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH]
    options = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION, *runs, *paeth]
    done, encoded = cv2.imencode(".png", image, options)
    if not done:
        raise RenderError(f"png encoding failed for an image {list(image.shape)} {image.dtype}")
    return bytes(encoded)


# Quantization of blended floats, one pass each

SOLID_ALPHA = 0.5
"""Minimum alpha of a hit; pixels below it have no depth."""


PIECE = 1 << 21
"""Values converted per piece of work; takes a few milliseconds."""


def to_uint8(rgb: Tensor, *, between: Callable[[], object] | None = None) -> NDArray[np.uint8]:
    """RGB [..., H, W, 3] float32 as uint8: clamped to [0, 1], halves rounded up, NaN to 0.

    Images on a GPU are rounded there and copied as bytes.

    Args:
        rgb: any number of images.
        between: callback between pieces of work.
    """
    if rgb.device.type != "cpu":
        rounded = (rgb.nan_to_num(0.0).clamp(0, 1) * 255 + 0.5).byte()
        return _on_host(rounded)
    values = np.ascontiguousarray(rgb.detach().numpy())
    levels = np.empty(values.shape, np.uint8)
    given, result = values.reshape(-1), levels.reshape(-1)
    for piece in _pieces(len(given), between):
        _round_to_bytes(given[piece], result[piece])
    return levels


def solid_depth(
    depth: Tensor, alpha: Tensor, *, between: Callable[[], object] | None = None
) -> NDArray[np.float32]:
    """Depth [..., H, W] float32 [m], 0 where ``alpha`` is below SOLID_ALPHA.

    ``between``: callback between pieces of work.
    """
    if depth.device.type != "cpu":
        return _on_host(depth.where(alpha >= SOLID_ALPHA, 0.0))
    values = np.ascontiguousarray(depth.detach().numpy())
    kept = np.empty_like(values)
    cover = np.ascontiguousarray(alpha.detach().numpy())
    given, covers, result = values.reshape(-1), cover.reshape(-1), kept.reshape(-1)
    for piece in _pieces(len(given), between):
        _keep_solid(given[piece], covers[piece], result[piece])
    return kept


def _on_host(image: Tensor) -> NDArray[Any]:
    """Copy to the host through pinned memory, which is several times faster."""
    if image.device.type != "cuda":
        return image.cpu().numpy()
    held = torch.empty(image.shape, dtype=image.dtype, pin_memory=True)
    return held.copy_(image).numpy()


def _pieces(length: int, between: Callable[[], object] | None) -> Iterator[slice]:
    """One slice of everything, or one slice per call of ``between``."""
    if between is None:
        yield slice(None)
        return
    for first in range(0, length, PIECE):
        yield slice(first, first + PIECE)
        between()


@kernel(parallel=PARALLEL_LOOPS)
def _round_to_bytes(values: NDArray[np.float32], levels: NDArray[np.uint8]) -> None:
    for i in prange(values.shape[0]):
        value = values[i]
        clamped = value if value > np.float32(0) else np.float32(0)
        clamped = clamped if clamped < np.float32(1) else np.float32(1)
        levels[i] = np.uint8(np.int32(clamped * np.float32(255) + np.float32(0.5)))


@kernel(parallel=PARALLEL_LOOPS)
def _keep_solid(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], kept: NDArray[np.float32]
) -> None:
    for i in prange(depth.shape[0]):
        kept[i] = depth[i] if alpha[i] >= np.float32(SOLID_ALPHA) else np.float32(0)


# Files, written atomically


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image uint8 [H, W, 3] as PNG; creates missing folders.

    Raises:
        RenderError: wrong shape or dtype.
        OSError: the file cannot be written.
    """
    data = encode_rgb(image, "png")
    with atomic_file(path) as file:
        file.write(data)


__all__ = ["write_png"]


# Camera effects

Light = NDArray[np.float32]
STEPS = 1 << 14
"""Size of the table from linear light to display values."""


def with_effects(
    rgb: NDArray[np.uint8], effects: CameraEffects, camera: str, t_us: int
) -> NDArray[np.uint8]:
    """Apply camera effects to an image [H, W, 3]; motion blur is already rendered.

    Args:
        rgb: rendered image.
        effects: effects of the camera.
        camera: name of the camera; noise differs between cameras and instants.
        t_us: time [us].
    """
    light = to_light(rgb)
    if effects.vignetting is not None:
        light *= _falloff(rgb.shape[:2], effects.vignetting)[..., None]
    gains = np.array(effects.white_balance or (1.0, 1.0, 1.0)) * 2.0**effects.exposure_ev
    light *= gains.astype(np.float32)
    if effects.noise is not None:
        light += _noise(light, effects.noise, camera, t_us)
    image = to_display(light, None if effects.tone_curve is None else tuple(effects.tone_curve))
    if effects.jpeg_quality is not None:
        image = _through_jpeg(image, effects.jpeg_quality)
    return image


def to_light(rgb: NDArray[np.uint8]) -> Light:
    """Linear light, 1 for white."""
    return _light_of_levels()[rgb]


def to_display(light: Light, tone_curve: tuple[float, ...] | None = None) -> NDArray[np.uint8]:
    """Display values of linear light, clamped to black and white."""
    index = np.clip(light * (STEPS - 1) + 0.5, 0, STEPS - 1).astype(np.uint16)
    levels: NDArray[np.uint8] = _levels_of_light(tone_curve)[index]
    return levels


@functools.cache
def _light_of_levels() -> Light:
    value = np.arange(256) / 255
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


@functools.lru_cache(maxsize=64)
def _levels_of_light(tone_curve: tuple[float, ...] | None) -> NDArray[np.uint8]:
    light = np.arange(STEPS) / (STEPS - 1)
    value = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    if tone_curve is not None:
        value = np.interp(value, np.linspace(0, 1, len(tone_curve)), tone_curve)
    return (np.clip(value, 0, 1) * 255 + 0.5).astype(np.uint8)


@functools.lru_cache(maxsize=16)
def _falloff(size: tuple[int, int], numbers: tuple[float, float, float]) -> Light:
    height, width = size
    y, x = np.ogrid[:height, :width]
    r2 = (x + 0.5 - width / 2) ** 2 + (y + 0.5 - height / 2) ** 2
    r2 = r2 / ((width**2 + height**2) / 4)
    a, b, c = numbers
    return np.maximum(1 + r2 * (a + r2 * (b + r2 * c)), 0).astype(np.float32)


def _noise(light: Light, noise: NoiseSpec, camera: str, t_us: int) -> Light:
    """Add noise from a counter-based generator: independent of thread and earlier draws."""
    key = np.array([noise.seed, zlib.crc32(camera.encode())], np.uint64)
    counter = np.array([0, 0, 0, t_us & (2**64 - 1)], np.uint64)
    generator = np.random.Generator(np.random.Philox(key=key, counter=counter))
    sigma = np.sqrt(noise.photon * np.maximum(light, 0) + noise.read**2)
    return (sigma * generator.standard_normal(light.shape, np.float32)).astype(np.float32)


def _through_jpeg(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    import simplejpeg

    data = encode_rgb(np.ascontiguousarray(image), "jpeg", quality=quality)
    return np.asarray(simplejpeg.decode_jpeg(data, colorspace="RGB"))


# --- Videos ---------------------------------------------------------------------------------------

# WebM with VP8 plays in every browser; MP4 has MPEG-4 Part 2. Both encoders come with OpenCV. VP8
# takes 80 ns per pixel, often longer than rendering, so frames are encoded on a separate thread, in
# order.

FOURCC_BY_SUFFIX = {".webm": "VP80", ".mp4": "mp4v"}
MATROSKA_DOCTYPE = b"\x42\x82\x88matroska"
MATROSKA_SEGMENT = b"\x18\x53\x80\x67"
WEBM_DOCTYPE = b"\x42\x82\x88webm\0\0\0\0"
"""DocType element; an EBML string may be padded with zeros (RFC 8794, 7.4)."""


WAITING_FRAMES = 16
"""Maximum length of the encoder queue; adding a frame to a full queue blocks."""


class VideoError(OSError):
    """A video that cannot be written."""


class VideoFile:
    """A video of frames of one size; the file is complete once it is closed.

    Args:
        path: path of the file, ``.webm`` or ``.mp4``.
        frames_per_second: frame rate.

    Raises:
        VideoError: unsupported suffix.
    """

    def __init__(self, path: Path, frames_per_second: float) -> None:
        if path.suffix not in FOURCC_BY_SUFFIX:
            raise VideoError(f"{path}: videos end in {' or '.join(FOURCC_BY_SUFFIX)}")
        self._path = path
        self._rate = frames_per_second
        # OpenCV has no four-character code for VP8 in WebM and prints a warning for each one. WebM
        # is a form of Matroska, so the document type is changed afterwards.
        container = ".mkv" if path.suffix == ".webm" else path.suffix
        self._temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{container}")
        self._writer: Any = None
        self._encoder = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._waiting: deque[Future[None]] = deque()

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append an RGB frame uint8 [H, W, 3]; odd sizes lose their last row or column.

        The frame may be modified afterwards.

        Raises:
            VideoError: OpenCV cannot write the video.
            OSError: the system refuses the file.
        """
        height, width = (side // 2 * 2 for side in frame.shape[:2])
        if self._writer is None:
            self._writer = self._open(width, height)
        image = frame[:height, :width, ::-1].copy()
        self._waiting.append(self._encoder.submit(self._writer.write, image))
        while len(self._waiting) > WAITING_FRAMES:
            self._waiting.popleft().result()

    def close(self) -> None:
        """Finish the file; without frames, no file is created. Re-raises encoding errors.

        Raises:
            OSError: a write failed.
        """
        try:
            while self._waiting:
                self._waiting.popleft().result()
            if not self._finish():
                return
            _check_whole(self._temporary)
            if self._path.suffix == ".webm":
                _name_webm(self._temporary)
            self._temporary.replace(self._path)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Stop encoding and delete the file."""
        for frame in self._waiting:
            frame.cancel()
        self._finish()
        self._temporary.unlink(missing_ok=True)

    def _open(self, width: int, height: int) -> Any:
        import cv2

        self._path.parent.mkdir(parents=True, exist_ok=True)
        fourcc = cv2.VideoWriter.fourcc(*FOURCC_BY_SUFFIX[self._path.suffix])
        writer = cv2.VideoWriter(str(self._temporary), fourcc, self._rate, (width, height))
        if not writer.isOpened():
            _raise_write_error(self._temporary)
            raise VideoError(f"{self._path}: OpenCV cannot write it; it may lack the encoder")
        return writer

    def _finish(self) -> bool:
        """End the thread and the encoder; return whether there is a file."""
        self._encoder.shutdown(wait=True)
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.release()
        return writer is not None


@contextmanager
def video_file(path: Path, *, frames_per_second: float) -> Iterator[VideoFile]:
    """A video that is complete when the block ends, and deleted if the block fails.

    Raises:
        VideoError: OpenCV cannot write the video.
        OSError: the system refuses the file.
    """
    video = VideoFile(path, frames_per_second)
    try:
        yield video
    except BaseException:
        video.discard()
        raise
    video.close()


def _check_whole(file: Path) -> None:
    """Check that OpenCV wrote the whole file.

    OpenCV does not report failed writes. FFmpeg, its writer, stops at the first failure and writes
    the length of the contents last.

    Raises:
        OSError: the file is incomplete; has the system's reason, or EIO if writes work again.
    """
    with file.open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        ends = _end_of_matroska if file.suffix == ".mkv" else _end_of_mp4
        if ends(opened) == size:
            return
    _raise_write_error(file)
    raise OSError(errno.EIO, "some of the video was not written", str(file))


def _raise_write_error(file: Path) -> None:
    """Raise the system's error if writes to the file still fail."""
    with file.open("ab", buffering=0) as opened:
        opened.write(b"\0")
        os.fsync(opened.fileno())


def _end_of_matroska(opened: BinaryIO) -> int | None:
    """End of the segment with the video (RFC 9559, 5.1)."""
    header = opened.read(256)
    at = header.find(MATROSKA_SEGMENT)
    start = at + len(MATROSKA_SEGMENT) + 8
    # FFmpeg writes the length in eight bytes, marked by a first byte of 1.
    if at < 0 or len(header) < start or header[start - 8] != 1:
        return None
    return start + int.from_bytes(header[start - 7 : start], "big")


def _end_of_mp4(opened: BinaryIO) -> int | None:
    """End of the last box, if it is the index of the video (ISO/IEC 14496-12, 4.2)."""
    at, kind = 0, b""
    while len(header := opened.read(16)) >= 8:
        size, kind = int.from_bytes(header[:4], "big"), header[4:8]
        if size == 1:
            size = int.from_bytes(header[8:], "big")
        if size < 8:
            return None
        at = opened.seek(at + size)
    return at if kind == b"moov" else None


def _name_webm(file: Path) -> None:
    """Change the document type of a Matroska file with VP8 to WebM."""
    with file.open("r+b") as opened:
        header = opened.read(256)
        at = header.find(MATROSKA_DOCTYPE)
        if at < 0:
            raise VideoError(f"{file}: OpenCV wrote no Matroska header")
        opened.seek(at)
        opened.write(WEBM_DOCTYPE)
