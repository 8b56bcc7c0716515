"""What the demo leaves for people to look at: video, stills, a map of the drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

INK = (32, 36, 44)
EGO_COLOUR = "#1f6feb"
OBJECT_COLOUR = "#8b949e"
EDITED_COLOUR = "#d1495b"


class FrameSink(Protocol):
    """Takes frames of one size, in order."""

    def add(self, frame: Image) -> None:
        """Append an RGB frame uint8 [H, W, 3]."""
        ...


class _Writer:
    def __init__(self, path: Path, frames_per_second: float) -> None:
        self._path = path
        self._rate = frames_per_second
        self._writer: Any = None

    def add(self, frame: Image) -> None:
        if self._writer is None:
            height, width = frame.shape[:2]
            # VP8 in WebM plays in every browser, and the encoder comes with OpenCV.
            fourcc = cv2.VideoWriter.fourcc(*"VP80")
            self._writer = cv2.VideoWriter(str(self._path), fourcc, self._rate, (width, height))
            if not self._writer.isOpened():
                raise OSError(f"{self._path}: cannot write video; OpenCV lacks a VP8 encoder")
        self._writer.write(np.ascontiguousarray(frame[:, :, ::-1]))

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()


@contextmanager
def video(path: Path, *, frames_per_second: float) -> Iterator[FrameSink]:
    """A WebM file that is complete when the block ends.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = _Writer(path, frames_per_second)
    try:
        yield writer
    finally:
        writer.close()


def mosaic(images: Sequence[Image], caption: str) -> Image:
    """Images of one height side by side, over a line of text; even width and height."""
    row = np.concatenate(images, axis=1)
    bar = np.full((24, row.shape[1], 3), INK, dtype=np.uint8)
    cv2.putText(
        bar, caption, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA
    )
    picture = np.concatenate([row, bar], axis=0)
    return np.ascontiguousarray(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])


def write_png(path: Path, image: Image) -> None:
    """Write an RGB image uint8 [H, W, 3].

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image[:, :, ::-1])):
        raise OSError(f"{path}: cannot be written")


def draw_map(
    path: Path,
    *,
    logged: NDArray[np.float64],
    driven: NDArray[np.float64],
    boxes: Sequence[tuple[str, NDArray[np.float64], bool]],
) -> None:
    """A top-down plot of the drive.

    Args:
        path: PNG to write.
        logged: [L, 2] path of the recording vehicle, world [m].
        driven: [N, 2] path of the controlled vehicle, world [m].
        boxes: (id, footprint [4, 2] in the world [m], whether it was edited).
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(12, 4.2), dpi=120)
    for name, corners, edited in boxes:
        colour = EDITED_COLOUR if edited else OBJECT_COLOUR
        axes.fill(corners[:, 0], corners[:, 1], color=colour, alpha=0.55 if edited else 0.35)
        if edited:
            x, y = corners.mean(axis=0)
            axes.annotate(name, (x, y + 1.6), color=colour, fontsize=8, ha="center")
    axes.plot(logged[:, 0], logged[:, 1], color="black", lw=1, ls="--", label="recorded")
    axes.plot(driven[:, 0], driven[:, 1], color=EGO_COLOUR, lw=2.5, alpha=0.8, label="driven")
    axes.set_aspect("equal")
    margin = 15.0
    axes.set_xlim(driven[:, 0].min() - margin, driven[:, 0].max() + margin)
    axes.set_ylim(driven[:, 1].min() - margin, driven[:, 1].max() + margin)
    axes.set_xlabel("x, forward at the start [m]")
    axes.set_ylabel("y, left [m]")
    axes.set_title("the drive from above; edited objects in red")
    axes.legend(loc="upper left", frameon=False)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)
