"""What the demo leaves for people to look at: frames with captions, stills, a map of the drive."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

CAPTION_BACKGROUND = (32, 36, 44)
EGO_COLOR = "#1f6feb"
OBJECT_COLOR = "#8b949e"
EDITED_COLOR = "#d1495b"


def mosaic(images: Sequence[Image], caption: str) -> Image:
    """Images of one height side by side, over a line of text."""
    row = np.concatenate(images, axis=1)
    bar = np.full((24, row.shape[1], 3), CAPTION_BACKGROUND, dtype=np.uint8)
    cv2.putText(
        bar, caption, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA
    )
    return np.concatenate([row, bar], axis=0)


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
        color = EDITED_COLOR if edited else OBJECT_COLOR
        axes.fill(corners[:, 0], corners[:, 1], color=color, alpha=0.55 if edited else 0.35)
        if edited:
            x, y = corners.mean(axis=0)
            axes.annotate(name, (x, y + 1.6), color=color, fontsize=8, ha="center")
    axes.plot(logged[:, 0], logged[:, 1], color="black", lw=1, ls="--", label="recorded")
    axes.plot(driven[:, 0], driven[:, 1], color=EGO_COLOR, lw=2.5, alpha=0.8, label="driven")
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
