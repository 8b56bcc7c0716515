"""A few sheets of labels over pictures that every data set carries, to be looked at first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..render import encode_image
from ..scene import Camera
from .clips import Clip
from .writers.pictures import labels_sheet

MOST = 6
QUALITY = 85


def write_previews(clips: Sequence[Clip], cameras: Sequence[Camera], folder: Path) -> None:
    """Sheets of up to MOST frames, spread evenly over clips and cameras, as jpg in ``folder``."""
    frames = [(clip, frame) for clip in clips for frame in clip.frames]
    count = min(MOST, len(frames) * len(cameras))
    folder.mkdir(exist_ok=True)
    for number in range(count):
        clip, frame = frames[(2 * number + 1) * len(frames) // (2 * count)]
        camera = cameras[number % len(cameras)]
        data = encode_image(labels_sheet(clip, camera, frame), "rgb", "jpeg", quality=QUALITY).data
        (folder / f"{number}.jpg").write_bytes(data)
