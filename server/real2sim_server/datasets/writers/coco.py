"""COCO: detection, instances and panoptic.

Source: Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014; Kirillov et al.,
"Panoptic Segmentation", CVPR 2019, and the formats' pages. Boxes are those of the visible pixels,
masks run-length encoded column by column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import SEMANTIC_CLASSES, UNLABELED

from ...body.model import KEYPOINTS
from ...render import encode_image
from ..labels.views import without_blobs
from .categories import CATEGORIES, classes_of
from .writer import LabelledDrive, objects_of, write_json

STUFF_FROM = 200
"""Offset of background categories; the semantic class is added."""

INSTANCES_FROM = 1 << 16
"""Offset of the panoptic ids of objects; background pixels have the id of their category."""

QUALITY = 95
PERSON = {
    "id": 1,
    "name": "person",
    "supercategory": "person",
    "keypoints": list(KEYPOINTS),
    # Pairs of keypoints, counted from 1, as COCO draws them.
    "skeleton": [
        [16, 14], [14, 12], [17, 15], [15, 13], [12, 13], [6, 12], [7, 13], [6, 7], [6, 8], [7, 9],
        [8, 10], [9, 11], [2, 3], [1, 2], [1, 3], [2, 4], [3, 5], [4, 6], [5, 7],
    ],
}  # fmt: skip


class CocoWriter:
    """Writes images by split, ``annotations/instances_*.json`` and ``panoptic_*``."""

    name = "coco"
    holds = (
        "instances_<split>.json (boxes, RLE masks, tracks), panoptic_<split>.json with png and, "
        "where people are walking bodies, person_keypoints_<split>.json"
    )

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        splits: dict[str, _Split] = {}
        for clip in drive.clips:
            split = splits.setdefault(clip.split, _Split(clip.split))
            for camera in drive.cameras:
                for frame in clip.frames:
                    index = frame["index"]
                    stem = f"{clip.name}_{camera.name}_{index:06d}"
                    size = {"width": camera.width, "height": camera.height}
                    image_id = split.add_image(stem, size, frame, camera.name, clip.name)
                    rgb = clip.pixels("rgb", camera.name, index)
                    path = folder / clip.split / f"{stem}.jpg"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data)
                    instance = clip.pixels("instance", camera.name, index)
                    semantic = clip.pixels("semantic", camera.name, index)
                    split.add_objects(image_id, frame, camera.name, instance)
                    split.add_panoptic(
                        folder,
                        stem,
                        frame,
                        image_id=image_id,
                        instance=instance,
                        semantic=semantic,
                    )
        for split in splits.values():
            split.write(folder, drive)


class _Split:
    """Collected annotations of a split."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.images: list[dict[str, Any]] = []
        self.annotations: list[dict[str, Any]] = []
        self.keypoints: dict[int, list[tuple[float, float, int]]] = {}
        self.panoptic: list[dict[str, Any]] = []

    def add_image(
        self, stem: str, size: Mapping[str, int], frame: Mapping[str, Any], camera: str, clip: str
    ) -> int:
        self.images.append(
            {
                "id": len(self.images) + 1,
                "file_name": f"{stem}.jpg",
                **size,
                "frame_index": frame["index"],
                "t_us": frame["t_us"],
                "camera": camera,
                "clip": clip,
            }
        )
        return len(self.images)

    def add_objects(
        self,
        image_id: int,
        frame: Mapping[str, Any],
        camera: str,
        instance: NDArray[np.uint16],
    ) -> None:
        objects = objects_of(frame)
        for view in frame["views"][camera]:
            if view["box_2d_modal"] is None:
                continue
            if "keypoints_2d" in view:
                self.keypoints[len(self.annotations) + 1] = view["keypoints_2d"]
            left, top, right, bottom = view["box_2d_modal"]
            category = objects[view["object_id"]]["category"]
            mask = without_blobs(instance == view["instance_id"])
            self.annotations.append(
                {
                    "id": len(self.annotations) + 1,
                    "image_id": image_id,
                    "category_id": classes_of(category).coco[0],
                    "category": category,
                    "bbox": [left, top, right - left, bottom - top],
                    "area": int(mask.sum()),
                    "iscrowd": 0,
                    "segmentation": {"size": list(mask.shape), "counts": compressed_rle(mask)},
                    "track_id": view["instance_id"],
                    "visibility": view["visibility"],
                    "truncation": view["truncation"],
                    "bbox_amodal": _from_corners(view["box_2d_amodal"]),
                }
            )

    def add_panoptic(
        self,
        folder: Path,
        stem: str,
        frame: Mapping[str, Any],
        *,
        image_id: int,
        instance: NDArray[np.uint16],
        semantic: NDArray[np.uint8],
    ) -> None:
        ids = np.where(semantic == UNLABELED, 0, STUFF_FROM + semantic.astype(np.int64))
        category = {int(i): int(i) for i in np.unique(ids) if i}
        for subject in frame["objects"]:
            own = instance == subject["instance_id"]
            if own.any():
                segment = INSTANCES_FROM + subject["instance_id"]
                ids[own] = segment
                category[segment] = classes_of(subject["category"]).coco[0]
        segments = [
            _segment(ids == segment, segment, category[segment])
            for segment in np.unique(ids).tolist()
            if segment
        ]
        coded = np.stack([ids % 256, ids // 256 % 256, ids // 65536], axis=-1).astype(np.uint8)
        path = folder / "annotations" / f"panoptic_{self.name}" / f"{stem}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_image(coded, "rgb", "png").data)
        self.panoptic.append(
            {"image_id": image_id, "file_name": f"{stem}.png", "segments_info": segments}
        )

    def write(self, folder: Path, drive: LabelledDrive) -> None:
        info = {"description": drive.name, "version": "1.0"}
        licences = [{"id": 1, "name": drive.licence, "url": ""}]
        images = [{**image, "license": 1} for image in self.images]
        objects = [
            {"id": number, "name": name, "supercategory": "object"}
            for number, name in sorted({row.coco for row in CATEGORIES.values()})
        ]
        common = {"info": info, "licenses": licences, "images": images}
        write_json(
            folder / "annotations" / f"instances_{self.name}.json",
            {**common, "annotations": self.annotations, "categories": objects},
        )
        if self.keypoints:
            write_json(
                folder / "annotations" / f"person_keypoints_{self.name}.json",
                {**common, "annotations": self._people(), "categories": [PERSON]},
            )
        stuff = [
            {"id": STUFF_FROM + number, "name": name, "isthing": 0, "supercategory": "background"}
            for name, number in SEMANTIC_CLASSES.items()
            if number != UNLABELED
        ]
        write_json(
            folder / "annotations" / f"panoptic_{self.name}.json",
            {
                **common,
                "annotations": self.panoptic,
                "categories": [{**o, "isthing": 1} for o in objects] + stuff,
            },
        )

    def _people(self) -> list[dict[str, Any]]:
        """Annotations with keypoints, for people with known keypoints."""
        found = []
        for row in self.annotations:
            points = self.keypoints.get(row["id"])
            if points is not None:
                flat = [number for point in points for number in point]
                known = sum(flag > 0 for *_, flag in points)
                person = {"category_id": PERSON["id"], "keypoints": flat, "num_keypoints": known}
                found.append({**row, **person})
        return found


def _from_corners(box: Sequence[float]) -> list[float]:
    left, top, right, bottom = box
    return [left, top, right - left, bottom - top]


def _segment(mask: NDArray[np.bool_], segment: int, category: int) -> dict[str, Any]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    return {
        "id": segment,
        "category_id": category,
        "area": int(mask.sum()),
        "bbox": [left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top],
        "iscrowd": 0,
    }


def run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """Lengths of the runs of False and True in turn, False first, column by column."""
    flat = mask.ravel(order="F")
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.concatenate([[0], edges, [flat.size]])
    lengths: list[int] = np.diff(ends).tolist()
    return [0, *lengths] if flat[0] else lengths


def compressed_rle(mask: NDArray[np.bool_]) -> str:
    """Run lengths as a COCO string.

    From the fourth on, the difference to the length two positions before is stored. Each number is
    split into groups of five bits, lowest first, with bit 32 if more follow, plus 48."""
    counts = run_lengths(mask)
    text = []
    for k, count in enumerate(counts):
        value = count - counts[k - 2] if k > 2 else count
        more = True
        while more:
            group, value = value & 31, value >> 5
            more = value != (-1 if group & 16 else 0)
            text.append(chr((group | 32 if more else group) + 48))
    return "".join(text)
