"""WebDataset: tar shards that training loops stream, one sample a frame and camera.

Source: the format's description in the webdataset project: files of one sample share the name up
to the first dot and follow each other.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...render import encode_image
from ...scene import Camera
from ..clips import Clip
from .writer import LabelledDrive, objects_of

QUALITY = 95


class WebDatasetWriter:
    """Writes ``<split>-NNNNNN.tar``, a clip each."""

    name = "webdataset"
    holds = "tar shards: jpg, depth.png, instance.png, semantic.png, flow png and json a sample"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        numbers: dict[str, int] = {}
        for clip in drive.clips:
            number = numbers.get(clip.split, 0)
            numbers[clip.split] = number + 1
            path = folder / f"{clip.split}-{number:06d}.tar"
            with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as shard:
                for frame in clip.frames:
                    for camera in drive.cameras:
                        key = f"{clip.name}_{frame['index']:06d}_{camera.name}"
                        for suffix, data in _sample(clip, camera, frame):
                            _add(shard, f"{key}.{suffix}", data)


def _sample(clip: Clip, camera: Camera, frame: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    index = frame["index"]
    rgb = clip.pixels("rgb", camera.name, index)
    yield "jpg", encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data
    for kind in ("depth", "instance", "semantic", "flow_forward", "flow_backward"):
        path = clip.file(kind, camera.name, index)
        if path.exists():
            yield f"{kind}.png", path.read_bytes()
    objects = objects_of(frame)
    content: dict[str, Any] = {
        "clip": clip.name,
        "split": clip.split,
        "camera": camera.name,
        "t_us": frame["t_us"],
        "K": camera.K.tolist(),
        "T_vehicle_camera": camera.T_vehicle_camera.tolist(),
        "T_world_ego": frame["T_world_ego"],
        "ego_future": frame["ego_future"],
        "objects": [{**objects[view["object_id"]], **view} for view in frame["views"][camera.name]],
    }
    content |= {key: frame[key] for key in ("beside_path", "detections") if key in frame}
    yield "json", json.dumps(content).encode()


def _add(shard: tarfile.TarFile, name: str, data: bytes) -> None:
    """Without the day, the user or the rights of whoever writes."""
    member = tarfile.TarInfo(name)
    member.size, member.mtime, member.mode = len(data), 0, 0o644
    shard.addfile(member, io.BytesIO(data))
