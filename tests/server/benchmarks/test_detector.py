"""The detector bench: average precision, network, and ground truth of edited streets."""

from __future__ import annotations

import contextlib
import io

import numpy as np
import pytest
import torch

from real2sim_bench import detector
from real2sim_bench.detector_model import (
    STRIDE,
    TrainingImages,
    TrueBoxes,
    _targets,
    average_precision,
    detect,
    train_detector,
)
from real2sim_bench.detector_streets import EditedStreets, boxes_in


def scene_of_boxes(seed: int = 0, images: int = 6):
    """Objects, and detections of a mediocre detector."""
    rng = np.random.default_rng(seed)
    truth, found = [], []
    for _ in range(images):
        corner, size = rng.uniform(0, 150, (5, 2)), rng.uniform(10, 60, (5, 2))
        boxes = np.concatenate([corner, corner + size], axis=1)
        near = boxes[:4] + rng.uniform(-4, 4, (4, 4))
        false = np.concatenate([corner[:2] + 90, corner[:2] + 120], axis=1)
        scores = np.sort(rng.uniform(0, 1, 6))[::-1]
        order = rng.permutation(6)
        truth.append(TrueBoxes(boxes, rng.random(5) < 0.8))
        found.append((np.concatenate([near, false])[order], scores))
    return found, truth


def test_average_precision_matches_pycocotools():
    coco, evaluation = (pytest.importorskip(f"pycocotools.{name}") for name in ("coco", "cocoeval"))
    found, truth = scene_of_boxes()
    notes, results = [], []
    for image, (one, (boxes, scores)) in enumerate(zip(truth, found, strict=True), start=1):
        for box, counts in zip(one.boxes, one.counts, strict=True):
            size = box[2:] - box[:2]
            notes.append(
                {
                    "id": len(notes) + 1,
                    "image_id": image,
                    "category_id": 1,
                    "bbox": [*box[:2], *size],
                    "area": float(size.prod()),
                    "iscrowd": 0,
                    "ignore": int(not counts),
                }
            )
        for box, score in zip(boxes, scores, strict=True):
            bbox = [*box[:2], *(box[2:] - box[:2])]
            results.append({"image_id": image, "category_id": 1, "bbox": bbox, "score": score})
    with contextlib.redirect_stdout(io.StringIO()):
        data = coco.COCO()
        data.dataset = {
            "info": {},
            "images": [{"id": k + 1} for k in range(len(truth))],
            "categories": [{"id": 1, "name": "vehicle"}],
            "annotations": notes,
        }
        data.createIndex()
        judge = evaluation.COCOeval(data, data.loadRes(results), "bbox")
        # The published code discards a given "ignore" before using it.
        judge._prepare = _keep_ignored(judge, judge._prepare, {n["id"]: n["ignore"] for n in notes})
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    own = average_precision(found, truth)
    assert [own["ap"], own["ap50"], own["ap75"]] == pytest.approx(judge.stats[:3], abs=1e-9)
    assert 0.1 < own["ap"] < 0.9


def _keep_ignored(judge, prepare, ignore):
    def prepared():
        prepare()
        for notes in judge._gts.values():
            for note in notes:
                note["ignore"] = ignore[note["id"]]

    return prepared


def test_perfect_detections_have_an_average_precision_of_1():
    _, truth = scene_of_boxes()
    found = [(one.boxes, np.ones(len(one.boxes))) for one in truth]
    assert average_precision(found, truth) == {"ap": 1.0, "ap50": 1.0, "ap75": 1.0}


def test_the_smaller_of_two_overlapping_objects_is_the_target():
    boxes = np.array([[0.0, 0.0, 64.0, 64.0], [24.0, 24.0, 40.0, 40.0]])
    found, target = _targets(boxes, 8, 8)
    middle = 32 // STRIDE
    assert found[middle, middle]
    assert target[middle, middle].tolist() == [24, 24, 40, 40]


def pictures(count: int) -> TrainingImages:
    """Images with one bright square each, on noise."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 60, (count, 48, 64, 3), dtype=np.uint8)
    boxes = []
    for image in images:
        left, top = rng.integers(0, 40), rng.integers(0, 24)
        image[top : top + 20, left : left + 20] = 220
        boxes.append(np.array([[left, top, left + 20, top + 20]], np.float64))
    return TrainingImages(images, boxes)


@pytest.mark.slow
def test_a_detector_learns_to_find_squares():
    shown = pictures(24)
    truth = [TrueBoxes(boxes, np.ones(1, np.bool_)) for boxes in shown.boxes]
    model = train_detector(shown, epochs=20, seed=0)
    assert average_precision(detect(model, shown.images), truth)["ap50"] > 0.8


def test_the_same_seed_gives_the_same_weights():
    one, two = (train_detector(pictures(8), epochs=1, seed=3) for _ in range(2))
    weights = zip(one.state_dict().values(), two.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in weights)


def test_boxes_of_an_instance_image_enclose_its_objects():
    instance = np.zeros((80, 120), np.uint16)
    instance[20:40, 10:51], instance[60:66, 80:86] = 1, 2
    found = boxes_in(instance)
    assert found.boxes.tolist() == [[5, 10, 25.5, 20], [40, 30, 43, 33]]
    assert found.counts.tolist() == [True, False]


def test_edited_streets_are_the_same_for_the_same_seed(tiny_scene):
    one, two = (EditedStreets.of(tiny_scene, 2, 3).sweeps for _ in range(2))
    assert one == two
    assert one[0] != one[1]


@pytest.mark.slow
def test_a_detector_trained_on_exported_frames_is_nearly_as_good_as_on_ground_truth():
    options = detector.DetectorBenchOptions(frames=400, epochs=16, drives=2, period_us=200_000)
    figures = detector.run(options)
    assert figures["ratio of ap50"] >= 0.95
    assert figures["ratio of ap"] > 0.85
