"""Average precision of boxes as COCO defines it, of one class.

Source: Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014, and its evaluation
page: detections of all images by falling score, each takes the free object that it overlaps most;
precision is made monotone and read at 101 recalls, and averaged over overlaps from 0.5 to 0.95.
Objects that do not count (small, hidden) take detections without counting either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Boxes = NDArray[np.float64]
"""[K, 4] left, top, right, bottom [px]."""

OVERLAPS = np.linspace(0.5, 0.95, 10)
RECALLS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, eq=False)
class TrueBoxes:
    """Objects of an image.

    Attributes:
        boxes: of all of them.
        counts: [K] bool, which are to be found.
    """

    boxes: Boxes
    counts: NDArray[np.bool_]


def average_precision(
    found: Sequence[tuple[Boxes, NDArray[np.float64]]], truth: Sequence[TrueBoxes]
) -> dict[str, float]:
    """``ap`` (overlaps of 0.5 to 0.95), ``ap50`` and ``ap75``, of 1.

    Args:
        found: boxes and scores by image, best first.
        truth: of the same images; at least one object counts.
    """
    total = sum(int(one.counts.sum()) for one in truth)
    scores = np.concatenate([score for _, score in found])
    order = np.argsort(-scores, kind="stable")
    values = []
    for overlap in OVERLAPS.tolist():
        matched = [
            _matched(boxes, one, overlap) for (boxes, _), one in zip(found, truth, strict=True)
        ]
        hit = np.concatenate([hits for hits, _ in matched])[order]
        ignored = np.concatenate([ignored for _, ignored in matched])[order]
        values.append(_precision(hit[~ignored], total))
    return {"ap": float(np.mean(values)), "ap50": values[0], "ap75": values[5]}


def _matched(
    boxes: Boxes, truth: TrueBoxes, overlap: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which boxes [K] find an object, and which are not counted."""
    hits, ignored = (np.zeros(len(boxes), np.bool_) for _ in range(2))
    shares = box_ious(boxes, truth.boxes)
    free = np.ones(len(truth.boxes), np.bool_)
    for k in range(len(boxes)):
        for counting in (True, False):
            able = free & (truth.counts == counting) & (shares[k] >= min(overlap, 1 - 1e-10))
            if able.any():
                taken = int(np.argmax(np.where(able, shares[k], -1)))
                free[taken] = False
                hits[k], ignored[k] = counting, not counting
                break
    return hits, ignored


def _precision(hit: NDArray[np.bool_], total: int) -> float:
    if not len(hit):
        return 0.0
    true = np.cumsum(hit)
    precision = true / np.arange(1, len(hit) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    place = np.searchsorted(true / total, RECALLS, side="left")
    return float(np.where(place < len(hit), precision[np.minimum(place, len(hit) - 1)], 0.0).mean())


def box_ious(one: Boxes, two: Boxes) -> Boxes:
    """Intersection over union [K, L] of boxes [K, 4] and [L, 4]."""
    low = np.maximum(one[:, None, :2], two[None, :, :2])
    high = np.minimum(one[:, None, 2:], two[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(2)
    areas = [np.clip(box[:, 2:] - box[:, :2], 0, None).prod(1) for box in (one, two)]
    union = areas[0][:, None] + areas[1][None] - shared
    return np.asarray(shared / np.maximum(union, 1e-12))
