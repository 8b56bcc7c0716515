"""Labels of the demo street compared with rays; the figures are in docs/datasets.md."""

from __future__ import annotations

import pytest

from real2sim_server.demo.street import SHIPPED
from real2sim_server.scene import Scene
from real2sim_server.scene.io import read_packed

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
