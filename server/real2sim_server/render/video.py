"""Videos as files: WebM with VP8, which every browser plays, and MP4 with MPEG-4 Part 2.

Both encoders come with OpenCV. VP8 takes 80 ns a pixel, often longer than the picture took to
render; so frames are encoded on a thread of their own, in the order they came.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOURCC_BY_SUFFIX = {".webm": "VP80", ".mp4": "mp4v"}
MATROSKA_DOCTYPE = b"\x42\x82\x88matroska"
WEBM_DOCTYPE = b"\x42\x82\x88webm\0\0\0\0"
"""An EBML string may be padded by zeros (RFC 8794, 7.4)."""


WAITING_FRAMES = 16
"""Frames that may wait for the encoder; whoever adds another waits for the first of them."""


class VideoError(OSError):
    """A video that cannot be written."""


class VideoFile:
    """A video of frames of one size; the file is there, whole, once it is closed.

    Args:
        path: of the file, ``.webm`` or ``.mp4``.
        frames_per_second: its rate.

    Raises:
        VideoError: another suffix.
    """

    def __init__(self, path: Path, frames_per_second: float) -> None:
        if path.suffix not in FOURCC_BY_SUFFIX:
            raise VideoError(f"{path}: videos end in {' or '.join(FOURCC_BY_SUFFIX)}")
        self._path = path
        self._rate = frames_per_second
        # OpenCV knows no four-character code for VP8 in WebM and complains of each on standard
        # error. WebM is Matroska under another name, so that name is written afterwards.
        container = ".mkv" if path.suffix == ".webm" else path.suffix
        self._temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{container}")
        self._writer: Any = None
        self._encoder = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._waiting: deque[Future[None]] = deque()

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Append an RGB frame uint8 [H, W, 3]; odd sizes lose their last row or column.

        The frame may be changed afterwards; it is encoded later.

        Raises:
            VideoError: the file cannot be written, or OpenCV lacks the encoder.
        """
        height, width = (side // 2 * 2 for side in frame.shape[:2])
        if self._writer is None:
            self._writer = self._open(width, height)
        image = frame[:height, :width, ::-1].copy()
        self._waiting.append(self._encoder.submit(self._writer.write, image))
        while len(self._waiting) > WAITING_FRAMES:
            self._waiting.popleft().result()

    def close(self) -> None:
        """Finish the file; without a frame there is none. Raises what encoding a frame raised."""
        try:
            while self._waiting:
                self._waiting.popleft().result()
        except BaseException:
            self.discard()
            raise
        if not self._finish():
            return
        if self._path.suffix == ".webm":
            _name_webm(self._temporary)
        self._temporary.replace(self._path)

    def discard(self) -> None:
        """Leave no file."""
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
            raise VideoError(f"{self._path}: cannot be written, or OpenCV lacks its encoder")
        return writer

    def _finish(self) -> bool:
        """End the thread and the encoder; whether there is a file."""
        self._encoder.shutdown(wait=True)
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.release()
        return writer is not None


@contextmanager
def video_file(path: Path, *, frames_per_second: float) -> Iterator[VideoFile]:
    """A video that is there, whole, when the block ends, and is not where it fails.

    Raises:
        VideoError: the file cannot be written.
    """
    video = VideoFile(path, frames_per_second)
    try:
        yield video
    except BaseException:
        video.discard()
        raise
    video.close()


def _name_webm(file: Path) -> None:
    """Change the document type of a Matroska file that holds VP8 to WebM."""
    with file.open("r+b") as opened:
        header = opened.read(256)
        at = header.find(MATROSKA_DOCTYPE)
        if at < 0:
            raise VideoError(f"{file}: OpenCV wrote no Matroska header")
        opened.seek(at)
        opened.write(WEBM_DOCTYPE)
