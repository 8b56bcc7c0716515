"""Simple formats: raw labels, pictures with overlaid labels, WebDataset shards."""

from __future__ import annotations

import colorsys
import io
import json
import shutil
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import GROUND, SKY, STATIC, UNLABELED

from ...geometry import box_corners
from ...render import encode_image
from ...scene import Camera
from ..clips import Clip, read_flow
from ..labels.boxes import EDGES, NEAR
from .writer import LabelledDrive, objects_of, write_json

# --- Labels ---------------------------------------------------------------------------------------


class LabelsWriter:
    """Writes each clip as a folder: ``labels.json``, images and points."""

    name = "labels"
    holds = "all labels as JSON, images as png, points as npy; docs/datasets.md has the fields"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`."""
        for clip in drive.clips:
            shutil.copytree(clip.folder, folder / clip.name)
        cameras = [
            {
                "name": camera.name,
                "width": camera.width,
                "height": camera.height,
                "K": camera.K.tolist(),
                "T_vehicle_camera": camera.T_vehicle_camera.tolist(),
            }
            for camera in drive.cameras
        ]
        content = {
            "name": drive.name,
            "period_us": drive.period_us,
            "ego_size": list(drive.ego_size),
            "cameras": cameras,
            "clips": {clip.name: clip.split for clip in drive.clips},
        }
        write_json(folder / "dataset.json", content)


# --- Pictures -------------------------------------------------------------------------------------

EVERY = 5
"""Draw every Nth frame."""

PICTURE_QUALITY = 90
BACKGROUND = {
    UNLABELED: (0, 0, 0),
    STATIC: (110, 110, 110),
    GROUND: (128, 64, 128),
    SKY: (70, 130, 180),
}
MODAL, AMODAL = (255, 255, 255), (255, 210, 0)
FLOW_SHOWN = 40.0
"""Flow with full colour saturation [px]."""

Image = NDArray[np.uint8]


class PicturesWriter:
    """Writes a sheet of four pictures for every fifth frame of each camera."""

    name = "pictures"
    holds = "jpg sheets: boxes with visibility, instances, classes, flow; to be looked at"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        for clip in drive.clips:
            for camera in drive.cameras:
                for frame in clip.frames[::EVERY]:
                    sheet = labels_sheet(clip, camera, frame)
                    path = folder / clip.name / f"{camera.name}_{frame['index']:06d}.jpg"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    data = encode_image(sheet, "rgb", "jpeg", quality=PICTURE_QUALITY).data
                    path.write_bytes(data)


def labels_sheet(clip: Clip, camera: Camera, frame: Mapping[str, Any]) -> Image:
    """Boxes, instances, classes and flow of an image, RGB uint8 [2 H, 2 W, 3]."""
    index = frame["index"]
    rgb = clip.pixels("rgb", camera.name, index)
    instance = clip.pixels("instance", camera.name, index)
    semantic = clip.pixels("semantic", camera.name, index)
    upper = np.hstack([_with_boxes(rgb, camera, frame), _with_instances(rgb, instance)])
    lower = np.hstack([_classes(rgb, semantic), _flow(clip, camera, index, rgb)])
    return np.vstack([upper, lower])


def _with_boxes(rgb: Image, camera: Camera, frame: Mapping[str, Any]) -> Image:
    picture = rgb.copy()
    objects = objects_of(frame)
    for view in frame["views"][camera.name]:
        colour = _colour(view["instance_id"])
        if view["box_2d_modal"] is None:
            continue
        _draw_box_3d(picture, camera, view, objects[view["object_id"]]["size"], colour)
        _rectangle(picture, view["box_2d_amodal"], AMODAL)
        _rectangle(picture, view["box_2d_modal"], MODAL)
        left, top = (int(edge) for edge in view["box_2d_modal"][:2])
        text = f"{view['object_id']} {100 * view['visibility']:.0f}%"
        place = (left, max(top - 3, 8))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.33, (0, 0, 0), 2)
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.33, colour, 1)
    return picture


def _draw_box_3d(
    picture: Image,
    camera: Camera,
    view: Mapping[str, Any],
    size: tuple[float, float, float],
    colour: tuple[int, int, int],
) -> None:
    corners = box_corners(np.array(view["T_camera_object"]), size)
    for i, j in EDGES:
        ends = np.stack([corners[i], corners[j]])
        if (ends[:, 2] < NEAR).any():
            continue
        pixels = ends @ camera.K.T
        (x0, y0), (x1, y1) = np.clip(pixels[:, :2] / pixels[:, 2:], -1e4, 1e4).astype(int).tolist()
        cv2.line(picture, (x0, y0), (x1, y1), colour, 1, cv2.LINE_AA)


def _rectangle(picture: Image, box: list[float], colour: tuple[int, int, int]) -> None:
    left, top, right, bottom = (round(edge) for edge in box)
    cv2.rectangle(picture, (left, top), (right - 1, bottom - 1), colour, 1)


def _with_instances(rgb: Image, instance: NDArray[np.uint16]) -> Image:
    picture = rgb.copy()
    for number in np.unique(instance).tolist():
        if number:
            own = instance == number
            picture[own] = picture[own] // 3 + np.array(_colour(number)) * 2 // 3
    return picture


def _classes(rgb: Image, semantic: NDArray[np.uint8]) -> Image:
    colours = np.array([BACKGROUND.get(k, _colour(k)) for k in range(256)])
    mixed: Image = (rgb // 3 + colours[semantic] * 2 // 3).astype(np.uint8)
    return mixed


def _flow(clip: Clip, camera: Camera, index: int, rgb: Image) -> Image:
    """Direction as hue, length as colour; pixels occluded in the other image are dark."""
    if not clip.file("flow_forward", camera.name, index).exists():
        return rgb // 3
    flow, valid = read_flow(clip.pixels("flow_forward", camera.name, index))
    hidden = clip.pixels("occluded_forward", camera.name, index) > 0
    hue = (np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi) + 0.5) * 179
    length = np.clip(np.hypot(flow[..., 0], flow[..., 1]) / FLOW_SHOWN, 0, 1) * 255
    bright = np.where(valid, np.where(hidden, 90, 255), 0)
    coloured = cv2.cvtColor(
        np.stack([hue, length, bright], axis=-1).astype(np.uint8), cv2.COLOR_HSV2RGB
    )
    return np.asarray(coloured, dtype=np.uint8)


def _colour(number: int) -> tuple[int, int, int]:
    red, green, blue = colorsys.hsv_to_rgb(number * 0.61803 % 1.0, 0.75, 1.0)
    return int(red * 255), int(green * 255), int(blue * 255)


# --- WebDataset -----------------------------------------------------------------------------------

# Source: the webdataset project. Files of one sample share the name up to the first dot and are
# stored next to each other.

QUALITY = 95


class WebDatasetWriter:
    """Writes ``<split>-NNNNNN.tar``, one per clip."""

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
    """Add a file without date, user or permissions, so that archives are reproducible."""
    member = tarfile.TarInfo(name)
    member.size, member.mtime, member.mode = len(data), 0, 0o644
    shard.addfile(member, io.BytesIO(data))
