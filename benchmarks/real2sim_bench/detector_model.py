"""A small single-class detector: one stage, anchor-free, trained on a CPU in minutes.

After FCOS (Tian et al., ICCV 2019): every cell near the centre of an object predicts a score and
the distances to the four sides of its box. About 0.3 million weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

# Average precision as COCO defines it, for one class.
#
# Source: Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014, and its evaluation
# page. Detections, by descending score, match the unmatched object with the largest overlap.
# Precision is made monotone, sampled at 101 recalls, and averaged over overlaps from 0.5 to 0.95.
# Ignored objects (small, hidden) and their detections do not count.

Boxes = NDArray[np.float64]
"""[K, 4] left, top, right, bottom [px]."""

OVERLAPS = np.linspace(0.5, 0.95, 10)
RECALLS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, eq=False)
class TrueBoxes:
    """Objects of an image.

    Attributes:
        boxes: boxes of all objects.
        counts: [K] bool, whether each object must be detected.
    """

    boxes: Boxes
    counts: NDArray[np.bool_]


def average_precision(
    found: Sequence[tuple[Boxes, NDArray[np.float64]]], truth: Sequence[TrueBoxes]
) -> dict[str, float]:
    """``ap`` (overlaps of 0.5 to 0.95), ``ap50`` and ``ap75``, each 0 to 1.

    Args:
        found: boxes and scores by image, best first.
        truth: objects of the same images; at least one must count.
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
    """Masks [K] of boxes that match an object, and of boxes that are ignored."""
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


STRIDE = 8
"""Distance of cell centres in both directions [px]."""
NEAR_CENTRE = 1.5
"""Cells within this distance of an object's centre are positive [strides]."""
PRIOR = 0.01
"""Initial score of a cell."""
ALPHA, GAMMA = 0.25, 2.0
BATCH, RATE, DECAY = 16, 3e-3, 1e-4
OVERLAP, MIN_SCORE, MOST = 0.55, 0.02, 100
"""IoU threshold of non-maximum suppression, minimum score, and maximum number of boxes."""


@dataclass(frozen=True, eq=False)
class TrainingImages:
    """Images with boxes.

    Attributes:
        images: [N, H, W, 3] uint8.
        boxes: boxes of each image, [K, 4] left, top, right, bottom [px].
    """

    images: NDArray[np.uint8]
    boxes: Sequence[Boxes]


class Detector(nn.Module):
    """Images [N, 3, H, W] in [-1, 1] to logits [N, h, w] and sides [N, h, w, 4] in pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.shallow = nn.Sequential(
            _block(3, 16, 2), _block(16, 24, 2), _block(24, 48, 2), _block(48, 48, 1)
        )
        self.deep = nn.Sequential(_block(48, 64, 2), _block(64, 64, 2), _block(64, 64, 1))
        self.joined = nn.Sequential(_block(48 + 64, 64, 1), _block(64, 64, 1))
        self.score, self.sides = nn.Conv2d(64, 1, 1), nn.Conv2d(64, 4, 1)
        assert self.score.bias is not None
        nn.init.constant_(self.score.bias, -float(np.log((1 - PRIOR) / PRIOR)))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        near = self.shallow(images)
        far = functional.interpolate(self.deep(near), size=near.shape[-2:], mode="nearest")
        seen = self.joined(torch.cat([near, far], dim=1))
        sides = functional.softplus(self.sides(seen)) * STRIDE
        return self.score(seen)[:, 0], sides.permute(0, 2, 3, 1)


def _block(before: int, after: int, stride: int) -> nn.Module:
    conv = nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(after), nn.ReLU(inplace=True))


def train_detector(
    pictures: TrainingImages,
    *,
    epochs: int,
    seed: int,
    on_progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Detector:
    """Train with AdamW and a one-cycle learning rate.

    Images are randomly mirrored and changed in brightness. Weights are deterministic for images and
    seed.

    Args:
        pictures: training images; at least one must have an object.
        epochs: number of epochs.
        seed: seed of weights, order and augmentation.
        on_progress: callback with (epochs done, total).
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        torch.manual_seed(seed)
        model, rng = Detector(), np.random.default_rng(seed)
        count = len(pictures.images)
        steps = epochs * -(-count // BATCH)
        optimizer = torch.optim.AdamW(model.parameters(), lr=RATE, weight_decay=DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
        for epoch in range(epochs):
            for rows in np.array_split(rng.permutation(count), -(-count // BATCH)):
                loss = _loss(model, *_batch(pictures, rows.tolist(), rng))
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
            on_progress(epoch + 1, epochs)
    finally:
        torch.set_num_threads(threads)
    return model.eval()


def _batch(
    pictures: TrainingImages, rows: Sequence[int], rng: np.random.Generator
) -> tuple[Tensor, list[Boxes]]:
    images, boxes = [], []
    for row in rows:
        image, own = pictures.images[row], pictures.boxes[row]
        if rng.random() < 0.5:
            image, width = image[:, ::-1], image.shape[1]
            own = np.stack([width - own[:, 2], own[:, 1], width - own[:, 0], own[:, 3]], axis=1)
        gain, shift = rng.uniform(0.7, 1.3), rng.uniform(-0.15, 0.15)
        images.append(np.clip(_scaled(image) * gain + shift, -1, 1))
        boxes.append(own)
    return torch.from_numpy(np.stack(images)), boxes


def _scaled(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    turned: NDArray[np.float32] = (image.transpose(2, 0, 1) / np.float32(127.5) - 1).astype("f4")
    return turned


def _loss(model: Detector, images: Tensor, boxes: Sequence[Boxes]) -> Tensor:
    """Focal loss of scores, plus 1 - GIoU of the boxes of positive cells."""
    logits, sides = model(images)
    wanted = [_targets(own, logits.shape[1], logits.shape[2]) for own in boxes]
    target = torch.from_numpy(np.stack([found for _, found in wanted]))
    positive = target[..., 2] > target[..., 0]
    truth = positive.float()
    entropy = functional.binary_cross_entropy_with_logits(logits, truth, reduction="none")
    right = torch.exp(-entropy)
    weight = (ALPHA * truth + (1 - ALPHA) * (1 - truth)) * (1 - right) ** GAMMA
    count = positive.sum().clamp(min=1)
    place = _corners(sides)[positive]
    fit = 1 - _giou(place, target[positive])
    return (weight * entropy).sum() / count + fit.sum() / count


def _targets(
    boxes: Boxes, height: int, width: int
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Positive cells [h, w] and their boxes [h, w, 4]; the smallest object has precedence."""
    target = np.zeros((height, width, 4), np.float32)
    found = np.zeros((height, width), np.bool_)
    y, x = (np.mgrid[:height, :width] + 0.5) * STRIDE
    sizes = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    for left, top, right, bottom in boxes[np.argsort(-sizes, kind="stable")].tolist():
        reach = NEAR_CENTRE * STRIDE
        near = (abs(x - (left + right) / 2) < reach) & (abs(y - (top + bottom) / 2) < reach)
        inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        own = near & inside
        if not own.any():
            # Smaller than a cell: use the cell that contains its centre.
            column, row = int((left + right) / 2 / STRIDE), int((top + bottom) / 2 / STRIDE)
            own[min(row, height - 1), min(column, width - 1)] = True
        target[own], found[own] = (left, top, right, bottom), True
    return found, target


def _corners(sides: Tensor) -> Tensor:
    """Boxes [N, h, w, 4] from the distances of their sides to the cell centres."""
    height, width = sides.shape[1:3]
    y = ((torch.arange(height) + 0.5) * STRIDE)[:, None].expand(height, width)
    x = ((torch.arange(width) + 0.5) * STRIDE)[None].expand(height, width)
    left, top, right, bottom = sides.unbind(-1)
    return torch.stack([x - left, y - top, x + right, y + bottom], dim=-1)


def _giou(one: Tensor, two: Tensor) -> Tensor:
    """Generalised IoU [N] of boxes [N, 4] (Rezatofighi et al., CVPR 2019)."""
    shared = (torch.minimum(one[:, 2:], two[:, 2:]) - torch.maximum(one[:, :2], two[:, :2])).clamp(
        min=0
    )
    around = torch.maximum(one[:, 2:], two[:, 2:]) - torch.minimum(one[:, :2], two[:, :2])
    inner, hull = shared.prod(1), around.prod(1).clamp(min=1e-6)
    areas = [(box[:, 2:] - box[:, :2]).clamp(min=0).prod(1) for box in (one, two)]
    union = areas[0] + areas[1] - inner
    return inner / union.clamp(min=1e-6) - (hull - union) / hull


def detect(model: Detector, images: NDArray[np.uint8]) -> list[tuple[Boxes, NDArray[np.float64]]]:
    """Boxes [K, 4] and scores [K] of each image, best first."""
    found = []
    with torch.inference_mode():
        for first in range(0, len(images), BATCH):
            part = np.stack([_scaled(image) for image in images[first : first + BATCH]])
            logits, sides = model(torch.from_numpy(part))
            scores, corners = torch.sigmoid(logits).numpy(), _corners(sides).numpy()
            height, width = images.shape[1:3]
            found += [
                _kept(corner.reshape(-1, 4), score.ravel(), width, height)
                for corner, score in zip(corners, scores, strict=True)
            ]
    return found


def _kept(
    boxes: NDArray[np.float32], scores: NDArray[np.float32], width: int, height: int
) -> tuple[Boxes, NDArray[np.float64]]:
    limit = np.array([width, height, width, height], np.float64)
    order = [k for k in np.argsort(-scores, kind="stable").tolist() if scores[k] >= MIN_SCORE]
    whole = np.clip(boxes.astype(np.float64), 0, limit)
    kept: list[int] = []
    while order and len(kept) < MOST:
        best, *rest = order
        kept.append(best)
        over = box_ious(whole[[best]], whole[rest])[0] if rest else np.zeros(0)
        order = [k for k, share in zip(rest, over.tolist(), strict=True) if share <= OVERLAP]
    return whole[kept], scores[kept].astype(np.float64)
