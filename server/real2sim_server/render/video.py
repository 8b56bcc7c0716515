"""Video files: WebM with VP8, which every browser plays, and MP4 with MPEG-4 Part 2.

Both encoders come with OpenCV. VP8 takes 80 ns per pixel, often longer than rendering, so frames
are encoded on a separate thread, in order.
"""

from __future__ import annotations

import errno
import os
import secrets
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

FOURCC_BY_SUFFIX = {".webm": "VP80", ".mp4": "mp4v"}
MATROSKA_DOCTYPE = b"\x42\x82\x88matroska"
MATROSKA_SEGMENT = b"\x18\x53\x80\x67"
WEBM_DOCTYPE = b"\x42\x82\x88webm\0\0\0\0"
"""An EBML string may be padded by zeros (RFC 8794, 7.4)."""


WAITING_FRAMES = 16
"""Frames that may wait for the encoder; whoever adds another waits for the first of them."""


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
        """Stop and delete the file."""
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
        OSError: the file is incomplete; with the system's reason, or EIO if writes work again.
    """
    with file.open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        ends = _end_of_matroska if file.suffix == ".mkv" else _end_of_mp4
        if ends(opened) == size:
            return
    _raise_write_error(file)
    raise OSError(errno.EIO, "some of the video was not written", str(file))


def _raise_write_error(file: Path) -> None:
    """Raise the system's error for writes to a file, if they still fail."""
    with file.open("ab", buffering=0) as opened:
        opened.write(b"\0")
        os.fsync(opened.fileno())


def _end_of_matroska(opened: BinaryIO) -> int | None:
    """End of the segment that holds the video (RFC 9559, 5.1)."""
    header = opened.read(256)
    at = header.find(MATROSKA_SEGMENT)
    start = at + len(MATROSKA_SEGMENT) + 8
    # FFmpeg writes the length in eight bytes; the first of them, 1, marks that form.
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
    """Change the document type of a Matroska file that holds VP8 to WebM."""
    with file.open("r+b") as opened:
        header = opened.read(256)
        at = header.find(MATROSKA_DOCTYPE)
        if at < 0:
            raise VideoError(f"{file}: OpenCV wrote no Matroska header")
        opened.seek(at)
        opened.write(WEBM_DOCTYPE)
