"""Labels of the demo street compared with rays; the figures are in docs/datasets.md."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from real2sim_server.datasets.drive import ScenarioDrive
from real2sim_server.datasets.labels import draw_moment
from real2sim_server.demo.street import SHIPPED
from real2sim_server.edit import ScenarioState
from real2sim_server.logs import open_log
from real2sim_server.reconstruct import ReconstructOptions, reconstruct
from real2sim_server.reconstruct.training.schedule import at_width, preset
from real2sim_server.scene import Scene
from real2sim_server.scene.io import load_scene, read_packed

from .ray_cast_truth import measure


@pytest.fixture(scope="module")
def street() -> Scene:
    return read_packed(SHIPPED)


def test_labels_of_a_frame_agree_with_rays(street):
    found = measure(street, [10], ["front"], width=200).summary()
    assert found["objects"] >= 3
    assert found["mask_iou"] > 0.85
    assert found["box_iou"] > 0.8
    assert found["visibility_error"] < 0.05
    assert found["depth_median"] < 0.2
    assert found["flow_median"] < 0.3


@pytest.mark.slow
def test_labels_of_the_whole_drive_agree_with_rays(street):
    found = measure(street, range(1, 54, 4), street.rig.names).summary()
    print(found)
    assert found["mask_iou"] > 0.95
    assert found["mask_iou_by_pixels"] > 0.965
    assert found["box_iou"] > 0.95
    assert found["box_iou_p10"] > 0.9
    assert found["visibility_error"] < 0.05
    assert found["depth_median"] < 0.045
    assert found["flow_median"] < 0.3
    assert found["flow_outliers"] < 0.035


@pytest.mark.slow
def test_masks_of_real_trucks_agree_with_outlines(test_data, tmp_path):
    folder = test_data / "kitti_jam"
    if not folder.is_dir():
        pytest.skip(f"no real log at {folder}")
    drawn = json.loads(Path(__file__).with_name("jam_outlines.json").read_text())
    training = at_width(preset("cpu-small", iterations=1200), 621)
    log, options = open_log(folder), ReconstructOptions(training=training)
    reconstruct(log, tmp_path / "jam.r2s", options)
    scene = load_scene(tmp_path / "jam.r2s")
    moment = ScenarioDrive(scene, ScenarioState.of(scene)).at(
        int(log.frame_times_us[drawn["frame"]])
    )
    (images,) = draw_moment(scene, moment, [scene.rig[drawn["camera"]]])
    ious = {}
    for name, lines in drawn["outlines"].items():
        true = np.zeros(images.instance.shape, np.uint8)
        cv2.fillPoly(true, [np.array(lines["outline"])], 1)
        for hole in lines["holes"]:
            cv2.fillPoly(true, [np.array(hole)], 0)
        mask = images.instance == scene.instance_id(name)
        ious[name] = float((mask & (true > 0)).sum() / (mask | (true > 0)).sum())
    print(ious)
    assert ious["truck_3"] > 0.94
    assert ious["truck_2"] > 0.92
