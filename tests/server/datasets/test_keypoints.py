"""Keypoints of people: in the world, in images, and in COCO format."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from real2sim_proto.operations import Insert
from real2sim_server.body.model import KEYPOINTS
from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.labels.views import HIDDEN, VISIBLE, keypoints_at
from real2sim_server.datasets.plan import ExportPlan
from real2sim_server.edit import ScenarioState, apply_operations
from real2sim_server.scene.asset import person_asset
from real2sim_server.service.library.assets import LibraryAsset

ANNA = person_asset("anna", "woman", height=1.7)
HALF = 2**-0.5
PLAN = ExportPlan(
    formats=("labels", "coco"), cameras=("front",), period_us=250_000, end_us=500_000, flow=False
)


@pytest.fixture(scope="module")
def drive(tiny_scene) -> ScenarioDrive:
    """A person crosses the street ahead, to the left."""
    times = [0, 500_000, 1_000_000]
    track = {
        "times_us": times,
        "positions": [[6.0, -0.7 + 1.4e-6 * t, ANNA.figure.middle] for t in times],
        "quaternions": [[HALF, 0.0, 0.0, HALF]] * 3,
    }
    state = ScenarioState.of(tiny_scene, assets={"anna": LibraryAsset(ANNA)}.get)
    insert = Insert.model_validate({"asset_id": "anna", "trajectory": track})
    return ScenarioDrive(tiny_scene, apply_operations(state, [insert]).state)


@pytest.fixture(scope="module")
def walked(drive, tmp_path_factory) -> Path:
    return export_dataset(drive, PLAN, tmp_path_factory.mktemp("people") / "out")


def frames(walked: Path) -> list[dict]:
    return json.loads((walked / "labels/0000/labels.json").read_text())["frames"]


def test_keypoints_follow_the_walking_body(drive):
    subject = next(o for o in drive.placed_at(250_000).objects if o.asset is not None)
    (points,) = keypoints_at(drive.scene, drive.placed_at(250_000), 250_000).values()
    own = ANNA.figure.keypoints(subject.trajectory, 250_000)
    # Facing +y of the world, which is x of the person; x of the world is to her right.
    expected = np.stack([6.0 - own[:, 1], -0.35 + own[:, 0], own[:, 2] + ANNA.figure.middle], -1)
    # An insert stands on the ground below it.
    np.testing.assert_allclose(points, expected, atol=1e-3)
    assert points[KEYPOINTS.index("nose"), 2] > 1.4
    assert points[KEYPOINTS.index("left_ankle"), 2] < 0.4


def test_only_people_have_keypoints(walked):
    for frame in frames(walked):
        for subject in frame["objects"]:
            assert ("keypoints" in subject) == (subject["category"] == "pedestrian")


def test_visible_keypoints_lie_on_the_persons_pixels(walked):
    seen = 0
    for frame in frames(walked):
        (person,) = (v for v in frame["views"]["front"] if "keypoints_2d" in v)
        path = walked / "labels/0000/instance/front" / f"{frame['index']:06d}.png"
        instance = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        for u, v, flag in person["keypoints_2d"]:
            if flag == VISIBLE:
                assert instance[int(v), int(u)] == person["instance_id"]
                seen += 1
    assert seen >= 3 * 8


def test_keypoints_on_the_far_side_are_hidden(walked):
    hidden = {
        name
        for frame in frames(walked)
        for view in frame["views"]["front"]
        for name, (_, _, flag) in zip(KEYPOINTS, view.get("keypoints_2d", ()), strict=False)
        if flag == HIDDEN
    }
    assert hidden
    assert hidden != set(KEYPOINTS)


def test_pycocotools_gives_keypoints_used_as_detections_a_perfect_score(walked):
    coco = pytest.importorskip("pycocotools.coco", exc_type=ImportError)
    evaluation = pytest.importorskip("pycocotools.cocoeval", exc_type=ImportError)
    truth = coco.COCO(str(walked / "coco/annotations/person_keypoints_train.json"))
    rows = truth.dataset["annotations"]
    assert len(rows) == 3
    assert truth.dataset["categories"][0]["keypoints"] == list(KEYPOINTS)
    fields = ("image_id", "category_id", "keypoints")
    found = truth.loadRes([{**{k: row[k] for k in fields}, "score": 1.0} for row in rows])
    run = evaluation.COCOeval(truth, found, "keypoints")
    run.evaluate()
    run.accumulate()
    run.summarize()
    assert run.stats[0] == 1.0


def test_no_keypoint_file_is_written_without_people(exported):
    assert not list((exported / "coco/annotations").glob("person_keypoints_*"))
