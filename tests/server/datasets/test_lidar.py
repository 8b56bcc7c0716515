"""Labelled LiDAR points: every return has its object and its time."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from real2sim_proto.conventions import GROUND, SEMANTIC_CLASSES
from real2sim_server.datasets.drive import SweepTargets
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.labels import points_in_boxes
from real2sim_server.datasets.labels.points import ROOF
from real2sim_server.datasets.plan import ExportPlan, planned_lidar
from real2sim_server.demo.street import SHIPPED
from real2sim_server.render import Instance
from real2sim_server.scene.io import read_packed
from real2sim_server.synthetic import SyntheticConfig, generate_log

from .lidar_truth import judged_share
from .test_export import recorded_episode

SMALL = {
    "name": "small",
    "beams": {"kind": "spinning", "elevation_deg": [-12, -8, -4, -1], "columns": 180},
    "range_m": [0.5, 80.0],
    "returns": 2,
    "detection": {"range_m": 80.0, "reflectivity": 0.02},
}
PLAN = ExportPlan(
    formats=("labels", "nuscenes", "kitti"),
    cameras=("front",),
    period_us=500_000,
    end_us=500_000,
    flow=False,
    lidar=SMALL,
)


@pytest.fixture(scope="module")
def exported(tiny_drive, tmp_path_factory):
    return export_dataset(tiny_drive, PLAN, tmp_path_factory.mktemp("lidar") / "out")


def points(exported, frame: int = 0):
    return np.load(exported / f"labels/0000/points/{frame:06d}.npy")


def objects(exported, frame: int = 0):
    return json.loads((exported / "labels/0000/labels.json").read_text())["frames"][frame][
        "objects"
    ]


def test_points_have_object_class_velocity_and_time(exported):
    rows = points(exported)
    assert set(np.unique(rows["beam"])) <= {0, 1, 2, 3}
    assert rows["time_us"].min() < 0 < rows["time_us"].max()
    assert (np.abs(rows["time_us"]) <= 50_000).all()
    assert (rows["semantic"] == GROUND).mean() > 0.1
    for subject in objects(exported):
        own = rows[rows["instance"] == subject["instance_id"]]
        if subject["category"] == "car" and len(own):
            assert (own["semantic"] == SEMANTIC_CLASSES["car"]).all()
            np.testing.assert_allclose(own["velocity"].mean(0), subject["velocity_ego"], atol=0.05)


def test_points_of_an_object_lie_in_its_box(exported):
    rows = points(exported)
    counted = 0
    for subject in objects(exported):
        own = rows["xyz"][rows["instance"] == subject["instance_id"]]
        pose, size = np.array(subject["T_ego_object"]), np.array(subject["size"])
        # Moved by up to half a sweep, and bloated Gaussians reach out of the box.
        slack = np.linalg.norm(subject["velocity"]) * 0.05 + 0.25
        assert points_in_boxes(own, [pose], [size + 2 * slack]) == [len(own)]
        counted += len(own)
        all_in = points_in_boxes(rows["xyz"], [pose], [size])
        assert [subject["points"]] == all_in
    assert counted > 10


def test_nuscenes_has_a_class_and_a_panoptic_label_for_every_point(exported):
    folder = exported / "nuscenes" / "v1.0-real2sim"
    tables = {p.stem: json.loads(p.read_text()) for p in folder.glob("*.json")}
    index = {row["name"]: row["index"] for row in tables["category"]}
    data = {row["token"]: row for row in tables["sample_data"]}
    for frame, (one, two) in enumerate(zip(tables["lidarseg"], tables["panoptic"], strict=True)):
        rows = points(exported, frame)
        classes = np.fromfile(exported / "nuscenes" / one["filename"], np.uint8)
        with np.load(exported / "nuscenes" / two["filename"]) as file:
            panoptic = file["data"]
        scan = exported / "nuscenes" / data[one["sample_data_token"]]["filename"]
        assert len(classes) == len(rows) == scan.stat().st_size // 20
        assert (panoptic // 1000 == classes).all()
        assert (panoptic % 1000 == rows["instance"]).all()
        cars = np.isin(
            rows["instance"],
            [o["instance_id"] for o in objects(exported) if o["category"] == "car"],
        )
        assert (classes[cars] == index["vehicle.car"]).all()
        assert (classes[rows["semantic"] == GROUND] == index["flat.driveable_surface"]).all()


def test_sweeps_follow_the_motion_in_an_episode(tiny_scene, tmp_path):
    drive = recorded_episode(tiny_scene, tmp_path)
    lidar = planned_lidar(PLAN)
    met: SweepTargets = drive.sweep_at(lidar, 200_000)
    recorded = drive.scene.ego.transform(200_000)
    middle = len(met.T_world_lidar) // 2
    np.testing.assert_allclose(met.T_world_lidar[middle][:3, 3] - recorded[:3, 3], ROOF, atol=0.03)
    speed = np.linalg.norm(met.T_world_lidar[-1][:3, 3] - met.T_world_lidar[0][:3, 3]) / 0.1
    assert speed == pytest.approx(5.0, rel=0.02)


def test_sweeps_of_an_episode_contain_fragments(tiny_scene, tmp_path):
    drive = recorded_episode(tiny_scene, tmp_path)
    lamp = Instance(tiny_scene.object("car_blue").cloud)
    broken = SimpleNamespace(has_impacts=False, fragments=lambda t_us: [lamp])
    drive.worlds[-1].deformation = broken
    targets = drive.sweep_at(planned_lidar(PLAN), drive.span[1]).scene
    assert targets.instances[-1] is lamp
    assert targets.poses[-1] is None


def truth_of(columns: int):
    """The demo street, its sensor with that many columns, and its rays."""
    scene = read_packed(SHIPPED)
    values = {
        **SMALL,
        "returns": 1,
        "beams": {
            "kind": "spinning",
            "elevation_deg": np.linspace(-18, 1, 24).tolist(),
            "columns": columns,
        },
    }
    log = generate_log(SyntheticConfig.from_values(scene.provenance["config"]))
    return scene, log, planned_lidar(replace(PLAN, lidar=values))


def test_point_labels_agree_with_rays_away_from_edges():
    share, judged = judged_share(*truth_of(512), [10])
    assert judged > 3000
    assert share > 0.99


@pytest.mark.slow
def test_point_labels_of_the_whole_drive_agree_with_rays():
    share, judged = judged_share(*truth_of(1024), range(1, 54, 6))
    print(share, judged)
    assert judged > 50_000
    assert share > 0.99
