"""What is in a data set, counted: boxes by class, distance and how much of them is seen."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from .clips import Clip

ZONE_M, ZONES = 20, 5
"""Distances from the ego are counted in zones of so many metres; the last has all beyond."""


def statistics_of(clips: Sequence[Clip]) -> dict[str, Any]:
    """Boxes by category, and by category and distance from the ego; those in images by category
    and visibility; objects and frames."""
    boxes: Counter[str] = Counter()
    distances: dict[str, Counter[int]] = {}
    seen: dict[str, Counter[int]] = {}
    objects: dict[str, set[tuple[str, str]]] = {}
    for clip in clips:
        for frame in clip.frames:
            categories = {o["object_id"]: o["category"] for o in frame["objects"]}
            for subject in frame["objects"]:
                category = subject["category"]
                boxes[category] += 1
                x, y = subject["T_ego_object"][0][3], subject["T_ego_object"][1][3]
                zone = min(int(math.hypot(x, y) / ZONE_M), ZONES - 1)
                distances.setdefault(category, Counter())[zone] += 1
                objects.setdefault(category, set()).add((clip.name, subject["object_id"]))
            for view in (v for views in frame["views"].values() for v in views):
                level = min(int(view["visibility"] * 5), 4)
                seen.setdefault(categories[view["object_id"]], Counter())[level] += 1
    return {
        "frames": sum(len(clip.frames) for clip in clips),
        "boxes": dict(sorted(boxes.items())),
        "tracks": {name: len(objects[name]) for name in sorted(objects)},
        "boxes_by_distance": _named(distances, _zone_name),
        "boxes_in_images_by_visibility": _named(seen, _level_name),
    }


def _named(counts: dict[str, Counter[int]], name: Any) -> dict[str, dict[str, int]]:
    return {
        category: {name(k): counts[category][k] for k in sorted(counts[category])}
        for category in sorted(counts)
    }


def _zone_name(zone: int) -> str:
    near = zone * ZONE_M
    return f"{near} m and more" if zone == ZONES - 1 else f"{near} to {near + ZONE_M} m"


def _level_name(level: int) -> str:
    return f"{level * 20} to {level * 20 + 20} %"
